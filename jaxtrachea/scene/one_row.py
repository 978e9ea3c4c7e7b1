"""A program of one row that is called many times: numbers go in and out as few arrays.

What there is for every ring or vertex is written where an earlier call wrote it, if nobody holds
that any more.
"""

import copy
import sys
from collections.abc import Callable
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from jaxtrachea._packed import Packing
from jaxtrachea.fusion import fuse
from jaxtrachea.scene.simulation import Simulation, surface
from jaxtrachea.scene.stage import Scene
from jaxtrachea.scene.together import deform_together

#: Arrays of the result that have a number for every ring or vertex.
LARGE = ("joints", "loads", "end_U", "end_V", "vertices")
#: Sets of them that are kept: one that the loop holds, one that is written, and what others hold.
SETS = 4


class Row:
    """The program of one row, before it is compiled.

    Attributes:
        contacts: layout of the result without `LARGE`.
        large: shapes of `LARGE`, by name; those of the vertices last.
    """

    def __init__(self, scene: Scene, setting: Callable, step: Callable):
        """Put it together.

        Args:
            scene: whose plan says whether there is a surface.
            setting: from what is given to scene and material.
            step: from state and what is given to the next state (one array, as the first), the
                result without its axis of rows and without vertices, and the path and `Pressed` of
                `simulation.surface`.
        """
        self._scene, self._setting, self._step = scene, setting, step
        self._shown = scene.plan.surface is not None

    def trace(self, state, *given) -> None:
        """Learn the shapes of the result."""

        @jax.jit  # traced once, for the shapes of the result and for the program
        def one(state, *given):
            state, result, press = self._step(state, *given)
            return state, *_apart(result), press if self._shown else None

        self._one = one
        _, self.contact, large, _ = jax.eval_shape(one, state, *given)
        self.contacts = Packing(self.contact)
        if self._shown:
            mesh = self._scene.mesh
            assert mesh is not None
            large["vertices"] = jax.ShapeDtypeStruct(mesh.straight.shape, mesh.straight.dtype)
        self.large = large

    def run(self, state, *given):
        """The next state, the contact as one array, and `large` (traced)."""

        def line(*given):
            # State and contact as two arrays: in one, much of what both need is computed twice.
            state, contact, large, press = self._one(*given)
            return state, self.contacts.pack(contact), tuple(large.values()), press

        # By itself it rounds alike in all programs: a scan of steps is the session to the bit.
        traced = any(isinstance(v, Tracer) for v in jax.tree.leaves(self._scene))
        state, contact, large, press = (line if traced else fuse(line))(state, *given)
        lay = deform_together if self._scene.instruments else surface
        vertices = lay(self._setting(*given)[0], *press) if self._shown else None
        return state, contact, large if vertices is None else (*large, vertices[0])

    def __call__(self, state, *given) -> tuple[Array, Simulation]:
        """The next state, and the result (traced)."""
        self.trace(state, *given)
        state, contact, large = self.run(state, *given)
        result = self.contacts.unpack(contact)
        return state, result._replace(**dict(zip(self.large, large, strict=True)))


class OneRow:
    """A compiled program, and the memory that it writes into.

    Attributes:
        state: that the next call begins with.
    """

    def __init__(
        self, scene: Scene, setting: Callable, step: Callable,
        state: Array | np.ndarray, *given: Any,
    ):  # fmt: skip
        """Compile.

        Args:
            scene: see `Row`.
            setting: -
            step: -
            state: to begin with.
            given: arrays as they are given at each call.
        """
        row = Row(scene, setting, step)
        row.trace(state, *given)
        self._contacts, contact, large = row.contacts, row.contact, row.large
        self._shapes = tuple(large.values())
        self._sets = [self._empty(), self._empty()]
        self._own = _holders(self._sets[0])

        def run(state, _, *given):
            return row.run(state, *given)

        # Donated: the new state and the large arrays are written where the old ones were.
        program = jax.jit(run, donate_argnums=(0, 1), keep_unused=True)
        self._run = program.lower(state, self._sets[0], *given).compile()
        self.state = jnp.array(state)
        names = [n for n in Simulation._fields if getattr(contact, n) is not None]
        where = {name: i for i, name in enumerate([*names, *large])}
        self._order = itemgetter(*(where.get(n, len(where)) for n in Simulation._fields))

    def __call__(self, *given: Any) -> Simulation:
        """The finished result: numpy arrays, and `LARGE` on the device."""
        free = self._free() if self._shapes else ()
        self.state, packed, large = self._run(self.state, free, *given)
        if large:
            self._sets.append(large)
        contact = self._contacts.leaves(np.asarray(packed))  # waits for all of them
        return Simulation._make(self._order((*contact, *large, None)))

    def copy(self) -> "OneRow":
        """The same program with memory and state of its own."""
        new = copy.copy(self)
        new.state, new._sets = jnp.array(self.state), [self._empty(), self._empty()]
        return new

    def _empty(self) -> tuple[Array, ...]:
        return tuple(jnp.array(np.zeros(v.shape, v.dtype)) for v in self._shapes)

    def _free(self) -> tuple[Array, ...]:
        """Memory to write into: the oldest set that nobody else holds, else a new one."""
        for i, large in enumerate(self._sets):
            if _holders(large) <= self._own:
                return self._sets.pop(i)
        if len(self._sets) == SETS:
            del self._sets[0]  # it lasts as long as its holder
        return self._empty()


def _holders(large: tuple[Array, ...]) -> int:
    """References to that array of a set which most hold."""
    return max((sys.getrefcount(v) for v in large), default=0)


def _apart(result: Simulation) -> tuple[Simulation, dict[str, Array]]:
    """The result without what there is for every ring or vertex, and that by name."""
    found = {name: getattr(result, name) for name in LARGE}
    large = {name: v for name, v in found.items() if v is not None}
    return result._replace(**dict.fromkeys(LARGE)), large
