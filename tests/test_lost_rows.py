"""Rows without a solution leave the derivatives of all that is shared as they are."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from admitted import BEAM, FULL

from jaxtrachea.mechanics import beam
from jaxtrachea.mechanics.oblique import ObliqueOptions, press_oblique
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.scene.assemble import make_scene
from jaxtrachea.scene.effects import EffectOptions
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.stage import Presses
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

pytestmark = pytest.mark.compiling


def masked(found):
    """A loss of the rows with a solution, of all that a press gives."""
    fine = (found.status == PressStatus.OK) | (found.status == PressStatus.NEGATIVE_LOCAL)
    numbers = [v.reshape(*fine.shape, -1) for v in (found.force, found.skeleton, found.joints)]
    rows = sum(jnp.sum(v, axis=-1) for v in numbers)
    return jnp.sum(jnp.where(fine, rows, 0))


def by_press(options):
    def loss(g, m, at, k_1, depth):
        def one(at, k_1, D):
            return press(g, dataclasses.replace(m, k_1=k_1), at, D, options)

        return masked(jax.vmap(one)(at, k_1, jnp.stack([depth / 2, depth], 1)))

    return loss


def by_scene(g, m, at, k_1, depth, scene):
    D = depth[:, None] * jnp.array([[0, -1.0, 0]])
    return masked(simulate(scene, m, Presses(at, jnp.zeros(2), D)))


def on_a_scene(loss):
    path = Presses([40.0] * 2, [0.0] * 2, [[0, -0.1, 0], [0, -0.2, 0]])
    effects = EffectOptions(contact_point="per_step", want_surface=False, want_ring_ends=False)
    scene = make_scene(table_1(), Material(**FULL), path, effects=effects)
    return functools.partial(loss, scene=scene)


#: Place, k_1 and displacement of a row without a solution.
LOST = {
    "past its fold": (40.0, 0.8, 80.0),
    "no displacement": (40.0, 0.8, np.nan),
    "infinite displacement": (40.0, 0.8, np.inf),
    "no place": (np.nan, 0.8, 1.0),
    "off the tube": (-1.0, 0.8, 1.0),
    "no stiffness": (40.0, np.nan, 1.0),
    "infinite stiffness": (40.0, np.inf, 1.0),
    "negative stiffness": (40.0, -1.0, 1.0),
}


@pytest.mark.parametrize(
    ("loss", "skip"),
    [
        (by_press(Options()), ()),
        pytest.param(by_press(Options(skeleton="softening")), (), marks=pytest.mark.slow),
        pytest.param(
            by_scene,
            ("no stiffness", "infinite stiffness", "negative stiffness"),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["press", "press softening", "simulate"],
)
def test_a_row_without_a_solution_leaves_shared_derivatives_as_they_are(loss, skip):
    """Those by tube and material are those of the other rows alone: 0 times NaN is NaN."""
    values = FULL | {"k_3": -0.01}
    if loss is by_scene:  # whose plan has no skeleton that softens
        loss = on_a_scene(loss)
    else:
        values |= {"e_1": 0.1, "e_2": 0.002}
    g, m = table_1(), Material(**values)

    @jax.jit
    @jax.grad
    def grad(shared, *of_row):
        return loss(
            *shared, *(jnp.stack([v, w]) for v, w in zip((40.0, 0.8, 0.5), of_row, strict=True))
        )

    alone = jax.tree.leaves(grad((g, m), 40.0, 0.8, 0.0))
    assert any(np.any(v != 0) for v in alone)
    for name, row in LOST.items():
        if name not in skip:
            found = jax.tree.leaves(grad((g, m), *row))
            for p, q in zip(found, alone, strict=True):
                np.testing.assert_allclose(p, q, rtol=1e-12, atol=1e-15, err_msg=name)


@pytest.mark.slow
def test_a_displacement_that_is_no_number_says_nothing_of_the_onset():
    """Nor of the angle of an oblique press: derivatives are those of the other rows alone."""
    g, m = table_1(), Material(**FULL)

    def straight(onset, D):
        return press(g, m, 40.0, D, Options(), onset=onset).force[0]

    def oblique(phi, onset, D):
        D = D[:, None] * jnp.array([[0.1, -1.0, 0.2]])
        found = press_oblique(g, m, 40.0, phi, D, ObliqueOptions(), onset=onset)
        return jnp.sum(found.force[0])

    for f, at in ((straight, (0.2,)), (oblique, (0.1, 0.2))):
        grad = jax.jit(jax.grad(f, range(len(at))))
        found, alone = (grad(*at, jnp.array([1.0, D])) for D in (np.nan, 2.0))
        assert all(np.asarray(alone) != 0)
        np.testing.assert_allclose(found, alone, rtol=1e-12)


@pytest.mark.long
def test_a_place_off_the_beam_says_nothing_of_the_beam():
    """As if it had not been asked for: `contact_compliance` of one and of many, `deflect`."""

    def one_by_one(beam_, s):
        return jnp.stack([beam.contact_compliance(beam_, v) for v in s])

    def deflected(beam_, s):
        return jax.vmap(lambda v: beam.deflect(beam_, v, 2.0).w_C)(s)

    for solve in (beam.contact_compliance, one_by_one, deflected):

        def f(beam_, s, solve=solve):
            return jnp.nansum(solve(beam_, s))

        grad = jax.jit(jax.grad(f))
        found, alone = (jax.tree.leaves(grad(BEAM, jnp.array(s))) for s in ([2.0, np.nan], [2.0]))
        assert all(np.any(v != 0) for v in alone)
        for p, q in zip(found, alone, strict=True):
            np.testing.assert_allclose(p, q, rtol=1e-12)
