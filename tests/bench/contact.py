"""Time and error of the contact search at its named levels.

Writes the table in docs/evidence/contact.md.

Run by hand on a quiet machine: `python tests/bench/contact.py [--quick]`. Errors are those
of the 2,000 pairs in tests/reference/contact_pairs.npz; times are the best of several runs.
"""

import argparse
import dataclasses
import pathlib
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

ROOT = pathlib.Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))
jax.config.update("jax_enable_x64", True)

from jaxtrachea.contact.distance import signed_distance, track  # noqa: E402
from jaxtrachea.contact.pose import compose, pose_from_quaternion, pose_from_vector  # noqa: E402
from jaxtrachea.contact.search import LEVELS  # noqa: E402
from jaxtrachea.contact.shapes import Shape, box  # noqa: E402
from jaxtrachea.status import ContactStatus  # noqa: E402

BEGIN, END = "<!-- table by tests/bench/contact.py -->\n", "<!-- end of table -->"
PARTS = [(0, "apart"), (1, "touching"), (2, "overlap")]


def load(dtype):
    """Stored pairs by kind, each with its own number of vertices: index, A, B and pose."""
    data = np.load(ROOT / "tests" / "reference" / "contact_pairs.npz")
    kinds, count = data["kind"], data["count"]
    for pair in np.unique(kinds, axis=0):
        index = np.flatnonzero((kinds == pair).all(axis=1))
        shapes = []
        for side in range(2):
            v = data["vertices"][index, side, : count[index[0], side]].transpose(0, 2, 1) / 1024
            r = data["radius"][index, side] / 1024
            shapes.append(Shape(jnp.asarray(v, dtype), jnp.asarray(r, dtype)))
        at = jax.vmap(pose_from_quaternion)(
            jnp.asarray(data["quaternion"][index], dtype),
            jnp.asarray(data["translation"][index], dtype),
        )
        yield index, (*shapes, at)


def size_of(a, b):
    def reach(v):
        return np.linalg.norm(v - v.mean(axis=2, keepdims=True), axis=1).max(axis=1)

    v_a, v_b = np.asarray(a.vertices, float), np.asarray(b.vertices, float)
    return reach(v_a) + reach(v_b) + np.asarray(a.radius + b.radius, float)


def nudge(pose, step, seed):
    w = jnp.asarray(np.random.default_rng(seed).normal(size=(len(pose.translation), 6)) * step)
    w = w.astype(pose.translation.dtype)
    return jax.vmap(lambda p, w: compose(pose_from_vector(w[:3], w[3:]), p))(pose, w)


def errors(settings, dtype):
    """Per pair: excess of the exact distance over phi and over `lower`, statuses, warm misses."""
    data = np.load(ROOT / "tests" / "reference" / "contact_pairs.npz")
    exact, columns = data["distance"], {}
    cold = jax.jit(jax.vmap(lambda a, b, p: signed_distance(a, b, p, settings)))
    warm = jax.jit(jax.vmap(lambda a, b, p, n: track(a, b, p, n, settings)))
    for index, (a, b, pose) in load(dtype):
        size = size_of(a, b)
        c = cold(a, b, pose)
        moved = nudge(pose, 0.01, 5)
        again, w = cold(a, b, moved), warm(a, b, moved, c.normal)
        off = np.asarray(again.distance - w.distance, float) / size
        # Below its own bound: another minimum than the lowest was found.
        bound = np.log(a.vertices.shape[2] * b.vertices.shape[2]) / settings.sharpness
        bias = (exact[index] - np.asarray(c.distance, float)) / size
        rows = {
            "bias": bias,
            "bound": np.full(len(index), bound),
            "missed": bias > bound + 1e-5,
            "lower": (exact[index] - np.asarray(c.lower, float)) / size,
            "stopped": np.asarray(c.status) == ContactStatus.NOT_CONVERGED,
            "warm_off": np.abs(off) > 1e-4,
            "warm_told": np.asarray(w.status) == ContactStatus.NOT_CONVERGED,
        }
        for name, values in rows.items():
            columns.setdefault(name, np.zeros(len(exact), values.dtype))[index] = values
    return columns, data["group"]


def best(f, *args, runs=7, calls=50):
    """Best time of one call, microseconds."""
    jax.block_until_ready(f(*args))
    found = []
    for _ in range(runs):
        start = time.perf_counter()
        for _ in range(calls):
            jax.block_until_ready(f(*args))
        found.append((time.perf_counter() - start) / calls)
    return 1e6 * min(found)


def times(settings, quick):
    """Two rounded boxes, float64: cold, warm, warm with gradient; the first two per vmap lane."""
    a, b = box([1.0, 0.7, 0.4], 0.1), box([0.5, 0.5, 0.2], 0.1)
    v = jnp.array([0.3, 0.2, 0.1, 1.5, 0.9, 0.4])

    def place(v):
        return pose_from_vector(v[:3], v[3:])

    def read(c):
        return (c.distance, c.normal, c.point_a, c.status)

    def cold(v):
        return read(signed_distance(a, b, place(v), settings))

    def warm(v, n):
        return read(track(a, b, place(v), n, settings))

    slope = jax.value_and_grad(lambda v, n: track(a, b, place(v), n, settings).distance)
    n = jax.jit(cold)(v)[1]
    single = [best(jax.jit(cold), v), best(jax.jit(warm), v, n), best(jax.jit(slope), v, n)]
    lanes, chunk = (1024 if quick else 8192), 256
    many = v[None] + 0.01 * jnp.asarray(np.random.default_rng(0).normal(size=(lanes, 6)))

    def batched(f):
        return jax.jit(lambda *x: jax.lax.map(lambda row: f(*row), x, batch_size=chunk))

    start = jnp.tile(n, (lanes, 1))
    runs = {"runs": 3, "calls": 2}
    return [
        *single,
        best(batched(cold), many, **runs) / lanes,
        best(batched(warm), many, start, **runs) / lanes,
    ]


def table(quick):
    lines = [
        "| level | dtype | part | phi* - phi over L: median / max | its bound: median / max "
        "| phi* - lower: median / max | wrong basin | not converged "
        "| warm off by > 1e-4 L (told) |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for level, settings in LEVELS.items():
        for dtype in ["float64"] if quick else ["float64", "float32"]:
            c, group = errors(settings, dtype)
            for g, part in PARTS:
                m = group == g
                bias, bound, lower = c["bias"][m], c["bound"][m], c["lower"][m]
                told = (c["warm_off"] & c["warm_told"])[m].sum()
                lines.append(
                    f"| {level} | {dtype} | {part} ({m.sum()}) | {np.median(bias):.1e} / "
                    f"{bias.max():.1e} | {np.median(bound):.1e} / {bound.max():.1e} | "
                    f"{np.median(lower):.1e} / {lower.max():.1e} | "
                    f"{c['missed'][m].sum()} | {c['stopped'][m].sum()} | "
                    f"{c['warm_off'][m].sum()} ({told}) |"
                )
    lines += [
        "",
        "| level | cold | warm | warm, value and pose gradient | cold per lane | warm per lane |",
        "|---|---|---|---|---|---|",
    ]
    for level, settings in LEVELS.items():
        cells = " | ".join(f"{t:.3g}" for t in times(dataclasses.replace(settings), quick))
        lines.append(f"| {level} | {cells} |")
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="float64 only, few lanes")
    parser.add_argument("--print", action="store_true", help="do not write the page")
    options = parser.parse_args()
    text = table(options.quick)
    if options.print:
        print(text)
        return
    page = ROOT / "docs" / "evidence" / "contact.md"
    head, rest = page.read_text().split(BEGIN)
    page.write_text(head + BEGIN + text + END + rest.split(END)[1])


if __name__ == "__main__":
    main()
