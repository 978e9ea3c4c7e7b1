"""The one door for numbers and words from outside: arrays of the right kind, or a clear error.

Static misuse only: everything here looks at shapes, kinds and Python values, never at the content
of an array, so that it works on traced arrays and adds nothing to a program.
"""

import dataclasses
import functools
import math
import numbers
import types
from collections.abc import Sequence
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike as _ArrayLike
from jaxtyping import Array

#: Numbers, arrays and lists of numbers: what public functions take.
ArrayLike = _ArrayLike | Sequence


def real(name: str, value: Any, dtype=None) -> Array:
    """An array of floating-point numbers.

    Floating-point arrays keep their dtype. A Python number stays weakly typed unless `dtype` is
    given: it takes the dtype of what it meets.

    Args:
        value: a number, an array (also traced) or a list of numbers.
        dtype: of numbers, lists and integer arrays; None: JAX's default.

    Raises:
        ValueError: it is none of these.
    """
    try:
        if isinstance(value, str | bytes):
            raise TypeError("text")
        number = type(value) is float or isinstance(value, int) and not isinstance(value, bool)
        if type(value) is np.ndarray:
            # Of a copy, that the caller cannot change; `jnp.asarray` compiles for every shape.
            array = jax.device_put(np.array(value))
        elif isinstance(value, Array):
            array = value
        else:
            array = jax.device_put(float(value)) if number else jnp.asarray(value)
    except (TypeError, ValueError, OverflowError):
        array = None
    if array is None or not (
        jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)
    ):
        raise ValueError(f"{name} is {_shown(value)}; expected a number or an array of numbers")
    if jnp.issubdtype(array.dtype, jnp.integer):
        return array.astype(float_dtype(dtype))
    own = isinstance(value, np.ndarray | Array)
    return array if own or dtype is None else array.astype(dtype)


def float_dtype(dtype: Any = None) -> Any:
    """The dtype of JAX's arrays for one that is asked for, None: its own; nothing is compiled."""
    return jax.eval_shape(functools.partial(jnp.zeros, 0, dtype)).dtype


def without_program(value: Any) -> Array:
    """As `jnp.asarray`, which compiles a program for every shape of numpy's arrays."""
    return jax.device_put(value) if isinstance(value, np.ndarray) else jnp.asarray(value)


def shaped(name: str, value: Any, *shapes: tuple[int | str, ...], dtype=None, why: str = ""):
    """As `real`, of one of the shapes; a word stands for any length.

    Raises:
        ValueError: no numbers, or another shape; the message gives both.
    """
    array = real(name, value, dtype)
    for shape in shapes:
        if len(shape) == array.ndim and all(
            isinstance(n, str) or n == m for n, m in zip(shape, array.shape, strict=True)
        ):
            return array
    expected = " or ".join(_shape_words(shape) for shape in shapes)
    raise ValueError(f"{name} has {_shape_words(array.shape)}; expected {expected}{why}")


def check_fits(name: str, value: Array, like: Any, cure: str, *, spread: bool = False) -> None:
    """Refuse an array that a program compiled for arrays `like` this one cannot take.

    Args:
        value: from `real`.
        like: has the shape and dtype.
        cure: what else to do, for the message.
        spread: a single number fits any shape.

    Raises:
        ValueError: another shape, or another dtype (a Python number fits any).
    """
    if value.shape != like.shape and not (spread and value.shape == ()):
        found, known = _shape_words(value.shape), _shape_words(like.shape)
        raise ValueError(f"{name} has {found}; the program was compiled for {known}: {cure}")
    if value.dtype != like.dtype and not getattr(value, "weak_type", False):
        raise ValueError(
            f"{name} is {value.dtype}; the program was compiled for {like.dtype}: convert it, or "
            f"{cure}"
        )


def last_axis(name: str, value: Any, length: int, dtype=None) -> Array:
    """As `real`, any shape that ends in an axis of `length`.

    Raises:
        ValueError: another last axis.
    """
    array = real(name, value, dtype)
    if array.shape[-1:] != (length,):
        raise ValueError(f"{name} has {_shape_words(array.shape)}; expected shape (..., {length})")
    return array


def _shape_words(shape: tuple) -> str:
    if not shape:
        return "no axis (a single number)"
    if len(shape) == 1:
        return f"{shape[0]} value{'s' * (shape[0] != 1)}"
    return f"shape ({', '.join(map(str, shape))})"


def check_word(name: str, value: object, kind: Any) -> None:
    """Refuse a word that is not one of a `Literal`, or a record of another class.

    Raises:
        ValueError: with the words there are, or the class.
    """
    if not _fits(value, kind):
        raise ValueError(f"{name} is {_shown(value)}; expected {_expected(kind)}")


def check_record(record: Any, **least: float) -> None:
    """Refuse a record of options whose values are not of the kind that its fields name.

    Words, switches, counts, finite numbers, None and classes of records are checked; of other kinds
    nothing is known.

    Args:
        record: a dataclass or named tuple.
        least: smallest value of fields that are numbers.

    Raises:
        ValueError: naming the field, what was found and what is expected.
    """
    for name, kind in _kinds(type(record)).items():
        value = getattr(record, name)
        low = least.get(name)
        if not _fits(value, kind) or (low is not None and value is not None and value < low):
            limit = "" if low is None else f", {low:g} or more"
            raise ValueError(f"{name} is {_shown(value)}; expected {_expected(kind)}{limit}")


@functools.cache
def _kinds(record: type) -> dict[str, Any]:
    return get_type_hints(record)


def _fits(value: object, kind: Any) -> bool:
    if get_origin(kind) is Literal:
        words = get_args(kind)
        return any(type(value) is type(word) and value == word for word in words)
    if get_origin(kind) in (Union, types.UnionType):
        return any(_fits(value, part) for part in get_args(kind))
    if kind in (None, type(None)):
        return value is None
    if kind is bool:
        return isinstance(value, bool | np.bool_)
    if kind is int:
        return isinstance(value, numbers.Integral) and not isinstance(value, bool)
    if kind is float:
        number = isinstance(value, numbers.Real) and not isinstance(value, bool)
        return number and math.isfinite(float(value))  # pyright: ignore
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return isinstance(value, kind)
    return True


def _expected(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return " or ".join(map(repr, get_args(kind)))
    if get_origin(kind) in (Union, types.UnionType):
        return " or ".join(_expected(part) for part in get_args(kind))
    words = {bool: "True or False", int: "a whole number", float: "a finite number"}
    if kind in (None, type(None)):
        return "None"
    return words.get(kind, getattr(kind, "__name__", str(kind)))


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) < 60 else f"{text[:56]} ..."
