"""What a result comes from: versions, command, digests of every input."""

import datetime
import functools
import hashlib
import itertools
import json
import platform
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import jaxtrachea
from jaxtrachea.files.atomic import write_text


@functools.cache
def installed(package: str) -> str:
    """Version of a package, in words where there is none."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


@functools.cache
def source_digest() -> str:
    """SHA-256 (16 digits) of the package's Python files, wherever it is installed."""
    root, digest = Path(jaxtrachea.__file__).parent, hashlib.sha256()
    for path in sorted(root.rglob("*.py"), key=lambda path: path.relative_to(root).as_posix()):
        content = path.read_bytes().replace(b"\r\n", b"\n")
        name = path.relative_to(root).as_posix().encode()
        digest.update(b"%d %s %d " % (len(name), name, len(content)) + content)
    return digest.hexdigest()[:16]


def provenance(
    spec: Path, inputs: dict[str, str], dtype: str, phases: Sequence[str], clock: Sequence[float]
) -> dict[str, object]:
    """Everything needed to repeat a run: versions, device, dtype, SHA-256 of every input.

    Args:
        inputs: SHA-256 by measurement file.
        phases: names of what was done, one after the other.
        clock: when the first began, and when each ended, s.
    """
    import jax

    versions = {"python": platform.python_version(), "platform": platform.platform()}
    for name in ("jaxtrachea", "jax", "jaxlib", "numpy", "scipy", "equinox", "optax", "h5py"):
        versions[name] = installed(name)
    return {
        "written": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "versions": versions,
        "device": str(jax.devices()[0]),
        "dtype": dtype,
        "specification": {
            "file": spec.name,
            "sha256": hashlib.sha256(spec.read_bytes()).hexdigest(),
        },
        "inputs": {Path(name).name: digest for name, digest in inputs.items()},
        "seconds": {
            name: round(end - begin, 3)
            for name, (begin, end) in zip(phases, itertools.pairwise(clock), strict=True)
        },
    }


def write_provenance(folder: Path, made: Mapping[str, object]) -> None:
    """Write provenance.json."""
    write_text(folder / "provenance.json", json.dumps(made, indent=2) + "\n")
