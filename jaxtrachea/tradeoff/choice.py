"""The cheapest program of a scene whose error is within a tolerance.

Every effect is dropped alone from the full program, the rung of the fewest operations within the
tolerance is taken (where time is the cost, if it surely saves some), and all of them together are
checked.
Effects do not add up: while the whole is too far off, the effect that errs most per cost saved
comes back by one rung. Cost (`price.Objective`) is operations, so that the choice does not depend
on the machine, or the time measured on this one; errors are those of force, joints and surface over
the path and two sample paths beside it.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxtrachea._arguments import check_word
from jaxtrachea.scene.effects import EFFECTS
from jaxtrachea.scene.plan import Decision, ValidRange
from jaxtrachea.scene.simulation import Simulation
from jaxtrachea.scene.stage import Poses, Presses, Scene
from jaxtrachea.trachea.material import Material
from jaxtrachea.tradeoff.cost import MIN_SAVING, Cost, Objective, describe
from jaxtrachea.tradeoff.errors import Errors
from jaxtrachea.tradeoff.ladders import QUALITY, Ladder, ladders
from jaxtrachea.tradeoff.levels import Full, Levels, program
from jaxtrachea.tradeoff.trial import Trial


class Rung(NamedTuple):
    """One effect at a lower level, alone.

    Attributes:
        ladder: by name.
        effect: that it is of.
        level: on the ladder.
        errors: what that changes.
        saved: share of the cost.
    """

    ladder: str
    effect: str
    level: str
    errors: Errors
    saved: float


class Choice(NamedTuple):
    """What was chosen.

    Attributes:
        scene: with the plan chosen; its decisions say what was dropped.
        material: in the precision chosen.
        path: likewise.
        levels: chosen.
        changed: what they change in those of the full program.
        tolerance: relative.
        dropped: effects at a lower level than in the full program.
        refused: rungs that are too far off alone.
        restored: rungs that were within the tolerance alone, but not together with the others.
        no_gain: rungs within the tolerance that do not surely save time, alone or with the others.
        errors: of the choice against the full program, on all sample paths.
        cost: of the full program and of the choice against it: s, or operations for the path.
        by: what was made least.
        operations: share of the full program's; by `step` those of one pose.
        others: most cores that others kept busy while times were measured.
    """

    scene: Scene
    material: Material
    path: Poses | Presses
    levels: Levels
    changed: dict[str, Any]
    tolerance: float
    dropped: tuple[Rung, ...]
    refused: tuple[Rung, ...]
    restored: tuple[Rung, ...]
    no_gain: tuple[Rung, ...]
    errors: Errors
    cost: Cost
    by: Objective
    operations: float
    others: float

    @property
    def sentence(self) -> str:
        """What was found, in a line."""
        if not self.dropped and self.no_gain:
            within = percent(self.tolerance)
            return f"nothing that is within {within} surely saves time; the full program is taken"
        if not self.dropped:
            return f"no program but the full one is within {percent(self.tolerance)}; it is taken"
        return (
            f"within {percent(self.tolerance)}: {changes(self.errors)} off the full program, "
            f"{describe(self.by, self.cost)}"
        )


def choose(
    full: Full | Trial, tolerance: float, report: Callable[[str], None] = lambda text: None,
    *, precision: Literal["auto", "float64"] = "auto", by: Objective = "operations",
) -> Choice:  # fmt: skip
    """Choose the cheapest levels within the tolerance.

    Args:
        full: the scene at its finest; or a `Trial` of it, which keeps what it has tried.
        tolerance: largest error of force, joints and surface, relative to the largest value.
        report: called with what is tried next; may raise to stop.
        precision: `auto`: float32 where that is within the tolerance.
        by: what is made least; operations unless told otherwise.

    Raises:
        PlanError: the path, or a sample path beside it, has no row with a force.
        ValueError: another word for `precision` or `by`.
    """
    check_word("precision", precision, Literal["auto", "float64"])
    check_word("by", by, Objective)
    trial = full if isinstance(full, Trial) else Trial(full, report)
    full = trial.full
    every = _ladders(full, precision)
    found = _Found([], [], [])
    options: dict[str, list[Rung]] = {}
    for ladder in every:
        within = _within(trial, by, ladder, tolerance, found)
        if within is not None:
            options[ladder.name] = [within]
    named = {ladder.name: ladder for ladder in every}
    while True:
        picked = [rungs[-1] for rungs in options.values()]
        changed: dict[str, Any] = {}
        for rung in picked:
            changed |= named[rung.ladder].rungs[rung.level]
        levels = full.levels.changed(**changed)
        errors = trial.errors(levels)
        if not picked:
            break
        if errors.worst > tolerance:
            back = max(picked, key=lambda r: r.errors.worst / r.saved)
            found.restored.append(back)
            finer = _within(trial, by, named[back.ladder], tolerance, found, back)
            if finer is None:
                del options[back.ladder]
            else:
                options[back.ladder].append(finer)
        elif by != "operations" and trial.cost(by, levels).saved < MIN_SAVING:
            # What saves time alone need not do so with the others.
            least = min(picked, key=lambda r: r.saved)
            found.no_gain.append(least)
            del options[least.ladder]
        else:
            break
    scene, material, path = program(full, levels)
    scene = _explained(scene, picked, found)
    plan = dataclasses.replace(scene.plan, valid_range=_served(trial.reference))
    scene = dataclasses.replace(scene, plan=plan)
    return Choice(
        scene=scene, material=material, path=path, levels=levels, changed=changed,
        tolerance=tolerance,
        dropped=tuple(picked), refused=tuple(found.refused), restored=tuple(found.restored),
        no_gain=tuple(found.no_gain), errors=errors,
        cost=trial.cost(by, levels), by=by,
        operations=trial.share(by, levels),
        others=trial.others,
    )  # fmt: skip


def percent(v: float) -> str:
    """Two digits, in percent."""
    return f"{float(f'{100 * v:.2g}'):g} %"


def changes(errors: Errors) -> str:
    """The three errors in words."""
    parts = {"force": errors.force, "joints": errors.joints, "surface": errors.surface}
    return ", ".join(f"{name} {percent(v)}" for name, v in parts.items() if v is not None)


def _ladders(full: Full, precision: str) -> list[Ladder]:
    """Those of the choice: what saves work, and what the user has not decided."""
    every = ladders(full)[0]
    found = [v for v in every if v.effect in EFFECTS and getattr(full.given, v.effect) == "auto"]
    if full.scene.plan.contact:
        rungs = {k: {"sharpness": sharp, "steps": n} for k, (sharp, n) in QUALITY.items()}
        quality = Ladder(
            name="quality", kind="truncation", rungs={**rungs, "fine": {}}, base={},
            effect="contact quality",
        )  # fmt: skip
        found.append(quality)
    return found + [v for v in every if v.name == "dtype" and precision == "auto"]


class _Found(NamedTuple):
    """Rungs that were tried and not taken; see `Choice`."""

    refused: list[Rung]
    restored: list[Rung]
    no_gain: list[Rung]


def _within(
    trial: Trial, by: Objective, ladder: Ladder, tolerance: float, found: _Found,
    above: Rung | None = None,
) -> Rung | None:  # fmt: skip
    """The rung of the fewest operations that is within the tolerance alone and saves time.

    Of equal ones that which errs least; with more operations than `above` if given.
    """
    names = list(ladder.rungs)[:-1]
    trial.report(ladder.name)
    levels = {name: ladder.levels(trial.full, name) for name in names}
    fewer = {name: trial.cost("operations", levels[name]).saved for name in names}
    for worth in sorted(set(fewer.values()), reverse=True):
        if worth <= 0 or (above is not None and worth >= fewer[above.level]):
            continue
        rungs = []
        for name in (name for name in names if fewer[name] == worth):
            trial.report(f"{ladder.name} {name}")
            rung = Rung(
                ladder=ladder.name, effect=ladder.effect, level=name,
                errors=trial.errors(levels[name]), saved=worth,
            )  # fmt: skip
            rungs.append(rung)
        best = min(rungs, key=lambda rung: rung.errors.worst)
        if best.errors.worst <= tolerance:
            if by == "operations":
                return best
            trial.report(f"{ladder.name} {best.level}: time")
            saved = trial.cost(by, levels[best.level]).saved
            if saved >= MIN_SAVING:
                return best._replace(saved=saved)
            found.no_gain.append(best)
        elif above is None:
            found.refused.extend(rungs)
    return None


def _served(reference: Simulation) -> ValidRange:
    """What the sample paths press, all of them together."""
    D, phi = reference.displacement, reference.phi
    inward = -np.cos(phi) * D[..., 1] - np.sin(phi) * D[..., 2]
    across = np.cos(phi) * D[..., 2] - np.sin(phi) * D[..., 1]
    on = np.asarray(reference.force).any(axis=-1) & np.isfinite(inward)

    def most(v):
        return float(np.abs(v[on]).max())

    s = float(reference.s[on].min()), float(reference.s[on].max())
    return ValidRange(
        s=s, angle=most(phi), along=most(D[..., 0]), across=most(across), inward=most(inward)
    )


def _explained(scene: Scene, picked: list[Rung], found: _Found) -> Scene:
    """The scene with the decisions of its plan in words."""
    said: dict[str, list[str]] = {}
    for rungs, form in (
        (picked, "within the tolerance: changes {1}"),
        (found.refused, "{0} would change {1}"),
        (found.restored, "{0} would change {1}, too much together with the others"),
        (found.no_gain, "{0} would change {1} and not surely save time"),
    ):
        for rung in rungs:
            said.setdefault(rung.effect, []).append(form.format(rung.level, changes(rung.errors)))
    plan = scene.plan
    more = [Decision("contact quality", "fine", "the finest")] if plan.contact else []
    more.append(Decision("precision", "float64", "the finest"))
    picks = {rung.effect: rung.level for rung in picked}

    def explained(decision: Decision) -> Decision:
        name = decision.name
        level = plan.level(name) if name in EFFECTS else picks.get(name, decision.level)
        reason = decision.reason if level == decision.level else "goes with another effect"
        reason = "; ".join(said.get(name, [reason]))
        return Decision(name, level, reason, decision.forced)

    effects = tuple(map(explained, (*plan.effects, *more)))
    return dataclasses.replace(scene, plan=dataclasses.replace(plan, effects=effects))
