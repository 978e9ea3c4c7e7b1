"""A lane: the arrays of all that is fitted together."""

from typing import NamedTuple

from jaxtyping import Array, Float, Int


class Lane(NamedTuple):
    """Everything of one lane (or, with a leading axis, of many); T trials of N samples.

    `index` says for each trial and free column which unknown it reads (-1: keeps `value`). Weights
    are square roots of what multiplies a squared residual; zero marks padding and missing samples.

    Attributes:
        s_c: contact position, mm; (T,).
        displacement: mm; (T, N).
        force: N; (T, N).
        precision: 1 / sigma of each force sample, or 1 where the noise is estimated; (T, N).
        joints: marker displacement, mm; (T, N, rings); None without markers.
        joint_precision: as `precision`; None without markers.
        balance: weight of each trial against the others; (T,).
        blend: smooth first touch of each trial, mm, see `first_touch`; (T,); None where no onset is
            fitted.
        value: value of every model parameter, used where it is not free; (T, J).
        index: (T, J).
        lower: bounds of the unknowns in scaled coordinates; (P,).
        upper: (P,).
        active: whether the unknown exists in this lane; (P,).
    """

    s_c: Float[Array, "*l T"]
    displacement: Float[Array, "*l T N"]
    force: Float[Array, "*l T N"]
    precision: Float[Array, "*l T N"]
    joints: Float[Array, "*l T N rings"] | None
    joint_precision: Float[Array, "*l T N rings"] | None
    balance: Float[Array, "*l T"]
    blend: Float[Array, "*l T"] | None
    value: Float[Array, "*l T J"]
    index: Int[Array, "*l T J"]
    lower: Float[Array, "*l P"]
    upper: Float[Array, "*l P"]
    active: Float[Array, "*l P"]
