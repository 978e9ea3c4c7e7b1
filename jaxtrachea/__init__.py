"""A differentiable skeleton model of the trachea for parameter identification.

Forward: `press(geometry, material, s_c, displacement, options)`. Identification from Python:
`jaxtrachea.fit`; from the command line: `jaxtrachea check SPEC`, `jaxtrachea fit SPEC`.
Whole scenes, from the tool's pose to the deformed surface: `make_scene`, `simulate`, `sweep`.
Units: mm, N, MPa, rad. The package never changes JAX's configuration; fits want float64
(`jax.config.update("jax_enable_x64", True)`).

The names stand in `__init__.pyi`. They are loaded when they are first used, so that the command
line answers before JAX is imported.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = "0.2.0"
