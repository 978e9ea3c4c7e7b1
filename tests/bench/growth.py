"""Growth of time with size: rings, contacts, vertices, lanes.

Run: python tests/bench/growth.py [part]. Every size is a program of its own.
"""

import dataclasses
import json
import sys
import time

import common
import jax
import jax.numpy as jnp
import numpy as np
import skeleton
import update

from jaxtrachea import Material, Presses, make_scene, press, simulate, table_1
from jaxtrachea.contact.patches import straight_patches, touch
from jaxtrachea.contact.pose import Pose
from jaxtrachea.contact.shapes import sphere
from jaxtrachea.mechanics.beam import contact_compliance
from jaxtrachea.scene.effects import EffectOptions
from jaxtrachea.scene.stage import Poses
from jaxtrachea.scene.sweep import sweep
from jaxtrachea.trachea.tube import make_tube

jax.config.update("jax_cpu_enable_async_dispatch", False)

LANES, FEW = 256, 32
#: Seconds of one call above which a case of many lanes is left out.
LONGEST = 5.0
BARE = EffectOptions(want_surface=False, want_joints=False, want_ring_ends=False)
MATERIAL = Material(**{k: jnp.asarray(v) for k, v in update.VALUES.items()})


def compiled(f, *args):
    """A call without arguments that waits for its result, and the seconds its program took."""
    begin = time.perf_counter()
    run = jax.jit(f).lower(*args).compile()
    return lambda: jax.block_until_ready(run(*args)), time.perf_counter() - begin


def record(out: common.Writer, table: str, size: int, programs, lanes: int = 1, **fields) -> None:
    """Compile, time in turn, one row each; `programs`: (function, arguments) by name."""
    calls, seconds, slowest = {}, {}, 0.0
    for name, (f, args) in programs.items():
        calls[name], seconds[name] = compiled(f, *args)
        begin = time.perf_counter()
        calls[name]()
        taken = time.perf_counter() - begin
        if taken > LONGEST:
            out.note(table, f"{name}: left out at {size:,}, one call takes more than {LONGEST} s")
            del calls[name]
        else:
            slowest = max(slowest, taken)
    rounds = 25 if slowest < 0.01 else 9 if slowest < 0.1 else 5
    found = common.interleaved(calls, rounds=rounds, target=0.003)
    out.table(table, found, size=size, lanes=lanes, compile=seconds, **fields)


def rings(out: common.Writer) -> None:
    """One call and 256 lanes against the number of rings."""
    for n in (2, 5, 15, 50, 100, 150, 500, 2000):
        b = skeleton.beam(n)
        at = jnp.asarray(0.52 * float(b.length)), jnp.asarray(skeleton.FORCE)
        args = (*jax.tree.leaves(b), *at)
        gradient = jax.value_and_grad(skeleton.compliance_of, argnums=(2, 3, 4))
        one = {
            "call: w_C, reactions": (skeleton.two_outputs, args),
            "call: w_C and gradient": (gradient, args[:5]),
        }
        record(out, "rings", n, one)
        inputs = tuple(map(jnp.asarray, skeleton.lane_inputs(n, LANES)))
        axes = (None, None, 0, 0, 0)
        many = {
            "lane: w_C, reactions": (jax.vmap(skeleton.two_outputs, (*axes, 0)), inputs),
            "lane: w_C and gradient": (jax.vmap(gradient, axes), inputs[:5]),
        }
        record(out, "rings", n, many, LANES)
        few = tuple(v[:FEW] if i in (2, 3, 4) else v for i, v in enumerate(inputs[:5]))
        name = f"lane of {FEW}: w_C and gradient"
        record(out, "rings", n, {name: (jax.vmap(gradient, axes), few)}, FEW)


def positions(out: common.Writer) -> None:
    """Contact positions of one sweep over the tube: the whole press, and its compliance alone."""
    geometry = table_1()
    start = Presses(jnp.array([75.0]), jnp.zeros(1), jnp.array([[0.0, -2.0, 0.0]]))
    scene = make_scene(geometry, MATERIAL, start, effects=BARE)

    def run(s, depth):
        return sweep(scene, MATERIAL, s, 0 * s, depth)

    for m in (1, 10, 100, 1000, 10_000, 100_000):
        s = jnp.linspace(5.0, 155.0, m)
        cases = {
            "`contact_compliance`": (contact_compliance, (skeleton.beam(), s)),
            "`sweep`: force, indentation, compliance": (run, (s, jnp.full(m, 2.0))),
        }
        record(out, "positions", m, cases)


def patches(out: common.Writer) -> None:
    """Patches of the tube that a tool may touch; two of them are searched."""
    tool, eye = sphere(update.RADIUS), jnp.eye(3)
    place = update.at(float).translation[0]
    for n in (4, 8, 16, 32, 64, 128, 256):
        tube = straight_patches(np.linspace(0.0, 160.0, n + 1), update.OUTER)

        def search(R, T, tube):
            return touch(tool, Pose(R, T), tube, near=2)

        record(out, "patches", n, {"contact of a ball": (search, (eye, place, tube))})


def ball_scene():
    """The ball on a round tube, forces alone."""
    ball = sphere(jnp.asarray(update.RADIUS))
    scene = make_scene(table_1(), MATERIAL, update.at(float), tool=ball, effects=BARE)
    return dataclasses.replace(scene, tube=update.round_tube(float), near=2)


def path(out: common.Writer) -> None:
    """Poses of one path of the tool: it approaches the midline, touches and presses."""
    scene = ball_scene()

    def run(path):
        return simulate(scene, MATERIAL, path).force

    for n in (1, 4, 16, 64, 256, 1024):
        way = np.linspace(1.0, -update.DEPTH, n) if n > 1 else np.array([-update.DEPTH])
        places = np.stack([0 * way + update.S, update.OUTER + update.RADIUS + way, 0 * way], 1)
        poses = Poses(jnp.broadcast_to(jnp.eye(3), (n, 3, 3)), jnp.asarray(places))
        record(out, "path", n, {"contact, skeleton": (run, (poses,))})


def vertices(out: common.Writer) -> None:
    """Vertices of the surface under a given press: skeleton, global shape, dent of 16 centres."""
    effects = dataclasses.replace(BARE, want_surface=True, dent="8")
    for count in (1_000, 10_000, 100_000, 1_000_000):
        around = round((count / 2.77) ** 0.5)
        for dtype in ("float32", "float64"):
            geometry = table_1(dtype)
            mesh = make_tube(geometry, around=around, along=round(count / around) - 1)
            material = jax.tree.map(lambda v: v.astype(dtype), MATERIAL)  # noqa: B023

            def number(*v):
                return jnp.asarray(v, dtype)  # noqa: B023

            given = Presses(number(update.S), number(0.0), number(0.0, -2.0, 0.0)[None])
            scene = make_scene(geometry, material, given, mesh=mesh, effects=effects)
            # The plan refuses 16 centres without a tool to shape the dent; the work is the same.
            scene = dataclasses.replace(scene, plan=dataclasses.replace(scene.plan, dent=16))

            def run(scene, m, p):
                return simulate(scene, m, p).vertices

            size = mesh.vertices.shape[0]
            # What must be read (s, phi, fraction, rest shape; place) and written (shape), at least.
            bytes_ = size * (9 * mesh.vertices.dtype.itemsize + 4)
            block = jnp.zeros(bytes_ // 2 // mesh.vertices.dtype.itemsize, dtype)
            cases = {
                f"surface; {dtype}": (run, (scene, material, given)),
                f"copy of as many bytes; {dtype}": (lambda v: v + 1, (block,)),
            }
            record(out, "vertices", size, cases, bytes=bytes_)


def lanes(out: common.Writer) -> None:
    """Presses and poses computed together."""
    geometry, scene = table_1(), ball_scene()

    def pressed(EI_L, k_M, s, depth):
        material = dataclasses.replace(MATERIAL, EI_L=EI_L, k_M=k_M)
        found = press(geometry, material, s, depth)
        return found.compliance, found.force

    def posed(place):
        found = simulate(scene, MATERIAL, Poses(jnp.eye(3)[None], place[None]))
        return found.force, found.status

    for n in (1, 10, 100, 1000, 10_000, 100_000, 1_000_000):
        rng = np.random.default_rng(0)

        def spread(low, high):
            return jnp.asarray(rng.uniform(low, high, n))  # noqa: B023

        s = spread(10, 150)
        args = spread(1.5, 2.2), spread(0.08, 0.12), s, spread(0.5, 3)
        cases = {"`press`: compliance, force": (jax.vmap(pressed), args)}
        if n <= 10_000:
            away = update.OUTER + update.RADIUS - spread(0.2, 3)
            places = jnp.stack([s, away, 0 * s], axis=1)
            cases["contact, skeleton"] = (jax.vmap(posed), (places,))
        record(out, "lanes", n, cases, n)


PARTS = {f.__name__: f for f in (rings, positions, patches, path, vertices, lanes)}


def measured_before(parts) -> list[dict]:
    """Rows of the last run that none of these parts measures again."""
    path = common.RESULTS / "growth.jsonl"
    lines = path.read_text().splitlines()[1:] if path.exists() else []
    return [row for row in map(json.loads, lines) if row["table"] not in parts]


def main() -> None:
    """Measure all or the parts named, whose rows then replace those of the last run."""
    out = common.Writer("growth")
    parts = sys.argv[1:] or list(PARTS)
    out.rows += measured_before(parts)
    for part in parts:
        begin = time.perf_counter()
        PARTS[part](out)
        print(f"{part}: {time.perf_counter() - begin:.0f} s", flush=True)
        out.write()


if __name__ == "__main__":
    main()
