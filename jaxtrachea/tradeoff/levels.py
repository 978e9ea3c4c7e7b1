"""The accuracy choices of a scene as one record, and the program that a record stands for.

`Levels` holds one level of every choice. A rung of a ladder is a `Levels` with few fields replaced,
so that rungs of several ladders combine.
"""

import dataclasses
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea._arguments import check_record
from jaxtrachea.contact.search import FINE
from jaxtrachea.mechanics.beam import Form, Split
from jaxtrachea.mechanics.skeleton import Rings
from jaxtrachea.scene.build import Staged, wishes_of
from jaxtrachea.scene.plan import Effect, Facts, Plan, PlanError, Wishes
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.spec import SceneSpec
from jaxtrachea.scene.stage import (
    Poses,
    Presses,
    Scene,
    facts_of,
    touch_tube,
    with_geometry,
    with_mesh,
)
from jaxtrachea.surface.regions import Method
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material
from jaxtrachea.trachea.tube import make_tube

#: What a program on a ladder leaves out knowingly: its errors are what is measured.
EVERY = frozenset({"seat", "friction", "rings", "axial", "shear", "two_material", "end_motion"})
#: A scene that climbs every ladder but friction's: a ball on the trachea of Table 1.
BUILT_IN = {
    "material": {
        "EI_L": "1.862 N mm^2", "EA_L": "3.9 N", "GA_L": "1.2 N", "EI_C": "13.07 N mm^2",
        "k_M": "0.1 N/mm", "k_t": "0.4 N/mm", "k_1": "0.3 N/mm", "k_3": "0.02 N/mm^3",
        "k_1_ring": "0.6 N/mm", "k_A": "0.2 N/mm", "k_B": "0.5 N/mm",
    },
    "tool": {"shape": "sphere", "radius": "5 mm"},
    "path": [
        {"start": ["73 mm", "18 mm", "1 mm"], "end": ["74 mm", "15 mm", "1.5 mm"], "steps": 4}
    ],
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Levels:
    """One level of every choice; hashable.

    Attributes:
        form: of the beam, see `Options`; read in one plane only, like `split`.
        split: -
        coupling: see `Options`, like `shear` and `local`.
        shear: -
        local: -
        second_plane: see `Wishes`, like all down to `dent`; without it rings are `mat` and nothing
            moves along the tube.
        rings: -
        axial: -
        end_motion: -
        friction: -
        surface: -
        dent: number of centres, 0: off.
        sharpness: of the contact, see `contact.search.Settings`.
        steps: Newton steps of the contact (`warm_steps`).
        mesh: vertices round and along the tube, against those of the scene.
        kept: number of rings nearest to the load.
        dtype: -
    """

    form: Form = "recursion"
    split: Split = "continuous"
    coupling: Literal["series", "total"] = "series"
    shear: bool = False
    local: Literal["uniform", "two-material"] = "uniform"
    second_plane: bool = False
    rings: Rings = "mat"
    axial: bool = False
    end_motion: bool = False
    friction: bool = False
    surface: Method | None = None
    dent: int = 0
    sharpness: float = FINE.sharpness
    steps: int = FINE.warm_steps
    mesh: float = 1.0
    kept: int = 1
    dtype: Literal["float32", "float64"] = "float64"

    def __post_init__(self):
        """Refuse words and numbers that mean nothing.

        Raises:
            ValueError: naming the field, what was found and what is expected.
        """
        check_record(self, dent=0.0, sharpness=0.0, steps=1.0, mesh=0.0, kept=1.0)


class Full(NamedTuple):
    """A scene at its finest.

    Attributes:
        scene: with the finest plan.
        material: -
        path: -
        levels: what that plan and the finest of all else are.
        facts: of the scene.
        wishes: of the user, what was `auto` at its finest.
        given: of the user.
        made: vertices round and along the mesh; None: not made, or none.
        load: s of the contacts, mm.
    """

    scene: Scene
    material: Material
    path: Poses | Presses
    levels: Levels
    facts: Facts
    wishes: Wishes
    given: Wishes
    made: tuple[int, int, float] | None
    load: np.ndarray


def full_scene(spec: SceneSpec, staged: Staged, *, coupling: str | None = None) -> Full:
    """The scene with everything that its material and path allow; what is forced is kept.

    Against the rules (`scene.rules`): rings are arches wherever EI_C and k_t are given, the dent
    has 32 centres, contacts are `fine`.

    Args:
        spec: of the scene.
        staged: made from it.
        coupling: instead of that of the specification.

    Raises:
        PlanError: a wish that cannot be met.
    """
    scene, material, path = staged.scene, staged.material, staged.path
    facts, given = facts_of(scene, material, path), wishes_of(spec)
    wishes = _finest(given, scene, material, path)
    if coupling is not None:
        wishes = dataclasses.replace(wishes, coupling=coupling)
    plan = _in_words(make_plan(facts, wishes), given)
    scene = dataclasses.replace(scene, plan=plan, quality=FINE)
    made = None
    if spec.trachea.file is None and scene.mesh is not None:
        made = spec.trachea.around, spec.trachea.along, spec.trachea.wall
    load = _load(scene, path)
    return Full(
        scene, material, path, levels_of(scene.plan, scene), facts, wishes, given, made, load
    )


def _finest(wishes: Wishes, scene: Scene, material: Material, path) -> Wishes:
    """The user's wishes, with the finest level instead of `auto` where the rules stop short."""
    bends = material.EI_C is not None and material.k_t is not None
    if wishes.rings == "auto" and bends and wishes.second_plane != "off":
        wishes = dataclasses.replace(wishes, rings="arch2")
    if wishes.dent == "auto" and scene.plan.dent and isinstance(path, Poses):
        wishes = dataclasses.replace(wishes, dent="32")
    return wishes


def _in_words(plan: Plan, given: Wishes) -> Plan:
    """The plan with reasons that do not call a wish what is one of `_finest` only."""

    def said(effect: Effect) -> Effect:
        mine = effect.name in ("rings", "dent") and getattr(given, effect.name) == "auto"
        if mine and effect.forced:
            return Effect(effect.name, effect.level, "the finest level")
        if effect.reason == "rings 'arch2' were asked for" and given.rings == "auto":
            return Effect(effect.name, effect.level, "arches need vectors")
        return effect

    return dataclasses.replace(plan, effects=tuple(map(said, plan.effects)))


def levels_of(plan: Plan, scene: Scene) -> Levels:
    """The levels that a plan stands for, with all rings, the scene's mesh and float64."""
    o = plan.options
    return Levels(
        o.form, o.split, o.coupling, o.shear, o.local, plan.second_plane, plan.rings, plan.axial,
        plan.end_motion, plan.friction, plan.surface, plan.dent, scene.quality.sharpness,
        scene.quality.warm_steps, kept=scene.geometry.rings,
    )  # fmt: skip


def program(full: Full, levels: Levels) -> tuple[Scene, Material, Poses | Presses]:
    """Scene, material and path whose `simulate` is the program of these levels."""
    scene, rings = full.scene, full.levels.kept
    plan = plan_of(full.scene.plan, levels)
    if plan.options.transition is None and levels.kept < rings:
        wide = dataclasses.replace(plan.options, transition=_half_gap(scene.geometry))
        plan = dataclasses.replace(plan, options=wide)
    work = {"sharpness": levels.sharpness, "warm_steps": levels.steps}
    scene = dataclasses.replace(scene, plan=plan, quality=dataclasses.replace(FINE, **work))
    if levels.mesh != 1:
        assert full.made is not None
        scene = with_mesh(scene, _mesh(scene.geometry, full.made, levels.mesh))
    if levels.kept < rings:
        x = scene.geometry.ring_positions[kept_rings(full, levels.kept)]
        scene = with_geometry(scene, dataclasses.replace(scene.geometry, ring_positions=x))
    if plan.surface is None and not plan.contact:
        scene = dataclasses.replace(scene, mesh=None, binding=None, runs=None)
    made = scene, full.material, full.path
    return made if levels.dtype == "float64" else cast(made, levels.dtype)


def plan_of(plan: Plan, levels: Levels) -> Plan:
    """The plan with these levels; decisions in words stay those of `plan`."""
    flat = not levels.second_plane
    options = dataclasses.replace(
        plan.options, form=levels.form, split=levels.split, coupling=levels.coupling,
        shear=levels.shear, local=levels.local,
    )  # fmt: skip
    return dataclasses.replace(
        plan, second_plane=levels.second_plane, rings="mat" if flat else levels.rings,
        axial=levels.axial and not flat, friction=levels.friction and not flat,
        end_motion=levels.end_motion and levels.axial and not flat and levels.surface is not None,
        surface=levels.surface, dent=levels.dent if levels.surface else 0, options=options,
        ignored=EVERY,
    )  # fmt: skip


def kept_rings(full: Full, count: int) -> np.ndarray:
    """The `count` rings nearest to the loads, in order."""
    x = np.asarray(full.scene.geometry.ring_positions)
    away = np.maximum(full.load.min() - x, x - full.load.max())
    return np.sort(np.argsort(away, kind="stable")[:count])


def one_plane(full: Full) -> str:
    """Why the path does not fit in one plane; empty if it does."""
    flat = {"rings": "mat", "axial": "off", "end_motion": "off", "friction": "off"}
    try:
        make_plan(full.facts, dataclasses.replace(full.wishes, second_plane="off", **flat))
    except PlanError as error:
        return str(error).removeprefix("second_plane: 'off', but ").split(";")[0]
    return ""


def cast(tree, dtype: str):
    """All floating arrays of a tree in this dtype."""
    change = lambda v: v.astype(dtype) if jnp.issubdtype(v.dtype, jnp.floating) else v  # noqa: E731
    return jax.tree.map(change, tree)


def _load(scene: Scene, path: Poses | Presses) -> np.ndarray:
    if isinstance(path, Presses):
        return np.asarray(path.s)
    seen = jax.jit(touch_tube)(scene, path)
    s, gap = np.asarray(seen.s), np.asarray(seen.gap)
    return s[gap < 0] if (gap < 0).any() else s


def _half_gap(geometry: Geometry) -> float:
    """Where the ligament's own law is reached, by default: as in `model.local_law`."""
    x = np.asarray(geometry.ring_positions)
    ends = np.r_[-x[:1], x, 2 * float(geometry.length) - x[-1:]]
    return float(np.diff(ends).min()) / 2


def _mesh(geometry: Geometry, made: tuple[int, int, float], factor: float):
    around, along, wall = made
    many = max(round(around * factor), 3), max(round(along * factor), 1)
    return make_tube(geometry, around=many[0], along=many[1], wall=wall)


def solve(scene: Scene, material: Material, path: Poses | Presses):
    """`simulate`, and how the force changes with each parameter per relative change of it.

    Returns:
        The `Simulation` and d force / d log parameter, N; shape (rows, 3, parameters).
    """
    names = parameter_names(material)
    values = {name: getattr(material, name) for name in names}

    def forces(share):
        changed = {name: v * (1 + share[i]) for i, (name, v) in enumerate(values.items())}
        out = simulate(scene, dataclasses.replace(material, **changed), path)
        return out.force, out

    change, out = jax.jacfwd(forces, has_aux=True)(jnp.zeros(len(names), material.k_1.dtype))
    return out, change


def parameter_names(material: Material) -> list[str]:
    """Parameters that the material has."""
    names = [field.name for field in dataclasses.fields(material)]
    return [name for name in names if getattr(material, name) is not None]
