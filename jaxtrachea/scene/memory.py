"""What a step remembers of a force that relaxes, and when it is forgotten.

The history belongs to the place that is pressed. It goes on while the tool holds the place or
slides with it, and in the air, where the surface recovers. It is forgotten where the tool grasps
anew, further away than its dent is wide and the tool is deep: there the wall counts as at rest.
While the place does not move this is exact. What slides takes the history of its first place along.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea.mechanics.press_history import History
from jaxtrachea.scene.anchor import Anchor, length
from jaxtrachea.scene.grip import pick
from jaxtrachea.scene.stage import Scene
from jaxtrachea.status import PressStatus


class Memory(NamedTuple):
    """A history, and the place that was pressed last.

    Attributes:
        press: in the frame of the contact.
        s: mm.
        phi: rad.
    """

    press: History
    s: Float[Array, ""]
    phi: Float[Array, ""]


def recall(
    scene: Scene, memory: Memory, rest: History, anchor: Anchor, depth, touching: Bool[Array, ""]
) -> Memory:
    """What a step begins with.

    Args:
        memory: after the step before.
        rest: the history of nothing.
        anchor: the place of the tool now.
        depth: of the tool, mm.
        touching: it is on that place.
    """
    turn = anchor.phi - memory.phi
    turn = jnp.arctan2(jnp.sin(turn), jnp.cos(turn))
    away = length(jnp.stack([anchor.s - memory.s, scene.radius * turn]))
    anew = touching & (away > scene.footprint + jnp.maximum(depth, 0))
    # A history that is unknown ends where the tool has lifted off.
    ended = ~touching & (memory.press.lost != PressStatus.OK)
    return Memory(
        press=pick(anew | ended, rest, memory.press),
        s=jnp.where(touching, anchor.s, memory.s),
        phi=jnp.where(touching, anchor.phi, memory.phi),
    )
