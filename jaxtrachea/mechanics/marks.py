"""Points of a beam where motions are read: further supports of no stiffness, the marks."""

import functools

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxtrachea.mechanics.compliance import Beam

#: Marks up to which values are chosen by comparisons, which go back as choices and fit one kernel
#: (`fusion.fuse`); a gather goes back as a scatter. Of more marks that would be most of the work.
FEW = 2


def with_marks(
    beam: Beam, places: Float[Array, " m"]
) -> tuple[Beam, Int[Array, " n"], Int[Array, " m"]]:
    """The beam with m more supports, the marks, of no stiffness.

    A mark at a support stands behind it; of marks at one place each stands behind the one before.

    Args:
        beam: the beam and its n supports.
        places: of the marks, mm, in [0, length], not falling; shape (m,).

    Returns:
        The beam with marks, how many marks stand before each support of `beam`, and the index of
        each mark among all supports.
    """
    m, n = places.shape[0], beam.x.shape[0]
    passed = jnp.sum(places[None] < beam.x[:, None], axis=1)
    mark = jnp.sum(beam.x[None] <= places[:, None], axis=1) + jnp.arange(m)
    place = jnp.arange(n + m + 1)  # of a support, and of the span before it
    before = jnp.sum(mark[None] < place[:, None], axis=1)

    def spread(v, before):
        """Each as far behind as marks stand before it."""
        if m > FEW:
            return v[jnp.minimum(jnp.arange(before.shape[0]) - before, v.shape[0] - 1)]
        return _chosen(before, [jnp.pad(v, (i, m - i)) for i in range(m + 1)])

    is_mark = [place[:-1] == at for at in mark]
    x, k = (spread(v, before[:-1]) for v in (beam.x, beam.k))
    for here, at in reversed(list(zip(is_mark, places, strict=True))):
        x = jnp.where(here, at, x)
    k = jnp.where(functools.reduce(jnp.logical_or, is_mark), 0, k)
    GA = None if beam.GA is None else spread(beam.GA, before)
    return Beam(x, beam.length, spread(beam.EI, before), k, GA), passed, mark


def without_marks(
    v: Float[Array, "..."], passed: Int[Array, " n"], marks: int
) -> Float[Array, "..."]:
    """Of all supports those that are no marks.

    Args:
        v: values for each support of the beam with marks, on the first axis.
        passed: how many marks stand before each support without them, from `with_marks`.
        marks: how many there are.
    """
    n = passed.shape[0]
    if marks > FEW:
        return v[jnp.arange(n) + passed]
    return _chosen(passed, [v[i : n + i] for i in range(marks + 1)])


def _chosen(count: Int[Array, " n"], values: list[Array]) -> Array:
    """`values[count]`, row by row; the last where `count` is none of the others."""
    out = values[-1]
    for i in reversed(range(len(values) - 1)):
        out = jnp.where((count == i).reshape(-1, *[1] * (out.ndim - 1)), values[i], out)
    return out
