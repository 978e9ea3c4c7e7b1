"""The file of one traced program; and a process that optimises such programs afterwards.

Programs of little work are compiled without optimisation, since the first answer is sooner so. A
command that finds one again gives its trace to a process of its own, which nobody waits for: it
compiles the trace with optimisation into JAX's folder, and says so in the file. Later starts find
the optimised program. One such process is at work in a folder at a time.
"""

import contextlib
import hashlib
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax import export

from jaxtrachea.files.atomic import write_whole
from jaxtrachea.files.lock import Busy, NoLocks, take

#: Bytes of the digest that comes before the content of a file.
_DIGEST = hashlib.sha256().digest_size


class KeptTrace(NamedTuple):
    """A traced function of a flat list of arrays.

    Attributes:
        name: of the function.
        exported: the trace, by `jax.export`.
        returns: what the function returns, with the numbers of its leaves in their places.
        donated: positions of donated arguments.
        optimised: whether JAX's folder has been given the optimised program.
    """

    name: str
    exported: bytes
    returns: Any
    donated: tuple[int, ...]
    optimised: bool = False

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
                kept.lower().compile()
                write(path, kept._replace(optimised=True))
    finally:
        lock.release()


def optimise_afterwards(paths: list[Path]) -> None:
    """Start a process that optimises traces, with this one's settings; it is not waited for."""
    # Imports as this process does, without its working folder: that may be taken away meanwhile.
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(sys.path),
        "JAX_ENABLE_X64": str(jax.config.values["jax_enable_x64"]),
        "JAX_COMPILATION_CACHE_DIR": str(paths[0].parent.absolute()),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
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
