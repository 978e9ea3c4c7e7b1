"""What decides the numbers of a run, kept beside its shards, so that no other run goes on there."""

import contextlib
import dataclasses
import hashlib
import json
import os
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

import jaxtrachea
from jaxtrachea.files.atomic import write_whole
from jaxtrachea.files.provenance import installed, source_digest

SCHEMA = "jaxtrachea-run"
SCHEMA_VERSION = 1
_PACKAGES = ("jax", "jaxlib", "numpy", "scipy")
_SOURCE = "the source of jaxtrachea"
#: Strict types; fields may be called otherwise on file.
_STORED = ConfigDict(strict=True, extra="forbid", populate_by_name=True)


@dataclass(frozen=True, config=_STORED)
class Rerun:
    """Fitting the failed lanes of a finished run again.

    Attributes:
        results: SHA-256 of the results.h5 that holds the others.
        lanes: that are fitted again.
        count: how often this was done, this time included.
    """

    results: Annotated[str, Field(alias="former")]
    lanes: list[int]
    count: int


@dataclass(frozen=True, config=_STORED)
class Manifest:
    """A run.

    Attributes:
        id: name of this run, in all its shards.
        specification: SHA-256.
        inputs: SHA-256 by file, seen from the folder of the data.
        versions: of what computes; of this package also the digest of its source, since numbers
            move between versions.
        dtype: of the computation.
        device: kind of device.
        lanes: of the whole study.
        batch: lanes computed together.
        save_every: lanes saved together, at most.
        options: of the command that need nothing but the fit: they are done at its end.
        rerun: None when all lanes are fitted.
        forced: differences that the user passed over with --force.
    """

    id: str
    specification: str
    inputs: dict[str, str]
    versions: dict[str, str]
    dtype: str
    device: str
    lanes: int
    batch: Annotated[int, Field(alias="chunk")]
    save_every: int
    options: list[str]
    rerun: Rerun | None = None
    forced: list[str] = dataclasses.field(default_factory=list)


_KIND = TypeAdapter(Manifest)


def describe(
    spec: Path, root: Path, inputs: dict[str, str], dtype: str, device: str, **sizes
) -> Manifest:
    """The manifest of a run that starts now.

    Args:
        root: folder of the data.
        inputs: SHA-256 by measurement file.
        device: kind of device.
        sizes: the other attributes of `Manifest`.
    """
    return Manifest(
        id=uuid.uuid4().hex,
        specification=hashlib.sha256(spec.read_bytes()).hexdigest(),
        inputs={os.path.relpath(name, root): digest for name, digest in inputs.items()},
        versions=versions(),
        dtype=dtype,
        device=device,
        **sizes,
    )


def versions() -> dict[str, str]:
    """Versions of what computes, and of this package the digest of its source."""
    mine = {"jaxtrachea": jaxtrachea.__version__, _SOURCE: source_digest()}
    return mine | {p: installed(p) for p in _PACKAGES}


def differences(was: Manifest, now: Manifest) -> Iterator[str]:
    """What differs between two runs that should give the same numbers, in words."""
    if was.specification != now.specification:
        yield "the specification has changed"
    for name in sorted(was.inputs.keys() | now.inputs.keys()):
        if name not in now.inputs:
            yield f"{name} is no longer read"
        elif name not in was.inputs:
            yield f"{name} is new"
        elif was.inputs[name] != now.inputs[name]:
            yield f"{name} has changed"
    for name, new in now.versions.items():
        if (old := was.versions.get(name)) != new:
            yield f"{name} was {old or 'not recorded'} and is {new}"
    for name in ("dtype", "device", "lanes"):
        if (old := getattr(was, name)) != (new := getattr(now, name)):
            more = [f"--{option}" for option in now.options if option not in was.options]
            why = f" ({', '.join(more)} of a joint fit needs one lane)" if more and new == 1 else ""
            yield f"{name} was {old} and is {new}{why}"


def as_dict(manifest: Manifest) -> dict[str, object]:
    """What is stored of a manifest."""
    stored = _KIND.dump_python(manifest, by_alias=True)
    return {"schema": SCHEMA, "schema_version": SCHEMA_VERSION} | stored


def write(path: Path, manifest: Manifest) -> None:
    """Write a manifest at once or not at all; the one before stays beside it (`previous`).

    Raises:
        OSError: it could not be written; the one that was there still is.
    """
    with contextlib.suppress(OSError, ValueError):
        if read(path) == manifest:
            return
        write_whole(previous(path), path.read_bytes())
    write_whole(path, json.dumps(as_dict(manifest), indent=2).encode())


def previous(path: Path) -> Path:
    """Where the manifest before the last change lies."""
    return path.with_name(f"previous-{path.name}")


def read(path: Path) -> Manifest:
    """Read a manifest.

    Raises:
        OSError: there is none, or it cannot be read.
        ValueError: it is damaged, or of another version.
    """
    try:
        return from_dict(json.loads(path.read_text(encoding="utf-8")))
    except RecursionError:
        raise ValueError("nested too deeply for the manifest of a run") from None


def from_dict(content: object) -> Manifest:
    """A manifest from what `as_dict` gives.

    Raises:
        ValueError: it is none, or of another version.
    """
    if not isinstance(content, dict):
        raise ValueError(f"not the manifest of a run, but {type(content).__name__}")
    found = dict(content)
    if (found.pop("schema", None), found.pop("schema_version", None)) != (SCHEMA, SCHEMA_VERSION):
        raise ValueError("not the manifest of a run, or one of another version")
    try:
        return _KIND.validate_json(json.dumps(found))
    except ValidationError as error:
        key = ".".join(map(str, error.errors()[0]["loc"]))
        raise ValueError(f"not the manifest of a run: {key}: {error.errors()[0]['msg']}") from None
