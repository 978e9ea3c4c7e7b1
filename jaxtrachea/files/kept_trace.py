"""The file of one program, traced and compiled; and a process that optimises such programs.

The compiled program is in it on a machine with one device, a CPU: to lower a trace and look for its
program in JAX's folder takes longer than to load it. Programs of little work are compiled without
optimisation, since the first answer is sooner so. A command that finds one again gives its file to
a process of its own, which nobody waits for: it compiles the trace with optimisation. Later starts
find the optimised program. One such process is at work in a folder at a time.
"""

import contextlib
import hashlib
import os
import pickle
import subprocess
import sys
import threading
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax import export, monitoring
from jax.experimental.serialize_executable import deserialize_and_load, serialize

from jaxtrachea._compiler import quick_options
from jaxtrachea.files.atomic import write_whole
from jaxtrachea.files.lock import Busy, NoLocks, take

#: Bytes of the digest that comes before the content of a file.
_DIGEST = hashlib.sha256().digest_size
#: Events of JAX: a program is looked for in its folder, and found.
_ASKED, _HIT = (
    f"/jax/compilation_cache/{name}" for name in ("compile_requests_use_cache", "cache_hits")
)


class _Found(threading.local):
    """How many programs a thread has found in JAX's folder."""

    programs = 0


_found = _Found()


def _count(event: str, **_: object) -> None:
    _found.programs += event == _HIT


monitoring.register_event_listener(_count)


def _one_cpu() -> bool:
    """Whether programs can run on one device alone, a CPU: they are kept for no other."""
    return jax.default_backend() == "cpu" and jax.device_count() == 1


class KeptTrace(NamedTuple):
    """A traced function of a flat list of arrays.

    Attributes:
        name: of the function.
        exported: the trace, by `jax.export`.
        returns: what the function returns, with the numbers of its leaves in their places.
        donated: positions of donated arguments.
        optimised: whether the program was compiled with optimisation.
        program: compiled, by `serialize`; None: JAX's folder alone has it.
    """

    name: str
    exported: bytes
    returns: Any
    donated: tuple[int, ...]
    optimised: bool = False
    program: bytes | None = None

    def load(self) -> Any:
        """The kept program; None: there is none, or none that this machine can run."""
        if self.program is None or not _one_cpu():
            return None
        try:
            run = deserialize_and_load(*pickle.loads(zlib.decompress(self.program)))
        except Exception:  # of another processor, say: it is compiled anew
            return None
        for event in (_ASKED, _HIT):
            monitoring.record_event(event)
        return run

    def compile(self, leaves: list | None = None, *, optimised: bool) -> tuple[Any, "KeptTrace"]:
        """The trace compiled, ready to run, and the trace with it; `leaves` as for `lower`."""
        lowered, options = self.lower(leaves), None if optimised else quick_options()
        before, program = _found.programs, None
        run = lowered.compile(options)
        # What was found in JAX's folder cannot be serialised once more: code is lost. What calls
        # LAPACK crashes where nothing that does was lowered (findings/serialised_programs.sh).
        alone = _found.programs == before and "custom_call" not in lowered.as_text()
        if _one_cpu() and alone:
            with contextlib.suppress(Exception):  # then JAX's folder alone has it
                program = zlib.compress(pickle.dumps(serialize(run)), 1)
        return run, self._replace(optimised=optimised, program=program)

    def lower(self, leaves: list | None = None) -> Any:
        """Ready for XLA; leaves: arguments, None for those that the trace was made with."""
        exported = export.deserialize(bytearray(self.exported))

        # Compiled by who lowers: what an exported function returns is bound to its device, and
        # `jax.jit` would compile it once more when given that.
        def flat(*leaves):
            return exported.call(*leaves)

        flat.__name__ = flat.__qualname__ = self.name
        return jax.jit(flat, donate_argnums=self.donated).lower(*(leaves or exported.in_avals))


def read(path: Path) -> KeptTrace | None:
    """The trace in a file; None: there is none that is whole."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, content = content[:_DIGEST], content[_DIGEST:]
    if hashlib.sha256(content).digest() != digest:
        return None
    return KeptTrace(*pickle.loads(content))


def write(path: Path, kept: KeptTrace) -> None:
    """Write the file of a trace, whole or not at all.

    Raises:
        OSError: nothing was written.
    """
    content = pickle.dumps(tuple(kept), protocol=5)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, hashlib.sha256(content).digest() + content)


def optimise(paths: list[Path]) -> None:
    """Compile traces of one folder with optimisation; nothing while another process does.

    Args:
        paths: files, of which those that are gone or were optimised meanwhile are left out.
    """
    try:
        lock = take(paths[0].parent)
    except (Busy, NoLocks, OSError):
        return
    try:
        for path in paths:
            kept = read(path)
            if kept is not None and not kept.optimised:
                write(path, kept.compile(optimised=True)[1])
    finally:
        lock.release()


def optimise_afterwards(paths: list[Path]) -> None:
    """Start a process that optimises traces, with this one's settings; it is not waited for.

    Args:
        paths: files of one folder.
    """
    # Imports as this process does, without its working folder: that may be taken away meanwhile.
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(sys.path),
        "JAX_ENABLE_X64": str(jax.config.values["jax_enable_x64"]),
        "JAX_COMPILATION_CACHE_DIR": str(paths[0].parent.absolute()),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_ENABLE_COMPILATION_CACHE": str(not _one_cpu()),
    }
    with contextlib.suppress(OSError):
        subprocess.Popen(
            [sys.executable, "-m", __name__, *(str(path.absolute()) for path in paths)],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            cwd=paths[0].parent, env=environment, start_new_session=True,
        )  # fmt: skip


if __name__ == "__main__":
    with contextlib.suppress(AttributeError):  # not on every system
        os.nice(19)
    optimise([Path(word) for word in sys.argv[1:]])
