"""A program of one row that is called many times: numbers go in and out as few arrays."""

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
from jaxtrachea.scene.deform_together import deform_together
from jaxtrachea.scene.simulation import Simulation, surface
from jaxtrachea.scene.stage import Scene

#: Arrays of the result that have a number for every ring or vertex.
LARGE = ("joints", "loads", "end_U", "end_V", "vertices")


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
        several = bool(self._scene.instruments)
        run = line if traced else fuse(line, products=several)
        state, contact, large, press = run(state, *given)
        lay = deform_together if several else surface
        vertices = lay(self._setting(*given)[0], *press) if self._shown else None
        return state, contact, large if vertices is None else (*large, vertices[0])

    def __call__(self, state, *given) -> tuple[Array, Simulation]:
        """The next state, and the result (traced)."""
        self.trace(state, *given)
        state, contact, large = self.run(state, *given)
        result = self.contacts.unpack(contact)
        return state, result._replace(**dict(zip(self.large, large, strict=True)))


class OneRow:
    """A compiled program, and the state that its next call begins with."""

    def __init__(
        self, scene: Scene, setting: Callable, step: Callable,
        state: Array | np.ndarray, *given: Any,
    ):  # fmt: skip
        """Compile."""
        row = Row(scene, setting, step)
        row.trace(state, *given)
        self._contacts = row.contacts
        self._run = jax.jit(row.run, keep_unused=True).lower(state, *given).compile()
        self.state = jnp.array(state)
        names = [n for n in Simulation._fields if getattr(row.contact, n) is not None]
        where = {name: i for i, name in enumerate([*names, *row.large])}
        self._order = itemgetter(*(where.get(n, len(where)) for n in Simulation._fields))

    def __call__(self, *given: Any) -> Simulation:
        """The finished result: numpy arrays, and `LARGE` on the device."""
        self.state, packed, large = self._run(self.state, *given)
        contact = self._contacts.leaves(np.asarray(packed))  # waits for all of them
        return Simulation._make(self._order((*contact, *large, None)))


def _apart(result: Simulation) -> tuple[Simulation, dict[str, Array]]:
    """The result without what there is for every ring or vertex, and that by name."""
    found = {name: getattr(result, name) for name in LARGE}
    large = {name: v for name, v in found.items() if v is not None}
    return result._replace(**dict.fromkeys(LARGE)), large
