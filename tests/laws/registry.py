"""Public functions of the mechanics, each a row: what it computes, from what, what it refuses.

A row is a function of a dictionary of numbers and arrays. The contracts over all rows are in
test_contracts.py; a new public function gets them by a row here.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea.contact.distance import signed_distance
from jaxtrachea.contact.pose import pose_from_vector
from jaxtrachea.contact.shapes import box, sphere
from jaxtrachea.mechanics.axial import stretch
from jaxtrachea.mechanics.beam import Beam, contact_compliance, deflect
from jaxtrachea.mechanics.equilibrium import press_series, press_total
from jaxtrachea.mechanics.force_law import Law, duffing, ring_weight
from jaxtrachea.mechanics.friction import Coulomb
from jaxtrachea.mechanics.oblique import press_oblique, press_path
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.mechanics.press_contacts import press_contacts
from jaxtrachea.mechanics.press_contacts_oblique import press_contacts_oblique
from jaxtrachea.mechanics.skeleton import skeleton_response
from jaxtrachea.mechanics.vector_equilibrium import press_vector
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material

RINGS = np.array([10.0, 20.0, 30.0, 42.0, 50.0])


class Row(NamedTuple):
    """One public function.

    Attributes:
        call: the function, from a dictionary of arrays to a tuple of arrays of floats.
        inputs: an example, in float64.
        bad: changes of the inputs that leave this row of a batch without a number.
        refused: calls of the function with a wrong argument, and what their message says. Words
            of options are refused in test_words.py.
        rounding: of float32, as a share of the largest entry of each result.
        differences: relative error of the derivative by differences.
    """

    call: Callable[[Mapping], tuple]
    inputs: dict[str, Any]
    bad: dict[str, Any]
    refused: tuple[tuple[Callable[[Mapping], Any], str], ...]
    rounding: float = 2e-5
    differences: float = 1e-6


BEAM = {"x": RINGS, "length": 61.0, "EI": 1.9 + 0.2 * np.arange(6), "k": np.full(5, 0.1)}
TUBE = {"x": RINGS, "length": 61.0}
VALUES = {"EI_L": 1.9, "k_M": 0.1, "k_1": 0.4, "k_3": 0.02}
RING = {"EA_L": 3.9, "EI_C": 13.0, "k_t": 0.4}


def _beam(v):
    return Beam(v["x"], v["length"], v["EI"], v["k"])


def _deflect(v):
    found = deflect(_beam(v), v["s"], v["force"])
    return found.w_C, found.w, found.theta, found.reaction


def _stretch(v):
    more = {"k_A": v["k_A"], "k_B": v["k_B"]}
    return tuple(stretch(v["x"], v["length"], v["EA"], v["s"], v["force"], **more))


def _law(v):
    return Law(v["k_1"], v["k_3"])


def _series(v, solve=press_series):
    return tuple(solve(v["D"], v["c"], _law(v))[:2])


def _vector(v):
    return tuple(press_vector(v["D"], jnp.diag(v["c"]), _law(v))[:2])


def _tube(v):
    more = (jnp.asarray(n, v["x"].dtype) for n in (11.0, 2.0, 4.0))
    return Geometry(v["length"], v["x"], *more)


def _material(v):
    names = ("EI_L", "k_M", "k_1", "k_3", *RING, "GA_L", "k_1_ring", "e_1", "e_2")
    return Material(**{n: v[n] for n in names if n in v})


def pressed(**options):
    def call(v):
        found = press(_tube(v), _material(v), v["s"], v["D"], Options(**options))
        return found.force, found.depth, found.skeleton, found.joints, found.compliance

    return call


def several(**options):
    def call(v):
        found = press_contacts(_tube(v), _material(v), v["s"], v["D"], Options(**options))
        return found.force, found.depth, found.skeleton, found.joints, found.compliance

    return call


def _pinched(v):
    found = press_contacts_oblique(_tube(v), _material(v), v["s"], v["phi"], v["D"])
    return found.force, found.depth, found.joints, found.loads, found.end_V, found.compliance


def _oblique(v):
    found = press_oblique(_tube(v), _material(v), v["s"], v["phi"], v["D"])
    return found.force, found.depth, found.joints


def _path(v):
    found = press_path(_tube(v), _material(v), v["s"], v["phi"], v["D"], Coulomb(v["mu"]))
    return found.press.force, found.slip


def _skeleton(v):
    found = skeleton_response(_tube(v), _material(v), v["s"], v["phi"])
    return found.compliance, found.loads


def _distance(v):
    shapes = box([2.0, 1.5, 4.0], 0.3), sphere(2.0)
    a, b = jax.tree.map(lambda w: w.astype(v["pose"].dtype), shapes)
    pose = pose_from_vector(v["pose"][:3], v["pose"][3:])
    return (signed_distance(a, b, pose).distance,)


def changed(call, says, **values):
    """Wrong values of the inputs."""
    return (lambda v: call(v | values)), says


NO_TUBE = changed(pressed(), r"s_c has 2 values; expected no axis", s=np.ones(2))
LONG = {"EI_L": np.ones(7)}
SAYS = r"Material.EI_L has 7 values; .* 6 values"

PRESS = TUBE | VALUES | {"s": 26.7, "D": np.array([0.3, 1.1, 2.5])}
OBLIQUE = TUBE | VALUES | RING | {"s": 26.7, "phi": 0.3, "D": np.array([0.1, -1.1, -0.2])}
#: The third is lifted off in the second row.
CONTACTS = PRESS | {
    "s": np.array([26.7, 44.0, 20.0]), "D": np.array([[0.3, 1.1, 2.5], [2.5, 0.6, 0.1]]),
}  # fmt: skip
#: Two share a part of their strips, the third is opposite.
PINCH = CONTACTS | RING | {"phi": np.array([0.1, 0.22, -0.9])}
SOFT = {"k_3": -1e4}
OFF = {"s": 400.0}

ROWS = {
    "contact_compliance": Row(
        lambda v: (contact_compliance(_beam(v), v["s"]),), BEAM | {"s": 26.7}, {"s": np.nan},
        (), differences=3e-6,
    ),
    "deflect": Row(
        _deflect, BEAM | {"s": 26.7, "force": 0.4}, {"force": np.nan},
        (),
    ),
    "stretch": Row(
        _stretch,
        TUBE | {"EA": np.linspace(1, 4, 6), "s": 26.7, "force": 0.4, "k_A": 0.3, "k_B": 9.0},
        {"force": np.nan}, (), differences=1e-7,
    ),
    "duffing": Row(
        lambda v: (duffing(v["d"], _law(v)),),
        {"d": np.array([0.0, 0.3, 1.2]), "k_1": 0.3, "k_3": 0.1}, {"k_1": np.nan}, (),
        differences=1e-7,
    ),
    "ring_weight": Row(
        lambda v: (ring_weight(v["s"], v["x"], v["t"]),), {"s": 27.2, "x": RINGS, "t": 5.0},
        {"s": np.nan}, (), differences=1e-7,
    ),
    "press_series": Row(
        _series, {"D": np.array([0.5, 3.0]), "c": 0.9, "k_1": 0.4, "k_3": 0.02}, SOFT, (),
    ),
    "press_total": Row(
        lambda v: _series(v, press_total),
        {"D": np.array([0.5, 3.0]), "c": 0.9, "k_1": 0.4, "k_3": 0.02}, {"k_1": np.nan}, (),
    ),
    "press_vector": Row(
        _vector, {"D": np.array([0.5, -1.0, 0.2]), "c": np.array([0.2, 0.9, 0.5]), "k_1": 0.4,
                  "k_3": 0.02}, {"D": np.full(3, np.nan)}, (),
    ),
    "press": Row(
        pressed(), PRESS, OFF,
        (NO_TUBE, changed(pressed(), SAYS, **LONG),
         changed(pressed(), r"displacement is '2 mm'; expected a number", D="2 mm")),
    ),
    "press, two materials": Row(
        pressed(contact="bonded", local="two-material", shear=True, half_width=2.0),
        PRESS | {"GA_L": 1.3, "k_1_ring": 0.9}, {"k_M": -0.1}, (),
    ),
    "press, softening": Row(
        pressed(skeleton="softening"), PRESS | {"e_1": 0.1, "e_2": 0.002}, {"k_1": np.inf}, (),
    ),
    "press_contacts": Row(
        several(), CONTACTS, {"s": np.array([26.7, 400.0, 20.0])},
        (changed(several(), r"displacement has 2 values; expected shape", D=np.ones(2)),),
    ),
    "press_contacts_oblique": Row(
        _pinched, PINCH, {"phi": np.array([0.1, 2.2, -0.9])},
        (changed(_pinched, r"phi_c has 2 values; expected 3 values", phi=np.ones(2)),),
    ),
    "press_oblique": Row(
        _oblique, OBLIQUE, OFF,
        (changed(_oblique, SAYS, **LONG),),
    ),
    "press_path": Row(
        _path, OBLIQUE | {"D": np.array([[0.1, -1.0, -0.2], [0.9, -1.1, -0.2]]), "mu": 0.3},
        {"mu": -0.1}, (changed(_path, SAYS, **LONG),), rounding=1e-4,
    ),
    "skeleton_response": Row(
        _skeleton, OBLIQUE, {"k_M": -0.1},
        (changed(_skeleton, SAYS, **LONG),),
    ),
    "signed_distance": Row(
        _distance, {"pose": np.array([0.1, 0.2, 0.3, 8.0, 1.0, 1.0])},
        {"pose": np.full(6, np.nan)}, (),
    ),
}  # fmt: skip
#: Long to compile, of a kind that another row is of too.
SLOW = (
    "press_path",
    "skeleton_response",
    "press, softening",
    "press, two materials",
    "press_contacts_oblique",
)
#: A path has an oblique press in it.
EACH = [
    pytest.param(n, marks=pytest.mark.slow if n in SLOW else ())
    for n in ROWS
    if n != "press_oblique"
]
