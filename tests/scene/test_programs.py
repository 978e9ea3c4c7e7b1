"""What is compiled: as many operations as a program written by hand for that scene alone."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import BALL, DOWN, MATERIAL, MESH, OBLIQUE, OFF, TUBE, ball

from jaxtrachea import (
    Options,
    Presses,
    Wishes,
    make_scene,
    press_oblique,
    press_path,
    simulate,
)
from jaxtrachea.admission import without_negative
from jaxtrachea.contact.patches import touch
from jaxtrachea.contact.pose import Pose
from jaxtrachea.model import ligament_beam, local_law, respond, unit_deflection
from jaxtrachea.scene.operations import count_operations
from jaxtrachea.skeleton import local_frame
from jaxtrachea.status import ContactStatus, PressStatus
from jaxtrachea.surface import local, regions
from jaxtrachea.trachea.mesh import place

HELD, TOTAL = Options(contact="bonded"), Options(coupling="total")


def by_hand(options=Options(), more="joints loads end_U end_V", surface="", **how):  # noqa: B008
    """A program for presses at one contact point."""

    def run(scene, m, p):
        at = p.s[0], p.phi[0]
        m, bad = admitted(m, **how)
        led, status = seated(scene, p, bad)
        s_c = onto_tube(scene, p.s)[0]
        out = press_oblique(scene.geometry, m, s_c, p.phi[0], led, options, **how)
        seen = [led, out.force, out.depth, out.skeleton, status(out.status)]
        seen += [getattr(out, name) for name in more.split()]
        return (*seen, move_surface(scene, *at, out, surface)) if surface else seen

    return run


def admitted(m, *, rings="arch2", axial=True):
    """The material without negative values, and whether a value that is read was one."""
    used = ["EI_L", "k_M", "k_1"]
    used += ["EI_C", "k_t"] if rings == "arch2" else []
    used += ["EA_L", "k_A", "k_B"] if axial else []
    used += ["EI_side"]
    return without_negative(m, used)


def onto_tube(scene, s):
    """Places off the tube at its ends: their rows are refused."""
    length = scene.geometry.length
    return jnp.where(s < 0, 0, jnp.where(s > length, length, s))


def seated(scene, p, bad, unfit=None):
    """The presses and their statuses; rows off the tube or at another point are refused."""
    off = (p.s < 0) | (p.s > scene.geometry.length)
    moved = ~((jnp.abs(p.s - p.s[0]) <= 1e-4) & (jnp.abs(p.phi - p.phi[0]) <= 1e-4))
    moved = moved if unfit is None else unfit | moved
    return refuse(p, {PressStatus.OFF_TUBE: off, PressStatus.OFF_PLAN: moved}, bad)


def refuse(p, refused, bad):
    """Presses with NaN in refused rows, and what becomes of their statuses."""
    refused = refused | {PressStatus.BAD_MATERIAL: jnp.broadcast_to(bad, p.s.shape)}
    led = p.displacement
    for rows in refused.values():
        led = jnp.where(rows[:, None], jnp.nan, led)

    def status(status):
        for code, rows in refused.items():
            status = jnp.where(rows, code, status)
        return status.astype(jnp.int8)

    return led, status


def move_surface(scene, s, phi, out, kind):
    mesh = scene.mesh
    weights = regions.weigh(scene.binding, phi)
    if kind == "with a dent":
        straight = mesh.straight
        where = local.centres(s, phi, scene.radius, scene.footprint, 8)

    def one(skeleton, joints, U, V, slopes, slope_C, depth):
        keys = regions.clamped(s, skeleton, joints, U, V, slopes, slope_C)
        u = regions.interpolate(scene.binding, weights, keys)
        if kind == "with a dent":
            goal = local.targets(depth, jnp.zeros(8))
            dent = local.fit(where, goal, 3 * scene.footprint)
            u = local.add_correction(u, dent, straight, scene.runs, s)
        return place(mesh, u)

    rows = out.skeleton, out.joints, out.end_U, out.end_V, out.slopes, out.slope_C, out.depth
    return jax.vmap(one)(*rows)


def normal(scene, m, p):
    """A normal press; its scalars as vectors, rows that are none of its kind refused."""
    D = jnp.abs(p.displacement)
    oblique = jnp.maximum(D[:, 0], D[:, 2]) > 1e-4 * D[:, 1] + 1e-4
    unfit = ~(jnp.abs(p.phi) <= 1e-4) | oblique
    m, bad = without_negative(m, ["EI_L", "k_M", "k_1"])
    led, status = seated(scene, p, bad, unfit)
    inward, options, s_c = -led[:, 1], Options(), p.s[0]
    unit = unit_deflection(ligament_beam(scene.geometry, m, options), s_c, options)
    law = local_law(scene.geometry, m, s_c, options)
    out = respond(inward, jnp.zeros_like(s_c), unit.w_C, law, options)
    F = -out.force  # outward is +y
    y = F, -out.depth, F * unit.w_C
    vectors = [jnp.stack([jnp.zeros(3), v, jnp.zeros(3)], -1) for v in y]
    return led, vectors, status(out.status)


def friction(scene, m, p):
    mu = scene.friction
    m, bad = admitted(m, rings="mat")
    led, status = seated(scene, p, bad | (mu < 0))
    out = press_path(scene.geometry, m, onto_tube(scene, p.s)[0], p.phi[0], led, mu, rings="mat")
    f = out.press
    vectors = f.force, f.depth, f.skeleton, f.joints, f.loads, f.end_U, f.end_V
    return led, vectors, status(f.status), out.slip, out.dissipated


def each(scene, m, p):
    m, bad = admitted(m, rings="mat", axial=False)
    off = (p.s < 0) | (p.s > scene.geometry.length)
    led, status = refuse(p, {PressStatus.OFF_TUBE: off}, bad)
    *rest, found = pressed_each(scene, m, Presses(p.s, p.phi, led))
    return led, *rest, status(found)


def pressed_each(scene, m, p):
    at = onto_tube(scene, p.s), p.phi, p.displacement
    one = lambda *at: press_oblique(scene.geometry, m, *at, rings="mat", axial=False)  # noqa: E731
    out = jax.vmap(one)(*at)
    return out.force, out.depth, out.skeleton, out.joints, out.loads, out.end_U, out.end_V, (
        out.status
    )  # fmt: skip


def tool(scene, m, p):
    """A tool led over the tube: every row presses along the normal where it touches."""
    geometry, near = scene.geometry, scene.near
    contact = lambda R, T: touch(scene.tool, Pose(R, T), scene.tube, near=near)  # noqa: E731
    seen = jax.vmap(contact)(p.rotation, p.translation)
    inward = jax.vmap(lambda phi: local_frame(phi)[0])(seen.phi)
    D = -seen.gap[:, None] * inward
    m, bad = admitted(m, rings="mat", axial=False)
    outside = ~((seen.s >= 0) & (seen.s <= geometry.length))
    off = outside & (jnp.sum(D * inward, axis=1) > 0)
    led, status = refuse(Presses(seen.s, seen.phi, D), {PressStatus.OFF_TUBE: off}, bad)
    out = pressed_each(scene, m, Presses(seen.s, seen.phi, led))
    found = jnp.where((seen.status > ContactStatus.FLAT) & (out[-1] == PressStatus.OK), 9, out[-1])
    return seen.gap, seen.s, seen.phi, led, out, status(found)


BARE = {"want_surface": False}
ONE = {**BARE, "want_joints": False, "want_ring_ends": False}
SKIN = {"want_joints": False, "want_ring_ends": False}
MANY = Presses([30.0, 75.0, 120.0], [0.1, 0.2, 0.3], np.full((3, 3), -1.0))
LED = ball([20, -1, 1.0], [130, -1, 2.0])
MAT = {"rings": "mat"}
#: name -> (path, wishes, program by hand)
PROGRAMS = {
    "normal": (DOWN, ONE, normal),
    "oblique": (OBLIQUE, BARE, by_hand(**MAT)),
    "force only": (OBLIQUE, ONE, by_hand(more="", **MAT)),
    "bonded": (OBLIQUE, {**BARE, "contact": "bonded"}, by_hand(HELD, **MAT)),
    "total": (OBLIQUE, {**BARE, "coupling": "total"}, by_hand(TOTAL, **MAT)),
    "no axial": (OBLIQUE, {**BARE, "axial": "off"}, by_hand(axial=False, **MAT)),
    "off the midline": (OFF, BARE, by_hand(rings="arch2", axial=False)),
    "friction": (OBLIQUE, BARE, friction),
    "many places": (MANY, {**BARE, **MAT, "axial": "off"}, each),
    "tool": (LED, {**BARE, **MAT}, tool),
    "surface": (OBLIQUE, {**SKIN, "dent": "off"}, by_hand(more="", surface="global", **MAT)),
    "dent": (OBLIQUE, SKIN, by_hand(more="", surface="with a dent", **MAT)),
}


def program(name):
    path, wishes, hand = PROGRAMS[name]
    mu = 0.66 if name == "friction" else None
    scene = make_scene(
        TUBE, MATERIAL, path, tool=BALL if name == "tool" else None, friction=mu, mesh=MESH,
        wishes=Wishes(**wishes),
    )  # fmt: skip
    return scene, path, hand


@pytest.mark.parametrize("name", PROGRAMS)
def test_an_unused_effect_adds_no_operation(name):
    """In the traced program: exactly those of the program by hand."""
    scene, path, hand = program(name)
    assert count_operations(simulate, scene, MATERIAL, path) == count_operations(
        hand, scene, MATERIAL, path
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS)
def test_an_unused_effect_adds_none_to_the_compiled_program(name):
    """After XLA's optimisation, by its own count; which folds the two in orders of their own."""
    scene, path, hand = program(name)
    count = lambda f: jax.jit(f).lower(scene, MATERIAL, path).compile().cost_analysis()  # noqa: E731
    mine, minimal = count(simulate), count(hand)
    assert mine["flops"] <= minimal["flops"]
    assert mine["transcendentals"] == minimal["transcendentals"]


@pytest.mark.slow
def test_each_effect_that_is_on_costs_operations():
    path = ball([75, 1, 0.5], [77, -2, 1.0])
    optional = {"GA_L": 9.0, "k_A": 0.2, "k_1_ring": 0.6}
    material = dataclasses.replace(MATERIAL, **{k: jnp.array(v) for k, v in optional.items()})
    scene = make_scene(TUBE, material, path, tool=BALL, friction=0.66, mesh=MESH)
    without = lambda plan: dataclasses.replace(scene, plan=plan)  # noqa: E731
    whole, taken = count_operations(simulate, scene, material, path), []
    for effect in scene.plan.effects:
        less = scene.plan.without(effect.name)
        if less is not None:
            count = count_operations(simulate, without(less), material, path)
            # Joints and ends are computed for the surface anyway: handing them out costs nothing.
            free = effect.name in ("joints", "ring_ends")
            assert count <= whole if free else count < whole, effect.name
            taken.append(effect.name)
    assert {"friction", "axial", "end_motion", "surface", "dent", "rings", "shear"} <= set(taken)


def test_counting_operations():
    x = jnp.ones((4, 5))
    assert count_operations(lambda x: (x + x).reshape(-1), x) == 20
    assert count_operations(lambda x: x @ x.T, x) == 2 * 5 * 16
    assert count_operations(lambda x: [jnp.sin(x), x][1], x) == 0
    loop = lambda x: jax.lax.fori_loop(0, 7, lambda i, y: jnp.sin(y), x)  # noqa: E731
    assert 140 <= count_operations(loop, x) <= 140 + 14
    assert count_operations(jax.jit(lambda x: (jnp.sin(x), jnp.cos(x))), x) == 40
