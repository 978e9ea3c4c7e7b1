"""Writes `contact_pairs.npz`: 2,000 random convex pairs with their signed distances and normals.

Run by hand: `python contact_pairs_make.py`. Needs `coal` (3.0.3 was used) and scipy; the tests need
neither. Bodies lie on a grid of 1/1024 and poses are small integers, so that the file is small and
exact.

Every distance comes from two programs that share no method: coal (GJK / EPA) and the difference
polytope in scipy (`ConvexHull` for the depth, `nnls` for the distance). Where they differ by more
than 1e-6 of the size the polytope's value is stored, and counted in `coal_differs`.

Columns: `vertices` (pair, 2, 12, 3) and `count` (pair, 2), `radius` (pair, 2), all times 1/1024;
`quaternion` (pair, 4), not normalised, and `translation` (pair, 3) take B into A's frame; `kind`
(pair, 2): 0 sphere, 1 capsule, 2 box, 3 cloud; `group`: 0 apart, 1 within 1e-3 of the size, 2
overlap; `distance`, `normal` (from A to B), `unique` (no second normal gives a depth within 1e-3 of
the size).
"""

import pathlib

import coal
import numpy as np
from scipy.optimize import nnls
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

GRID, MOST, PAIRS = 1024, 12, 2000
SIGNS = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T


def body(rng, kind):
    """Vertices and radius on the grid."""
    radius = int(rng.integers(GRID // 20, GRID // 2)) if kind < 2 else int(rng.integers(0, 200))
    if kind == 0:
        return np.zeros((1, 3), int), radius
    if kind == 1:
        half = int(rng.integers(GRID // 4, 2 * GRID))
        return np.array([[0, 0, -half], [0, 0, half]]), radius
    if kind == 2:
        return SIGNS * rng.integers(GRID // 10, GRID, 3), radius
    size = rng.integers(GRID // 4, GRID, 3)
    return np.rint(rng.uniform(-1, 1, (MOST, 3)) * size).astype(int), radius


def to_coal(kind, vertices, radius):
    v, r = vertices / GRID, radius / GRID
    if kind == 0:
        return coal.Sphere(r)
    if kind == 1:
        return coal.Capsule(r, 2 * v[1, 2])
    if kind == 2:
        shape = coal.Box(*(2 * np.abs(v[0])))
    else:
        found = ConvexHull(v)
        keep = {int(i): n for n, i in enumerate(found.vertices)}
        points, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
        for i in found.vertices:
            points.append(v[i])
        for simplex, plane in zip(found.simplices, found.equations, strict=True):
            a, b, c = simplex
            if np.dot(np.cross(v[b] - v[a], v[c] - v[a]), plane[:3]) < 0:
                b, c = c, b
            faces.append(coal.Triangle(keep[int(a)], keep[int(b)], keep[int(c)]))
        shape = coal.Convex(points, faces)
    shape.setSweptSphereRadius(r)
    return shape


def by_coal(a, b, rotation, translation):
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.enable_signed_distance = True
    request.gjk_tolerance = request.epa_tolerance = 1e-12
    request.gjk_max_iterations = request.epa_max_iterations = 1000
    there = coal.Transform3s(rotation, translation)
    return coal.distance(a, coal.Transform3s(), b, there, request, result), result.normal


def by_difference(v_a, v_b, radius):
    """Signed distance from the hull of all b - a; its normal; gap to the second best facet."""
    points = (v_b[None] - v_a[:, None]).reshape(-1, 3)
    # Nearest point of the hull to 0: min |P w|, sum w = 1, by nnls on [P; 1] w = [0; 1].
    scale = np.abs(points).max()
    weights, _ = nnls(np.vstack([points.T / scale, np.ones(len(points))]), np.array([0, 0, 0, 1.0]))
    nearest = points.T @ weights / weights.sum()
    apart = np.linalg.norm(nearest)
    if apart > 1e-7 * scale:
        normal = nearest / apart
        # Sharpen: the supporting value at this normal bounds the distance from below.
        return np.min(points @ normal) - radius, normal, np.inf
    if np.linalg.matrix_rank(points - points[0], tol=1e-9) < 3:
        return None
    planes = ConvexHull(points, qhull_options="Qt").equations
    # n . x + c <= 0 inside: the depth at 0 is the least -c, and B moves out along -n.
    depth = -planes[:, 3]
    best = int(np.argmin(depth))
    apart_from_best = planes[:, :3] @ planes[best, :3] < 1 - 1e-9
    second = np.min(depth[apart_from_best]) - depth[best]
    return -depth[best] - radius, -planes[best, :3], second


def make(rng, index):
    kind = [index % 4, (index // 4) % 4]
    (v_a, r_a), (v_b, r_b) = (body(rng, k) for k in kind)
    q = rng.integers(-1000, 1001, 4)
    rotation = Rotation.from_quat([q[1], q[2], q[3], q[0]]).as_matrix()
    a, b = to_coal(kind[0], v_a, r_a), to_coal(kind[1], v_b, r_b)
    u = rng.normal(size=3)
    u /= np.linalg.norm(u)

    def reach(v):
        return np.linalg.norm(v, axis=1).max() / GRID

    size = reach(v_a) + reach(v_b) + (r_a + r_b) / GRID
    low, high = 0.0, 2 * size
    for _ in range(40):
        middle = (low + high) / 2
        touching = by_coal(a, b, rotation, middle * u)[0] > 0
        low, high = (low, middle) if touching else (middle, high)
    group = (index // 16) % 3
    t = [high + rng.uniform(0.01, 1) * size, high + rng.uniform(-1, 1) * 1e-3 * size,
         high * rng.uniform(0.02, 0.95)][group] * u  # fmt: skip
    t = np.float32(t).astype(float)
    ours = by_difference(v_a / GRID, (v_b / GRID) @ rotation.T + t, (r_a + r_b) / GRID)
    theirs, normal = by_coal(a, b, rotation, t)
    if ours is None:
        ours = (theirs, normal, np.inf)
    differs = abs(ours[0] - theirs) > 1e-6 * size
    return kind, (v_a, v_b), (r_a, r_b), q, t, group, ours, theirs, differs, size


def main():
    rng = np.random.default_rng(20)
    made = [make(rng, i) for i in range(PAIRS)]
    vertices = np.zeros((PAIRS, 2, MOST, 3), np.int16)
    for i, row in enumerate(made):
        for side in range(2):
            vertices[i, side, : len(row[1][side])] = row[1][side]

    def column(f, dtype):
        return np.array([f(row) for row in made], dtype)

    differs = column(lambda r: r[8], bool)
    np.savez_compressed(
        pathlib.Path(__file__).with_name("contact_pairs.npz"),
        vertices=vertices,
        count=column(lambda r: [len(v) for v in r[1]], np.int8),
        radius=column(lambda r: r[2], np.int16),
        quaternion=column(lambda r: r[3], np.int16),
        translation=column(lambda r: r[4], np.float32),
        kind=column(lambda r: r[0], np.int8),
        group=column(lambda r: r[5], np.int8),
        distance=column(lambda r: r[6][0], float),
        normal=column(lambda r: r[6][1], np.float32),
        unique=column(lambda r: r[6][2] > 1e-3 * r[9], bool),
        coal_differs=differs,
    )
    print(f"coal differs in {differs.sum()} of {PAIRS}")
    for row in (r for r in made if r[8]):
        print(row[0], row[5], "polytope", row[6][0], "coal", row[7])


if __name__ == "__main__":
    main()
