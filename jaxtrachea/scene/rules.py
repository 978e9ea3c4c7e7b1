"""The rules: from facts and options to a `Plan`, each choice with its reason (docs/simulate.md).

What is not wished for is chosen by the rule of its effect (`effects`); a wish that cannot be met is
refused, never dropped.
"""

from collections.abc import Iterator

from jaxtrachea.mechanics.press import Options
from jaxtrachea.scene.declare import Case, Effect, PlanError, SceneFacts
from jaxtrachea.scene.effects import EFFECTS, EffectOptions
from jaxtrachea.scene.plan import OUTPUTS, Decision, Plan, stored


def make_plan(
    facts: SceneFacts,
    options: EffectOptions = EffectOptions(),
    *,
    finest: frozenset[str] = frozenset(),
) -> Plan:
    """Choose the program of a scene.

    Args:
        options: of the user.
        finest: effects whose level in `options` is not the user's wish, but the finest.

    Raises:
        PlanError: a wish that cannot be met, with the cure.
    """
    case, decisions, ignored = Case(facts, options, {}, finest), [], set()
    for effect in EFFECTS.values():
        decision = _decided(effect, case)
        decisions.append(decision)
        if decision.level != "on" and (decision.forced or effect.name in finest):
            ignored.add(effect.name)
    own, of_model = stored(case.levels)
    half_width = of_model.pop("half_width", options.half_width)
    model = Options(
        coupling=options.coupling, contact=options.contact, onset_width=options.onset_width,
        transition=options.transition, half_width=half_width, **of_model,
    )  # fmt: skip
    plan = Plan(
        contact=facts.poses, curved=facts.poses and facts.curved, joints=options.want_joints,
        ring_ends=options.want_ring_ends, options=model, ignored=frozenset(ignored),
        effects=(*_path(facts), *decisions, *_asked(options, facts)), **own,
    )  # fmt: skip
    assert plan == plan.at(), "an effect is on without one that it needs"
    return plan


def _decided(effect: Effect, case: Case) -> Decision:
    """The level of an effect; the rules below read it in the case."""
    verdict, requested = effect.rule(case), getattr(case.options, effect.name)
    if requested in verdict.refused:
        raise PlanError(effect.name, repr(requested), *verdict.refused[requested])
    free = requested != "auto" and verdict.free
    level = case.levels[effect.name] = requested if free else verdict.level
    if not free:
        return Decision(effect.name, level, verdict.reason, caveat=verdict.caveat)
    if effect.name in case.finest:
        return Decision(effect.name, level, "the finest level")
    return Decision(effect.name, level, "as you wish", forced=True)


def _path(facts: SceneFacts) -> Iterator[Decision]:
    """What follows from the kind of path and mesh alone."""
    if facts.poses:
        yield Decision("contact", "on", "the path is given as positions of the tool")
    else:
        yield Decision("contact", "off", "the contact points are given")
    if facts.curved and facts.poses:
        turned = "motions are turned into the frame of its centreline at the contact"
        yield Decision("curved", "on", f"the mesh is bent: {turned}")
    elif facts.curved:
        reason = "displacements are given along the centreline's own frame"
        yield Decision("curved", "off", reason)


def _asked(options: EffectOptions, facts: SceneFacts) -> Iterator[Decision]:
    """The model, and what is wanted of it."""
    series = options.coupling == "series"
    share = "indentation and skeleton share the way" if series else (
        "the local law takes the whole way"
    )  # fmt: skip
    yield Decision("coupling", options.coupling, share)
    pull = "no pull" if options.contact == "unilateral" else "glued"
    words = ("mixed", "some tools are glued") if facts.glued else (options.contact, pull)
    yield Decision("contact law", *words)
    for name in OUTPUTS:
        wanted = getattr(options, f"want_{name}")
        yield Decision(name, *(("on", "asked for") if wanted else ("off", "not asked for")))
