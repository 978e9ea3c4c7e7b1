"""What a program costs: its operations, and the share of each effect."""

import dataclasses

import jax
import jax.numpy as jnp

from jaxtrachea.scene.build import Staged
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.stage import Presses
from jaxtrachea.tradeoff.operations import count_operations


def shares(staged: Staged) -> tuple[int, dict[str, float]]:
    """Operations of the whole program, and the share of each effect that can be taken away."""
    scene = staged.scene

    def count(s):
        return count_operations(simulate, s, staged.material, staged.path)

    whole, found = count(scene), {}
    for effect in scene.plan.effects:
        less = scene.plan.without(effect.name)
        if less is not None:
            found[effect.name] = 1 - count(dataclasses.replace(scene, plan=less)) / whole
    if scene.plan.contact and not scene.instruments:
        moved = jax.eval_shape(simulate, scene, staged.material, staged.path)
        given = jax.tree.map(
            lambda v: jnp.zeros(v.shape, v.dtype),
            (moved.s, moved.phi, moved.displacement, moved.time),
        )
        # Compared without dent, which takes another form without a tool.
        plan = scene.plan.at(dent="off")
        bare = dataclasses.replace(plan, contact=False)
        rest = count_operations(
            simulate, dataclasses.replace(scene, plan=bare), staged.material, Presses(*given)
        )
        found["contact"] = (count(dataclasses.replace(scene, plan=plan)) - rest) / whole
    return whole, found
