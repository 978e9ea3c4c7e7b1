r"""Coulomb friction between tool and tube along a path: stick and slip (Table 1: 0.66).

The paper lets the finger move with the surface; here it may slide. Vectors have the components
(inward normal, tangent, tangent) of the contact. With slip g, the way the tool has slid:

    d + C F + (0, g) = D,   F = kappa(|d|) d,   |F_t| <= mu F_n,   g' || F_t where equality holds.

Backward Euler over one step with g' = lambda F_t makes the slip a compliance lambda in series, in
the tangent plane only: sticking is `press_vector`, sliding has one unknown more, and a condition
that is nearly linear in it. Local law and skeleton are the elasticity that regularises Coulomb's
law: force and slip are continuous in everything, with a kink where sticking turns into sliding.

A step that comes from the air is straight, and touches where its normal component is 0: the way
along the surface before that is no slip of the contact and stretches nothing.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea._arguments import ArrayLike
from jaxtrachea._numerics import epsilon, product
from jaxtrachea.mechanics._matrix2 import apply, solve
from jaxtrachea.mechanics.equilibrium import press_series
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.roots import newton_tolerance
from jaxtrachea.mechanics.vector_equilibrium import press_vector
from jaxtrachea.status import PressStatus

#: Newton steps to the friction cone at most; 3 to 5 are usual.
_ITERATIONS = 12


class Coulomb(eqx.Module):
    """Coulomb's law, with a corner that may be rounded.

    Attributes:
        mu: coefficient, not negative (paper, Table 1: 0.66); a scalar.
        rounding: width w that rounds the kink (static). A step creeps once |F_t| > (1 - w) mu F_n
            on trial; above (1 + w) it is exact. 0: the law itself, with one-sided derivatives where
            a step passes from sticking to sliding.
    """

    mu: ArrayLike
    rounding: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        """Refuse a width that is none.

        Raises:
            ValueError: negative or not finite.
        """
        if not 0 <= self.rounding < math.inf:
            raise ValueError(f"rounding is {self.rounding}; expected a finite number, not negative")


class Slide(NamedTuple):
    """One step, or with a leading axis a path, of a tool that may slide.

    Attributes:
        depth: local indentation, mm; (3,).
        force: contact force, N; (3,).
        slip: way slid since first touch, mm; (2,). Out of contact it goes with the tool, so that it
            is where the tool touches next.
        dissipated: work lost to friction in this step, N mm; not negative.
        sliding: whether this step slides.
        status: a `PressStatus` as int8.
        began: the slip where the step came into contact, out of contact that at its end, mm; (2,).
    """

    depth: Float[Array, "*n 3"]
    force: Float[Array, "*n 3"]
    slip: Float[Array, "*n 2"]
    dissipated: Float[Array, "*n"]
    sliding: Bool[Array, "*n"]
    status: Int[Array, "*n"]
    began: Float[Array, "*n 2"]


def slide_path(
    displacement: Float[Array, "steps 3"],
    compliance: Float[Array, "3 3"],
    law: Law,
    friction: Coulomb,
    slip: Float[Array, "2"] | None = None,
    height: Float[Array, ""] | None = None,
) -> Slide:
    """Follow a tool along a path; the slip is carried from step to step.

    Out of contact the tool takes the slip with it, up to where it touches: the point at which the
    straight line between two steps has the normal component 0.

    Args:
        displacement: of the tool, (inward normal, tangent, tangent), mm, in order. Contact is where
            the normal component is positive (unilateral: no tension).
        compliance: skeleton at the contact in the same frame, mm/N, symmetric.
        law: local law; k_1 > 0.
        friction: between tool and surface.
        slip: at the start, mm; None: 0.
        height: of the tool above the surface at the start, mm, not negative; None: 0 (it just
            touches, or is in contact). Above it, the tool stands over `slip`.

    Returns:
        A `Slide` with a leading axis of steps. A step without a solution is NaN with its status and
        leaves slip and height as they were.
    """
    start = jnp.zeros_like(displacement[0, 1:]) if slip is None else slip
    above = jnp.zeros_like(displacement[0, 0]) if height is None else height

    def step(state, D):
        return land_and_slide(D, compliance, law, friction, *state)

    return jax.lax.scan(step, (start, above), displacement)[1]


def land_and_slide(
    displacement: Float[Array, "3"],
    compliance: Float[Array, "3 3"],
    law: Law,
    friction: Coulomb,
    slip: Float[Array, "2"],
    above: Float[Array, ""],
) -> tuple[tuple[Float[Array, "2"], Float[Array, ""]], Slide]:
    """One step of `slide_path`, of a tool that stood `above` the surface: slip and height after it.

    Args:
        displacement: see `slide_path`.
        compliance: see `slide_path`.
        law: see `slide_path`.
        friction: see `slide_path`.
        slip: before the step, mm.
        above: height before the step, mm; 0 in contact.
    """
    known = jnp.isfinite(jnp.sum(displacement))
    given = jnp.where(known, displacement, 0)  # before what is derived from it
    pressing = given[0] > 0
    share = jnp.where(pressing, above / jnp.where(pressing, above + given[0], 1), 0)
    out = slide(displacement, compliance, law, friction, slip + share * (given[1:] - slip))
    solved = known & ((out.status == PressStatus.OK) | ~pressing)
    slip = jnp.where(solved, out.slip, slip)
    above = jnp.where(solved, jnp.where(pressing, 0, -given[0]), above)
    return (slip, above), out._replace(slip=slip)


def slide(
    displacement: Float[Array, "3"],
    compliance: Float[Array, "3 3"],
    law: Law,
    friction: Coulomb,
    slip: Float[Array, "2"],
) -> Slide:
    """One step of the return mapping: stick if the friction cone allows it, else slide on the cone.

    Strong coupling of normal and tangent together with high friction can jam (several solutions);
    the one nearest to frictionless contact is then not guaranteed.

    Args:
        displacement: of the tool at the end of the step, see `slide_path`.
        compliance: see `slide_path`.
        law: see `slide_path`.
        friction: see `slide_path`.
        slip: at the beginning of the step, mm.

    Returns:
        The `Slide`. Where neither sticking nor sliding is an equilibrium that presses (a law that
        softens), force and depth are NaN and the slip stays: PULLS where sticking would need a
        pull, else PAST_FOLD.
    """
    mu, rounding = jnp.asarray(friction.mu), friction.rounding
    touching = ~(displacement[0] <= 0)  # NaN stays in
    trial = jnp.where(touching, displacement - jnp.concatenate([jnp.zeros(1, slip.dtype), slip]), 0)
    stuck = press_vector(trial, compliance, law)
    tangential, limit = _length(stuck.force[1:]), mu * stuck.force[0]
    sliding = touching & ~(tangential <= (1 - rounding) * limit)
    mobilised = mu
    if rounding > 0:
        # min(ratio, 1) with its corner replaced by a parabola below it.
        inside = sliding & (tangential < (1 + rounding) * limit)
        room = 1 + rounding - jnp.where(inside, tangential, 1) / jnp.where(inside, limit, 1)
        mobilised = mu * (1 - jnp.where(inside, room * room / (4 * rounding), 0))
    on_cone = _on_cone(sliding, trial, compliance, law, mobilised)
    pulls = stuck.force[0] < 0
    solved = jnp.where(sliding, on_cone.solved, jnp.isfinite(jnp.sum(stuck.force)) & ~pulls)
    force = jnp.where(sliding, on_cone.force, jnp.where(solved, stuck.force, 0))
    depth = jnp.where(sliding, on_cone.depth, jnp.where(solved, stuck.depth, 0))
    moved = jnp.where(sliding & solved, (trial - depth - product(compliance, force))[1:], 0)
    away = jnp.where(jnp.isfinite(jnp.sum(displacement)), displacement[1:], slip)
    failed = jnp.where(pulls, PressStatus.PULLS, PressStatus.PAST_FOLD)
    failed = jnp.where(stuck.status == PressStatus.OK, failed, stuck.status)
    status = jnp.where(solved, PressStatus.OK, failed)
    return Slide(
        depth=jnp.where(solved, depth, jnp.nan),
        force=jnp.where(solved, force, jnp.nan),
        slip=jnp.where(touching, slip + moved, away),
        dissipated=jnp.sum(jnp.where(solved, force[1:], 0) * moved),
        sliding=sliding,
        status=jnp.where(touching, status, PressStatus.NO_CONTACT).astype(jnp.int8),
        began=jnp.where(touching, slip, away),
    )


def without_steps(slid: Slide, lost: Bool[Array, " steps"]) -> Slide:
    """With zeros in steps without a solution: by 0 times NaN they would reach derivatives."""

    def still(v):
        off = lost.reshape(-1, *[1] * (v.ndim - 1))
        return jnp.where(off, jnp.zeros_like(v), v)

    return jax.tree.map(still, slid._replace(status=None))._replace(status=slid.status)


def _length(v):
    """Norm with derivative 0 at 0."""
    squared = jnp.sum(v * v)
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1)), 0)


class _OnCone(NamedTuple):
    """A sliding step: force and indentation (any numbers where it is not solved)."""

    force: Float[Array, "3"]
    depth: Float[Array, "3"]
    solved: Bool[Array, ""]


def _on_cone(sliding, D, compliance, law: Law, mu) -> _OnCone:
    """Force with |F_t| = mu F_n along the slip, and the indentation under it.

    A law that softens may have no such force, or only one that pulls or gains energy: whatever the
    search ends with is held against the conditions. A step that does not slide, or has no solution,
    is computed as another one that has, so that no derivative is NaN because of it.
    """
    still = jax.lax.stop_gradient((D, compliance, law, mu))
    z = _cone_root(jax.lax.stop_gradient(sliding), *still)
    force, depth, pressed = _at_root(z, *still)
    normal, tangential = force[0], jnp.linalg.norm(force[1:])
    tolerance = epsilon(D.dtype) ** 0.5
    size = tolerance * jnp.linalg.norm(force)
    work = jnp.sum(force[1:] * (still[0] - depth - product(still[1], force))[1:])
    solved = sliding & jnp.isfinite(jnp.sum(force + depth)) & (normal >= 0) & (pressed >= 0)
    solved &= jnp.abs(tangential - still[3] * normal) <= size
    solved &= work >= -size * jnp.linalg.norm(still[0])

    def safe(value, other):
        return jnp.where(solved, value, jnp.asarray(other, D.dtype))

    linear = jax.tree.map(jnp.zeros_like, law)._replace(k_1=jnp.ones_like(law.k_1))
    used = safe(D, 1), safe(compliance, 0), jax.tree.map(safe, law, linear), mu
    z = _follow(safe(z, 2**0.5), *used)  # of unit motions on a law of 1 N/mm alone
    force, depth, _ = _at_root(z, *used)
    return _OnCone(force, depth, solved)


def _at_root(z, D, compliance, law: Law, mu):
    """Force, indentation and the length of it (negative: of a pull), for a mobility of the cone."""
    N, h, d = _given_mobility(z, D, compliance, law, mu)
    force = jnp.concatenate([N[None], mu / z * h])
    return force, force / law.secant(d * d), d


def _given_mobility(z, D, C, law: Law, mu):
    """Normal force N, h = F_t z / mu and |d| for a tangential compliance z / mu beside C.

    z, not its inverse, so that mu = 0 is an ordinary value: N and h are then frictionless. |d|
    takes |F_t| = mu N for granted, which makes the normal part a press in series of its own.
    """
    q = mu / z
    M = jnp.eye(2, dtype=D.dtype) + q * C[1:, 1:]
    h, coupled = solve(M, jnp.stack([D[1:], C[1:, 0]], 1)).T
    lean = jnp.sqrt(1 + mu * mu)
    pressed = D[0] - q * jnp.sum(C[1:, 0] * h)
    softness = C[0, 0] - q * jnp.sum(C[1:, 0] * coupled)
    normal = press_series(lean * pressed, softness, law)
    N = normal.force / lean
    return N, h - N * coupled, normal.depth


def _excess(z, D, C, law: Law, mu):
    """What mu N / |F_t| exceeds 1 by; a straight line in z for equal, uncoupled compliances."""
    N, h, _ = _given_mobility(z, D, C, law, mu)
    return N * z / jnp.linalg.norm(h) - 1


def _cone_root(sliding, D, C, law: Law, mu):
    """Root z of `_excess`: Newton from the frictionless tangent, kept in a shrinking bracket.

    It ends where z stands still, and does not begin where nothing slides (any number then).
    """
    low = mu / law.stiffest(jnp.sum(D * D))  # no softer than sticking
    N, w, _ = _given_mobility(jnp.full_like(mu, jnp.inf), D, C, law, mu)
    length = jnp.linalg.norm(w)
    first = length / N - mu * jnp.sum(w * apply(C[1:, 1:], w)) / length**2

    def excess(z):
        return _excess(z, D, C, law, mu)

    def moves(state):
        count, moving = state[:2]
        return moving & (count < _ITERATIONS)

    def newton(state):
        count, _, z, low, high = state
        value, slope = jax.jvp(excess, (z,), (jnp.ones_like(z),))
        low, high = jnp.where(value < 0, z, low), jnp.where(value < 0, high, z)
        new = z - value / slope
        middle = jnp.where(jnp.isfinite(high), (low + high) / 2, 2 * z)
        new = jnp.where((new >= low) & (new <= high), new, middle)
        return count + 1, ~(jnp.abs(new - z) <= still * z), new, low, high

    still = newton_tolerance(low.dtype)
    start = jnp.asarray(0), sliding, jnp.maximum(first, low), low, jnp.full_like(low, jnp.inf)
    return jax.lax.while_loop(moves, newton, start)[2]


@jax.custom_jvp
def _follow(z, D, C, law: Law, mu):
    """The root `z` of `_excess`, with the derivatives that it has as one."""
    return z


@_follow.defjvp
def _follow_jvp(primals, tangents):
    z = _follow(*primals)
    _, by_inputs = jax.jvp(lambda *p: _excess(z, *p), primals[1:], tangents[1:])
    slope = jax.grad(_excess)(z, *primals[1:])
    return z, -by_inputs / slope
