"""Hard cases of the whole press that the table (jaxtrachea.selfcheck) does not hold.

200 rings with all their joints, and the softest ligament in float32, where only gradients of forces
stay finite. All others, with truth, are rows of the table: tests/test_selfcheck.py.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material

DTYPES = ["float32", "float64"]
LENGTH = 100.0
D = np.array([0.0, 0.3, 2.0])
BASE = {"EI_L": 1.862, "k_M": 0.1, "k_1": 0.3, "k_3": 0.02, "s": 42.0}

#: name: (changes, number of rings, expected status of the two presses that touch)
CASES = {
    "200 rings": ({}, 200, PressStatus.OK),
    "200 rigid rings": ({"k_M": 1e9}, 200, PressStatus.OK),
    "past the fold": ({"k_3": -1e4}, 9, PressStatus.PAST_FOLD),
    "soft ligament": ({"EI_L": 1e-9}, 9, PressStatus.OK),
}


def _press(v, rings):
    dtype = v["s"].dtype
    x = np.asarray(LENGTH / (rings + 1) * np.arange(1, rings + 1), dtype)
    g = Geometry(*(jnp.asarray(a, dtype) for a in (LENGTH, x, 11.0, 2.0, 4.0)))
    m = Material(v["EI_L"], v["k_M"], v["k_1"], v["k_3"])
    return press(g, m, v["s"], jnp.asarray(D, dtype), Options())


def _value_and_gradient(v, rings):
    def total(v):
        got = _press(v, rings)
        return jnp.sum(jnp.where(got.status == PressStatus.OK, got.force, 0)), got

    return jax.value_and_grad(total, has_aux=True)(v)


_run = jax.jit(_value_and_gradient, static_argnums=1)


def solved(name, dtype):
    changes, rings, status = CASES[name]
    v = {n: jnp.asarray(a, dtype) for n, a in (BASE | changes).items()}
    (_, got), gradient = _run(v, rings)
    return got, gradient, status


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("name", CASES)
def test_value_and_gradient(name):
    """The right status; where it says OK, finite numbers that add up, and a finite gradient."""
    got, gradient, status = solved(name, "float64")
    np.testing.assert_array_equal(got.status[1:], status)
    if status != PressStatus.OK:
        assert np.all(np.isnan(got.force[1:]))
        return
    assert got.status[0] == PressStatus.NO_CONTACT
    assert got.force[0] == 0
    assert all(np.all(np.isfinite(v)) for v in got)
    assert got.force[2] > got.force[1] > 0
    np.testing.assert_allclose(got.depth + got.skeleton, D, rtol=1e-10)
    assert all(np.isfinite(v) for v in gradient.values())


@pytest.mark.long
def test_float32_agrees_with_float64():
    one, two = (solved("200 rings", dtype)[0] for dtype in DTYPES)
    np.testing.assert_allclose(one.force, two.force, rtol=2e-5)
    np.testing.assert_allclose(one.compliance, two.compliance, rtol=2e-5)
    peak = float(jnp.max(jnp.abs(two.reactions)))
    np.testing.assert_allclose(one.reactions, two.reactions, atol=3e-5 * peak, rtol=0)


@pytest.mark.long
def test_bad_rows_do_not_touch_their_neighbours():
    """NaN and folded specimens in a batch are flagged; the good ones keep every bit."""
    rows = [{}, {"EI_L": np.nan}, {"s": 40.0}, {"k_3": -1e4}]

    def stack(rows):
        return {n: jnp.asarray([(BASE | r)[n] for r in rows], "float64") for n in BASE}

    run = jax.jit(jax.vmap(lambda v: _value_and_gradient(v, 9)))
    (_, mixed), gradients = run(stack(rows))
    (_, clean), others = run(stack([rows[0], {}, rows[2], {}]))
    keep = jnp.asarray([0, 2])
    for p, q in zip(mixed, clean, strict=True):
        np.testing.assert_array_equal(p[keep], q[keep])
    for n in BASE:
        np.testing.assert_array_equal(gradients[n][keep], others[n][keep])
    np.testing.assert_array_equal(
        mixed.status[:, 2],
        [PressStatus.OK, PressStatus.NON_FINITE, PressStatus.OK, PressStatus.PAST_FOLD],
    )
