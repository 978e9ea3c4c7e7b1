"""What a press needs of a plan: asked of the whole path by the rules, and of every row by `ranges`.

One test each, of numbers as of traced arrays, so that a plan serves the path that it is made for: a
path needs what one of its rows does.
"""

from types import ModuleType
from typing import Any, NamedTuple

import jax.numpy as jnp

#: What counts as a normal press on the midline and as one contact point: rad, mm, and share of the
#: motion. Patches of a mesh with a mirror plane are not its mirror images to the last corner: a
#: tool in the plane touches up to 2e-5 rad beside it.
COVERED = 1e-4
#: The same where a plan is made: half of it, as its program has other roundings than the rules.
PLANNED = COVERED / 2
#: How much more of a way along the surface several tools may have, which slide without friction.
DRAGS = 1000


class Motion(NamedTuple):
    """Presses by what their needs follow from; shapes (rows,).

    Attributes:
        s: contact position, mm.
        phi: contact angle, rad.
        along: way along the tube, mm; not negative.
        across: way round the tube at the contact, mm; likewise.
        length: of the whole way, mm.
    """

    s: Any
    phi: Any
    along: Any
    across: Any
    length: Any

    @property
    def slip(self):
        """Way along the surface at the contact, mm."""
        return (self.along**2 + self.across**2) ** 0.5


def motion_of(s, phi, displacement, xp: ModuleType = jnp) -> Motion:
    """What presses (`stage.Presses`) do; `xp`: the library of the arrays."""
    x, y, z = displacement[:, 0], displacement[:, 1], displacement[:, 2]
    across = abs(xp.cos(phi) * z - xp.sin(phi) * y)
    return Motion(s, phi, abs(x), across, (x**2 + y**2 + z**2) ** 0.5)


def off_midline(phi, covered: float = COVERED):
    """Whether a contact lies off the midline; that is no number."""
    return ~(abs(phi) <= covered)


def _moves(way, length, covered):
    return way > covered * length + covered


def axial(motion: Motion, covered: float = COVERED):
    """Whether it moves along the tube."""
    return _moves(motion.along, motion.length, covered)


def lateral(motion: Motion, covered: float = COVERED):
    """Whether it moves round the tube."""
    return _moves(motion.across, motion.length, covered)


def slides(motion: Motion, covered: float = COVERED):
    """Whether it moves along the surface."""
    return _moves(motion.slip, motion.length, covered)


def rubs(motion: Motion, covered: float = COVERED):
    """Whether it moves along the surface, or presses where the skeleton does so under it."""
    return slides(motion, covered) | off_midline(motion.phi, covered)


def drags(motion: Motion, covered: float = COVERED):
    """Whether more than a tenth of its way is along the surface (a plan refuses half of that)."""
    return motion.slip > DRAGS * covered * motion.length + covered


def elsewhere(motion: Motion, covered: float = COVERED):
    """Whether it presses another place than the first row; one that is no number is no place."""
    s, phi = motion.s - motion.s[:1], motion.phi - motion.phi[:1]
    return (abs(s) > covered) | (abs(phi) > covered)
