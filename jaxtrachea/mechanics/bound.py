"""`press` for many single calls: one array of numbers in, one out, and named views on both."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxtrachea._arguments import ArrayLike, check_fits, real, shaped
from jaxtrachea._packed import Packing
from jaxtrachea.fusion import fuse
from jaxtrachea.mechanics.press import Options, Press, check_line, press
from jaxtrachea.mechanics.validation import check_alike, check_shapes
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material

CURE = "bind anew"


class Given(NamedTuple):
    """The numbers of a press that may change from call to call; arguments as those of `press`."""

    material: Material
    s_c: Float[Array, ""]
    displacement: Float[Array, "*n"]
    onset: Float[Array, ""]
    blend: Float[Array, ""] | None


class BoundPress:
    """`press` on one tube with one set of options, compiled; from `bind`.

    Calling it takes one array of numbers (`pack`) and gives one (`result` names its parts), shape
    (size,), of `dtype`. It is a pure function of that array: under `jit`, `vmap` and derivatives as
    well. Outside of them the call waits for the result.

    Attributes:
        size: count of the numbers that go in.
        dtype: theirs, and of those that come out.
    """

    def __init__(self, geometry: Geometry, options: Options, given: Given):
        """Compile; see `bind`."""
        self._geometry, self._options = geometry, options
        self._given = Packing(given, weak=geometry.length.dtype)
        self.size, self.dtype = self._given.size, self._given.dtype

        def run(numbers):
            m, s_c, displacement, onset, blend = self._given.unpack(numbers)
            return press(geometry, m, s_c, displacement, options, onset=onset, blend=blend)

        like = jax.ShapeDtypeStruct((self.size,), self.dtype)
        self._result = Packing(jax.eval_shape(run, like))
        whole = fuse(lambda numbers: self._result.pack(run(numbers)))
        self._run: Callable = jax.jit(whole)
        self(self._given.fill(given))

    def pack(
        self,
        material: Material,
        s_c: ArrayLike,
        displacement: ArrayLike,
        *,
        onset: ArrayLike | None = None,
        blend: ArrayLike | None = None,
    ) -> Float[np.ndarray, " numbers"]:
        """The one array of concrete numbers; arguments as those of `press`.

        Raises:
            ValueError: as `press`; or a shape, a dtype or an optional value that is not as in
                `bind`.
        """
        like: Given = self._given.like
        given = _given(self._geometry, Given(material, s_c, displacement, onset, blend))  # pyright: ignore
        check_alike(material, like.material, CURE)
        if (blend is None) != (like.blend is None):
            was = "without" if like.blend is None else "with"
            raise ValueError(f"blend: the program was compiled {was} it: {CURE}")
        for name in ("s_c", "displacement", "onset", "blend"):
            if (value := getattr(given, name)) is not None:
                check_fits(name, value, getattr(like, name), CURE)
        return self._given.fill(given)

    def given(self, numbers: Float[np.ndarray, " numbers"]) -> Given:
        """Named views on an array from `pack`: to write into them changes it.

        Only what has the dtype of the array is a view; with one dtype everywhere all is.
        """
        return self._given.views(numbers)

    def __call__(self, numbers: ArrayLike) -> Float[Array, " results"]:
        """Press.

        Args:
            numbers: as from `pack`; a numpy or JAX array, also traced.

        Raises:
            ValueError: another shape or dtype.
        """
        shape, dtype = getattr(numbers, "shape", None), getattr(numbers, "dtype", None)
        if shape != (self.size,) or dtype != self.dtype:
            found = type(numbers).__name__ if shape is None else f"{dtype} of shape {shape}"
            raise ValueError(
                f"numbers is {found}; expected {self.dtype} of shape ({self.size},), from pack"
            )
        out = self._run(numbers)
        # Who writes into the numbers next must not change those that are still being read.
        return out if isinstance(out, Tracer) else out.block_until_ready()

    def result(self, out: ArrayLike) -> Press:
        """The `Press` in an array that a call gave: of a traced one slices, else numpy views."""
        if isinstance(out, Tracer):
            return self._result.unpack(out)  # pyright: ignore
        return self._result.views(np.asarray(out))


def bind(
    geometry: Geometry,
    material: Material,
    s_c: ArrayLike,
    displacement: ArrayLike,
    options: Options = Options(),
    *,
    onset: ArrayLike | None = None,
    blend: ArrayLike | None = None,
) -> BoundPress:
    """Compile `press` on this tube for many single calls, each of which takes about half as long.

    The tube becomes a constant of the program, everything else is read at every call. For batches
    and derivatives `press` itself under `jit` and `vmap` is as fast.

    Args:
        geometry: the tube at rest.
        material: its shapes, dtypes and which optional values are there; like those of the
            arguments that follow. Python numbers take the dtype of the geometry.
        s_c: contact position, mm.
        displacement: of the tool, mm; any shape.
        options: what is modelled (static).
        onset: mm; 0 if None, and may be given later.
        blend: mm, or None, which it then stays.

    Returns:
        The `BoundPress`; statuses as those of `press`.

    Raises:
        ValueError: as `press`.
    """
    check_line(options, "bind")
    given = Given(material, s_c, displacement, onset, blend)  # pyright: ignore
    return BoundPress(geometry, options, _given(geometry, given))


def _given(geometry: Geometry, given: Given) -> Given:
    """The arguments as arrays, as `press` takes them."""
    check_shapes(geometry, given.material)
    length = geometry.length.dtype
    displacement = real("displacement", given.displacement, length)
    dtype = displacement.dtype
    onset, blend = 0.0 if given.onset is None else given.onset, given.blend
    return Given(
        material=given.material,
        s_c=shaped("s_c", given.s_c, (), dtype=length, why="; use jax.vmap for many positions"),
        displacement=displacement,
        onset=shaped("onset", onset, (), dtype=dtype),
        blend=None if blend is None else shaped("blend", blend, (), dtype=dtype),
    )
