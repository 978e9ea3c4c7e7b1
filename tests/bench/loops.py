"""Loops round a scene: environments, threads, and what a change of material costs.

    python loops.py environments | threads | drawing | material      (tests/reference on PYTHONPATH)

environments: 1,000 balls with friction, each on a way of its own, by `vmap` of `step` under `scan`:
time and memory for each. threads: eight on one session, 10,000 steps in all. drawing: a loop at
1 kHz in one thread and one that draws at 60 Hz in another, for a minute. material: `set_material`
with one changed value against a step.
"""

import dataclasses
import resource
import sys
import threading
import time

import jax

jax.config.update("jax_enable_x64", True)  # before the scenes are made

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from small_scenes import BALL, BARE, MATERIAL, OUTER, TUBE, ball  # noqa: E402
from tool_ways import closed_loop, random_way  # noqa: E402

import jaxtrachea as jt  # noqa: E402
from jaxtrachea.scene.stage import Tool  # noqa: E402
from jaxtrachea.trachea.tube import make_tube  # noqa: E402

EYE = np.eye(3)
RUBBED = dataclasses.replace(
    BARE, contact_point="fixed", friction="on", axial="on", second_plane="on", want_joints=False,
    want_ring_ends=False,
)  # fmt: skip


def scene(**how):
    start = ball([75, 1, 0], [76, -2, 0])
    mesh = make_tube(TUBE, around=36, along=160) if how.get("want_surface") else None
    effects = dataclasses.replace(RUBBED, **how)
    return jt.make_scene(TUBE, MATERIAL, start, tool=Tool(BALL, 0.66), mesh=mesh, effects=effects)


def environments(count: int = 1000, steps: int = 12) -> None:
    """Time and memory for each, and the largest difference from single ones."""
    made = scene()
    ways = [random_way(steps, OUTER, seed) for seed in range(count)]
    rotation, translation = (
        jnp.asarray(np.stack([getattr(w, name)[:steps] for w in ways], 1))
        for name in ("rotation", "translation")
    )
    many = jax.vmap(lambda *given: jt.step(made, MATERIAL, *given))
    states = jax.vmap(lambda _: jt.init_state(made, MATERIAL))(jnp.arange(count))

    @jax.jit
    def run(states, rotation, translation):
        def one(states, pose):
            states, seen = many(states, *pose)
            return states, (seen.force, seen.status)

        return jax.lax.scan(one, states, (rotation, translation))[1]

    program = run.lower(states, rotation, translation).compile()
    memory = program.memory_analysis()
    assert memory is not None
    begin = time.perf_counter()
    force, status = jax.block_until_ready(program(states, rotation, translation))
    taken = time.perf_counter() - begin
    size = sum(v.nbytes for v in jax.tree.leaves(states)) / count
    print(
        f"{count} environments, {steps} steps: {1e6 * taken / steps / count:.1f} us a step of one; "
        f"state {size:.0f} bytes, program {memory.temp_size_in_bytes / count / 1e3:.1f} kB for each"
    )
    session, worst = jt.Session(made, MATERIAL), 0.0
    for i in range(0, count, 10):
        session.reset()
        for k in range(steps):
            seen = session.step(rotation[k, i], translation[k, i])
            assert int(seen.status) == int(status[k, i])
            worst = max(worst, float(np.nanmax(np.abs(seen.force - force[k, i]), initial=0)))
    print(f"largest difference from {len(range(0, count, 10))} single ones: {worst:.1e} N")


def threads(steps: int = 10_000) -> None:
    """No exception, and the forces of the same order one after the other."""
    session = jt.Session(scene(), MATERIAL)
    way, order, program, errors = random_way(steps, OUTER, 4), [], session._program, []

    def watched(*given):
        result = program(*given)
        order.append((given, result.force.copy()))
        return result

    def work(first: int) -> None:
        try:
            for i in range(first, steps, 8):
                session.step(way.rotation[i], way.translation[i])
        except Exception as error:
            errors.append(error)

    session._program = watched
    sys.setswitchinterval(1e-5)
    running = [threading.Thread(target=work, args=(i,)) for i in range(8)]
    for one in running:
        one.start()
    for one in running:
        one.join()
    session._program = program
    session.reset()
    same = all(
        np.array_equal(session.step(*given[:2]).force, force, equal_nan=True)
        for given, force in order
    )
    print(f"{len(order)} steps by eight threads: {len(errors)} exceptions, the same forces: {same}")


def drawing(seconds: float = 60.0) -> None:
    """Late steps of a loop at 1 kHz beside a thread that draws."""
    session = jt.Session(scene(want_surface=True, dent="16"), MATERIAL)
    way, latest, errors = closed_loop(0, 2000, OUTER), {}, []
    end, late, taken, frames, moved = time.perf_counter() + seconds, 0, [], 0, 0

    def draw() -> None:
        nonlocal frames, moved
        try:
            while time.perf_counter() < end:
                if "result" in latest:
                    vertices = latest["result"].vertices
                    before = np.array(vertices)
                    time.sleep(1 / 60)  # holds it while the loop goes on
                    moved += not np.array_equal(before, np.asarray(vertices), equal_nan=True)
                    frames += 1
        except Exception as error:
            errors.append(error)

    drawer = threading.Thread(target=draw)
    drawer.start()
    due, k = time.perf_counter(), 0
    while due < end:
        while time.perf_counter() < due:
            time.sleep(0)
        start = time.perf_counter()
        latest["result"] = session.step(EYE, way[k % len(way)])
        stop = time.perf_counter()
        taken.append(stop - start)
        due, k = due + 1e-3, k + 1
        if stop > due:
            late, due = late + 1, stop
    drawer.join()
    median, p99, worst = 1e3 * np.quantile(taken, (0.5, 0.99, 1))
    print(
        f"{k} steps in {seconds:.0f} s, {late} late; step {median:.2f} ms, 99 % {p99:.2f}, worst "
        f"{worst:.1f}; {frames} frames, {moved} that changed while held; {len(errors)} exceptions"
    )


def material(rounds: int = 2000) -> None:
    """Medians in turns."""
    session = jt.Session(scene(), MATERIAL)
    soft = dataclasses.replace(MATERIAL, k_1=jnp.asarray(0.31))
    place, found = np.array([75.0, OUTER + 4, 0.0]), []
    for k in range(rounds):
        a = time.perf_counter()
        session.step(EYE, place)
        b = time.perf_counter()
        session.set_material(soft if k % 2 else MATERIAL)
        found.append((b - a, time.perf_counter() - b))
    step, change = 1e6 * np.median(found, axis=0)
    print(f"step {step:.0f} us, set_material {change:.0f} us: {change / step:.2f} steps")


if __name__ == "__main__":
    for name in sys.argv[1:]:
        {"environments": environments, "threads": threads, "drawing": drawing,
         "material": material}[name]()  # fmt: skip
    print(f"resident {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")
