"""A program of one row that is called many times: numbers go in and out as few arrays.

All but the surface is one kernel (`fusion`); what there is for every ring or vertex is written
where that of the call before was.
"""

from collections.abc import Callable
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxtrachea._packed import Packing
from jaxtrachea.fusion import fuse
from jaxtrachea.scene.simulation import Simulation, surface
from jaxtrachea.scene.stage import Scene

#: Arrays of the result that have a number for every ring or vertex.
LARGE = ("joints", "loads", "end_U", "end_V", "vertices")


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
            scene: whose plan says whether there is a surface.
            setting: from what is given to scene and material.
            step: from state and what is given to the next state (one array, as the first), the
                result without its axis of rows and without vertices, and the path and `Pressed` of
                `simulation.surface`.
            state: to begin with.
            given: arrays as they are given at each call.
        """
        shown = scene.plan.surface is not None

        @jax.jit  # traced once, for the shapes of the result and for the program
        def one(state, *given):
            state, result, press = step(state, *given)
            return state, *_apart(result), press if shown else None

        _, contact, large, _ = jax.eval_shape(one, state, *given)
        self._contacts = contacts = Packing(contact)
        if shown:
            assert scene.mesh is not None
            vertices = scene.mesh.straight
            large["vertices"] = jax.ShapeDtypeStruct(vertices.shape, vertices.dtype)

        def line(*given):
            # State and contact as two arrays: in one, much of what both need is computed twice.
            state, contact, large, press = one(*given)
            return state, contacts.pack(contact), tuple(large.values()), press

        def run(state, _, *given):
            state, contact, large, press = fuse(line)(state, *given)
            vertices = surface(setting(*given)[0], *press) if shown else None
            return state, contact, large if vertices is None else (*large, vertices[0])

        self._large = tuple(jnp.array(np.zeros(v.shape, v.dtype)) for v in large.values())
        # Donated: the new state and the large arrays are written where the old ones were.
        program = jax.jit(run, donate_argnums=(0, 1), keep_unused=True)
        self._run = program.lower(state, self._large, *given).compile()
        self.state = jnp.array(state)
        names = [n for n in Simulation._fields if getattr(contact, n) is not None]
        where = {name: i for i, name in enumerate([*names, *large])}
        self.fusion = itemgetter(*(where.get(n, len(where)) for n in Simulation._fields))

    def __call__(self, *given: Any) -> Simulation:
        """The finished result: numpy arrays, and `LARGE` on the device until the next call."""
        self.state, packed, self._large = self._run(self.state, self._large, *given)
        contact = self._contacts.leaves(np.asarray(packed))  # waits for all of them
        return Simulation._make(self.fusion((*contact, *self._large, None)))


def _apart(result: Simulation) -> tuple[Simulation, dict[str, Array]]:
    """The result without what there is for every ring or vertex, and that by name."""
    found = {name: getattr(result, name) for name in LARGE}
    large = {name: v for name, v in found.items() if v is not None}
    return result._replace(**dict.fromkeys(LARGE)), large
