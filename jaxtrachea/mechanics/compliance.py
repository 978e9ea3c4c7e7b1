"""Records of the ligament beam and the algebra of tip compliances, shared by both of its forms.

Signs and units as in `jaxtrachea.mechanics.beam`.
"""

from functools import partial
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxtrachea._arguments import real

Split = Literal["continuous", "independent"]


class Beam(eqx.Module):
    """A straight beam clamped at both ends, on n spring supports.

    Attributes:
        x: support positions, mm, strictly increasing in (0, length); shape (n,).
        length: mm.
        EI: bending stiffness of each span, N mm^2, positive; shape (n + 1,).
        k: stiffness of each support, N/mm, not negative; shape (n,).
        GA: shear stiffness kappa G A of each span, N; shape (n + 1,). None: no shear flexibility
            (Bernoulli-Euler, as in the paper).
    """

    x: Float[Array, " n"] = eqx.field(converter=partial(real, "Beam.x"))
    length: Float[Array, ""] = eqx.field(converter=partial(real, "Beam.length"))
    EI: Float[Array, " spans"] = eqx.field(converter=partial(real, "Beam.EI"))
    k: Float[Array, " n"] = eqx.field(converter=partial(real, "Beam.k"))
    GA: Float[Array, " spans"] | None = eqx.field(
        default=None, converter=lambda v: None if v is None else real("Beam.GA", v)
    )


class Compliance(NamedTuple):
    """Tip compliance [[a, b], [b, c]] of a cantilever: (w, theta) = G (V, M).

    a: mm/N; b: 1/N (deflection per moment = rotation per force); c: 1/(N mm); det = a c - b^2,
    1/N^2. Any common shape. The determinant is carried because with it spans, supports and the
    parallel combination of two sides need sums of positive terms only: nothing cancels.
    """

    a: Float[Array, "*s"]
    b: Float[Array, "*s"]
    c: Float[Array, "*s"]
    det: Float[Array, "*s"]


class Deflection(NamedTuple):
    """Response of the beam to a force at C.

    Attributes:
        w_C: deflection of C, mm. With `independent` the two beams disagree there; this is then the
            deflection conjugate to the force, sum(share^2 * compliance) * F.
        theta_C: rotation of C, rad (`independent`: that of beam AC).
        w: deflection of the beam at each support, mm; shape (n,).
        theta: rotation of the section at each support, rad; shape (n,).
        reaction: force of each support against the load, N; shape (n,).
        force_A: part of the force carried by beam AC, N.
        moment_A: moment that beam BC exerts on AC at C, N mm (0 for `independent`).
    """

    w_C: Float[Array, ""]
    theta_C: Float[Array, ""]
    w: Float[Array, " n"]
    theta: Float[Array, " n"]
    reaction: Float[Array, " n"]
    force_A: Float[Array, ""]
    moment_A: Float[Array, ""]


def add_span(g: Compliance, h, EI, GA=None) -> Compliance:
    """Tip compliance after a span of length h: bending exactly, shear if GA is given."""
    a, b, c, det = g
    f = h / EI
    det = det + f * (a + h * (b + h * (c / 3 + f / 12)))
    a = a + h * (2 * b + h * (c + f / 3))
    if GA is not None:
        a = a + h / GA
        det = det + (h / GA) * (c + f)
    return Compliance(a, b + h * (c + f / 2), c + f, det)


def add_support(g: Compliance, k) -> Compliance:
    """Tip compliance after a support of stiffness k at the tip (one redundant released).

    c - k b^2 q is written as (c + k det) q, which subtracts nothing.
    """
    a, b, c, det = g
    q = 1 / (1 + k * a)
    return Compliance(a * q, b * q, c * q + (k * q) * det, det * q)


def sides(g: Compliance) -> tuple[Compliance, Compliance]:
    """Both sides of a stacked compliance, (A, B)."""
    first, second = (jax.tree.map(lambda v, i=i: v[i], g) for i in (0, 1))
    return first, second


class Joint(NamedTuple):
    """Two sides joined at C, for a unit force there: G_A (G_A + S G_B S)^-1 S G_B S and its parts.

    S = diag(1, -1) mirrors side B. V, M: load on each side in its own signs; w, theta: motion of C;
    `inverse`: entries of the symmetric (G_A + S G_B S)^-1. Products are divided by a_A + a_B before
    they are summed, to stay within the range of float32.
    """

    w: Float[Array, ""]
    theta: Float[Array, ""]
    V: Float[Array, "2"]
    M: Float[Array, "2"]
    inverse: tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]


def join(A: Compliance, B: Compliance) -> Joint:
    """Deflection and rotation agree at C; every result but theta is a sum of positive terms."""
    scale = A.a + B.a
    a_A, a_B, b_A, b_B = A.a / scale, B.a / scale, A.b / scale, B.b / scale
    det_A, det_B = A.det / scale, B.det / scale
    det = det_A + det_B + a_A * B.c + a_B * A.c + 2 * b_A * B.b
    V_A = (det_B + a_B * A.c + b_A * B.b) / det
    V_B = (det_A + a_A * B.c + b_A * B.b) / det
    M = -(b_A * B.a + A.a * b_B) / det
    return Joint(
        w=(a_A * det_B + a_B * det_A) * (scale / det),
        theta=(A.b * det_B - B.b * det_A) / det,
        V=jnp.stack([V_A, V_B]),
        M=jnp.stack([M, M]),
        inverse=((A.c + B.c) / scale / det, (b_B - b_A) / det, 1 / det),
    )


def force_shares(s):
    """Paper eq. 3: F_AC : F_BC = L_BC^3 : L_AC^3."""
    cubes = (s / jnp.sum(s)) ** 3
    return cubes[::-1] / jnp.sum(cubes)


def divide_load(
    g: Compliance, s: Float[Array, "2"], force, split: Split, free=None
) -> tuple[Array, Array, Float[Array, "2"], Float[Array, "2"]]:
    """How a force at C divides between the sides A and B.

    Args:
        g: tip compliances of both sides, leading axis (A, B).
        s: distance of C from either clamp, mm.
        force: N.
        split: `continuous` or `independent`.
        free: motion (w, theta) of both tips under other loads, or None.

    Returns:
        Deflection and rotation of C; force and moment there on each side, in its own signs.
    """
    if split == "independent":
        shares = force_shares(s)
        V = shares * force
        w, theta = g.a * V, g.b * V
        if free is not None:
            w, theta = w + free[0], theta + free[1]
        return jnp.sum(shares * w), theta[0], V, jnp.zeros_like(V)
    joint = join(*sides(g))
    w, theta, V, M = (v * force for v in joint[:4])
    if free is not None:
        # Misfit of the free motions at C, closed by a force and a moment between the two sides.
        gap_w, gap_theta = free[0][1] - free[0][0], -free[1][1] - free[1][0]
        vv, vm, mm = joint.inverse
        dV, dM = vv * gap_w + vm * gap_theta, vm * gap_w + mm * gap_theta
        w = w + free[0][0] + g.a[0] * dV + g.b[0] * dM
        theta = theta + free[1][0] + g.b[0] * dV + g.c[0] * dM
        V, M = V + jnp.stack([dV, -dV]), M + jnp.stack([dM, dM])
    return w, theta, V, M
