"""A differentiable skeleton model of the trachea for parameter identification.

Forward: `press(geometry, material, s_c, displacement, options)`. Identification from Python:
`jaxtrachea.fit`; from the command line: `jaxtrachea check SPEC`, `jaxtrachea fit SPEC`.
Whole scenes, from the tool's pose to the deformed surface: `make_scene`, `simulate`, `sweep`.
Units: mm, N, MPa, rad. The package never changes JAX's configuration; fits want float64
(`jax.config.update("jax_enable_x64", True)`).

Names are loaded when they are first used, so that the command line answers before JAX is imported.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxtrachea.mechanics.beam import Beam as Beam
    from jaxtrachea.mechanics.beam import contact_compliance as contact_compliance
    from jaxtrachea.mechanics.beam import deflect as deflect
    from jaxtrachea.mechanics.force_law import Law as Law
    from jaxtrachea.mechanics.force_law import duffing as duffing
    from jaxtrachea.mechanics.oblique import ObliquePath as ObliquePath
    from jaxtrachea.mechanics.oblique import ObliquePress as ObliquePress
    from jaxtrachea.mechanics.oblique import press_oblique as press_oblique
    from jaxtrachea.mechanics.oblique import press_path as press_path
    from jaxtrachea.mechanics.press import Options as Options
    from jaxtrachea.mechanics.press import Press as Press
    from jaxtrachea.mechanics.press import press as press
    from jaxtrachea.mechanics.skeleton import Skeleton as Skeleton
    from jaxtrachea.mechanics.skeleton import skeleton_response as skeleton_response
    from jaxtrachea.prediction.predict import CurvePrediction as CurvePrediction
    from jaxtrachea.prediction.predict import predict as predict
    from jaxtrachea.results.stored import NoResults as NoResults
    from jaxtrachea.results.stored import StoredFit as StoredFit
    from jaxtrachea.results.stored import read_results as read_results
    from jaxtrachea.scene.assemble import make_scene as make_scene
    from jaxtrachea.scene.assemble import with_geometry as with_geometry
    from jaxtrachea.scene.declare import PlanError as PlanError
    from jaxtrachea.scene.effects import EffectOptions as EffectOptions
    from jaxtrachea.scene.plan import Plan as Plan
    from jaxtrachea.scene.session import Session as Session
    from jaxtrachea.scene.simulation import Simulation as Simulation
    from jaxtrachea.scene.simulation import simulate as simulate
    from jaxtrachea.scene.stage import Poses as Poses
    from jaxtrachea.scene.stage import Presses as Presses
    from jaxtrachea.scene.stage import Scene as Scene
    from jaxtrachea.scene.sweep import sweep as sweep
    from jaxtrachea.status import FitStatus as FitStatus
    from jaxtrachea.status import PredictionStatus as PredictionStatus
    from jaxtrachea.status import PressStatus as PressStatus
    from jaxtrachea.trachea.geometry import Geometry as Geometry
    from jaxtrachea.trachea.geometry import table_1 as table_1
    from jaxtrachea.trachea.material import Material as Material

__version__ = "0.1.0"

_HOME = {
    "prediction.predict": ("CurvePrediction", "predict"),
    "results.stored": ("NoResults", "StoredFit", "read_results"),
    "mechanics.beam": ("Beam", "contact_compliance", "deflect"),
    "mechanics.force_law": ("Law", "duffing"),
    "mechanics.press": ("Options", "Press", "press"),
    "mechanics.oblique": ("ObliquePath", "ObliquePress", "press_oblique", "press_path"),
    "scene.assemble": ("make_scene", "with_geometry"),
    "scene.declare": ("PlanError",),
    "scene.effects": ("EffectOptions",),
    "scene.plan": ("Plan",),
    "scene.session": ("Session",),
    "scene.simulation": ("Simulation", "simulate"),
    "scene.stage": ("Poses", "Presses", "Scene"),
    "scene.sweep": ("sweep",),
    "mechanics.skeleton": ("Skeleton", "skeleton_response"),
    "status": ("FitStatus", "PredictionStatus", "PressStatus"),
    "trachea.geometry": ("Geometry", "table_1"),
    "trachea.material": ("Material",),
}
_MODULE = {name: module for module, names in _HOME.items() for name in names}


def __getattr__(name: str):
    """Load a public name on first use."""
    if name not in _MODULE:
        raise AttributeError(f"module 'jaxtrachea' has no attribute {name!r}")
    value = getattr(import_module(f"jaxtrachea.{_MODULE[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names."""
    return sorted([*_MODULE, "__version__"])
