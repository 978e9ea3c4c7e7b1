"""A program of one row that is called many times: numbers go in and out as few arrays.

All but the surface is one kernel (`_in_order`); what there is for every ring or vertex is written
where that of the call before was.
"""

from collections.abc import Callable
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxtrachea._in_order import one_kernel
from jaxtrachea._packed import Packing
from jaxtrachea.scene.simulation import Simulation, surface
from jaxtrachea.scene.stage import Scene

#: Arrays of the result that have a number for every ring or vertex.
LARGE = ("joints", "loads", "end_U", "end_V", "vertices")


class OneRow:
    """A compiled program, and the memory that it writes into."""

    def __init__(
        self, scene: Scene, now: Callable[..., tuple], step: Callable[..., tuple], *given: Any
    ):
        """Compile.

        Args:
            scene: whose plan says whether there is a surface.
            now: from what is given to scene and material.
            step: from what is given to the next state (an array), the result without its axis of
                rows and without vertices, and the path and `Ground` of `simulation.surface`.
            given: arrays as they are given at each call; the first is the state.
        """

        @jax.jit  # traced once, for the shapes of the result and for the program
        def one(*given):
            state, result, rest = step(*given)
            return state, *_apart(result), rest

        _, contact, large, _ = jax.eval_shape(one, *given)
        self._contacts = contacts = Packing(contact)
        if scene.plan.surface is not None:
            assert scene.mesh is not None
            vertices = scene.mesh.straight
            large["vertices"] = jax.ShapeDtypeStruct(vertices.shape, vertices.dtype)

        def line(*given):
            # State and contact as two arrays: in one, much of what both need is computed twice.
            state, contact, large, rest = one(*given)
            return state, contacts.pack(contact), tuple(large.values()), rest

        def run(state, _, *more):
            given = state, *more
            state, contact, large, rest = one_kernel(line)(*given)
            vertices = surface(*now(*given), *rest)
            return state, contact, large if vertices is None else (*large, vertices[0])

        self._large = tuple(jnp.array(np.zeros(v.shape, v.dtype)) for v in large.values())
        # Donated: the new state and the large arrays are written where the old ones were.
        made = jax.jit(run, donate_argnums=(0, 1), keep_unused=True)
        self._run = made.lower(given[0], self._large, *given[1:]).compile()
        names = [n for n in Simulation._fields if getattr(contact, n) is not None]
        where = {name: at for at, name in enumerate([*names, *large])}
        self._in_order = itemgetter(*(where.get(n, len(where)) for n in Simulation._fields))

    def __call__(self, state: Array, *given: Any) -> tuple[Array, Simulation]:
        """The next state and the finished result: numpy arrays, and `LARGE` on the device.

        The state and the large arrays of the call before are given up.
        """
        state, packed, self._large = self._run(state, self._large, *given)
        contact = self._contacts.leaves(np.asarray(packed))  # waits for all of them
        return state, Simulation._make(self._in_order((*contact, *self._large, None)))


def _apart(result: Simulation) -> tuple[Simulation, dict[str, Array]]:
    """The result without what there is for every ring or vertex, and that by name."""
    found = {name: getattr(result, name) for name in LARGE}
    large = {name: v for name, v in found.items() if v is not None}
    return result._replace(**dict.fromkeys(LARGE)), large
