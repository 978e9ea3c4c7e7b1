"""A scene for a mouse: the plan of a tool that goes anywhere, and the place where it begins."""

from collections.abc import Callable
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
    """A scene whose tool a user moves.

    Attributes:
        title: of the scene.
        staged: scene and material; its path is not used.
        rotation: of the tool at the start; shape (3, 3).
        translation: of its origin, mm; shape (3,).
        notes: sentences for the user.
    """

    title: str
    staged: Staged
    rotation: np.ndarray
    translation: np.ndarray
    notes: tuple[str, ...]

    def session(self) -> Session:
        """Compile."""
        return Session(self.staged.scene, self.staged.material)


def read_handled(path: Path, begin: Callable[[str], None] = lambda _: None) -> Handled:
    """Read a scene file for a tool that goes anywhere.

    The second plane is on, and axial motion where `EA_L` is given. The contact point is `per_step`
    without friction, so that the force depends on the pose alone. With a coefficient of friction,
    of a bonded tool, and where the force relaxes, it is `fixed`, as docs/haptics.md has it.

    Args:
        path: of the scene (TOML).
        begin: called with the name of each stage of the work.

    Raises:
        SpecError: a file or a value that cannot be used, with its key.
    """
    spec = load_scene_spec(path)
    changed, notes = for_a_mouse(spec)
    staged = stage(changed, path.parent, lambda text: begin(text))
    if spec.tool is None:
        notes += (f"the scene has no tool: a finger ({_words(FINGER)}) is used",)
    rotation, translation = _start(spec, staged, path.parent)
    return Handled(
        title=spec.title or path.stem, staged=staged, rotation=rotation,
        translation=translation, notes=(*staged.notes, *notes),
    )  # fmt: skip


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
    glued = spec.model.contact == "bonded"
    if glued and spec.tool is None:
        glued = False
        notes.append("contact: unilateral, since a finger is not glued to the wall")
    rubs = _rubs(spec)
    if rubs and relaxes:
        rubs = False
        notes.append("no friction, since the force relaxes")
    changes["contact_point"] = "fixed" if glued or rubs or relaxes else "per_step"
    changes["friction"] = "on" if rubs else "off"
    away = {"positions": [["0 mm", "1000 mm", "0 mm"]]}
    legs = [away | {"duration": f"{t} s"} for t in TIMES] if relaxes else [away]
    return spec.model_copy(
        update={
            "effects": wanted.model_copy(update=changes),
            "output": spec.output.model_copy(update={"surface": True, "joints": False}),
            "model": spec.model.model_copy(update={"contact": "bonded" if glued else "unilateral"}),
            "tool": spec.tool or ToolSection.model_validate(FINGER),
            "path": [PathSection.model_validate(leg) for leg in legs],
            "plan": None,
        }
    ), tuple(notes)


def _rubs(spec: SceneSpec) -> bool:
    """Whether a tool of this scene sticks and slides by Coulomb's law."""
    known = isinstance(spec.tool, ToolSection) and spec.tool.friction is not None
    wished = spec.effects.friction != "off" and spec.effects.contact_point != "per_step"
    return (
        known and wished and (spec.model.contact, spec.model.coupling) == ("unilateral", "series")
    )


def _words(tool: dict[str, str]) -> str:
    return ", ".join((tool["shape"], *(f"{k} {v}" for k, v in tool.items() if k != "shape")))


def _start(spec: SceneSpec, staged: Staged, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """The first pose of the scene's path, or one above its first press."""
    scene = staged.scene
    first = spec.path[0]
    if first.kind != "press":
        path = path_of(spec, folder, [], scene.geometry)
        assert isinstance(path, Poses)
        return np.array(path.rotation[0]), np.array(path.translation[0])
    return np.eye(3), above(scene, first.s or 0.0, first.phi or 0.0, CLEARANCE)


def above(scene: Scene, s: float, phi: float, gap: float) -> np.ndarray:
    """Position of an unturned tool over a place of the wall at rest, mm; shape (3,).

    Args:
        scene: with tool and mesh.
        s: along the centreline, mm.
        phi: from the anterior midline, rad.
        gap: distance of tool and wall along the normal; negative: below the wall at rest.
    """
    mesh = scene.mesh
    assert mesh is not None
    assert scene.tool is not None
    turn = (np.asarray(mesh.phi) - phi + np.pi) % (2 * np.pi) - np.pi
    near = np.hypot(np.asarray(mesh.s) - s, np.asarray(mesh.distance) * turn).argmin()
    normal, point = np.asarray(mesh.normals[near]), np.asarray(mesh.vertices[near])
    return point + (gap + float(reach(scene.tool, -normal))) * normal


def reach(tool: Shape, direction: np.ndarray) -> float:
    """How far a tool goes from its origin in this direction, mm."""
    return max(
        float((direction @ np.asarray(part.vertices)).max() + part.radius)
        for part in parts_of(tool)
    )
