"""Products of float32 matrices are in float32 on a GPU too, where TF32 (10 bits) is the default.

Read in the programs that are made for a GPU; none is run, so none need be at hand.
"""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea import (
    Curve,
    Material,
    Options,
    Poses,
    build_study,
    make_scene,
    table_1,
)
from jaxtrachea.contact.shapes import sphere
from jaxtrachea.fitting.cost import evaluate
from jaxtrachea.fitting.information import information
from jaxtrachea.mechanics.sections.material import from_wall
from jaxtrachea.mechanics.sections.press import SectionOptions, press_sections
from jaxtrachea.scene import step
from jaxtrachea.scene.simulation import surface
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.tube import make_tube

PRODUCT = re.compile(r"stablehlo\.dot_general.*")
IN_FULL = "precision = [HIGHEST, HIGHEST]"


def products(f, *inputs) -> list[str]:
    """Those of a program as made for a GPU."""
    lowered = jax.jit(f).trace(*inputs).lower(lowering_platforms=("cuda",))
    return [v for v in PRODUCT.findall(lowered.as_text()) if "xf32>" in v]


def number(v):
    return jnp.asarray(v, jnp.float32)


SHORT = Geometry(*map(number, (30.0, [10.0, 20.0], 11.7, 2.0, 4.0)))
VALUES = {"EI_L": 1.86, "k_M": 0.1, "k_1": 0.3, "k_3": 0.02, "EA_L": 5.0, "EI_C": 100.0}
VALUES |= {"k_t": 2.0, "k_A": 1.0, "k_B": 1.0, "GA_L": 7.0}
MATERIAL = Material(**{name: number(v) for name, v in VALUES.items()})
PATH = number(np.linspace(0.2, 1, 3))


def sections(phi):
    wall = from_wall(SHORT)

    def force(s):
        return press_sections(
            SHORT, wall, s, phi, PATH, options=SectionOptions(midline=phi == 0)
        ).force

    return force


def poses(s):
    return Poses(jnp.eye(3, dtype=jnp.float32)[None], jnp.stack([s, s * 0 + 15.6, s * 0])[None])


@functools.cache
def scene():
    """A ball at the trachea of Table 1, with its surface and joints."""
    geometry = table_1(jnp.float32)
    mesh, ball = make_tube(geometry), sphere(number(5.0))
    return make_scene(geometry, MATERIAL, poses(number(73.0)), tool=ball, mesh=mesh)


def stepped(s):
    path = poses(s)
    here = path.rotation[0], path.translation[0]
    state = step._start(scene(), None)
    _, found, press = step.move_tool(scene(), MATERIAL, state, *here)
    return found.force, surface(scene(), *press), found.joints


def fit(theta):
    """Normal equations and information of a fit of a curve."""
    depth = np.linspace(0.1, 3, 5)
    curve = Curve("a", "1", 13.0, 0.0, depth, 0.2 * depth)
    study = build_study([curve], SHORT, Options(), {"k_1": {"fixed": False}})

    def cast(v):
        return jnp.asarray(v[0] if v.dtype == np.int32 else v[0].astype(np.float32))

    lane, unknowns = jax.tree.map(cast, study.lanes), theta + jnp.zeros(study.size, theta.dtype)
    given = study.model, unknowns, lane, number([1.0, 1.0])
    return evaluate(*given).hessian, information(*given).bread


CASES = [
    pytest.param(sections(1.5), id="sections, off the midline", marks=pytest.mark.slow),
    pytest.param(stepped, id="session", marks=pytest.mark.slow),
    pytest.param(fit, id="fit"),
]


@pytest.mark.long
@pytest.mark.parametrize("f", CASES)
def test_products_of_a_value_and_its_gradient(f):
    def total(s):
        return sum(jnp.sum(v) for v in jax.tree.leaves(f(s)))

    if f is stepped:
        scene()  # made outside of the programs
    found = products(jax.grad(jax.jit(total)), number(13.0)) + products(f, number(13.0))
    assert found
    wrong = [v for v in found if IN_FULL not in v]
    assert not wrong, f"{len(wrong)} of {len(found)}: {wrong[:5]}"
