r"""The energy that a press stores, and how it changes with the place that is pressed.

A press straight in by delta at (s, phi) stores, in series coupling,

    E(delta; s, phi) = max_F [F . n p(delta) - F . C(s, phi) F / 2 - W*(F; s)],

n the inward normal, p the smooth touch (`press.touch`), C the skeleton's compliance and W* the
complementary energy of the local law W(d; s). At the maximum F is the contact force, so that by the
envelope theorem (the first variation with F does not count), C and F along the local frame,

    dE/d delta = F . n p',
    dE/ds      = -F . (dC/ds) F / 2 + dW/ds     = -F . w' + dW/ds,
    dE/dphi    = -F . (dC/dphi) F / 2           = -sum_i P_i . (dC_i/dphi) P_i / 2,

dW/ds at a fixed indentation d; w' the slope of the deflected ligament under C (Maxwell:
d/ds G(s, s) is twice the derivative by one of them): a normal force on an inclined wall. P_i is the
load on ring i and C_i its compliance: the bending stiffness of the ligament turns with the frame
(least complementary energy). In `total` coupling the skeleton takes no part: E = W(p(delta); s).

A tube that softens (`mechanics.softening`, in one plane) stores the integral of r(x) F_0(x; s)
over the way x of the tool, F_0 the force of small strain: no maximum of anything. dE/ds is that of
the integral, by Gauss points.

With shear C(s) has a kink where a ring stands (dE/ds jumps there); with the `split` "independent" a
jump, which no derivative has.

Source: Danskin, "The theory of max-min, with applications", SIAM J. Appl. Math. 14 (1966),
doi:10.1137/0114053; configurational force: Eshelby, Phil. Trans. R. Soc. A 244 (1951),
doi:10.1098/rsta.1951.0016.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxtrachea._numerics import product
from jaxtrachea.mechanics import press, skeleton
from jaxtrachea.mechanics.skeleton import Rings, local_frame
from jaxtrachea.mechanics.softening import Softening
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material

#: Points and weights on -1 to 1: forces are smooth over the way of a press.
_GAUSS = np.polynomial.legendre.leggauss(12)


class StraightPress(NamedTuple):
    """A solved press along the inward normal; fields as in `oblique.ObliquePress`.

    Attributes:
        s: contact position on the tube, mm.
        phi: contact angle on the rings, rad.
        inward: displacement of the tool along the inward normal, mm.
        force: contact force, N.
        depth: local indentation, mm.
        slope_C: of the ligament at the contact, in y and z.
        loads: on the rings, N.
    """

    s: Float[Array, ""]
    phi: Float[Array, ""]
    inward: Float[Array, ""]
    force: Float[Array, "3"]
    depth: Float[Array, "3"]
    slope_C: Float[Array, "2"]
    loads: Float[Array, "rings 3"]


class Gradient(NamedTuple):
    """Derivatives of the energy that a press straight in stores.

    Attributes:
        inward: by the displacement, N: the normal force, times the slope of `press.touch`.
        s: by the contact position, the displacement held, N.
        phi: by the contact angle, the displacement held, N mm.
    """

    inward: Float[Array, ""]
    s: Float[Array, ""]
    phi: Float[Array, ""]


def gradient(
    geometry: Geometry,
    material: Material,
    solved: StraightPress,
    options: press.Options,
    *,
    rings: Rings,
    axial: bool,
    one_plane: bool = False,
) -> Gradient:
    """Of a solved press straight in, by the envelope theorem.

    Args:
        material: values that are not negative.
        options: that it was solved with.
        rings: likewise.
        axial: likewise.
        one_plane: on the midline, by `press.respond`: `rings` is `mat`, and `options.split` may be
            "independent".
    """
    F, zero = solved.force, jnp.zeros_like(solved.inward)

    def touched(inward):
        return press.indentation(inward, zero, options)

    moved, rising = jax.jvp(touched, (solved.inward,), (jnp.ones_like(zero),))
    normal = jnp.sum(local_frame(solved.phi)[0] * F)
    total = options.coupling == "total"
    squared = moved * moved if total else jnp.sum(solved.depth * solved.depth)

    def local(s):
        return press.local_law(geometry, material, s, options).energy(squared)

    softening = press.softening_of(material, options)
    if softening is not None:

        def stored(s):
            return _stored_softening(geometry, material, s, moved, softening, options)

        return Gradient(inward=normal * rising, s=jax.grad(stored)(solved.s), phi=zero)
    by_s, by_phi = zero, zero
    if not total:
        by_s = _by_position(
            geometry, material, solved, options, rings=rings, axial=axial, one_plane=one_plane
        )
    if options.local == "two-material":
        by_s = by_s + jax.grad(local)(solved.s)
    if not (total or one_plane or rings == "mat"):
        by_phi = _by_angle(geometry, material, solved, rings)
    return Gradient(inward=normal * rising, s=by_s, phi=by_phi)


def _by_position(
    geometry: Geometry,
    material: Material,
    solved: StraightPress,
    options: press.Options,
    *,
    rings: Rings,
    axial: bool,
    one_plane: bool,
):
    """-F . (dC/ds) F / 2, N."""
    F = solved.force
    if not options.shear and options.split == "continuous":
        return -jnp.sum(F[1:] * solved.slope_C)

    # With shear the slope is another on either side of the force.
    def yielding(s):
        if one_plane:
            return F[1] * F[1] * press.compliance(geometry, material, s, options)
        levels = {"rings": rings, "axial": axial, "shear": options.shear}
        C = skeleton.respond(geometry, material, s, solved.phi, **levels).compliance
        return jnp.sum(F * (C @ F))

    return -jax.grad(yielding)(solved.s) / 2


def _stored_softening(
    geometry: Geometry, material: Material, s, moved, softening: Softening, options: press.Options
):
    """Integral of the force of a tube that softens over the way `moved`, N mm, on the midline."""
    nodes, weights = (jnp.asarray(v, moved.dtype) for v in _GAUSS)
    way = moved * (1 + nodes) / 2
    c = press.compliance(geometry, material, s, options)
    law = press.local_law(geometry, material, s, options)
    force = softening.ratio(way) * law.series(way, c).force
    return jnp.sum(weights * force) * moved / 2


def _by_angle(geometry: Geometry, material: Material, solved: StraightPress, rings: Rings):
    """-sum_i P_i . (dC_i/dphi) P_i / 2, N mm, C_i along the local frame."""

    def turning(phi):
        return skeleton.turned_rings(geometry, material, phi, rings)

    phi = solved.phi
    change = jax.jvp(turning, (phi,), (jnp.ones_like(phi),))[1]
    P = product(solved.loads[:, 1:], local_frame(phi)[::2, 1:].T)
    return -jnp.sum(P[:, :, None] * change * P[:, None]) / 2
