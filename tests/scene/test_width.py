"""A tool with a width in scenes: two forces hold the ligament level, see `mechanics.punch`."""

import dataclasses
import functools
import json
import re
from pathlib import Path

import beam_fem
import jax
import jax.numpy as jnp
import numpy as np
import punch_fem
import pytest
from run_cli import run as run_cli
from small_scenes import BALL, BARE, MATERIAL, MESH, OUTER, SPRINGS, TUBE, ball, presses

from jaxtrachea import (
    EffectOptions,
    Material,
    PlanError,
    Poses,
    Presses,
    make_scene,
    press,
    simulate,
    sweep,
)
from jaxtrachea._errors import InputError
from jaxtrachea.contact.shapes import sphere
from jaxtrachea.measurements.read import read_measurements
from jaxtrachea.mechanics.energy import StraightPress, gradient
from jaxtrachea.mechanics.press import Options
from jaxtrachea.scene.assemble import with_tool
from jaxtrachea.scene.build import stage
from jaxtrachea.scene.declare import SceneFacts
from jaxtrachea.scene.rules import make_plan
from jaxtrachea.scene.spec import SceneSpec
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.sizes import SizeError
from jaxtrachea.trachea.tube import make_tube
from jaxtrachea.tradeoff.ladders import ladders
from jaxtrachea.tradeoff.levels import Full, full_scene, program
from jaxtrachea.tradeoff.trial import samples

pytestmark = [pytest.mark.long, pytest.mark.compiling]

ROOT = Path(__file__).resolve().parents[2]
HALF = 2.4
#: As a fit to the finite-element trachea gives it, but with a contact that yields.
DEEP = Material(
    EI_L=2479.0, GA_L=4.948, k_M=0.2356, k_1=20.0, k_3=0.1, k_1_ring=60.0, e_1=0.1159, e_2=0.00652
)
STIFF = dataclasses.replace(SPRINGS, EI_L=jnp.array(900.0), k_M=jnp.array(0.2))
PUNCH = dataclasses.replace(BARE, half_width=HALF)
BONDED = dataclasses.replace(PUNCH, contact="bonded")
OK, OFF_PLAN, OFF_TUBE = PressStatus.OK, PressStatus.OFF_PLAN, PressStatus.OFF_TUBE
run = jax.jit(simulate)


def down(depths, s=75.0):
    """Presses straight in on the midline."""
    D, s = np.broadcast_arrays(np.asarray(depths, float), s)
    return Presses(s, 0 * D, np.stack([0 * D, -D, 0 * D], 1))


def by_elements(s, at=(), GA=None):
    """Finite elements of the ligament of `STIFF` under the punch, per unit force."""
    x = np.asarray(TUBE.ring_positions)
    EI = np.full(len(x) + 1, float(STIFF.EI_L))
    GA = None if GA is None else np.full(len(x) + 1, GA)
    return punch_fem.held(x, 160.0, EI, np.full(len(x), float(STIFF.k_M)), s, HALF, GA, at)


PLACES = [HALF, 22.0, 30.0, 71.7, 75.0, 160 - HALF]


@pytest.mark.parametrize("kind", ["linear", "softening"])
def test_rows_are_those_of_press(kind):
    """At both ends of the tube, on a ring, with an edge beside one and between two; to rounding."""
    material = DEEP if kind == "softening" else dataclasses.replace(DEEP, e_1=None, e_2=None)
    path = down([0.5, 1.0, 3.0, 3.0, -1.0, 2.0], PLACES)
    scene = make_scene(TUBE, material, path, effects=BONDED)
    said = next(e for e in scene.plan.effects if e.name == "width")
    assert (said.level, scene.plan.level("skeleton")) == ("punch", kind)
    assert "half_width is 2.4 mm" in said.reason
    out = run(scene, material, path)
    assert out.status.tolist() == [OK] * 6
    options = Options(
        shear=True, local="two-material", half_width=HALF, skeleton=kind, contact="bonded"
    )
    assert scene.plan.options == options
    one = jax.jit(jax.vmap(lambda s, D: press(TUBE, material, s, D, options)))
    alone = one(path.s, -path.displacement[:, 1])
    for name in ("force", "depth", "skeleton"):
        found = np.asarray(getattr(out, name))
        np.testing.assert_allclose(-found[:, 1], getattr(alone, name), rtol=1e-12, atol=1e-14)
        assert not found[:, [0, 2]].any()
    for name, own in (
        ("joints", alone.joints),
        ("end_U", alone.joints),
        ("loads", alone.reactions),
    ):
        np.testing.assert_allclose(-getattr(out, name)[:, :, 1], own, rtol=1e-12, atol=1e-14)
    assert out.skeleton[0, 1] == out.skeleton[5, 1] == 0  # edges on the clamps: nothing yields


@pytest.mark.parametrize("s", [22.0, 30.0, 71.7, 75.0])
def test_the_surface_is_the_beam_under_two_forces(s):
    """The crest of the wall against elements with a node at every vertex; joints likewise.

    With both edges between two rings, and with a ring under the punch.
    """
    mesh = make_tube(TUBE, around=3, along=200)
    crest = np.abs(np.asarray(mesh.phi)) < 1e-9
    at = np.asarray(mesh.s, float)[crest]
    effects = EffectOptions(half_width=HALF, contact="bonded", dent="off")
    scene = make_scene(TUBE, STIFF, down([2.0], s), mesh=mesh, effects=effects)
    out = run(scene, STIFF, down([2.0], s))
    true, force = by_elements(s, np.unique(at)), -float(out.force[0, 1])
    assert 0.3 < force * true.w_C < 2.0
    u = np.asarray(out.vertices[0] - mesh.vertices)[crest]
    line = np.interp(at, np.unique(at), true.line)
    np.testing.assert_allclose(u[:, 1], -force * line, atol=1e-9)
    assert not u[:, [0, 2]].any()
    np.testing.assert_allclose(out.joints[0, :, 1], -force * true.w, atol=1e-9)
    np.testing.assert_allclose(out.loads[0, :, 1], -force * true.reaction, atol=1e-9)
    # Between its edges the ligament bows; a single force in the middle would move it elsewhere.
    under = np.abs(at - s) < HALF - 0.1
    assert under.any()
    assert np.abs(u[under, 1] + force * true.w_C).max() > 1e-4


@pytest.mark.slow
def test_other_surfaces_are_flat_under_the_tool():
    method = "phong"
    mesh = make_tube(TUBE, around=3, along=200)
    effects = EffectOptions(half_width=HALF, contact="bonded", dent="off", surface=method)
    scene = make_scene(TUBE, STIFF, down([2.0]), mesh=mesh, effects=effects)
    out = run(scene, STIFF, down([2.0]))
    under = (np.abs(np.asarray(mesh.phi)) < 1e-9) & (np.abs(np.asarray(mesh.s) - 75) < HALF)
    assert under.sum() > 3
    u = np.asarray(out.vertices[0] - mesh.vertices)[under]
    np.testing.assert_allclose(u, np.broadcast_to(out.skeleton[0], u.shape), atol=1e-6)


@pytest.mark.slow
def test_the_energy_by_the_place_is_that_of_the_elements():
    """Rigid contact: E = D^2 / (2 c(s)), by differences of fourth order."""
    material = dataclasses.replace(
        STIFF, k_1=jnp.array(1e9), k_3=jnp.array(0.0), GA_L=jnp.array(9.0)
    )
    s, D, h = 73.3, 2.0, 0.02
    scene = make_scene(TUBE, material, down([D], s), effects=BONDED)
    out = run(scene, material, down([D], s))

    def stored(s):
        return D * D / (2 * by_elements(s, GA=9.0).w_C)

    true = (8 * (stored(s + h) - stored(s - h)) - stored(s + 2 * h) + stored(s - 2 * h)) / (12 * h)
    unit = by_elements(s)
    theta = np.array([float(out.force[0, 1]) * (unit.share @ unit.edges), 0.0])
    solved = StraightPress(
        jnp.asarray(s), jnp.asarray(0.0), jnp.asarray(D), out.force[0], out.depth[0],
        jnp.asarray(theta), out.loads[0],
    )  # fmt: skip
    options = scene.plan.options
    assert (options.half_width, options.shear) == (HALF, True)
    by = gradient(TUBE, material, solved, options, rings="mat", axial=False, one_plane=True).s
    assert abs(true) > 1e-3
    np.testing.assert_allclose(by, true, rtol=1e-5)


@pytest.mark.slow
def test_closed_loops_of_a_tool_that_wanders_do_no_work():
    """Up and down near an end on a deep skeleton; what is left is the trapezoidal rule's."""
    material = dataclasses.replace(DEEP, GA_L=None)
    effects = dataclasses.replace(PUNCH, contact_point="per_step")
    start = ball([20, 1, 0], [20, -3, 0])
    scene = make_scene(TUBE, material, start, tool=BALL, effects=effects)
    assert scene.plan.has("width")
    assert scene.plan.level("skeleton") == "softening"
    t = np.linspace(0, 2 * np.pi, 513)
    way = np.stack([20 + 6 * np.cos(t), OUTER + 5 - 2.5 + 1.5 * np.sin(t), 0 * t], 1)
    out = run(scene, material, Poses(np.broadcast_to(np.eye(3), (513, 3, 3)), way))
    assert (np.asarray(out.status) == OK).all()
    F, step = np.asarray(out.force), np.diff(way, axis=0)
    part = np.sum((F[1:] + F[:-1]) / 2 * step, axis=1)
    spent = np.maximum(part, 0).sum()
    assert abs(part.sum()) < 1e-4 * spent
    # Without the force along the tube much would be left.
    assert abs(np.sum((F[1:, 1] + F[:-1, 1]) / 2 * step[:, 1])) > 0.01 * spent


def finite_element():
    """The specimen's curves to 6 mm, and the material and width that were fitted to them."""
    folder = ROOT / "fits" / "virtual_trachea"
    fits = json.loads((folder / "expected.json").read_text())["finite_strain"]
    fit = next(f for f in fits if (f["depth_mm"], f["skeleton"]) == (6.0, "softening"))
    material = Material(k_3=0.0, **{k: v["value"] for k, v in fit["parameters"].items()})
    measured = read_measurements(folder / "finite_strain.h5").curves
    return material, {c.s_c: (c.displacement, c.force) for c in measured}


def test_against_the_finite_element_trachea():
    """The figures of docs/simulate.md: largest error over the peak, with the width and without."""
    material, curves = finite_element()
    s = np.concatenate([np.full(len(D), at) for at, (D, _) in curves.items()])
    D, F = (np.concatenate(v) for v in zip(*curves.values(), strict=True))
    off = {}
    for half in (2.36, 0.0):
        effects = dataclasses.replace(BONDED, half_width=half)
        scene = make_scene(TUBE, material, down(D, s), effects=effects)
        error = np.abs(-np.asarray(run(scene, material, down(D, s)).force[:, 1]) - F)
        off[half] = {at: error[s == at].max() / F[s == at].max() for at in curves}
    punch, point = off[2.36], off[0.0]
    expected = {22.0: 0.025, 35.0: 0.026, 58.0: 0.011, 70.0: 0.009, 75.0: 0.024, 107.0: 0.017}
    for at, share in expected.items():
        assert punch[at] == pytest.approx(share, abs=6e-4)
    assert max(punch.values()) == pytest.approx(punch[35.0], rel=1e-9)  # its mirror: to rounding
    assert point[22.0] == pytest.approx(0.149, abs=6e-4)
    assert min(point.values()) > 0.04


def test_every_row_has_its_status():
    """Part of the tool beyond an end; off the midline, oblique; without motion it is no press."""
    path = down([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0], [75, 2.3, 157.7, 0.0, 75, 75, 2.5, 75])
    phi, D = np.array(path.phi), np.array(path.displacement)
    phi[4], D[5, 0], phi[7] = 0.3, 0.5, 0.3
    path = Presses(path.s, phi, D)
    several = dataclasses.replace(PUNCH, contact_point="per_step")
    scene = make_scene(TUBE, STIFF, down([1.0, 2.0], [75, 60]), effects=several)
    none = PressStatus.NO_CONTACT
    expected = [OK, OFF_TUBE, OFF_TUBE, OFF_TUBE, OFF_PLAN, OFF_PLAN, OK, none]

    def total(D):
        out = simulate(scene, STIFF, Presses(path.s, path.phi, D))
        good = (out.status == OK)[:, None]
        return jnp.sum(jnp.where(good, out.force + out.skeleton, 0)), out

    by, out = jax.jit(jax.grad(total, has_aux=True))(path.displacement)
    assert np.isfinite(by).all()
    assert out.status.tolist() == expected
    solved = np.isin(out.status, (OK, none))
    assert np.isfinite(out.force[solved]).all()
    assert np.isnan(out.force[~solved]).any(axis=1).all()


def test_a_sweep_of_the_midline():
    """As presses, its ends off the tube, off the midline off the plan."""
    scene = make_scene(TUBE, STIFF, down([2.0]), effects=PUNCH)
    s = [75.0, 71.7, 2.0, 158.0, 75.0, 75.0, 75.0]
    phi = [0.0, 0.0, 0.0, 0.0, 0.4, 0.4, 3.0]
    depth = [2.0, 1.0, 1.0, 1.0, 1.0, 0.0, 1.0]
    out = jax.jit(sweep)(scene, STIFF, s, phi, depth)
    assert out.status.tolist() == [
        OK, OK, OFF_TUBE, OFF_TUBE, OFF_PLAN, PressStatus.NO_CONTACT, PressStatus.BEHIND_GAP
    ]  # fmt: skip
    for i in (0, 1):
        true = by_elements(s[i])
        np.testing.assert_allclose(out.compliance[i], true.w_C, rtol=1e-8)
    assert np.isnan(np.asarray(out.force)[2:5]).all()


def test_paths_beside_a_path_lie_on_the_tube():
    """Those that a choice by tolerance tries too: all of the tool's width does."""
    length = float(TUBE.length)
    for s_c, furthest in ((HALF, np.min), (length - HALF, np.max)):
        path = down([2.0], [s_c])
        scene = make_scene(TUBE, STIFF, path, effects=PUNCH)
        known = SceneFacts(spacing=10.0)
        full = Full(scene, STIFF, path, {}, known, PUNCH, PUNCH, None, np.array([s_c]))
        beside = np.ravel(samples(full).s)
        assert furthest(beside) == s_c
        assert np.ptp(beside) == pytest.approx(2.5)


@pytest.mark.slow
def test_derivatives_and_lanes():
    """Forward = reverse = differences by material, place and depth, surface included; `vmap`."""
    effects = EffectOptions(half_width=HALF, contact="bonded")
    scene = make_scene(TUBE, DEEP, down([3.0], 71.7), mesh=MESH, effects=effects)
    names = ("EI_L", "GA_L", "k_M", "k_1", "k_1_ring", "e_1", "e_2")
    x = jnp.array([float(getattr(DEEP, n)) for n in names] + [71.7, 3.0])

    def values(x):
        material = Material(k_3=jnp.asarray(0.1), **dict(zip(names, x[:-2], strict=True)))
        D = x[-1] * jnp.array([[0, -1, 0]], x.dtype)
        out = simulate(scene, material, Presses(x[-2:-1], jnp.zeros(1, x.dtype), D))
        moved = out.vertices[0, 100:200:7, 1] - scene.mesh.vertices[100:200:7, 1]
        return jnp.concatenate([out.force[0, 1:2], out.joints[0, 6:8, 1], moved])

    quick = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    value = quick(values)
    here = value(x)
    forward, reverse = quick(jax.jacfwd(values))(x), quick(jax.jacrev(values))(x)
    np.testing.assert_allclose(forward, reverse, rtol=1e-8, atol=1e-11)
    for i in range(len(x)):
        h = 1e-5 * jnp.zeros_like(x).at[i].set(x[i])
        difference = (value(x + h) - value(x - h)) / (2 * h[i])
        np.testing.assert_allclose(forward[:, i], difference, rtol=1e-5, atol=1e-7)
    lanes = quick(jax.vmap(lambda s: values(x.at[-2].set(s))))(jnp.array([22.0, 71.7]))
    np.testing.assert_allclose(lanes[1], here, rtol=1e-12, atol=1e-14)


WIDE = {"half_width": HALF}


@pytest.mark.parametrize(
    ("facts", "effects", "says"),
    [
        ({"angle": 0.5}, WIDE, "width: 'auto', but half_width is 2.4 mm.*midline.*width 'point'"),
        ({"known": frozenset({"EI_C", "k_t"})}, WIDE, "second plane; .*rings 'mat'"),
        ({"along": 0.3, "slip": 1.0, "spacing": 10.0}, WIDE, "second plane"),
        ({"friction": True, "slip": 1.0, "spacing": 10.0}, WIDE, "no friction"),
        ({"angle": 0.5}, WIDE | {"width": "punch"}, "'punch', but a width is for presses"),
        ({}, {"width": "punch"}, "'punch', but half_width is 0; give it, in .model."),
        ({"spacing": 10.0}, {"half_width": 0.0024}, "next to a point .* 10 mm apart; check its un"),
    ],
)  # fmt: skip
def test_a_width_is_never_a_point_without_a_word(facts, effects, says):
    with pytest.raises(PlanError, match=says):
        make_plan(SceneFacts(**facts), EffectOptions(**effects))


def test_the_rule():
    plan = make_plan(SceneFacts(), EffectOptions())
    assert (plan.level("width"), plan.options.half_width) == ("point", 0.0)
    wished = EffectOptions(half_width=HALF, width="point")
    plan = make_plan(SceneFacts(angle=0.5), wished)
    assert (plan.level("width"), plan.second_plane) == ("point", True)
    plan = make_plan(SceneFacts(), EffectOptions(**WIDE, coupling="total"))
    assert (plan.level("width"), plan.options.half_width) == ("punch", HALF)
    less = plan.without("width")
    assert (less.options.half_width, less.ignored >= {"width"}) == (0.0, True)
    assert plan.at(width="punch") == plan
    with pytest.raises(ValueError, match="width 'punch' needs a number"):
        less.at(width="punch")
    with pytest.raises(InputError, match="half_width is 2.4, with second_plane 'on'; expected 0.0"):
        plan.at(second_plane="on")
    with pytest.raises(ValueError, match="half_width is -1"):
        EffectOptions(half_width=-1.0)


def test_a_width_that_neither_tube_nor_tool_has():
    with pytest.raises(SizeError, match="half_width is 80.5 mm; expected at most 80 mm, half the"):
        make_scene(TUBE, STIFF, down([1.0]), effects=dataclasses.replace(BARE, half_width=80.5))
    path, wide = ball([75, 1, 0], [75, -2, 0]), dataclasses.replace(BARE, half_width=5.1)
    with pytest.raises(SizeError, match="half_width is 5.1 mm; expected at most 5 mm, as far as"):
        make_scene(TUBE, STIFF, path, tool=BALL, effects=wide)
    scene = make_scene(TUBE, STIFF, path, tool=BALL, effects=PUNCH)
    with pytest.raises(SizeError, match=re.escape("at most 2 mm, as far as the tool reaches")):
        with_tool(scene, sphere(2.0))


SCENE = """
[material]
EI_L = "900 N mm^2"
k_M = "0.2 N/mm"
k_1 = "20 N/mm"
k_3 = "0 N/mm^3"
[model]
half_width = "{}"
[path]
s = "{}"
displacement = ["{}", "-2 mm", "0 mm"]
[output]
surface = false
pictures = false
[effects]
{}
"""


@pytest.mark.parametrize(
    ("half", "s", "along", "more", "says"),
    [
        (
            "2.4 mm",
            "2 mm",
            "0 mm",
            "",
            "path.0.s: 2 mm; expected a place on the tube, 2.4 to 157.6",
        ),
        ("2.4 mm", "75 mm", "1 mm", "", "effects.width: 'auto', but half_width is 2.4 mm, and a "),
        ("90 mm", "75 mm", "0 mm", "", "model.half_width is 90 mm; expected at most 80 mm"),
        ("-1 mm", "75 mm", "0 mm", "", "model.half_width"),
        ("2.4 mm", "75 mm", "0 mm", "rings = 'arch'", "effects.rings"),
        ("2.4 mm", "2 mm", "0 mm", "width = 'point'", ""),
    ],
)
def test_keys_of_a_file(half, s, along, more, says, tmp_path, monkeypatch, capsys):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE.format(half, s, along, more))
    code, out, err = run_cli(monkeypatch, capsys, "plan", path)
    assert (code, says in err) == ((2, True) if says else (0, True)), err
    assert "Traceback" not in err
    if not says:
        assert re.search(r"width +point", out)


def test_the_ladder_of_the_width():
    """A point in place of the punch is softer, as by elements; one form and one split."""
    text = {
        "material": {"EI_L": "900 N mm^2", "k_M": "0.2 N/mm", "k_1": "1e9 N/mm", "k_3": "0 N/mm^3"},
        "model": {"half_width": "2.4 mm", "contact": "bonded"},
        "path": {"s": "75 mm", "displacement": ["0 mm", "-2 mm", "0 mm"], "steps": 1},
        "output": {"surface": False},
    }
    spec = SceneSpec.model_validate(text)
    full = full_scene(spec, stage(spec, ROOT))
    found, out = ladders(full)
    ladder = next(v for v in found if v.name == "width")
    assert (list(ladder.rungs), ladder.kind) == (["point", "punch"], "model")
    assert out["form"] == out["split"] == "a tool with a width has one form and one split"
    force = {}
    for rung in ladder.rungs:
        scene, material, path = program(full, ladder.levels(full, rung))
        assert scene.plan.options.half_width == (HALF if rung == "punch" else 0.0)
        force[rung] = -float(run(scene, material, path).force[0, 1])
    x = np.asarray(TUBE.ring_positions)
    point = beam_fem.solve(x, 160.0, [900.0] * 16, [0.2] * 15, 75.0, 1.0).w_C
    np.testing.assert_allclose(force["point"] * float(point), 2.0, rtol=1e-6)
    np.testing.assert_allclose(force["punch"] * by_elements(75.0).w_C, 2.0, rtol=1e-6)


def test_a_linear_material_of_vectors_has_no_width():
    """The cure is in the words: leaving out what bends, or the width."""
    with pytest.raises(PlanError, match="rings 'mat'"):
        make_scene(TUBE, MATERIAL, presses([0, -2, 0]), effects=PUNCH)
    flat = dataclasses.replace(PUNCH, rings="mat")
    scene = make_scene(TUBE, MATERIAL, presses([0, -2, 0]), effects=flat)
    assert scene.plan.has("width")
