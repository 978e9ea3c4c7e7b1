"""The scene as arrays: trachea, tool, surface, path; and how the tool touches it at rest."""

import dataclasses
import math
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxtrachea._arguments import check_word, real, shaped
from jaxtrachea.contact.patches import Patches, Touch, touch
from jaxtrachea.contact.pose import Pose, check_rotations
from jaxtrachea.contact.search import STANDARD, Settings
from jaxtrachea.contact.shapes import Shape
from jaxtrachea.fusion import fuse
from jaxtrachea.mechanics.levels.choose import AnyMaterial, level_type
from jaxtrachea.mechanics.levels.relaxing import RelaxingMaterial, long_run
from jaxtrachea.mechanics.sections.wall import Points
from jaxtrachea.scene.plan import Plan
from jaxtrachea.surface import local, regions
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material
from jaxtrachea.trachea.mesh import Mesh


def _time(given: Any) -> Array | None:
    return None if given is None else real("time", given)


class Presses(eqx.Module):
    """Presses at known contact points.

    Attributes:
        s: contact position, mm; shape (rows,).
        phi: contact angle from the anterior midline, rad; shape (rows,).
        displacement: of the tool along x (to the larynx), y (anterior), z, mm; shape (rows, 3).
        time: of every row, s, never falling; None: the force must not depend on it.
    """

    s: Float[Array, " rows"] = eqx.field(converter=partial(real, "s"))
    phi: Float[Array, " rows"] = eqx.field(converter=partial(real, "phi"))
    displacement: Float[Array, "rows 3"] = eqx.field(converter=partial(real, "displacement"))
    time: Float[Array, " rows"] | None = eqx.field(default=None, converter=_time)


class Poses(eqx.Module):
    """A tool's positions in the frame of the mesh (without one: of the tube), in order.

    Attributes:
        rotation: orthogonal with determinant 1, which `make_scene` and `simulate` check outside of
            `jit`; shape (rows, 3, 3).
        translation: of the tool's origin, mm; shape (rows, 3).
        time: as of `Presses`.
    """

    rotation: Float[Array, "rows 3 3"] = eqx.field(converter=partial(real, "rotation"))
    translation: Float[Array, "rows 3"] = eqx.field(converter=partial(real, "translation"))
    time: Float[Array, " rows"] | None = eqx.field(default=None, converter=_time)


@dataclasses.dataclass(frozen=True, eq=False)
class Tool:
    """What touches the trachea.

    Attributes:
        shape: about its own origin, convex or of convex parts (`contact.shapes.compound`); None:
            presses are given at their contact points.
        friction: Coulomb's coefficient; None: the tool holds the surface.
        contact: `bonded`: glued (forceps, a suture), `unilateral`; None: as `EffectOptions` says.
    """

    shape: Shape | None = None
    friction: float | None = None
    contact: Literal["unilateral", "bonded"] | None = None

    def __post_init__(self):
        """Refuse a friction that there is not, what is no shape, and a contact that is none.

        Raises:
            ValueError: negative or not finite, or of a glued tool; another word.
        """
        check_word("tool.contact", self.contact, Literal["unilateral", "bonded"] | None)
        friction = self.friction
        check_word("tool.shape", self.shape, Shape | None)
        if friction is not None and not 0 <= float(friction) < math.inf:
            raise ValueError(f"friction is {friction}; expected a finite number, not negative")
        if friction is not None and self.contact == "bonded":
            raise ValueError(
                f"friction is {friction}, and contact is 'bonded'; expected one of them: what is "
                "glued does not slide"
            )


def check_material(geometry: Geometry, material: AnyMaterial) -> None:
    """Refuse arrays of a wrong length, and half of what a skeleton softens by.

    Raises:
        ValueError: naming the value, what was expected and the cure.
    """
    level_type(material).check(geometry, long_run(material))


def check_kind(scene: "Scene", material: AnyMaterial) -> None:
    """Refuse the material of another skeleton than the plan has.

    Raises:
        ValueError: what was expected.
    """
    level = scene.plan.mechanics
    if level.relaxes and not isinstance(material, RelaxingMaterial):
        raise ValueError(
            f"material is {type(material).__name__}; expected RelaxingMaterial (the plan has "
            f"relaxation {scene.plan.options.relaxation!r})"
        )
    if isinstance(material, RelaxingMaterial):
        if level.relaxes:
            _check_branches(scene, material)
        elif "relaxation" not in scene.plan.ignored:
            raise ValueError(
                "material relaxes, and the plan has relaxation 'off': make the scene with this "
                "material and a path with times, or with effects relaxation='off'"
            )
    material = long_run(material)
    if not isinstance(material, level.material_type):
        expected = level.material_type.__name__
        if level.material_type is not Material:
            expected += f" (the plan has a skeleton {level.name!r})"
        raise ValueError(f"material is {type(material).__name__}; expected {expected}")


def _check_branches(scene: "Scene", material: RelaxingMaterial) -> None:
    """Refuse branches that do not fit the plan.

    Raises:
        ValueError: those of the skeleton are missing; another dtype than the scene has.
    """
    local, skeleton = material.relaxation
    if scene.plan.options.relaxation == "parts" and skeleton is None:
        raise ValueError("relaxation.skeleton is None; the plan has relaxation 'parts'")
    dtype = scene.footprint.dtype
    for v in jax.tree.leaves((local, skeleton)):
        if v.dtype != dtype:
            raise ValueError(f"relaxation is {v.dtype}; expected {dtype}, as the scene has")


def check_path(path: Presses | Poses) -> None:
    """Refuse a path whose arrays do not belong together, or of matrices that are no rotations.

    Traced matrices are not looked at: that would be operations in every program.

    Raises:
        ValueError: the argument, its length and the expected one; or the row; no path.
    """
    check_word("path", path, Presses | Poses)
    if isinstance(path, Presses):
        rows = shaped("path.s", path.s, ("rows",)).shape[0]
        shaped("path.phi", path.phi, (rows,), why=" (as path.s has)")
        shaped("path.displacement", path.displacement, (rows, 3), why=" (rows as path.s has)")
    else:
        rows = shaped("path.translation", path.translation, ("rows", 3)).shape[0]
        why = " (rows as path.translation has)"
        rotation = shaped("path.rotation", path.rotation, (rows, 3, 3), why=why)
        if not isinstance(rotation, Tracer):
            check_rotations("path.rotation", np.asarray(rotation))
    if path.time is not None:
        shaped("path.time", path.time, (rows,), why=" (rows as the path has)")


class Instrument(eqx.Module):
    """One of several tools: what a `Scene` of this tool alone has of its own.

    Attributes:
        name: of the tool (static).
        tool: see `Scene`, as all others.
        friction: -
        footprint: -
        near: -
        quality: -
        contact: of this tool, where others have another (static); None: that of the plan.
    """

    name: str = eqx.field(static=True)
    tool: Shape | None
    friction: Float[Array, ""] | None
    footprint: Float[Array, ""]
    near: int = eqx.field(static=True)
    quality: Settings = eqx.field(static=True)
    contact: Literal["unilateral", "bonded"] | None = eqx.field(static=True, default=None)


class Scene(eqx.Module):
    """Everything of a scene but its material and its path.

    Attributes:
        geometry: the tube at rest.
        radius: of the tube's outside, where a tool touches it and the dent lies, mm.
        tube: its outside as convex patches, for a tool; or None.
        near: number of patches searched for a contact (static).
        tool: its shape about its own origin, or None.
        friction: Coulomb's coefficient of the tool, or None.
        mesh: the surface at rest, or None.
        binding: of the mesh, or None.
        footprint: distance between the circles of the dent's centres, mm.
        runs: order of the mesh's vertices, for a dent of this footprint; or None.
        points: the vertices on the wall of deforming cross-sections, in the place of `binding`.
        instruments: tools of a scene whose path is a mapping, in its order; tool and friction are
            None then, and the footprint is the largest. Empty: one tool, or none.
        plan: the program (static).
        quality: accuracy and work of the search for a contact (static).
    """

    geometry: Geometry
    radius: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    tube: Patches | None
    tool: Shape | None
    friction: Float[Array, ""] | None
    mesh: Mesh | None
    binding: regions.Binding | None
    footprint: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    near: int = eqx.field(static=True)
    plan: Plan = eqx.field(static=True)
    quality: Settings = eqx.field(static=True, default=STANDARD)
    runs: local.Runs | None = None
    points: Points | None = None
    instruments: tuple[Instrument, ...] = ()

    @property
    def names(self) -> list[str]:
        """Names of the instruments."""
        return [instrument.name for instrument in self.instruments]


def touch_tube(scene: Scene, path: Poses) -> Touch:
    """Contact of the tool with the tube at rest, row by row, batched.

    The tube is that of the mesh; without a mesh a straight cylinder of `scene.radius`.

    Raises:
        ValueError: no tool.
    """
    if scene.tool is None or scene.tube is None:
        raise ValueError("scene.tool is None; contact needs a tool")
    return touch_rows(scene.tool, scene.tube, path, scene.quality, scene.near)


@partial(jax.jit, static_argnames=("quality", "near"), inline=True)
def touch_rows(tool: Shape, tube: Patches, path: Poses, quality: Settings, near: int) -> Touch:
    """`touch_tube`: of other plans of a scene too it is traced once."""

    def one(tool, tube, R, T):
        return touch(tool, Pose(R, T), tube, quality, near=near)

    axes = (None, None, 0, 0)
    return jax.vmap(fuse(one), axes)(tool, tube, path.rotation, path.translation)


def at_row(v, row):
    """One row, of a traced number."""
    return jax.lax.dynamic_index_in_dim(v, row, keepdims=False)
