"""A flat punch on deforming cross-sections: both its edges move alike.

Its limit of rigid rings, against the line of joints: test_press.py.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea.mechanics.sections.material import SectionMaterial
from jaxtrachea.mechanics.sections.press import SectionOptions, press_sections
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry

from .test_press import VALUES

pytestmark = [pytest.mark.compiling, pytest.mark.slow]
TUBE = Geometry.create(50.0, [10.0, 20.0, 30.0, 40.0], radius=11.7)
HALF, DEEP = 2.4, 4.0
POINTS, WEIGHTS = np.polynomial.legendre.leggauss(8)
PATH = jnp.asarray(np.append(DEEP / 2 * (POINTS + 1), DEEP))
#: In one span, in two spans, its mirror image; on both ends of the tube, and beyond them.
PLACES = jnp.asarray([25.0, 21.0, 21.0, 2.5, 47.5, 2.3, 47.7])
ANGLES = jnp.asarray([0.0, 0.9, -0.9, 0.3, 0.3, 0.0, 0.0])
QUICK = {"xla_backend_optimization_level": 0}


@functools.cache
def pressed():
    def one(s_c, phi_c):
        edges = jnp.stack([s_c - HALF, s_c + HALF])
        asked = TUBE, SectionMaterial(**VALUES), s_c, phi_c, PATH
        return press_sections(*asked, places=edges, options=SectionOptions(half_width=HALF))

    got = jax.jit(jax.vmap(one), compiler_options=QUICK)(PLACES, ANGLES)
    return jax.tree.map(np.asarray, got)


def test_statuses():
    """All of it has to lie on the tube."""
    status = [PressStatus.OK] * 5 + [PressStatus.OFF_TUBE] * 2
    np.testing.assert_array_equal(pressed().status, np.array(status)[:, None] + np.zeros(9, int))
    assert np.isnan(pressed().force[5:]).all()
    assert np.isfinite(pressed().force[:5]).all()
    with pytest.raises(ValueError, match="half_width is -1.0; expected a finite number, 0 or more"):
        press_sections(
            TUBE,
            SectionMaterial(**VALUES),
            25.0,
            0.0,
            PATH,
            options=SectionOptions(half_width=-1.0),
        )


def test_work_and_mirror_image():
    """What is stored is the work of the tool; the two sides are alike."""
    got, phi = pressed(), ANGLES[:3]
    inward = np.stack([-np.cos(phi), -np.sin(phi)], 1)
    push = np.einsum("lnc,lc->ln", got.force[:3, :, 1:], inward)
    np.testing.assert_allclose(got.energy[:3, -1], DEEP / 2 * push[:, :-1] @ WEIGHTS, rtol=1e-6)
    np.testing.assert_allclose(got.force[2], got.force[1] * [1, 1, -1], rtol=1e-8, atol=1e-10)
    assert got.imbalance[:5].max() < 1e-9


def test_the_wall_at_both_edges_is_where_the_tool_holds_it():
    """Alike, in the middle of the tube: own deflections of both forces on top of the rings'."""
    along = jax.tree.map(lambda v: v[0], pressed().along)
    total = along.carried + along.own
    np.testing.assert_allclose(total[:, 0], total[:, 1], rtol=1e-8, atol=1e-10)
    assert np.abs(along.own[:, 0]).max() > 0.01
