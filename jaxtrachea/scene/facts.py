"""The facts of a scene and its path, that its plan is made from (concrete numbers)."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxtrachea.files.traces import Traced
from jaxtrachea.mechanics.levels.choose import AnyMaterial, level_type
from jaxtrachea.mechanics.levels.relaxing import long_run
from jaxtrachea.scene.approach import first_touch, on_one_point
from jaxtrachea.scene.declare import SceneFacts
from jaxtrachea.scene.effects import EffectOptions, given_values
from jaxtrachea.scene.lumen import in_lumen
from jaxtrachea.scene.needs import (
    PLANNED,
    axial,
    drags,
    elsewhere,
    lateral,
    motion_of,
    off_midline,
    slides,
)
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.stage import Poses, Presses, Scene, touch_tube
from jaxtrachea.surface import local
from jaxtrachea.trachea.material import DEEP

#: Rows that a path is filled up to, or twice, four times ...; longer ones than `MAX_ROWS` are not.
MIN_ROWS, MAX_ROWS = 64, 4096


#: Others may raise the wall to a tool that is clear of it at rest by so much of the tube's radius.
RAISED = 0.25


def facts_of(
    scene: Scene, material: AnyMaterial, path: Poses | Presses, *, bonded: bool = False,
    several: bool = False,
) -> SceneFacts:  # fmt: skip
    """What the rules need to know of a scene and its path; rows in the lumen touch nothing.

    What one row needs (`needs`) the path does, so that its plan serves it.

    Args:
        scene: its plan is not read.
        material: read only for which optional values are there.
        path: what the plan is made for.
        bonded: the tool sticks to the wall: it draws, too.
        several: others press beside it.
    """
    curved = scene.mesh is not None and scene.mesh.frames is not None
    if isinstance(path, Poses):
        seen = _TOUCHED(_what_is_touched(scene, curved, bonded), _filled_up(path))
        rows = len(path.translation)
        s, phi, touching, moved = (np.asarray(v)[:rows] for v in seen[:4])
        s, phi, moved = (np.asarray(v, float) for v in (s, phi, moved))
        place = np.asarray(seen[6], float)
        gap = np.asarray(seen[5], float)[:rows]
        outside = touching | ~(gap < 0)
        after = outside & (np.arange(rows) >= int(seen[4]))
    else:
        s, phi, moved = (np.asarray(v, float) for v in (path.s, path.phi, path.displacement))
        touching, place = np.ones(len(s), bool), np.array([s, phi])
        gap, outside, after = np.zeros(len(s)), touching, touching
    here = np.broadcast_to(place[1], s.shape)
    inward = -(moved[:, 1] * np.cos(here) + moved[:, 2] * np.sin(here))
    # Rows that press one place, and those that press each its own; not what goes before.
    held = touching | (outside & (moved != 0).any(axis=1)) if bonded else touching
    own = outside if bonded else touching
    near = held | (several & outside & (gap < RAISED * float(scene.radius)))
    motion = motion_of(s[held], here[held], moved[held], np)
    beside = motion_of(s[near], here[near], moved[near], np)
    whole = max(_largest(motion.length), 1e-9)

    radius = float(level_type(material).wall_radius(scene.geometry, scene.radius))

    def reach(way, retracted):
        least, most = (
            np.fmin.reduce(way[retracted], initial=0),
            np.fmax.reduce(way[outside], initial=0),
        )
        return float(least) / radius, float(most) / radius

    def largest(v, needed):
        return _largest(v[needed])

    angles = np.concatenate([phi[own], np.ravel(here[near])])
    x = np.asarray(scene.geometry.ring_positions, float)
    return SceneFacts(
        poses=isinstance(path, Poses),
        angle=largest(abs(angles), off_midline(angles, PLANNED)),
        several_points=bool(elsewhere(motion._replace(phi=phi[held]), PLANNED).any()),
        along=largest(beside.along, axial(beside, PLANNED)) / whole,
        across=largest(beside.across, lateral(beside, PLANNED)) / whole,
        slip=largest(motion.slip, slides(motion, PLANNED)),
        drags=bool(drags(motion, PLANNED).any()),
        spacing=float(np.diff(x).min()) if len(x) > 1 else float(scene.geometry.length),
        friction=scene.friction is not None,
        known=given_values(material),
        mesh=scene.mesh is not None,
        curved=curved,
        near=_near(scene, np.append(s, place[0]), np.append(phi, place[1])),
        way_fixed=reach(inward, after),
        way_per_step=reach(-gap, outside),
        softness=_softness(long_run(material), radius),
        timed=path.time is not None,
        duration=0.0 if path.time is None else float(np.ptp(np.asarray(path.time, float))),
    )  # fmt: skip


def facts_together(each: Sequence[SceneFacts], *, glued: bool = False) -> SceneFacts:
    """What the rules need to know of several tools of one scene: what one of them needs.

    Args:
        each: of every tool.
        glued: some of them are glued, and others not.
    """

    def joined(name: str):
        values = [getattr(facts, name) for facts in each]
        if isinstance(values[0], tuple):
            low, high = zip(*values, strict=True)
            return min(low), max(high)
        return max(values)

    whole = "angle", "several_points", "along", "across", "slip", "near"
    whole += "way_fixed", "way_per_step", "duration", "drags"
    changed = {name: joined(name) for name in whole}
    rubs = all(facts.friction for facts in each)
    return dataclasses.replace(each[0], tools=len(each), friction=rubs, glued=glued, **changed)


def _largest(v) -> float:
    """The largest of numbers that are not negative; those that are none do not count."""
    return float(np.fmax.reduce(v, initial=0))


def _softness(material: AnyMaterial, radius: float) -> tuple[float, float]:
    """e_1 R and e_2 R^2; 0 where the material does not soften."""
    e_1, e_2 = (getattr(material, name, None) for name in DEEP)
    if e_1 is None or e_2 is None:
        return 0.0, 0.0
    return float(e_1) * radius, float(e_2) * radius**2


def _what_is_touched(scene: Scene, curved: bool, bonded: bool) -> Scene:
    """The scene without what a tool does not touch: other plans and meshes share one program."""
    contact = "bonded" if bonded else "unilateral"
    plan = make_plan(SceneFacts(mesh=False), EffectOptions(want_surface=False, contact=contact))
    return dataclasses.replace(
        scene, mesh=None, binding=None, runs=None, friction=None,
        plan=dataclasses.replace(plan, curved=curved),
    )  # fmt: skip


def _filled_up(path: Poses) -> Poses:
    """The path to a round number of rows by its last pose: paths of any length share a program."""
    rows = len(path.translation)
    if rows > MAX_ROWS:
        return path
    round_number = MIN_ROWS
    while round_number < rows:
        round_number *= 2
    filled = np.minimum(np.arange(round_number), rows - 1)
    return Poses(np.asarray(path.rotation)[filled], np.asarray(path.translation)[filled])


def _touched(
    scene: Scene, path: Poses
) -> tuple[
    Float[Array, " rows"],
    Float[Array, " rows"],
    Bool[Array, " rows"],
    Float[Array, "rows 3"],
    Int[Array, ""],
    Float[Array, " rows"],
    tuple[Float[Array, ""], Float[Array, ""]],
]:
    """Contact of every row and whether it is one with the outside; the path as presses there.

    Returns:
        s, mm; phi, rad; whether the row touches from outside; displacement of the contact point,
        mm; the row of first touch; gap, mm; s and phi of the first touch.
    """
    seen = touch_tube(scene, path)
    inside = in_lumen(scene, path, seen)
    touching, row = first_touch(seen, inside)
    presses = on_one_point(scene, path, seen, row, inside).presses
    place = presses.s[0], presses.phi[0]
    return seen.s, seen.phi, touching, presses.displacement, row, seen.gap, place


#: Paths of any length share its program, and other starts its trace.
_TOUCHED = Traced(_touched)


def _near(scene: Scene, s, phi) -> bool:
    """Whether a vertex lies within the reach of a dent at any of the contacts."""
    if scene.mesh is None:
        return False
    mesh, reach = scene.mesh, local.REACH * float(scene.footprint)

    def points_of(*at):
        s, phi, r = (np.asarray(v, float) for v in at)
        return np.stack([s, r * np.cos(phi), r * np.sin(phi)], axis=1)

    C, points = points_of(s, phi, scene.radius), points_of(mesh.s, mesh.phi, mesh.distance)
    return any(bool((np.sum((points - c) ** 2, axis=1) < reach**2).any()) for c in C)
