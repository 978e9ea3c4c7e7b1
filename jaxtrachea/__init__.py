"""A differentiable skeleton model of the trachea for parameter identification.

Forward: `press(geometry, material, s_c, displacement, options)`. Identification from Python:
`jaxtrachea.identify`; from the command line: `jaxtrachea check SPEC`, `jaxtrachea fit SPEC`.
Units: mm, N, MPa, rad. The package never changes JAX's configuration; fits want float64
(`jax.config.update("jax_enable_x64", True)`).
"""

from jaxtrachea.mechanics.beam import Beam as Beam
from jaxtrachea.mechanics.beam import contact_compliance as contact_compliance
from jaxtrachea.mechanics.beam import deflect as deflect
from jaxtrachea.mechanics.force_law import Law as Law
from jaxtrachea.mechanics.force_law import duffing as duffing
from jaxtrachea.model import Options as Options
from jaxtrachea.model import Press as Press
from jaxtrachea.model import press as press
from jaxtrachea.status import FitStatus as FitStatus
from jaxtrachea.status import PressStatus as PressStatus
from jaxtrachea.trachea.geometry import Geometry as Geometry
from jaxtrachea.trachea.geometry import table_1 as table_1
from jaxtrachea.trachea.material import Material as Material

__version__ = "0.1.0"
