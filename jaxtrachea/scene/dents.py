"""The dents of several tools as one correction of the surface (`surface.local`).

At its contact a tool that presses is met. At any other centre the surface keeps out of all tools as
far as their shapes are known: the target is the largest of what they ask for. A centre of one tool
beside the contact of another is the softer the closer it is, so that the contact prevails; those of
a tool that does not press weigh nothing. A sum of dents that were fitted singly would count twice
where they overlap.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxtrachea.scene.approach import Approach
from jaxtrachea.scene.curve import lay
from jaxtrachea.scene.deform import dent_parts, sag
from jaxtrachea.scene.stage import Poses, Presses, Scene
from jaxtrachea.surface import local

#: Softness of targets that weigh nothing.
NOTHING = 1e9


class Dents(eqx.Module):
    """Centres of all tools, one tool after the other, and what each tool asks of each of them.

    Attributes:
        centres: mm; shape (n, 3).
        reach: of all of them, mm.
        radii: distance of the contacts from the centreline, mm; (m,).
        sags: how far each tool lies over every centre where it just touches, mm; None: presses at
            points, whose tool is not known.
        peaks: share of each contact's indentation at every centre, where the tool is not known.
        beside: how close every centre is to each contact, 1 there, 0 from half a footprint on.
        own: whether a centre is of this tool; shape (m, n).
        contact: whether it is a contact; shape (n,).
        collar: whether it is of the collar of this tool; shape (m, n).
    """

    centres: Float[Array, "n 3"]
    reach: Float[Array, ""]
    radii: Float[Array, " m"]
    sags: Float[Array, "m n"] | None
    peaks: Float[Array, "m n"]
    beside: Float[Array, "m n"]
    own: Bool[np.ndarray, "m n"]
    contact: Bool[np.ndarray, " n"]
    collar: Bool[np.ndarray, "m n"]


def lay_out(
    each: Sequence[Scene],
    s: Float[Array, " m"],
    phi: Float[Array, " m"],
    paths: Sequence[Poses | Presses],
    made: Sequence[Approach | None],
) -> Dents:
    """The centres round these contacts; the tools stand on the places that they touched first.

    Args:
        each: the scene as each tool sees it.
        s: of the contacts, mm.
        phi: rad.
        made: their ways; None: presses.
    """
    parts = [dent_parts(*one) for one in zip(each, paths, made, strict=True)]
    radii = [v.radius if p[1] is None else p[1][0] for v, p in zip(each, parts, strict=True)]
    m, count = len(each), each[0].plan.dent
    spacing = [v.footprint for v in each]
    laid = [local.centres(s[j], phi[j], radii[j], spacing[j], count) for j in range(m)]
    centres = where = jnp.concatenate(laid)
    if each[0].plan.curved and each[0].tube is not None:
        where = lay(each[0].tube.line, centres)
    sags = None
    if parts[0][2] is not None:
        stands = [jax.tree.map(lambda v: v[0], part[2]) for part in parts]
        sags = jnp.stack([sag(v.tool, at, where) for v, at in zip(each, stands, strict=True)])

    def close(share):
        return jnp.stack([
            local.kernel(centres, laid[j][:1], share * spacing[j])[:, 0] for j in range(m)
        ])  # fmt: skip

    own = np.repeat(np.eye(m, dtype=bool), count, axis=1)
    return Dents(
        centres, local.REACH * jnp.max(jnp.stack(spacing)), jnp.stack(radii), sags,
        close(1.0), close(0.5),
        own, np.tile(np.arange(count) == 0, m), own & np.tile(local.pattern(count)[1], m),
    )  # fmt: skip


def fit(
    dents: Dents, depth: Float[Array, " m"], inward: Float[Array, "m 3"] | None = None
) -> list[local.Dent]:
    """The part of the correction that the centres of each tool carry.

    Args:
        dents: from `lay_out`.
        depth: local indentation of each contact, inwards, mm; 0: it does not press.
        inward: direction of the dent of each contact: its normal, or with friction inclined; None:
            all are on the midline.
    """
    m, n = dents.own.shape
    if dents.sags is None:
        asked = depth[:, None] * dents.peaks
    else:
        room = jnp.maximum(jnp.abs(depth)[:, None] - dents.sags, 0)
        asked = jnp.sign(depth)[:, None] * room
    asked = jnp.where(dents.collar, 0, asked)
    most = jnp.argmax(jnp.abs(asked), axis=0)
    target = jnp.take_along_axis(asked, most[None], axis=0)[0]
    owned = jnp.repeat(depth, n // m)
    target = jnp.where(dents.contact, owned, target)
    foreign = jnp.where(dents.own | (depth == 0)[:, None], 0, dents.beside)
    softness = jnp.where(dents.contact, 0, jnp.max(foreign, axis=0))
    softness = jnp.where(owned == 0, NOTHING, softness)
    way, targets = jnp.array([0, -1, 0], depth.dtype), target[:, None]
    if inward is not None:
        owner = jnp.where(dents.contact, jnp.asarray(np.argmax(dents.own, axis=0)), most)
        way, targets = None, targets * inward[owner]
    whole = local.fit(dents.centres, targets, dents.reach, way, softness)
    parts = (v.reshape(m, n // m, -1) for v in (whole.centres, whole.weights))
    return [local.Dent(c, w, whole.reach, way) for c, w in zip(*parts, strict=True)]
