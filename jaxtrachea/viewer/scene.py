"""A scene for a mouse: the plan of tools that go anywhere, and the places where they begin."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxtrachea.contact.shapes import Shape, parts_of
from jaxtrachea.scene.build import Staged, stage
from jaxtrachea.scene.paths import path_of
from jaxtrachea.scene.session import Session
from jaxtrachea.scene.spec import SceneSpec, load_scene_spec
from jaxtrachea.scene.spec_parts import PathSection, ToolSection
from jaxtrachea.scene.stage import Poses, Scene

#: The tool of a scene that has none: the last joint of a finger, across the tube.
FINGER = {"shape": "capsule", "radius": "7 mm", "length": "10 mm"}
#: Shortest and longest time, s, that a force which relaxes without a time of its own is made for.
TIMES = (0.05, 1000.0)
#: Distance of the tool from the wall where the scene gives no first position, mm.
CLEARANCE = 3.0


class Handled(NamedTuple):
    """A scene whose tools a user moves.

    Attributes:
        title: of the scene.
        staged: scene and material; its path is not used.
        poses: of the tools at the start: rotation by rows, translation, mm; shape (tools, 12).
        notes: sentences for the user.
    """

    title: str
    staged: Staged
    poses: np.ndarray
    notes: tuple[str, ...]

    @property
    def tools(self) -> list[Shape | None]:
        """About their origins."""
        return tools_of(self.staged.scene)

    @property
    def names(self) -> list[str]:
        """Of the tools; a single one may have none."""
        return self.staged.scene.names or ["tool"]

    def session(self) -> Session:
        """Compile."""
        return Session(self.staged.scene, self.staged.material)


def read_handled(path: Path, begin: Callable[[str], None] = lambda _: None) -> Handled:
    """Read a scene file for tools that go anywhere.

    The second plane is on, and axial motion where `EA_L` is given (of several tools: with
    friction). The contact point is `per_step` without friction, so that the force depends on the
    pose alone. With a coefficient of friction, of a bonded tool, and where the force relaxes, it is
    `fixed`, as docs/haptics.md has it.

    Raises:
        SpecError: a file or a value that cannot be used, with its key.
    """
    spec = _without_the_name_of_one(load_scene_spec(path))
    changed, notes = for_a_mouse(spec)
    staged = stage(changed, path.parent, lambda text: begin(text))
    if spec.tool is None:
        notes += (f"the scene has no tool: a finger ({_words(FINGER)}) is used",)
    poses = _start(spec, staged, path.parent)
    return Handled(spec.title or path.stem, staged, poses, (*staged.notes, *notes))


def _without_the_name_of_one(spec: SceneSpec) -> SceneSpec:
    """A single tool of a list as the only one: one tool may stick, slide and relax."""
    if len(spec.names) != 1:
        return spec
    tool = spec.tool[0].model_copy(update={"name": None}) if isinstance(spec.tool, list) else None
    legs = [leg.model_copy(update={"tool": None}) for leg in spec.path]
    return spec.model_copy(update={"tool": tool, "path": legs})


def for_a_mouse(spec: SceneSpec) -> tuple[SceneSpec, tuple[str, ...]]:
    """The specification of a tool that goes anywhere, and what that leaves out."""
    wanted, notes = spec.effects, []
    changes = {"second_plane": "on", "width": "point", "surface": "auto", "dent": "16"}
    material = None if spec.material is None else spec.material.model_dump()
    if material is not None:
        changes |= {"skeleton": "linear", "axial": "on" if material["EA_L"] is not None else "off"}
        if material["e_1"] is not None:
            notes.append("skeleton: linear, since a softening one is for the midline alone")
    if wanted.surface not in ("auto", "off"):
        changes["surface"] = wanted.surface
    relaxes = spec.relaxation is not None and wanted.relaxation != "off"
    if spec.model.half_width > 0:
        notes.append("width: point, since half_width is for presses straight in on the midline")
    tools = spec.tool if isinstance(spec.tool, list) else [spec.tool]
    own = {(tool and tool.contact) or spec.model.contact for tool in tools}
    glued, contact = "bonded" in own, spec.model.contact
    if glued and spec.tool is None:
        glued, contact = False, "unilateral"
        notes.append("contact: unilateral, since a finger is not glued to the wall")
    rubs = _rubs(spec) and not glued
    bare = any(tool is None or tool.friction is None for tool in tools)
    if rubs and (relaxes or bare):
        rubs = False
        why = "the force relaxes" if relaxes else "not every tool has a coefficient"
        notes.append(f"no friction, since {why}")
    changes["contact_point"] = "fixed" if glued or rubs or relaxes else "per_step"
    if spec.names and not rubs:
        changes["axial"] = "off"
    changes["friction"] = "on" if rubs else "off"
    return spec.model_copy(
        update={
            "effects": wanted.model_copy(update=changes),
            "output": spec.output.model_copy(update={"surface": True, "joints": False}),
            "model": spec.model.model_copy(update={"contact": contact}),
            "tool": spec.tool or _fingers(spec.names),
            "path": _far_away(spec.names, TIMES if relaxes else ()),
            "plan": None,
        }
    ), tuple(notes)


def _fingers(names: Sequence[str]) -> ToolSection | list[ToolSection]:
    """A finger, or one of each name."""
    named = [ToolSection.model_validate(FINGER | {"name": name}) for name in names]
    return named or ToolSection.model_validate(FINGER)


def _far_away(names: Sequence[str], times: Sequence[float]) -> list[PathSection]:
    """Paths beside the tube that the scene is made with: of each tool a row for each time."""
    tools: list[dict] = [{"tool": name} for name in names] or [{}]
    durations: list[dict] = [{"duration": f"{t} s"} for t in times] or [{}]
    places = [{"positions": [[f"{100 * k} mm", "1000 mm", "0 mm"]]} for k in range(len(tools))]
    legs = [
        place | tool | of for place, tool in zip(places, tools, strict=True) for of in durations
    ]
    return [PathSection.model_validate(leg) for leg in legs]


def _rubs(spec: SceneSpec) -> bool:
    """Whether a tool of this scene is to stick and slide by Coulomb's law."""
    tools = spec.tool if isinstance(spec.tool, list) else [spec.tool]
    known = any(tool is not None and tool.friction is not None for tool in tools)
    wished = spec.effects.friction != "off" and spec.effects.contact_point != "per_step"
    return known and wished and spec.model.coupling == "series"


def _words(tool: dict[str, str]) -> str:
    return ", ".join((tool["shape"], *(f"{k} {v}" for k, v in tool.items() if k != "shape")))


def _start(spec: SceneSpec, staged: Staged, folder: Path) -> np.ndarray:
    """The first pose of each tool's path, or one above its first press; shape (tools, 12)."""
    scene, found = staged.scene, []
    if spec.path[0].kind != "press":
        path = path_of(spec, folder, [], scene.geometry)
        for one in path.values() if isinstance(path, dict) else [path]:
            assert isinstance(one, Poses)
            found.append(np.append(one.rotation[0], one.translation[0]))
        return np.stack(found)
    for tool, name in zip(tools_of(scene), spec.names or [None], strict=True):
        leg = next(leg for leg in spec.path if leg.tool == name)
        assert tool is not None
        over = above(scene, tool, leg.s or 0.0, leg.phi or 0.0, CLEARANCE)
        found.append(np.append(np.eye(3), over))
    return np.stack(found)


def tools_of(scene: Scene) -> list[Shape | None]:
    """Its tools, or its one, about their origins."""
    return [one.tool for one in scene.instruments] or [scene.tool]


def above(scene: Scene, tool: Shape, s: float, phi: float, gap: float) -> np.ndarray:
    """Position of an unturned tool over a place of the wall at rest, mm; shape (3,).

    Args:
        scene: with a mesh.
        tool: about its origin.
        s: along the centreline, mm.
        phi: from the anterior midline, rad.
        gap: distance of tool and wall along the normal; negative: below the wall at rest.
    """
    mesh = scene.mesh
    assert mesh is not None
    turn = (np.asarray(mesh.phi) - phi + np.pi) % (2 * np.pi) - np.pi
    near = np.hypot(np.asarray(mesh.s) - s, np.asarray(mesh.distance) * turn).argmin()
    normal, point = np.asarray(mesh.normals[near]), np.asarray(mesh.vertices[near])
    return point + (gap + float(reach(tool, -normal))) * normal


def reach(tool: Shape, direction: np.ndarray) -> float:
    """How far a tool goes from its origin in this direction, mm."""
    return max(
        float((direction @ np.asarray(part.vertices)).max() + part.radius)
        for part in parts_of(tool)
    )
