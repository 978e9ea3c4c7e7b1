"""A tree of arrays as one array of numbers: a compiled program is called sooner.

Each array that goes in or comes out costs a microsecond or more, and waiting for several costs more
than for one. Nothing is rounded: the array has the widest floating dtype of the tree, and booleans
and small integers are exact in it.
"""

from collections.abc import Callable
from operator import itemgetter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Part(NamedTuple):
    """Where an array stands.

    Attributes:
        numbers: its place, as a slice.
        dtype: None: that of the one array.
    """

    numbers: slice
    shape: tuple[int, ...]
    dtype: Any


class Packing:
    """Where each array of a tree stands in the one array, and of which shape and dtype it is.

    Attributes:
        size: count of the numbers.
        dtype: of the one array.
        like: the tree, of `jax.ShapeDtypeStruct`.
    """

    def __init__(self, tree: Any, weak: Any = None):
        """Lay out a tree.

        Args:
            tree: of arrays or of their shapes; booleans, integers and floating-point numbers.
            weak: dtype of what came from Python numbers; None: its own.
        """
        leaves, self._tree = jax.tree.flatten(tree)
        shapes = [jax.ShapeDtypeStruct(v.shape, _dtype(v, weak)) for v in leaves]
        floats = [v.dtype for v in shapes if jnp.issubdtype(v.dtype, jnp.floating)]
        self.dtype = np.dtype(max(floats, key=lambda dtype: jnp.finfo(dtype).bits))
        self.like, self.size, self._parts = jax.tree.unflatten(self._tree, shapes), 0, []
        for v in shapes:
            numbers = slice(self.size, self.size + v.size)
            self._parts.append(Part(numbers, v.shape, None if v.dtype == self.dtype else v.dtype))
            self.size += v.size
        # One call for all views, and no cast: numpy's ways would cost a step in real time more.
        at = [p.numbers if p.shape else (p.numbers.start, ...) for p in self._parts]
        self._all = itemgetter(*at) if len(at) > 1 else lambda numbers: (numbers[at[0]],)
        unlike = [(i, p) for i, p in enumerate(self._parts) if p.dtype or len(p.shape) > 1]
        self._others = [(i, _maker(part)) for i, part in unlike]

    def pack(self, tree: Any) -> Float[Array, " numbers"]:
        """One array of a tree of these shapes (traced)."""
        leaves = self._tree.flatten_up_to(tree)
        return jnp.concatenate([jnp.ravel(v).astype(self.dtype) for v in leaves])

    def fill(self, tree: Any) -> Float[np.ndarray, " numbers"]:
        """The same of concrete arrays, by numpy; an array may be any that broadcasts."""
        numbers, leaves = np.empty(self.size, self.dtype), self._tree.flatten_up_to(tree)
        for part, v in zip(self._parts, leaves, strict=True):
            numbers[part.numbers].reshape(part.shape)[...] = np.asarray(v)
        return numbers

    def refill(self, numbers: Float[np.ndarray, " numbers"], old: Any, new: Any) -> None:
        """Change numbers of `old` into those of `new`: only where its arrays are others."""
        given = map(self._tree.flatten_up_to, (old, new))
        for part, was, v in zip(self._parts, *given, strict=True):
            if v is not was:
                numbers[part.numbers].reshape(part.shape)[...] = np.asarray(v)

    def unpack(self, numbers: Float[Array, " numbers"]) -> Any:
        """The tree again (traced)."""
        leaves = []
        for part in self._parts:
            v = numbers[part.numbers].reshape(part.shape)
            leaves.append(v if part.dtype is None else v.astype(part.dtype))
        return jax.tree.unflatten(self._tree, leaves)

    def leaves(self, numbers: Float[np.ndarray, " numbers"]) -> list[np.ndarray]:
        """The arrays of the tree in order, as views on this one; of another dtype as copies."""
        leaves = list(self._all(numbers))
        for i, make in self._others:
            leaves[i] = make(leaves[i])
        return leaves

    def views(self, numbers: Float[np.ndarray, " numbers"]) -> Any:
        """The tree of these."""
        return jax.tree.unflatten(self._tree, self.leaves(numbers))


def _maker(part: Part) -> Callable[[np.ndarray], np.ndarray]:
    """From the numbers of an array to the array."""
    if part.dtype == np.int8 and not part.shape:
        return lambda number: _STATUSES[int(number)]
    if part.dtype is None:
        return lambda numbers: numbers.reshape(part.shape)
    return lambda numbers: numbers.reshape(part.shape).astype(part.dtype)


#: Every int8 as an array that cannot be written, negative ones last.
_STATUSES = [np.array(i, np.int8) for i in (*range(128), *range(-128, 0))]
for _status in _STATUSES:
    _status.setflags(write=False)


def _dtype(v: Any, weak: Any):
    return weak if weak is not None and getattr(v, "weak_type", False) else v.dtype
