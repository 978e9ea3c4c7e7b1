"""A small scene to try things on: Table 1's tube, a coarse mesh, a ball, and its paths."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from jaxtrachea import EffectOptions, Material, Poses, Presses, table_1
from jaxtrachea.contact.shapes import sphere
from jaxtrachea.trachea.tube import make_tube

TUBE = table_1()
OUTER = float(TUBE.radius) + 1.3
MATERIAL = Material(EI_L=1.86, EA_L=3.9, EI_C=13.0, k_M=0.1, k_t=0.4, k_1=0.3, k_3=0.02)
#: Without what bends a ring: one plane is enough on the midline.
SPRINGS = dataclasses.replace(MATERIAL, EI_C=None, k_t=None)
MESH = make_tube(TUBE, around=9, along=40)
BALL = sphere(5.0)
BARE = EffectOptions(want_surface=False)


def presses(D, s=75.0, phi=0.0, rows=3):
    """From rest to D in equal steps."""
    share = np.linspace(0, 1, rows)[:, None]
    return Presses(np.full(rows, s), np.full(rows, phi), share * np.asarray(D, float))


def poses(start, end, rows=4):
    """The tool's origin led along a line, without turning."""
    places = np.linspace(np.asarray(start, float), np.asarray(end, float), rows)
    return Poses(np.broadcast_to(np.eye(3), (rows, 3, 3)), places)


def ball(start, end, rows=4, top=OUTER):
    """The ball, by its lowest point's (s, height over the tube, z)."""
    up = np.array([0, top + 5, 0])
    return poses(np.asarray(start) + up, np.asarray(end) + up, rows)


DOWN, OBLIQUE, OFF = presses([0, -4, 0]), presses([-2, -4, 0]), presses([0, -3, -1], phi=0.5)


def on_arc(s, radius):
    """Centreline and frame (tangent, anterior, lateral) of a tube bent to an arc, anterior out."""
    a = np.asarray(s) / radius
    one, no = np.ones_like(a), np.zeros_like(a)
    columns = [[np.cos(a), -np.sin(a), no], [np.sin(a), np.cos(a), no], [no, no, one]]
    centre = radius * np.stack([np.sin(a), np.cos(a) - 1, no], -1)
    return centre, np.stack([np.stack(c, -1) for c in columns], -1)


def bend(mesh, radius):
    """The same tube along an arc, as an imported one: with frames."""
    s, phi, r = (np.asarray(v) for v in (mesh.s, mesh.phi, mesh.distance))
    centre, frames = on_arc(s, radius)
    across = np.stack([0 * s, r * np.cos(phi), r * np.sin(phi)], -1)
    vertices = centre + np.einsum("vij,vj->vi", frames, across)
    return dataclasses.replace(mesh, vertices=jnp.asarray(vertices), frames=jnp.asarray(frames))
