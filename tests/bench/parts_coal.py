"""Tools of several convex parts on a round tube, against coal (3.0.3): `pip install coal`.

    python tests/bench/parts_coal.py

Two jaws, a hook and three clouds of points in 200 poses each, beside the tube and in it. coal gives
the signed distance of every part and patch; the least of a pose is compared with `touch`, whose
smoothing (beta 1e4 / mm) lies below it by some 1e-4 mm.
"""

import coal
import common  # noqa: F401  (pins one core, before jax)
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import ConvexHull

from jaxtrachea.contact import shapes
from jaxtrachea.contact.patches import straight_patches, touch
from jaxtrachea.contact.pose import pose_from_vector
from jaxtrachea.status import ContactStatus

TUBE = straight_patches(np.r_[0.0, np.arange(10, 151, 20), 160.0], 12.0)
POSES, BETA = 200, 1e4


def at(x, y, z, turn=0.0):
    return pose_from_vector(jnp.array([0.0, turn, 0.0]), jnp.array([x, y, z], float))


def tools():
    """By name."""
    rng = np.random.default_rng(1)
    jaw, rod = shapes.box([1, 1.5, 5], 0.3), shapes.capsule(6.0, 1.0)
    clouds = [shapes.cloud(2 * rng.normal(size=(12, 3)), 0.2) for _ in range(3)]
    hook = [rod, shapes.capsule(3.0, 1.0), shapes.sphere(1.8)]
    return {
        "jaws": shapes.compound([jaw, jaw], [at(-3, 0, 0, 0.2), at(3, 0, 0, -0.2)]),
        "hook": shapes.compound(hook, [at(0, 0, 0), at(3, 0, -6, 1.57), at(6, 0, -6)]),
        "clouds": shapes.compound(clouds, [at(-5, 0, 0), at(0, 0, 1), at(5, 0, 0)]),
    }


def of_coal(shape):
    """The same body, and its pose: a ball, a capsule or a rounded polytope."""
    points, radius = np.unique(np.asarray(shape.vertices).T.round(12), axis=0), float(shape.radius)
    if len(points) == 1:
        return coal.Sphere(radius), coal.Transform3s(np.eye(3), points[0])
    if len(points) == 2:
        way = points[1] - points[0]
        axes = np.linalg.svd(way[None])[2][[1, 2, 0]].T
        axes[:, 0] *= np.linalg.det(axes)
        body = coal.Capsule(radius, float(np.linalg.norm(way)))
        return body, coal.Transform3s(axes, points.mean(0))
    hull = ConvexHull(points)
    number = {int(i): n for n, i in enumerate(hull.vertices)}
    corners, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for i in hull.vertices:
        corners.append(points[i])
    for (a, b, c), plane in zip(hull.simplices, hull.equations, strict=True):
        if np.cross(points[b] - points[a], points[c] - points[a]) @ plane[:3] < 0:
            b, c = c, b
        faces.append(coal.Triangle(*(number[int(i)] for i in (a, b, c))))
    body = coal.Convex(corners, faces)
    body.setSweptSphereRadius(radius)
    return body, coal.Transform3s()


def distance(a, b, pose):
    """Signed, of two bodies with their poses; b is led by a pose."""
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.enable_signed_distance = True
    request.gjk_tolerance = request.epa_tolerance = 1e-10
    request.gjk_max_iterations = request.epa_max_iterations = 1000
    return coal.distance(a[0], a[1], b[0], pose * b[1], request, result)


def main():
    """Print, by tool and status, how far both are apart."""
    patches = [jax.tree.map(lambda v, i=i: v[i], TUBE.shapes) for i in range(len(TUBE.centres))]
    patches = [of_coal(patch) for patch in patches]
    meet = jax.jit(jax.vmap(lambda t, pose: touch(t, pose, TUBE, near=3, beta=BETA), (None, 0)))
    for name, tool in tools().items():
        rng = np.random.default_rng(7)
        phi, high = rng.uniform(-1.2, 1.2, POSES), rng.uniform(13, 24, POSES)
        s, turn = rng.uniform(20, 140, POSES), rng.normal(size=(POSES, 3))
        places = np.stack([s, high * np.cos(phi), high * np.sin(phi)], 1)
        poses = jax.vmap(pose_from_vector)(turn, places)
        ours = meet(tool, poses)
        parts = [of_coal(part) for part in shapes.parts_of(tool)]
        led = map(coal.Transform3s, *map(np.asarray, (poses.rotation, poses.translation)))
        known = np.array([[min(distance(p, q, x) for p in patches) for q in parts] for x in led])
        least, order = known.min(axis=1), np.sort(known, axis=1)
        off, clear = np.abs(np.asarray(ours.gap) - least), order[:, 1] - order[:, 0] > 0.01
        same = (known.argmin(axis=1) == ours.part)[clear].mean()
        print(f"{name}: {(least < 0).sum()} of {POSES} overlap; the deepest part is the same in "
              f"{same:.0%} of {clear.sum()}")  # fmt: skip
        for status in np.unique(ours.status):
            some = off[np.asarray(ours.status) == status]
            print(f"  {ContactStatus(status).name}: {len(some)}, {some.max():.2g} mm at most")


if __name__ == "__main__":
    main()
