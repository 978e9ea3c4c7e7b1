"""Friction of several tools: what each drags along, with the forces of all others."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxtrachea._numerics import product_of_rows
from jaxtrachea.mechanics.contacts_friction import slide_paths
from jaxtrachea.mechanics.force_law import Law
from jaxtrachea.mechanics.friction import Coulomb, Slide
from jaxtrachea.mechanics.influence_vector import VectorInfluence, influence_vector
from jaxtrachea.mechanics.press import indentation, local_law
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.scene.stage import Presses, Scene
from jaxtrachea.trachea.material import Material


class Rubbed(NamedTuple):
    """What tools that rub do to the wall.

    Attributes:
        unit: what unit forces in all directions of all contacts move.
        slid: of each tool in each row, in (inward, along, round the tube) of its contact.
    """

    unit: VectorInfluence
    slid: Slide


def influence_of(
    scene: Scene, material: Material, s: Float[Array, " m"], phi: Float[Array, " m"]
) -> VectorInfluence:
    """What contacts off the midline move: by inward forces, or with friction by all."""
    plan = scene.plan
    return influence_vector(
        scene.geometry, material, s, phi, rings=plan.rings, shear=plan.options.shear,
        tangential=plan.friction, axial=plan.axial,
    )  # fmt: skip


def rub_paths(
    scene: Scene,
    material: Material,
    s: Float[Array, " m"],
    phi: Float[Array, " m"],
    presses: Sequence[Presses],
    hidden: Bool[Array, " rows"],
) -> Rubbed:
    """Follow all tools side by side.

    A row in which one has no solution has none for all: forces 0 (it is hidden), and its statuses.

    Args:
        scene: of several instruments with friction.
        material: values that are not negative.
        s: places of the contacts, mm.
        phi: their angles, rad.
        presses: of each tool.
        hidden: rows that are passed over.
    """
    unit = influence_of(scene, material, s, phi)
    D = jnp.stack([_in_its_frame(p, hidden) for p in presses], axis=1)
    D = jnp.where(hidden[:, None, None], jnp.nan, smooth_touch(scene, D))
    return Rubbed(unit, slide_paths(D, felt(scene, unit), law_of(scene, material, s), mu_of(scene)))


def _in_its_frame(presses: Presses, hidden) -> Float[Array, "rows 3"]:
    """Displacements inwards, along and round the tube where the tool is, behind it or not."""
    D = jnp.where(hidden[:, None], 0, presses.displacement)
    phi = presses.phi[0]
    return product_of_rows(D, local_frame(jnp.where(jnp.isnan(phi), 0, phi)).T)


def smooth_touch(scene: Scene, D: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """The displacements, with the smooth first touch that one tool by itself has."""
    inward, onset = D[..., 0], jnp.zeros((), D.dtype)
    inward = jnp.where(inward < 0, inward, indentation(inward, onset, scene.plan.options))
    return jnp.concatenate([inward[..., None], D[..., 1:]], -1)


def law_of(scene: Scene, material: Material, s: Float[Array, " m"]) -> Law:
    """The local law at every contact."""
    options = scene.plan.options
    return jax.vmap(lambda at: local_law(scene.geometry, material, at, options))(s)


def felt(scene: Scene, unit: VectorInfluence) -> Float[Array, "m 3 m 3"]:
    """The compliance that contacts feel, of themselves and of each other."""
    m = len(scene.instruments)
    C = unit.compliance.reshape(m, 3, m, 3)
    if scene.plan.tools == "coupled":
        return C
    return C * jnp.eye(m, dtype=C.dtype)[:, None, :, None]


def mu_of(scene: Scene) -> Coulomb:
    """Friction of every tool (a negative coefficient is refused row by row)."""
    given = [v.friction for v in scene.instruments if v.friction is not None]
    return Coulomb(jnp.maximum(jnp.stack(given), 0))
