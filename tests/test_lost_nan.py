"""A NaN among many: XLA for CPUs drops it from a maximum of 4,096 entries and more.

Rows and lanes count together; one that comes last is kept. A NaN that was
computed (0 / 0) has another sign than `jnp.nan`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea._numerics import largest
from jaxtrachea.contact.shapes import sphere
from jaxtrachea.fitting import descent
from jaxtrachea.fusion import fuse
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.sections import solve
from jaxtrachea.mechanics.sections.system import System
from jaxtrachea.mechanics.vector_equilibrium import press_vector
from jaxtrachea.prediction.core import _unseen
from jaxtrachea.scene import trail
from jaxtrachea.scene.stage import Poses
from jaxtrachea.status import FitStatus, PressStatus


@jax.jit
def computed(x):
    """0 / 0, as the processor makes it: not the bits of `jnp.nan`."""
    return x * 0 / (x * 0)


@pytest.mark.parametrize("shape", [(4096,), (4101,), (512, 9), (64, 130)])
def test_the_largest_of_many_is_no_number(shape):
    """One computed NaN at each of three places: its row is NaN, and the others are as by numpy."""
    x = np.random.default_rng(1).normal(size=shape).astype("float64")
    nan = np.asarray(computed(1.0))
    found = jax.jit(largest)
    np.testing.assert_array_equal(found(x), x.max(axis=-1))
    for at in (0, x.size // 2, x.size - 1):
        bad = x.copy()
        bad.flat[at] = nan
        np.testing.assert_array_equal(found(bad), bad.max(axis=-1))


@pytest.mark.parametrize("lanes", [1, 200])
def test_the_largest_in_one_kernel(lanes):
    """Alone it is part of the kernel, and lanes of it, taken twice, keep a NaN as well."""
    x = np.random.default_rng(2).normal(size=(lanes, 3, 20))
    found = jax.jit(jax.vmap(jax.vmap(fuse(lambda x: largest(2 * x)))))
    np.testing.assert_array_equal(found(x), 2 * x.max(axis=-1))
    x[lanes // 2, 1, 4] = np.nan
    np.testing.assert_array_equal(found(x), 2 * x.max(axis=-1))


def test_the_derivative_of_the_largest():
    """Of one entry alone; equal ones share it."""
    x = np.r_[np.zeros(20), 3.0, np.ones(19)]
    moved = np.random.default_rng(3).normal(size=40)
    assert float(jax.jit(lambda x, t: jax.jvp(largest, (x,), (t,))[1])(x, moved)) == moved[20]
    slope = jax.jit(jax.grad(largest))
    np.testing.assert_array_equal(slope(x), np.arange(40) == 20)
    assert np.asarray(slope(np.ones(40))).sum() == pytest.approx(1, abs=1e-15)


def test_a_press_by_what_is_no_number():
    """1,400 presses of three components: each whose way is NaN along x is NON_FINITE, not free."""
    ways, law = np.zeros((1400, 3)), Law(jnp.asarray(1.0), jnp.asarray(1.0))
    ways[:, 0] = np.where(np.arange(1400) % 2, np.asarray(computed(1.0)), 0)
    run = jax.jit(jax.vmap(lambda D: press_vector(D, jnp.eye(3), law)))
    found = jax.device_get(run(ways))
    bad = np.isnan(ways[:, 0])
    np.testing.assert_array_equal(found.status[bad], PressStatus.NON_FINITE)
    np.testing.assert_array_equal(np.isnan(found.force).any(axis=1), bad)
    np.testing.assert_array_equal(found.status[~bad], PressStatus.NO_CONTACT)


class _Shape(NamedTuple):
    radius: jax.Array


class _Place(NamedTuple):
    own: np.ndarray


def test_newtons_method_on_sections_accepts_no_state_that_is_no_number(monkeypatch):
    """512 lanes of 12 unknowns, of which the sixth is NaN after a step (in every other lane)."""
    lanes, unknowns, rest = 512, 12, jnp.zeros(())
    parts = dict.fromkeys(System._fields) | {
        "scale": np.zeros((1, 1, 8)), "give": np.zeros(2),
        "shape": _Shape(radius=jnp.asarray(10.0)), "place": _Place(own=np.zeros((1, 2))),
    }  # fmt: skip
    system = System(**parts)  # pyright: ignore

    def newton(z, displacement, _):
        step = jnp.zeros_like(z).at[5].set(jnp.where(displacement > 1, computed(displacement), 0))
        return step, jnp.zeros_like(z), jnp.asarray(True)

    monkeypatch.setattr(solve, "_newton", newton)
    begin = solve._Way(
        known=jnp.zeros((4, unknowns)), z=jnp.zeros(unknowns),
        converging=jnp.stack([rest, rest + jnp.inf]),
        places=jnp.stack([rest, rest, rest, rest + 1.5]), steps=jnp.zeros(2, jnp.int32),
        lost=jnp.asarray(False), stable=jnp.asarray(True),
    )  # fmt: skip
    target = np.where(np.arange(lanes) % 2 == 1, 1.2, 0.8)

    def one(target):
        way = begin._replace(places=begin.places.at[solve.TRIED].set(target))
        return solve._advance(way, target, system).places[solve.AT]

    at = jax.jit(jax.vmap(one))(target)
    np.testing.assert_array_equal(at, np.where(target > 1, 0, target))


class _Lane(NamedTuple):
    lower: jax.Array
    upper: jax.Array
    active: jax.Array


class _Point(NamedTuple):
    cost: jax.Array
    gradient: jax.Array
    hessian: jax.Array


@pytest.mark.parametrize("lost", ["gradient", "hessian", ""])
def test_a_descent_that_ends_without_derivatives_has_not_converged(monkeypatch, lost):
    """The cost is a number where it ends, its Jacobian none: of 600 lanes with 8 unknowns."""
    box = _Lane(jnp.full(8, -9.0), jnp.full(8, 9.0), jnp.ones(8))

    def evaluate(model, theta, lane, sigma):
        point = _Point(jnp.sum(theta**2) / 2 + 1, theta, jnp.eye(8))
        if lost:
            value = getattr(point, lost)
            bad = value.at[0].set(computed(value[0]))
            point = point._replace(**{lost: jnp.where(sigma > 1, bad, value)})
        return point

    monkeypatch.setattr(descent, "evaluate", evaluate)
    monkeypatch.setattr(descent, "cost", lambda model, theta, *_: jnp.sum(theta**2) / 2 + 1)
    monkeypatch.setattr(descent, "rounding_cost", lambda *_: 0.0)
    sigma = np.arange(600.0) % 3
    how = descent.Descent("adam", descent.Tolerances(cost=1e-4))

    def one(sigma):
        return descent._descend(None, how, jnp.zeros(8), box, sigma)[2]

    with jax.numpy_dtype_promotion("standard"):  # as `descend` has it, for optax
        status = jax.jit(jax.vmap(one))(sigma)
    bad = FitStatus.NON_FINITE if lost else FitStatus.CONVERGED
    np.testing.assert_array_equal(status, np.where(sigma > 1, bad, FitStatus.CONVERGED))


@pytest.mark.parametrize("rows", [1, 70])
def test_a_vertex_that_is_no_number_scales_no_dent(rows):
    """A ball over a plane, one of 225 vertices NaN: the others are moved as without it."""
    x, z = (v.ravel() for v in np.meshgrid(np.linspace(-3, 3, 15), np.linspace(-3, 3, 15)))
    flat = np.stack([x, 0 * x, z], axis=1)
    dented = flat - np.stack([0 * x, 0.3 * np.exp(-(x * x + z * z)), 0 * x], axis=1)
    ball, at = sphere(5.0), jnp.asarray([0.0, 4.5, 0.0])  # half a millimetre deep
    bad = np.zeros((225, 3))
    bad[100] = np.asarray(computed(1.0))

    @jax.jit
    def laid(off):
        def one(turn):
            near = jnp.sum((flat + off) ** 2, axis=1)
            sunk, low = flat + off, dented + off
            return sunk + trail.scale_to_touch(ball, Poses(turn, at), near, sunk, low) * (
                low - sunk
            )

        return jax.vmap(one)(jnp.tile(jnp.eye(3), (rows, 1, 1)))

    wanted, found = (np.asarray(laid(v)) for v in (np.zeros((225, 3)), bad))
    assert np.abs(wanted - dented[None]).max() > 0.1  # it has to be scaled
    kept = np.arange(225) != 100
    np.testing.assert_allclose(found[:, kept], wanted[:, kept], atol=1e-12)
    assert np.isnan(found[:, ~kept]).all()


@pytest.mark.parametrize("samples", [20, 5000])
def test_a_sample_without_a_solution_hides_no_undetermined_direction(samples):
    """The slope that a fit could not see is that of the samples that have one."""
    slope = np.ones((2, samples))
    slope[:, 7] = np.asarray(computed(1.0))
    slack = np.full((samples, 2), 1e-3)
    np.testing.assert_allclose(jax.jit(_unseen)(slope, slack), np.sqrt(2) * 1e-3)
