"""Compiled functions that are not traced anew at every start.

JAX keeps what XLA compiles, but a process must first trace and lower a function to know what to
look for: of a warm start that is about half the time. Here the lowered function is kept too, beside
JAX's own files, under a digest of all that a trace depends on: the sources of this package,
versions, JAX's settings, the function and its static arguments by value, and the arguments' shapes,
dtypes and static fields. Where that cannot be said for certain (a class from elsewhere, a traced
argument, several devices), the function is traced as ever.
"""

import contextlib
import functools
import hashlib
import io
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox
import jax
import jaxlib
import numpy as np
from jax import export
from jax.core import Tracer

from jaxtrachea.files.atomic import write_whole
from jaxtrachea.files.programs import TRACED
from jaxtrachea.files.provenance import source_digest

#: Packages whose code is told by the digest; what is defined elsewhere may change unseen.
_KNOWN = {"jaxtrachea", "jax", "jaxlib", "numpy", "ml_dtypes", "equinox", "builtins", "copyreg"}
_KNOWN |= {"functools", "collections", "enum", "operator", "pathlib", "types"}
#: Settings of JAX that say where and how long files are kept, not what is computed.
_OF_FILES = ("cache", "_log", "dump")
#: Settings under which a function is to be traced, or run one operation after the other.
_TO_DEBUG = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs")
#: Bytes of the digest that comes before the content of a file.
_DIGEST = hashlib.sha256().digest_size


class Traced:
    """`jax.jit(function)`, the trace of which is kept where JAX keeps compiled programs.

    With no such folder (`jax_compilation_cache_dir`), and under JAX's settings for debugging, it is
    `jax.jit(function)`.
    """

    def __init__(
        self,
        function: Callable,
        *static: Any,
        axes: Any = None,
        donate: tuple[int, ...] = (),
        **named: Any,
    ):
        """Nothing is traced yet.

        Args:
            function: pure, a module's own.
            static: its first arguments.
            axes: of the other arguments, as `in_axes` of `jax.vmap`; None: no `vmap`.
            donate: of the other arguments, as `donate_argnums` of `jax.jit`.
            named: static arguments by name.
        """
        self._name, self._donate = function.__name__, donate
        self._given = (function, static, named, axes, donate)
        one = functools.partial(function, *static, **named)
        self._function = one if axes is None else jax.vmap(one, axes)
        self._plain = jax.jit(self._function, donate_argnums=donate)
        self._known: dict[Any, Callable] = {}
        self._settings: dict[str, Any] = {}

    def __call__(self, *arguments: Any) -> Any:
        """What the function returns."""
        settings = jax.config.values  # here and now, in a `with` too
        folder = _folder(settings)
        if folder is None or any(settings[name] for name in _TO_DEBUG):
            return self._plain(*arguments)
        if settings != self._settings:
            self._known, self._settings = {}, settings
        leaves, tree = jax.tree.flatten(arguments)
        device = settings["jax_default_device"] or jax.local_devices()[0]
        try:
            kinds = tuple(_kind(leaf, device) for leaf in leaves)
            key = folder, device, tree, kinds
            known = self._known.get(key)
        except TypeError:  # neither an array nor a number; a field without a hash
            return self._plain(*arguments)
        if known is None:
            said = jax.tree.unflatten(tree, kinds)
            known = self._known[key] = self._kept(folder, arguments, said) or self._plain
        return known(*arguments)

    def _kept(self, folder: Path, arguments: tuple, kinds: Any) -> Callable | None:
        """The function of arguments like these by a kept trace, which is made if there is none."""
        leaves, tree = jax.tree.flatten(arguments)
        try:
            digest = hashlib.sha256(_surroundings(self._settings))
            digest.update(_said((self._given, kinds)))
        except (pickle.PicklingError, TypeError, AttributeError):
            return None
        path = folder / f"{self._name}-{digest.hexdigest()}{TRACED}"
        content = _read(path)
        if content is None:
            content = self._traced(leaves, tree)
            if content is None:
                return None
            with contextlib.suppress(OSError):  # then the next start traces anew
                folder.mkdir(parents=True, exist_ok=True)
                write_whole(path, hashlib.sha256(content).digest() + content)
        trace, made = pickle.loads(content)
        call, read = export.deserialize(bytearray(trace)).call, jax.tree.structure(made)
        flat = self._named(lambda *leaves: call(*leaves))
        # Compiled here: what an exported function returns is bound to its device, and `jax.jit`
        # would compile it once more when given that.
        run = jax.jit(flat, donate_argnums=self._donated(arguments)).lower(*leaves).compile()
        return lambda *arguments: jax.tree.unflatten(read, run(*jax.tree.leaves(arguments)))

    def _traced(self, leaves: list, tree: Any) -> bytes | None:
        """The trace and the structure of what it returns, in bytes; None: it cannot be kept."""
        made = []

        def flat(*leaves):
            values, read = jax.tree.flatten(self._function(*jax.tree.unflatten(tree, leaves)))
            made[:] = [jax.tree.unflatten(read, range(len(values)))]
            return values

        try:
            trace = export.export(jax.jit(self._named(flat)))(*leaves).serialize()
            _said(made[0])
            return pickle.dumps((bytes(trace), made[0]), protocol=5)
        except (ValueError, TypeError, NotImplementedError, AttributeError, pickle.PicklingError):
            return None  # what is wrong with the function itself is said by the plain call

    def _named(self, flat: Callable) -> Callable:
        """The function under the name by which JAX calls its program."""
        flat.__name__ = flat.__qualname__ = self._name
        return flat

    def _donated(self, arguments: tuple) -> tuple[int, ...]:
        """Positions of the donated arguments' leaves among all."""
        counts = [len(jax.tree.leaves(value)) for value in arguments]
        starts = np.concatenate([[0], np.cumsum(counts)]).tolist()
        return tuple(i for d in self._donate for i in range(starts[d], starts[d + 1]))


def _folder(settings: dict[str, Any]) -> Path | None:
    """Where JAX keeps compiled programs; None: nowhere."""
    chosen = settings["jax_compilation_cache_dir"]
    return Path(chosen) if chosen and settings["jax_enable_compilation_cache"] else None


def _kind(leaf: Any, device: Any) -> tuple:
    """All that a trace sees of an argument.

    Raises:
        TypeError: not an array of that device, or no array.
    """
    if isinstance(leaf, jax.Array):
        if isinstance(leaf, Tracer) or leaf.devices() != {device}:
            raise TypeError("a trace is kept of arrays of the device in use")
        return leaf.shape, str(leaf.dtype), leaf.weak_type
    if isinstance(leaf, np.ndarray | np.generic):
        return leaf.shape, str(leaf.dtype), False
    if isinstance(leaf, bool | int | float | complex):
        return (), type(leaf).__name__, True
    raise TypeError(f"{type(leaf).__name__} is no array")


class _Pickler(pickle.Pickler):
    """Says an object by value; refuses what is defined where the digest does not reach."""

    def reducer_override(self, obj: Any) -> Any:
        module = getattr(obj, "__module__", None) if callable(obj) else None
        if module is not None and module.split(".")[0] not in _KNOWN:
            raise pickle.PicklingError(f"{obj!r} is defined in {module}")
        return NotImplemented

    def persistent_id(self, obj: Any) -> Any:
        """Members of a set in an order of their own: that of a set differs between processes."""
        if isinstance(obj, set | frozenset):
            return type(obj).__name__, sorted(map(_said, obj))
        return None


def _said(value: Any) -> bytes:
    """The object in bytes, not to be read again: equal bytes, equal object.

    Raises:
        PicklingError, TypeError, AttributeError: it cannot be said.
    """
    out = io.BytesIO()
    _Pickler(out, protocol=5).dump(value)
    return out.getvalue()


@functools.cache
def _sources() -> str:
    """Digest of this package's sources, and the versions of what they stand on."""
    packages = (jax, jaxlib, np, equinox)
    return " ".join([source_digest(), *(f"{p.__name__} {p.__version__}" for p in packages)])


def _surroundings(settings: dict[str, Any]) -> bytes:
    """What a trace depends on besides the function and its arguments."""
    of_jax = [
        (name, repr(value))
        for name, value in sorted(settings.items())
        if not any(word in name for word in _OF_FILES)
    ]
    ours = [(k, v) for k, v in sorted(os.environ.items()) if k.startswith("JAXTRACHEA_")]
    return repr((_sources(), of_jax, ours, jax.default_backend())).encode()


def _read(path: Path) -> bytes | None:
    """What is kept in a file; None: there is none that is whole."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, content = content[:_DIGEST], content[_DIGEST:]
    return content if hashlib.sha256(content).digest() == digest else None
