"""A tool that slides takes its dent along: the surface touches it, and does not enter it."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxtrachea import Poses, simulate
from jaxtrachea._numerics import full_precision
from jaxtrachea.contact.shapes import capsule, sphere
from jaxtrachea.scene import trail
from jaxtrachea.scene.build import stage
from jaxtrachea.scene.spec import load_scene_spec
from jaxtrachea.surface import local

pytestmark = pytest.mark.compiling

CONFIGS = Path(__file__).parents[2] / "configs"


def test_a_dent_laid_elsewhere_is_the_dent_made_there():
    radius, spacing = jnp.asarray(12.6), jnp.asarray(4.0)
    depth, sag = jnp.array([0.2, -0.6, 0.1]), jnp.linspace(0, 1, 16)

    @jax.jit
    def both(s, phi):
        def at(s, phi):
            return local.fit(
                local.centres(s, phi, radius, spacing, 16), local.targets(depth, sag), 3 * spacing
            )

        s_0, phi_0 = jnp.asarray(80.0), jnp.asarray(0.3)
        return trail.lay_at(at(s_0, phi_0), s - s_0, phi - phi_0), at(s, phi)

    laid, anew = both(jnp.asarray(82.3), jnp.asarray(0.1))
    np.testing.assert_allclose(laid.centres, anew.centres, atol=1e-12)
    np.testing.assert_allclose(laid.weights, anew.weights, atol=1e-12)


def test_the_place_under_a_slip():
    """Along the tube as it is, round it by the arc; tangents at 0.3 rad written out."""
    slip = 2.0 * np.array([1.0, 0, 0]) + 1.5 * np.array([0, -np.sin(0.3), np.cos(0.3)])
    at = trail.slid(jnp.asarray(80.0), jnp.asarray(0.3), jnp.asarray(12.0), jnp.asarray(slip))
    np.testing.assert_allclose(at, [82.0, 0.3 + 1.5 / 12], rtol=1e-14)


#: name -> (tool, height of its origin over a plane that it just touches)
TOOLS = {"ball": (sphere(5.0), 5.0), "capsule": (capsule(1.5, 3.0), 3.0)}


def plane(dtype=float):
    """A plane, sunk 0.7 mm under its middle, and the square of the distance from there."""
    x, z = (v.ravel() for v in np.meshgrid(np.linspace(-6, 6, 25), np.linspace(-6, 6, 25)))
    bump = 0.7 * np.exp(-(x * x + z * z) / 16)
    arrays = x * x + z * z, np.stack([x, 0 * x, z], 1), np.stack([x, -bump, z], 1)
    return tuple(jnp.asarray(v, dtype) for v in arrays)


def touching(tool, pose, near, sunk, dented):
    """The surface with its dent scaled."""
    return sunk + trail.scale_to_touch(tool, pose, near, sunk, dented) * (dented - sunk)


def test_the_scale_has_the_derivatives_of_finite_differences():
    """By the ball's height: 1 over the dent's share where it touches; and not at all above."""

    def depth(height):
        pose = Poses(jnp.eye(3), jnp.zeros(3).at[1].set(height))
        return -jnp.min(touching(TOOLS["ball"][0], pose, *plane())[:, 1])

    both = jax.jit(jax.vmap(jax.value_and_grad(depth)))
    heights = np.array([3.7, 4.6, 5.2])
    slope = both(jnp.asarray(heights))[1]
    step = 1e-6
    up, down = (both(jnp.asarray(heights + d))[0] for d in (step, -step))
    np.testing.assert_allclose(slope, (up - down) / (2 * step), atol=1e-6)
    assert slope[0] < -0.9
    assert slope[2] == 0


@pytest.mark.long
@pytest.mark.parametrize(("name", "dtype"), [("ball", "f4"), ("capsule", float)])
def test_a_dent_is_scaled_until_it_touches(name, dtype):
    """A plane with a dent 0.7 mm deep; the tool reaches below it, less, or not to the plane."""
    tool, height = TOOLS[name]
    square, flat, dented = plane(dtype)
    tool = jax.tree.map(lambda v: jnp.asarray(v, dtype), tool)
    reaches = np.array([1.3, 0.4, -0.2])
    places = jnp.asarray(np.stack([0 * reaches, height - reaches, 0 * reaches], 1), dtype)
    poses = Poses(jnp.broadcast_to(jnp.eye(3, dtype=dtype), (3, 3, 3)), places)
    # As a part of `simulate`, also where products of matrices are in less by default.
    run = jax.jit(jax.vmap(full_precision(touching), (None, 0, None, None, None)))
    surfaces = run(tool, poses, square, flat, dented)
    assert surfaces.dtype == flat.dtype
    # The capsule's distance is that of its smoothed shape, up to log(2) / beta too small.
    smoothing = {"ball": 1e-5, "capsule": 0.01}[name]
    for place, reach, out in zip(places, reaches, np.asarray(surfaces, float), strict=True):
        core = np.broadcast_to(np.asarray(place, float), out.shape).copy()
        if name == "capsule":
            core[:, 2] = np.clip(out[:, 2], -1.5, 1.5)
        under = np.asarray(square) <= 4
        apart = (np.linalg.norm(out - core, axis=1)[under] - height).min()
        np.testing.assert_allclose(apart, max(-reach, 0), atol=smoothing)
    np.testing.assert_array_equal(surfaces[2], flat)


def test_the_surface_is_continuous_where_the_dent_goes_to_nothing():
    """A ball 0.3 mm inside: dents of 1e-2 to 1e-12 mm all moved it by 0.3 mm, none by 0."""
    tool, height = TOOLS["ball"]
    square, flat, dented = plane()
    pose = Poses(jnp.eye(3), jnp.array([0, height - 0.3, 0]))
    peaks = np.array([0.2, 0.1, 0.05, 1e-2, 1e-6, 1e-12, 0])
    dents = jnp.asarray(np.asarray(flat) + (peaks / 0.7)[:, None, None] * np.asarray(dented - flat))
    run = jax.jit(jax.vmap(touching, (None, None, None, None, 0)))
    lowest = -np.asarray(run(tool, pose, square, flat, dents))[:, :, 1].min(axis=1)
    np.testing.assert_allclose(lowest[:2], 0.3, atol=1e-2)  # it touches, up to the edge of the dent
    np.testing.assert_allclose(lowest[2:], 5 * peaks[2:], rtol=1e-9)


@pytest.mark.slow
def test_the_ball_of_friction_toml_stays_out_of_the_surface():
    """From row 10 on it slides: the ball was 0.37 mm inside in row 14, 0.015 before it slid."""
    path = CONFIGS / "friction.toml"
    staged = stage(load_scene_spec(path), CONFIGS)
    out = jax.jit(simulate)(staged.scene, staged.material, staged.path)
    assert staged.scene.mesh is not None
    faces, slip = np.asarray(staged.scene.mesh.faces), np.asarray(out.slip)[:, 0]
    assert (slip[:9] == 0).all()
    assert (np.diff(slip)[8:] > 0.3).all()
    for row in range(1, 14):
        centre = np.asarray(staged.path.translation)[row]
        corners = np.asarray(out.vertices)[row][faces]
        off = np.linalg.norm(corners - centre, axis=2) - 5
        np.testing.assert_allclose(off.min(), 0, atol=1e-8, err_msg=f"row {row + 1}")
        # A flat triangle with its corners on the ball has its middle inside, by no more than this:
        close = corners[off.min(axis=1) < 1.5]
        edge = np.linalg.norm(close - np.roll(close, 1, axis=1), axis=2).max()
        middle = trimesh.triangles.closest_point(close, np.broadcast_to(centre, (len(close), 3)))
        inside = 5 - np.linalg.norm(middle - centre, axis=1).min()
        assert inside <= 5 - np.sqrt(25 - edge**2 / 3)
        assert inside < 0.04
