"""What is compiled: as many operations as a program written by hand for that scene alone."""

import dataclasses
import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_scenes import BALL, DOWN, MATERIAL, MESH, OBLIQUE, OFF, TUBE, ball

from jaxtrachea import (
    EffectOptions,
    Options,
    Poses,
    Presses,
    make_scene,
    press_oblique,
    press_path,
    simulate,
)
from jaxtrachea.contact.patches import touch
from jaxtrachea.contact.pose import Pose
from jaxtrachea.fusion import fuse, one_by_one
from jaxtrachea.mechanics.friction import Coulomb
from jaxtrachea.mechanics.oblique import ObliqueOptions
from jaxtrachea.mechanics.press import Contact, ligament_beam, local_law, respond, unit_deflection
from jaxtrachea.mechanics.press import indentation as first_touch
from jaxtrachea.mechanics.skeleton import local_frame
from jaxtrachea.scene.approach import Approach
from jaxtrachea.scene.lumen import in_lumen
from jaxtrachea.scene.ranges import contact_share, depth_share
from jaxtrachea.scene.refusals import (
    hidden_rows,
    mask_rows,
    refuse,
    status_of,
    without_negative_values,
)
from jaxtrachea.scene.stage import Tool, touch_tube
from jaxtrachea.status import PressStatus
from jaxtrachea.surface import local, regions
from jaxtrachea.trachea.mesh import place
from jaxtrachea.tradeoff.operations import count_operations


def by_hand(more="joints loads end_U end_V", surface=False, **how):
    """A program for presses at one contact point."""
    oblique = ObliqueOptions(**how)

    def run(scene, m, p):
        m, led, used, status, hidden = admitted(scene, m, p)
        at = used.s[0], used.phi[0]

        out = press_oblique(scene.geometry, m, *at, used.displacement, oblique)
        vertices = move_surface(scene, *at, out) if surface else ()
        named = {name: getattr(out, name) for name in ("force", "depth", "skeleton", *more.split())}
        named, vertices = hidden((named, vertices))
        return led, named, vertices, status(out._replace(**named))

    return run


def admitted(scene, m, p, made=None):
    """Material and presses as computed, and how statuses are read: the same in all programs."""
    m, bad = without_negative_values(scene, m)
    presses, used, inward, refused = refuse(scene, m, p, made, bad)

    def status(out):
        share = depth_share(scene, out.depth, out.skeleton, inward)
        return share, status_of(out.status, share, made, refused)

    hidden = functools.partial(mask_rows, hidden_rows(scene, refused))
    return m, presses.displacement, used, status, hidden


def move_surface(scene, s, phi, out):
    mesh = scene.mesh
    weights = regions.weigh(scene.binding, phi)
    straight = mesh.straight

    def one(skeleton, joints, U, V, slopes, slope_C, depth):
        keys = regions.clamped(s, skeleton, joints, U, V, slopes, slope_C)
        u = regions.interpolate(scene.binding, weights, keys)
        # In every row, as in a step of a session: a scan of steps is the session to the bit.
        where = local.centres(s, phi, scene.radius, scene.footprint, 8)
        share = local.shares(depth, jnp.zeros(8))[:, None]
        dent = local.fit(where, share, 3 * scene.footprint, depth)
        u = local.add_correction(u, dent, straight, scene.runs, s)
        return place(mesh, u)

    rows = out.skeleton, out.joints, out.end_U, out.end_V, out.slopes, out.slope_C, out.depth
    return one_by_one(lambda row: one(*row), rows)


def normal(scene, m, p):
    """A normal press; its scalars as vectors, rows that are none of its kind refused."""
    m, led, used, status, hidden = admitted(scene, m, p)
    inward = -used.displacement[:, 1]
    s, options = used.s[0], Options()
    unit = unit_deflection(ligament_beam(scene.geometry, m, options), s, options)
    law = local_law(scene.geometry, m, s, options)
    out = respond(inward, unit.w_C, Contact(law, jnp.zeros_like(s)), options)
    F = -out.force  # outward is +y
    y = F, -out.depth, F * unit.w_C
    force, depth, way = (jnp.stack([jnp.zeros(3), v, jnp.zeros(3)], -1) for v in y)
    force, depth, way = hidden((force, depth, way))
    moved = SimpleNamespace(depth=depth, skeleton=way, status=out.status)
    return led, force, depth, way, status(moved)


def friction(scene, m, p):
    law = Coulomb(scene.friction)
    m, led, used, status, _ = admitted(scene, m, p)
    at = used.s[0], used.phi[0]
    out = press_path(scene.geometry, m, *at, used.displacement, law, ObliqueOptions(rings="mat"))
    f = out.press
    vectors = f.force, f.depth, f.skeleton, f.joints, f.loads, f.end_U, f.end_V
    return led, vectors, status(f), out.slip, out.dissipated


def each(scene, m, p):
    m, led, used, status, hidden = admitted(scene, m, p)
    out = oblique_presses(scene, m, used)
    seen = hidden({name: getattr(out, name) for name in SEEN})
    return led, seen, status(out._replace(**seen))


SEEN = "force", "depth", "skeleton", "joints", "loads", "end_U", "end_V"


def oblique_presses(scene, m, used):
    at = used.s, used.phi, used.displacement

    def one(*at):
        return press_oblique(scene.geometry, m, *at, ObliqueOptions(rings="mat", axial=False))

    return jax.vmap(one)(*at)


def tool(scene, m, p):
    """A tool led over the tube: every row presses along the normal where it touches."""
    near = scene.near

    def contact(R, T):
        return touch(scene.tool, Pose(R, T), scene.tube, near=near)

    def pressed(p):
        # As `simulate` does, here and below: across the border of a computation XLA finds nothing
        # that is there twice.
        seen = jax.vmap(fuse(contact))(p.rotation, p.translation)
        inward = jax.vmap(lambda phi: local_frame(phi)[0])(seen.phi)
        return Presses(seen.s, seen.phi, -seen.gap[:, None] * inward), (seen, inward)

    presses, pull, (seen, inward) = jax.vjp(pressed, p, has_aux=True)
    inside = in_lumen(scene, p, seen)
    made = Approach(seen, presses, inward, None, None, seen, inside)
    m, led, used, status, hidden = admitted(scene, m, None, made)
    out = oblique_presses(scene, m, used)
    wrench = force_and_moment(p, pull, inward, used, out)
    # A row is OK only with a force and a moment that are finite.
    finite = jnp.isfinite(jnp.sum(wrench[0] + wrench[1], axis=1))
    solved = jnp.where((out.status == 0) & ~finite, PressStatus.NON_FINITE, out.status)
    rest, wrench = hidden(({name: getattr(out, name) for name in SEEN[1:]}, wrench))
    said = status(out._replace(status=solved, **rest))
    return seen.gap, seen.s, seen.phi, led, wrench, rest, said, contact_share(scene, seen)


def force_and_moment(p, pull, inward, used, out):
    """Normal force where it is touched, and the force that the slope of the ligament makes."""

    def one(phi, D, n, F, slope):
        x = jnp.sum(D * n)
        rising = jax.jvp(
            lambda x: first_touch(x, jnp.zeros_like(x), Options()), (x,), (jnp.ones_like(x),)
        )
        return jnp.sum(local_frame(phi)[0] * F) * rising[1], -jnp.sum(F[1:] * slope)

    N, by_s = jax.vmap(one)(used.phi, used.displacement, inward, out.force, out.slope_C)
    (by,) = pull(Presses(by_s, jnp.zeros_like(by_s), N[:, None] * inward))
    return by.translation, jnp.sum(jnp.cross(p.rotation, by.rotation, axis=1), axis=2)


BARE = {"want_surface": False}
ONE = {**BARE, "want_joints": False, "want_ring_ends": False}
SKIN = {"want_joints": False, "want_ring_ends": False}
MANY = Presses([30.0, 75.0, 120.0], [0.1, 0.2, 0.3], np.full((3, 3), -1.0))
LED = ball([20, -1, 1.0], [130, -1, 2.0])
MAT = {"rings": "mat"}
#: name -> (path, effects, program by hand)
PROGRAMS = {
    "normal": (DOWN, {**ONE, **MAT}, normal),
    "force only": (OBLIQUE, {**ONE, **MAT}, by_hand(more="", **MAT)),
    "off the midline": (OFF, BARE, by_hand(rings="arch2", axial=False)),
    "friction": (OBLIQUE, {**BARE, **MAT}, friction),
    "many places": (MANY, {**BARE, **MAT, "axial": "off"}, each),
    "tool": (LED, {**BARE, **MAT}, tool),
    "surface": (OBLIQUE, {**SKIN, **MAT}, by_hand(more="", surface=True, **MAT)),
}


@functools.cache
def program(name):
    path, effects, hand = PROGRAMS[name]
    mu = 0.66 if name == "friction" else None
    scene = make_scene(
        TUBE, MATERIAL, path, tool=Tool(BALL if name == "tool" else None, mu), mesh=MESH,
        effects=EffectOptions(**effects),
    )  # fmt: skip
    return scene, path, hand


@pytest.mark.slow
@pytest.mark.compiling
@pytest.mark.parametrize("name", PROGRAMS)
def test_an_unused_effect_adds_no_operation(name):
    """In the traced program: no more than in the program by hand, which uses public functions."""
    scene, path, hand = program(name)
    by_plan, own = (count_operations(run, scene, MATERIAL, path) for run in (simulate, hand))
    assert 0.99 * own < by_plan <= own


#: Operations of each row of a normal press for what a plan refuses, counted on paper.
QUESTIONS = {
    "does it press? sine, cosine, two signs, product and sum with D, two comparisons": 10,
    "is it on the tube? two comparisons, two logical": 4,
    "which way does it go? sine, cosine, across (four), along, length of the way (six)": 13,
    "is it normal, on the midline? two limits of two, four comparisons, two logical": 10,
    "is it elsewhere than the first? two differences with size and limit, one logical": 7,
    "does it press off the plan?": 1,
    "is it behind the ends of the rings? size, limit, two for NaN, four logical": 8,
    "is it a number? a sum, three added for s, phi and the first's, a comparison": 5,
    "three displacements are NaN for each of five refusals": 15,
    "computed instead: two comparisons of s, two logical, three choices, one of three": 10,
    "how deep? two vectors added, part inwards (five), not below 0, against the radius": 10,
    "status: too deep (four), five refusals": 9,
}
#: The same for a ball: is it in the lumen, and how sure is the contact.
BALL_QUESTIONS = {
    "place of its one corner, a product of three by three and a sum": 21,
    "its distance from the axis: squares and sum; greatest, within the room: two, logical": 6,
    "its middle: three quotients, distance, within the wall": 7,
    "is it known? a sum of three and the gap, a comparison": 4,
    "does it touch?": 1,
    "is it off an end? two comparisons, one logical": 3,
    "or on a face there? twice two comparisons and two logical": 8,
    "its side: three comparisons, four logical, six choices": 13,
    "is that the lumen? one comparison, one logical": 2,
    "counting the rows": 2,
    "share of what is sure: sign, limit, quotient": 3,
}


def per_row(function, scene, path):
    """Operations for each row, those for all rows apart."""
    both = jax.tree.map(lambda v: jnp.concatenate([v, v]), path)
    more = count_operations(function, scene, MATERIAL, both)
    return (more - count_operations(function, scene, MATERIAL, path)) / len(
        jax.tree.leaves(path)[0]
    )


@pytest.mark.slow
def test_refusals_cost_no_more_than_counted_on_paper():
    """The programs by hand share them with `simulate`: these counts see what is added there."""

    def refusals(scene, m, p):
        _, _, used, status, _ = admitted(scene, m, p)
        moved = SimpleNamespace(depth=p.displacement, skeleton=p.displacement)
        moved.status = jnp.zeros(len(p.s), jnp.int8)
        return used, status(moved)

    def ball_in_lumen(scene, _, seen):
        path = Poses(jnp.zeros((len(seen.s), 3, 3)), seen.point)
        return in_lumen(scene, path, seen), contact_share(scene, seen)

    scene, path, _ = program("normal")
    assert per_row(refusals, scene, path) <= sum(QUESTIONS.values())
    scene, path, _ = program("tool")
    seen = jax.eval_shape(touch_tube, scene, path)
    seen = jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), seen)
    assert per_row(ball_in_lumen, scene, seen) <= sum(BALL_QUESTIONS.values())


@pytest.mark.slow
def test_each_effect_that_is_on_costs_operations():
    path = ball([75, 1, 0.5], [77, -2, 1.0])
    optional = {"GA_L": 9.0, "k_A": 0.2, "k_1_ring": 0.6}
    material = dataclasses.replace(MATERIAL, **{k: jnp.array(v) for k, v in optional.items()})
    scene = make_scene(TUBE, material, path, tool=Tool(BALL, 0.66), mesh=MESH)

    def without(plan):
        return dataclasses.replace(scene, plan=plan)

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

    def loop(x):
        return jax.lax.fori_loop(0, 7, lambda i, y: jnp.sin(y), x)

    assert 140 <= count_operations(loop, x) <= 140 + 14
    assert count_operations(jax.jit(lambda x: (jnp.sin(x), jnp.cos(x))), x) == 40
    # A part that is one kernel counts with what is in it.
    assert count_operations(fuse(lambda x: jnp.sin(jnp.cos(x))), x) >= 2 * 20
