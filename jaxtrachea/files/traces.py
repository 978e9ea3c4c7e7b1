"""Compiled functions that the next start of a command does not trace anew.

JAX keeps what XLA compiles, but a process must first trace and lower a function to know what to
look for: of a warm start that is about half the time. Commands keep the lowered function too,
beside JAX's own files, under a digest of the sources of this package, of versions, of JAX's
settings, of the function and its static arguments by value, and of the shapes, dtypes and static
fields of the others. Where that does not tell all (a class from elsewhere, sources that were edited
since the start), and wherever anything goes wrong, the function is traced as ever.

For commands only: a program that sets constants of a module, or JAX's settings for a while, would
be given the traces of before.
"""

import contextlib
import functools
import hashlib
import io
import os
import pickle
import platform
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import export
from jax.core import Tracer

import jaxtrachea
from jaxtrachea._compiler import quick_options
from jaxtrachea._memory import give_back
from jaxtrachea.files import kept_trace
from jaxtrachea.files.kept_trace import KeptTrace
from jaxtrachea.files.programs import TRACED
from jaxtrachea.files.provenance import installed, source_digest

#: Packages with code of which a trace may be made.
_VERSIONS = ("jax", "jaxlib", "numpy", "scipy", "ml_dtypes", "equinox", "optax", "blackjax")
#: Packages of which static arguments may be made: those, and what Python brings.
_KNOWN = {"jaxtrachea", "builtins", "collections", "copyreg", "enum", "functools", "operator"}
_KNOWN |= {"pathlib", "types", *_VERSIONS}
#: Settings of JAX that say where files are kept and what is run where, not what is computed.
_ELSEWHERE = ("cache", "_log", "dump", "default_device")

#: When this process began, s; what it took to come here was processor time.
_start = time.time() - time.process_time()
_folder: Path | None = None
#: Traces that this process found, whose programs are not optimised yet.
_found_unoptimised: list[Path] = []


def keep_traces(folder: Path | None) -> None:
    """Say where this process keeps traces from now on, beside compiled programs; None: nowhere.

    Nor in what is no folder of this machine (gs://bucket), where JAX can keep its own.
    """
    global _folder
    remote = folder is not None and folder.parts[:1] and folder.parts[0].endswith(":")
    _folder = None if remote else folder


def are_kept() -> bool:
    """Whether this process keeps traces."""
    return _folder is not None


def optimise_afterwards() -> None:
    """Have what this process found unoptimised be optimised for later starts; nobody waits."""
    if _found_unoptimised:
        kept_trace.optimise_afterwards(_found_unoptimised)
        _found_unoptimised.clear()


class Traced:
    """`jax.jit(function)`; where `keep_traces` says so, its trace is kept for the next start."""

    def __init__(
        self,
        function: Callable,
        *static: Any,
        axes: Any = None,
        donate: tuple[int, ...] = (),
        unoptimised: bool = False,
        **named: Any,
    ):
        """Nothing is traced yet.

        Args:
            function: pure, a module's own.
            static: its first arguments.
            axes: of the other arguments, as `in_axes` of `jax.vmap`; None: no `vmap`.
            donate: of the other arguments, as `donate_argnums` of `jax.jit`.
            unoptimised: compiled without optimisation, until `optimise_afterwards` has seen to it;
                the trace is the same.
            named: static arguments by name.
        """
        self._name, self._donate = function.__name__, donate
        self._identity = (function, static, named, axes, donate)
        one = functools.partial(function, *static, **named)
        self._function = one if axes is None else jax.vmap(one, axes)
        self._unoptimised = unoptimised
        self._compiled: dict[Any, Callable] = {}
        self._compiling: dict[Any, threading.Lock] = {}

    @functools.cached_property
    def _plain(self) -> Any:
        """As `jax.jit` makes it."""
        options = quick_options() if self._unoptimised else None
        return jax.jit(self._function, donate_argnums=self._donate, compiler_options=options)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """What the function returns."""
        return self._program(arguments, named)(*arguments, **named)

    def compile(self, *arguments: Any, **named: Any) -> None:
        """Trace and compile for arguments like these, and keep both; nothing is computed.

        Where nothing is kept, nothing is done.
        """
        self._program(arguments, named)

    def _program(self, arguments: tuple, named: dict) -> Callable:
        """The function of arguments like these, compiled where its trace is kept."""
        if _folder is None:
            return self._plain
        leaves, tree = jax.tree.flatten((arguments, named))
        chosen = jax.config.jax_default_device  # pyright: ignore
        device = chosen or jax.local_devices()[0]
        try:
            kinds = tuple(_kind(leaf, device) for leaf in leaves)
            key = _folder, device, tree, kinds
            compiled = self._compiled.get(key)
        except TypeError:  # neither an array nor a number; a field without a hash
            return self._plain
        return self._compile(key, (arguments, named)) if compiled is None else compiled

    def _compile(self, key: tuple, given: tuple) -> Callable:
        """The function of arguments like these, compiled by one thread for all."""
        folder, device, _, kinds = key
        with self._compiling.setdefault(key, threading.Lock()):
            if key not in self._compiled:
                compiled = None
                with contextlib.suppress(Exception):  # what is wrong is said by the plain call
                    compiled = self._by_trace(folder, given, kinds, device)
                self._compiled[key] = compiled or self._plain
                give_back()
            return self._compiled[key]

    def lower(self, *arguments: Any, **named: Any) -> Any:
        """As of `jax.jit`; nothing is kept."""
        return self._plain.lower(*arguments, **named)

    def _by_trace(self, folder: Path, given: tuple, kinds: tuple, device: Any) -> Callable:
        """The function of arguments like these by a kept trace, which is made if there is none."""
        leaves, tree = jax.tree.flatten(given)
        digest = hashlib.sha256(_surroundings(device.platform))
        # Words, not dtypes: two that are equal may be one object or two, which pickle tells apart.
        named = [(shape, str(dtype), weak) for shape, dtype, weak in kinds]
        digest.update(_said((self._identity, jax.tree.unflatten(tree, named))))
        path = folder / f"{self._name}-{digest.hexdigest()}{TRACED}"
        kept = kept_trace.read(path)
        found = kept is not None
        if kept is None:
            kept = self._traced(leaves, tree, device, self._donated(given[0]))
            with contextlib.suppress(OSError):  # then the next start traces anew
                kept_trace.write(path, kept)
        unoptimised = self._unoptimised and not kept.optimised
        if found and unoptimised:
            _found_unoptimised.append(path)
        run = kept.lower(leaves).compile(quick_options() if unoptimised else None)
        structure = jax.tree.structure(kept.returns)

        def compiled(*arguments, **named):
            return jax.tree.unflatten(structure, run(*jax.tree.leaves((arguments, named))))

        return compiled

    def _traced(self, leaves: list, tree: Any, device: Any, donated: tuple) -> KeptTrace:
        """The trace of arguments like these."""
        made = []

        def flat(*leaves):
            arguments, named = jax.tree.unflatten(tree, leaves)
            values, structure = jax.tree.flatten(self._function(*arguments, **named))
            if any(getattr(jax.typeof(v), "weak_type", False) for v in values):
                raise TypeError(f"{self._name} returns weak types")
            made[:] = [jax.tree.unflatten(structure, range(len(values)))]
            return values

        # JAX's own name of the backend (cuda, rocm) is not that of its devices (gpu).
        where = None if device.platform == jax.default_backend() else (device.platform,)
        flat.__name__ = flat.__qualname__ = self._name
        trace = export.export(jax.jit(flat), platforms=where)(*leaves)
        _said(made[0])
        return KeptTrace(self._name, bytes(trace.serialize()), made[0], donated)

    def _donated(self, arguments: tuple) -> tuple[int, ...]:
        """Positions of the donated arguments' leaves among all."""
        counts = [len(jax.tree.leaves(value)) for value in arguments]
        starts = np.concatenate([[0], np.cumsum(counts)]).tolist()
        return tuple(i for d in self._donate for i in range(starts[d], starts[d + 1]))


def _kind(leaf: Any, device: Any) -> tuple:
    """Shape, dtype and whether its type is weak, of an argument."""
    if isinstance(leaf, np.ndarray | np.generic):
        return leaf.shape, leaf.dtype, False
    if isinstance(leaf, jax.Array):
        if isinstance(leaf, Tracer) or leaf.devices() != {device}:
            raise TypeError("a trace is kept of arrays of the device in use")
        return leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)
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
        if type(obj) in (set, frozenset):
            return type(obj).__name__, sorted(map(_said, obj))
        return None


def _said(value: Any) -> bytes:
    """The object in bytes, not to be read again; those of an object that is equal may differ.

    Raises:
        PicklingError: it is made of what is defined elsewhere. Others of `pickle`.
    """
    out = io.BytesIO()
    _Pickler(out, protocol=5).dump(value)
    return out.getvalue()


def _sources() -> str:
    """Digest of this package's sources, and the versions of what they stand on."""
    for path in Path(jaxtrachea.__file__).parent.rglob("*.py"):
        found = path.stat()
        if max(found.st_mtime, found.st_ctime) > _start:
            raise RuntimeError(f"{path} was edited")
    versions = [f"{name} {installed(name)}" for name in _VERSIONS]
    return " ".join([source_digest(), platform.python_version(), *versions])


@functools.cache
def _surroundings(backend: str) -> bytes:
    """Sources, versions and settings, of this process; and the kind of device."""
    settings = [
        (name, repr(value))
        for name, value in sorted(jax.config.values.items())
        if not any(word in name for word in _ELSEWHERE)
    ]
    ours = [(k, v) for k, v in sorted(os.environ.items()) if k.startswith("JAXTRACHEA_")]
    return repr((_sources(), settings, ours, backend)).encode()
