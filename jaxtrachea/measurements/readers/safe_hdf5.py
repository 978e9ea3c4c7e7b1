"""Opening HDF5 files whose numbers may lie elsewhere, or be far more than were measured.

Links to other places, virtual datasets and data kept in other files would bring in numbers that the
file, its digest and its author do not vouch for. The whole file is walked through before a value is
read, and anything of the kind refuses it.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from jaxtrachea.measurements.curve import DataError

MAX_ELEMENTS = 10_000_000
MAX_TOTAL_ELEMENTS = 100_000_000
#: Longest text of a dataset of texts, bytes.
MAX_TEXT_BYTES = 1024


class Limits(NamedTuple):
    """What a file may hold.

    Attributes:
        elements: most numbers in a dataset.
        total: most numbers in the file.
        texts: datasets that may hold text of fixed length, by their place from the root.
    """

    elements: int = MAX_ELEMENTS
    total: int = MAX_TOTAL_ELEMENTS
    texts: tuple[str, ...] = ()


@contextmanager
def opened(
    path: Path,
    *,
    audit: bool = True,
    read: tuple[str, ...] | None = None,
    limits: Callable[[Any], Limits] = lambda file: Limits(),
) -> Iterator[Any]:
    """Open an HDF5 file for reading after walking through all of it.

    Args:
        audit: walk through it; without that only names may be asked for, no value be read.
        read: groups and datasets, from the root, whose values will be read; None: all. Others may
            hold text, and as much as they like.
        limits: of a file, by the names in it.

    Raises:
        DataError: not HDF5, truncated, damaged, or refused for what it contains.
    """
    import h5py

    try:
        file = h5py.File(path, "r")
    except (OSError, RuntimeError, ValueError) as error:
        raise _damaged(path, error) from None
    with file:
        try:
            if audit:
                _Audit(path, read, limits(file)).group(file.id, "")
        except DataError:
            raise
        except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
            # The library reports a damaged file by whichever of these its error code maps to.
            raise _damaged(path, error) from None
        try:
            yield file
        except (OSError, RuntimeError, KeyError) as error:
            raise _damaged(path, error) from None


def _damaged(path: Path, error: Exception) -> DataError:
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    return DataError(
        f"not a readable HDF5 file, truncated or damaged ({reason})",
        place=str(path),
        cure="copy or export it again",
    )


class _Audit:
    """Walks a file and refuses what a measurement never needs."""

    def __init__(self, path: Path, read: tuple[str, ...] | None, limits: Limits) -> None:
        import h5py

        self.path, self.read, self.limits = path, read, limits
        self.h5: Any = h5py
        self.elements = 0
        self.groups: set = set()

    def refuse(self, name: str, what: str, cure: str) -> DataError:
        return DataError(what, place=f"{self.path}:{name or '/'}", cure=cure)

    def group(self, group: Any, name: str) -> None:
        info = self.h5.h5o.get_info(group)
        if (info.fileno, info.addr) in self.groups:
            raise self.refuse(
                name, "is linked from several places or from within itself", "store it once"
            )
        self.groups.add((info.fileno, info.addr))
        links: list[tuple[bytes, int]] = []
        group.links.iterate(lambda child, link: links.append((child, link.type)), info=True)
        for child, kind in links:
            text = child.decode("utf-8", "replace")
            where = f"{name}/{text}"
            if not text.isprintable() or "\ufffd" in text:
                raise self.refuse(f"{name}/{text!r}", "name with control characters", "rename it")
            if kind != self.h5.h5l.TYPE_HARD:
                raise self.refuse(
                    where, "is a soft or external link", "store the data itself in its place"
                )
            self.member(self.h5.h5o.open(group, child), where)

    def member(self, identifier: Any, where: str) -> None:
        if isinstance(identifier, self.h5.h5g.GroupID):
            self.group(identifier, where)
        elif isinstance(identifier, self.h5.h5d.DatasetID):
            self.dataset(identifier, where)
        else:
            raise self.refuse(where, "is neither group nor dataset", "remove it")

    def dataset(self, dataset: Any, name: str) -> None:
        plan = dataset.get_create_plist()
        if plan.get_layout() == self.h5.h5d.VIRTUAL:
            raise self.refuse(name, "is a virtual dataset", "store the data itself")
        if plan.get_external_count() > 0:
            raise self.refuse(name, "keeps its data in another file", "store the data in this one")
        read = self.read or ("",)
        if not any(name == start or name.startswith(f"{start}/") for start in read):
            return
        kind = dataset.get_type()
        if name in self.limits.texts and not self.is_number(kind):
            if not self.is_short_text(kind):
                found = f"holds no text of fixed length of at most {MAX_TEXT_BYTES} bytes"
                raise self.refuse(name, found, "store such text, in UTF-8")
        elif not self.is_number(kind):
            raise self.refuse(
                name,
                "holds no plain numbers (but object, reference, text, compound or variable length)",
                "store numbers as integers or floats and text in attributes",
            )
        self.size(dataset, kind.get_size(), name)

    def is_number(self, kind: Any) -> bool:
        kinds = self.h5.h5t
        return kind.get_class() in (kinds.INTEGER, kinds.FLOAT, kinds.ENUM)

    def is_short_text(self, kind: Any) -> bool:
        if kind.get_class() != self.h5.h5t.STRING or kind.is_variable_str():
            return False
        return kind.get_size() <= MAX_TEXT_BYTES

    def size(self, dataset: Any, width: int, name: str) -> None:
        size = math.prod(dataset.get_space().get_simple_extent_dims() or ())
        # Text counts as the numbers of 8 bytes that would fill its place.
        self.elements += size * max(1, width // 8)
        if size > self.limits.elements or self.elements > self.limits.total:
            raise self.refuse(
                name,
                f"declares {size} elements ({self.elements} in the file so far),"
                f" at most {self.limits.elements} ({self.limits.total}) are read",
                "thin out or split the recording",
            )
