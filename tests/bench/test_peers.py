"""Ours beside other programs that solve the same problem, timed by pytest-benchmark in turns.

Run by peers.py. A group is one problem; its first case is ours, and the others must agree with it
before they are timed. The cases of a group run in turns (A B C A B C ...).
"""

import functools
import os
from collections.abc import Callable
from typing import NamedTuple

import common  # First: it pins the process before numpy and jax are loaded.

# isort: split
import fitting
import frames
import jax
import numpy as np
import pytest
import skeleton
import update

from jaxtrachea.fitting import fit
from jaxtrachea.fitting.settings import Settings

TURNS = 7
SPECIMENS, SAMPLE = 500, 10
OURS = "jaxtrachea"


class Case(NamedTuple):
    """One program on the problem of its group.

    Attributes:
        make: gives the function to be timed, which waits for its result; called once a turn.
        differs: from its result and ours to how much they differ; refuses too much.
        lanes: problems solved by one call.
    """

    make: Callable[[], Callable]
    differs: Callable = lambda found, ours: None
    lanes: int = 1


def made(call: Callable, **more) -> Case:
    """A case that needs nothing anew in a turn."""
    return Case(lambda: call, **more)


def press() -> dict[str, Case]:
    """Deflection and reactions, all that can change read at every call."""
    frame, args = skeleton.mid_tube()
    given = skeleton.of_frame(frame)
    kept = frames.scikit_fem(frame)
    calls = skeleton.numpy_calls(frame) | {
        "scikit-fem: basis kept": lambda: kept(*given),
        "scikit-fem: mesh, basis, solution": lambda: frames.scikit_fem(frame)(*given),
        "PyNite: model, analysis": lambda: frames.pynite(frame, *given)(),
        "OpenSees: model, analysis, reactions": lambda: frames.opensees(frame, *given)(),
    }
    cases = {OURS: made(skeleton.our_calls(args)["jaxtrachea: w_C, reactions"])}
    for name, call in calls.items():
        cases[name] = made(call, differs=functools.partial(skeleton.differs, name))
    return cases


def press_kept() -> dict[str, Case]:
    """The same of a beam that does not change."""
    frame, args = skeleton.mid_tube()
    ours = skeleton.our_calls(args)["jaxtrachea: w_C, reactions, beam kept"]
    cases = {OURS: made(ours)}
    makers = {
        "PyNite: analysis again": frames.pynite,
        "OpenSees: reset, analysis, reactions": frames.opensees,
    }
    for name, maker in makers.items():
        make = functools.partial(maker, frame, *skeleton.of_frame(frame))
        cases[name] = Case(make, functools.partial(skeleton.differs, name))
    return cases


def lanes(what: str) -> dict[str, Case]:
    """4096 beams together, against a plain C loop."""
    ours = skeleton.jax_calls(15, skeleton.LANES)[what]
    value, gradient = skeleton.c_calls(15, skeleton.LANES)
    rivals = {
        "value": (value, skeleton.values_differ),
        "gradient": (gradient, skeleton.gradients_differ),
    }
    call, differs = rivals[what]
    count = skeleton.LANES
    return {
        OURS: made(ours, lanes=count),
        "scalar C loop": made(call, differs=differs, lanes=count),
    }


def contact(tool: str) -> dict[str, Case]:
    """A tool at 16 patches, two of them searched, against coal at 16 capsules."""
    own, other = update.tools()[tool]

    # Ours is smoothed and up to 0.06 mm too small; coal is exact.
    def differs(gap, touch):
        return common.close(tool, [gap], [touch.gap], 0.05)

    return {
        OURS: made(skeleton.wait(update.touch_call(own, 2))),
        "coal: 16 capsules, called from Python": made(update.coal_call(other), differs=differs),
    }


def whole_update() -> dict[str, Case]:
    """Pose of the ball in, force and every vertex out."""
    scenes, material = update.scenes("float64")
    scene, place = scenes["whole, dent of 16; round tube"], update.at("float64").translation[0]
    run = jax.jit(update.of_one_pose(scene, material)).lower(place).compile()
    call, ball = update.c_update(scene, scene.plan.dent), np.asarray(place)

    def differs(found, ours):
        return max(update.differs("C loop", found, ours))

    return {
        OURS: made(skeleton.wait(lambda: run(place))),
        "scalar C loop": made(lambda: call(ball), differs=differs),
    }


def fits() -> dict[str, Case]:
    """A batch with standard errors against solvers that take one specimen at a time."""
    study, model, forces = fitting.make_study(SPECIMENS)
    fitting.check(study, model, forces)
    settings = Settings(starts=1, verify=False)
    solvers = {
        "scipy least_squares lm": lambda i: fitting.with_scipy(model.value, model.jacobian),
        "lmfit leastsq": lambda i: fitting.with_lmfit(model),
    }
    cases = {OURS: made(lambda: fit.fit(study, settings), lanes=SPECIMENS)}
    for name, one in solvers.items():
        call = fitting.one_by_one(model, forces[:SAMPLE], one)
        cases[name] = made(call, differs=in_standard_errors, lanes=SAMPLE)
    return cases


def in_standard_errors(found, ours) -> float:
    """Largest difference of an estimate, in units of its standard error."""
    theta, _, _, errors = (np.array(v) for v in zip(*found, strict=True))
    error = float(np.max(abs(theta - ours.theta[:SAMPLE]) / errors))
    assert error < 1e-3, f"estimates differ by {error:.3g} standard errors"
    return error


#: Every group: what prepares it, and its cases but ours, with the package of each.
GROUPS: dict[str, tuple[Callable[[], dict[str, Case]], dict[str, str]]] = {
    "press, one call": (press, {
        "numpy + dpbsv": "scipy",
        "numpy + solveh_banded": "scipy",
        "OpenSees: model, analysis, reactions": "openseespy",
        "scikit-fem: basis kept": "scikit-fem",
        "scikit-fem: mesh, basis, solution": "scikit-fem",
        "PyNite: model, analysis": "PyNiteFEA",
    }),
    "press, beam kept": (press_kept, {
        "OpenSees: reset, analysis, reactions": "openseespy",
        "PyNite: analysis again": "PyNiteFEA",
    }),
    "press, 4096 lanes": (functools.partial(lanes, "value"), {"scalar C loop": "cc"}),
    "gradient, 4096 lanes": (functools.partial(lanes, "gradient"), {"scalar C loop": "cc"}),
    "contact, ball": (functools.partial(contact, "ball"), {
        "coal: 16 capsules, called from Python": "coal",
    }),
    "contact, rounded box": (functools.partial(contact, "rounded box"), {
        "coal: 16 capsules, called from Python": "coal",
    }),
    "whole update": (whole_update, {"scalar C loop": "cc"}),
    "fit": (fits, {"scipy least_squares lm": "scipy", "lmfit leastsq": "lmfit"}),
}  # fmt: skip


@functools.cache
def prepared(group: str) -> tuple[dict[str, Case], object]:
    """The cases of a group, and our result, which the others must agree with."""
    cases = GROUPS[group][0]()
    return cases, cases[OURS].make()()


ORDER = [
    pytest.param(group, turn, name, id=f"{group}-{turn}-{name}")
    for group, (_, rivals) in GROUPS.items()
    for turn in range(TURNS)
    for name in (OURS, *rivals)
]


@pytest.mark.parametrize(("group", "turn", "name"), ORDER)
def test_speed(benchmark, group, turn, name):
    try:
        cases, ours = prepared(group)
        case = cases[name]
        call = case.make()
        error = case.differs(call(), ours)
    except ImportError as missing:
        pytest.skip(f"{name}: {missing}")
    benchmark.extra_info |= {
        "group": group,
        "turn": turn,
        "case": name,
        "package": GROUPS[group][1].get(name),
        "lanes": case.lanes,
        "error": error,
        "load": os.getloadavg()[0],
    }
    benchmark(call)


def test_springs_of_pynite_are_in_equilibrium():
    frame, _ = skeleton.mid_tube()
    model = frames.pynite_model(frame, *skeleton.of_frame(frame))
    model.analyze_linear()
    reactions = [node.RxnFY["Combo 1"] for node in model.nodes.values()]
    assert sum(reactions) == pytest.approx(-skeleton.FORCE, rel=1e-12)
