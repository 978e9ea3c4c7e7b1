"""The accuracy choices of a scene as one record, and the program that a record stands for.

`Levels` holds one level of every choice: those of the effects in its plan, the others beside it. A
rung of a ladder is a `Levels` with a few of them changed, so that rungs of several ladders combine.
"""

import dataclasses
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxtrachea._arguments import check_record
from jaxtrachea.contact.search import FINE
from jaxtrachea.mechanics.levels.choose import AnyMaterial
from jaxtrachea.mechanics.levels.relaxing import RelaxingMaterial, long_run
from jaxtrachea.mechanics.press import default_transition
from jaxtrachea.scene.assemble import with_geometry, with_mesh
from jaxtrachea.scene.build import Staged, effects_of
from jaxtrachea.scene.declare import PlanError, SceneFacts
from jaxtrachea.scene.effects import EFFECTS, EffectOptions, given_values, goes_with
from jaxtrachea.scene.facts import facts_of
from jaxtrachea.scene.plan import Plan
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.simulation import simulate
from jaxtrachea.scene.spec import SceneSpec
from jaxtrachea.scene.stage import Poses, Presses, Scene, touch_tube
from jaxtrachea.trachea.material import Material
from jaxtrachea.trachea.tube import make_tube

#: What a program on a ladder leaves out knowingly: its errors are what is measured.
EVERY = frozenset(EFFECTS)
#: Choices of the model that a ladder climbs and no effect is.
MODEL = ("form", "split", "coupling")
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
        plan: levels of the effects, and the model.
        sharpness: of the contact, see `contact.search.Settings`.
        steps: Newton steps of the contact (`warm_steps`).
        mesh: vertices round and along the tube, against those of the scene.
        kept: number of rings nearest to the load.
    """

    plan: Plan
    sharpness: float = FINE.sharpness
    steps: int = FINE.warm_steps
    mesh: float = 1.0
    kept: int = 1
    dtype: Literal["float32", "float64"] = "float64"

    def __post_init__(self):
        """Refuse words and numbers that mean nothing (`ValueError`)."""
        check_record(self, sharpness=0.0, steps=1.0, mesh=0.0, kept=1.0)

    def changed(self, **levels: Any) -> "Levels":
        """With these levels: of effects, of the model (`MODEL`), or of the other fields."""
        effects = {name: level for name, level in levels.items() if name in EFFECTS}
        model = {name: level for name, level in levels.items() if name in MODEL}
        others = {k: v for k, v in levels.items() if k not in effects | model}
        options = dataclasses.replace(self.plan.options, **model)
        plan = dataclasses.replace(self.plan, options=options).at(**effects)
        return dataclasses.replace(self, plan=plan, **others)


class Full(NamedTuple):
    """A scene at its finest.

    Attributes:
        scene: with the finest plan.
        levels: what that plan and the finest of all else are.
        facts: of the scene.
        options: of the user, what was `auto` at its finest.
        given: of the user.
        made: vertices round and along the mesh, its wall and relief, mm; None: not made, or none.
        load: s of the contacts, mm.
    """

    scene: Scene
    material: Material
    path: Poses | Presses
    levels: Levels
    facts: SceneFacts
    options: EffectOptions
    given: EffectOptions
    made: tuple[int, int, float, float | None] | None
    load: np.ndarray


def full_scene(spec: SceneSpec, staged: Staged, *, coupling: str | None = None) -> Full:
    """The scene with everything that its material and path allow; what is forced is kept.

    Against the rules (`scene.rules`): rings are arches wherever EI_C and k_t are given, the dent
    has 32 centres, contacts are `fine`.

    Raises:
        PlanError: a wish that cannot be met.
    """
    scene, path = staged.scene, staged.path
    material: Any = staged.material
    if isinstance(path, dict):
        why = "nothing of several tools is traded for time"
        raise PlanError("tools", f"{len(path)} tools", why, "leave [plan] out, or give one tool")
    if not scene.plan.mechanics.hangs_on_rings:
        why = "nothing of deforming cross-sections is traded for time"
        raise PlanError("skeleton", "'sections'", why, "leave [plan] out, or give [material]")
    given = effects_of(spec)
    facts = facts_of(scene, material, path, bonded=given.contact == "bonded")
    options, finest = _finest(given, scene, material, path)
    if coupling is not None:
        options = dataclasses.replace(options, coupling=coupling)
    plan = make_plan(facts, options, finest=finest)
    scene = dataclasses.replace(scene, plan=plan, quality=FINE)
    made = None
    if spec.trachea.file is None and scene.mesh is not None:
        tube = spec.trachea
        made = tube.around, tube.along, tube.wall, tube.relief
    return Full(
        scene=scene, material=material, path=path,
        levels=Levels(plan, kept=scene.geometry.rings), facts=facts, options=options, given=given,
        made=made, load=_load(scene, path),
    )  # fmt: skip


def _finest(
    given: EffectOptions, scene: Scene, material: Material, path: Poses | Presses
) -> tuple[EffectOptions, frozenset[str]]:
    """The user's options, the finest level in place of `auto` where rules stop short; its names."""
    finest = {}
    bends = EFFECTS["rings"].given(given_values(material))
    if given.rings == "auto" and bends and given.second_plane != "off":
        finest["rings"] = EFFECTS["rings"].rungs[-1]
    softens = EFFECTS["skeleton"].given(given_values(material)) and given.coupling == "series"
    if given.skeleton == "auto" and softens and not scene.plan.second_plane:
        finest["skeleton"] = EFFECTS["skeleton"].rungs[-1]
    if given.dent == "auto" and scene.plan.dent and isinstance(path, Poses):
        finest["dent"] = EFFECTS["dent"].rungs[-1]
    return dataclasses.replace(given, **finest), frozenset(finest)


def program(full: Full, levels: Levels) -> tuple[Scene, Material, Poses | Presses]:
    """Scene, material and path whose `simulate` is the program of these levels."""
    scene, rings = full.scene, full.levels.kept
    plan = dataclasses.replace(levels.plan, ignored=EVERY)
    if plan.options.transition is None and levels.kept < rings:
        transition = float(default_transition(scene.geometry))
        wide = dataclasses.replace(plan.options, transition=transition)
        plan = dataclasses.replace(plan, options=wide)
    work = {"sharpness": levels.sharpness, "warm_steps": levels.steps}
    scene = dataclasses.replace(scene, plan=plan, quality=dataclasses.replace(FINE, **work))
    if levels.mesh != 1:
        assert full.made is not None
        around, along, wall, relief = full.made
        around, along = max(round(around * levels.mesh), 3), max(round(along * levels.mesh), 1)
        mesh = make_tube(scene.geometry, around=around, along=along, wall=wall, relief=relief)
        scene = with_mesh(scene, mesh)
    if levels.kept < rings:
        x = scene.geometry.ring_positions[kept_rings(full, levels.kept)]
        scene = with_geometry(scene, dataclasses.replace(scene.geometry, ring_positions=x))
    if plan.surface is None and not plan.contact:
        scene = dataclasses.replace(scene, mesh=None, binding=None, runs=None)
    made = scene, full.material, full.path
    return made if levels.dtype == "float64" else cast(made, levels.dtype)


def kept_rings(full: Full, count: int) -> np.ndarray:
    """The `count` rings nearest to the loads, in order."""
    x = np.asarray(full.scene.geometry.ring_positions)
    away = np.maximum(full.load.min() - x, x - full.load.max())
    return np.sort(np.argsort(away, kind="stable")[:count])


def one_plane(full: Full) -> str:
    """Why the path does not fit in one plane; empty if it does."""
    flat = {name: EFFECTS[name].least for name in ("second_plane", *goes_with("second_plane"))}
    try:
        make_plan(full.facts, dataclasses.replace(full.options, **flat))
    except PlanError as error:
        return error.why
    return ""


def cast(tree, dtype: str):
    """All floating arrays of a tree in this dtype."""

    def change(v):
        return v.astype(dtype) if jnp.issubdtype(v.dtype, jnp.floating) else v

    return jax.tree.map(change, tree)


def _load(scene: Scene, path: Poses | Presses) -> np.ndarray:
    if isinstance(path, Presses):
        return np.asarray(path.s)
    seen = jax.jit(touch_tube)(scene, path)
    s, gap = np.asarray(seen.s), np.asarray(seen.gap)
    return s[gap < 0] if (gap < 0).any() else s


def solve(scene: Scene, material: AnyMaterial, path: Poses | Presses):
    """`simulate`, and how the force changes with each parameter per relative change of it.

    Returns:
        The `Simulation` and d force / d log parameter, N; shape (rows, 3, parameters).
    """
    names, lasting = parameter_names(material), long_run(material)
    values = {name: getattr(lasting, name) for name in names}

    def forces(share):
        changed = {name: v * (1 + share[i]) for i, (name, v) in enumerate(values.items())}
        new: Any = dataclasses.replace(lasting, **changed)
        if isinstance(material, RelaxingMaterial):
            new = RelaxingMaterial(new, material.relaxation)
        out = simulate(scene, new, path)
        return out.force, out

    change, out = jax.jacfwd(forces, has_aux=True)(jnp.zeros(len(names), lasting.k_1.dtype))
    return out, change


def parameter_names(material: AnyMaterial) -> list[str]:
    """Parameters that the material has; of one that relaxes in the long run."""
    material = long_run(material)
    names = [field.name for field in dataclasses.fields(material)]
    return [name for name in names if getattr(material, name) is not None]
