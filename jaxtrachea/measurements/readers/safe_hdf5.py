"""Opening HDF5 files that nobody vouches for.

An HDF5 file can name other files (external links, external raw storage, virtual datasets), declare
exabytes in a few bytes, or loop. The whole file is walked through before a single value is read,
and anything of the kind refuses the file; links other than hard ones are never followed.
"""

import math
import mmap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from jaxtrachea.measurements.curve import DataError

MAX_ELEMENTS = 10_000_000
MAX_TOTAL_ELEMENTS = 100_000_000
MAX_OBJECTS = 200_000
MAX_DEPTH = 8
MAX_ATTRIBUTES = 256
MAX_ATTRIBUTE_BYTES = 2**20
#: Longest text of a dataset of texts, bytes.
MAX_TEXT_BYTES = 1024
#: Deflate packs 1032 numbers of one byte into one at most; more is declared and not stored.
MOST_PACKED = 1100
# deflate, shuffle, fletcher32, lzf: others would load plug-ins chosen by the file.
FILTERS = (1, 2, 3, 32000)


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
        path: the file.
        audit: walk through it; without that only names may be asked for, no value be read.
        read: groups and datasets, from the root, whose values will be read; None: all. Others may
            hold text, and as much as they like.
        limits: of a file, by the names in it.

    Yields:
        The open `h5py.File`.

    Raises:
        DataError: not HDF5, truncated, damaged, or refused for what it contains.
    """
    import h5py

    try:
        _check_heaps(path)
        file = h5py.File(path, "r")
    except (OSError, RuntimeError, ValueError) as error:
        raise _damaged(path, error) from None
    with file:
        try:
            if audit:
                _Audit(path, read, limits(file)).group(file.id, "", 0)
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


def _check_heaps(path: Path) -> None:
    """Refuse a file whose damage would make the library loop for ever over a text attribute.

    Global heap collections ("GCOL") hold variable-length text as a chain of objects, each with its
    size; the library steps from one to the next and never arrives if the free space claims size 0.
    Layout: HDF5 File Format Specification 3.0, section III.E, with lengths of 8 bytes.

    Raises:
        OSError: such a chain, or a file that cannot be read.
    """
    if path.stat().st_size == 0:
        raise OSError("the file is empty")
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        # Collections do not overlap, which bounds the steps; a file made of overlaps is refused.
        steps = len(data) // 16
        start = data.find(b"GCOL\1\0\0\0")
        while start >= 0:
            end = min(start + int.from_bytes(data[start + 8 : start + 16], "little"), len(data))
            at = start + 16
            while at + 16 <= end:
                steps -= 1
                size = int.from_bytes(data[at + 8 : at + 16], "little")
                free = data[at : at + 2] == b"\0\0"
                if steps < 0 or (free and size < 16):
                    raise OSError(f"global heap at byte {start} is damaged")
                at += size if free else 16 + (size + 7) // 8 * 8
            start = data.find(b"GCOL\1\0\0\0", start + 4)


class _Audit:
    """Walks a file and refuses what a measurement never needs."""

    def __init__(self, path: Path, read: tuple[str, ...] | None, limits: Limits) -> None:
        import h5py

        self.path = path
        self.read = read
        self.limits = limits
        self.h5: Any = h5py
        self.objects = 0
        self.elements = 0
        self.groups: set = set()
        kinds = self.h5.h5t
        self.numbers = (kinds.INTEGER, kinds.FLOAT, kinds.ENUM)
        self.plain = (*self.numbers, kinds.STRING)

    def refuse(self, name: str, what: str, cure: str) -> DataError:
        return DataError(what, place=f"{self.path}:{name or '/'}", cure=cure)

    def group(self, group: Any, name: str, depth: int) -> None:
        info = self.h5.h5o.get_info(group)
        if (info.fileno, info.addr) in self.groups:
            raise self.refuse(
                name, "is linked from several places or from within itself", "store it once"
            )
        self.groups.add((info.fileno, info.addr))
        if depth > MAX_DEPTH:
            raise self.refuse(name, f"nested deeper than {MAX_DEPTH} groups", "flatten the file")
        self.attributes(group, name)
        for child, kind in self.links(group):
            self.objects += 1
            if self.objects > MAX_OBJECTS:
                raise self.refuse(name, f"more than {MAX_OBJECTS} objects in the file", "split it")
            text = child.decode("utf-8", "replace")
            where = f"{name}/{text}"
            if not text.isprintable() or "\ufffd" in text:
                raise self.refuse(f"{name}/{text!r}", "name with control characters", "rename it")
            if kind != self.h5.h5l.TYPE_HARD:
                raise self.refuse(
                    where, "is a soft or external link", "store the data itself in its place"
                )
            self.member(self.h5.h5o.open(group, child), where, depth)

    def links(self, group: Any) -> list[tuple[bytes, int]]:
        """Names and kinds of the links of a group, at most one more than are allowed."""
        found: list[tuple[bytes, int]] = []

        def note(name: bytes, info: Any) -> bool | None:
            found.append((name, info.type))
            return True if len(found) > MAX_OBJECTS else None

        group.links.iterate(note, info=True)
        return found

    def member(self, identifier: Any, where: str, depth: int) -> None:
        if isinstance(identifier, self.h5.h5g.GroupID):
            self.group(identifier, where, depth + 1)
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
        filters = [plan.get_filter(i)[0] for i in range(plan.get_nfilters())]
        if any(code not in FILTERS for code in filters):
            raise self.refuse(name, f"needs compression filters {filters}", "use gzip")
        self.size(dataset, kind.get_size(), name)
        self.attributes(dataset, name)

    def is_number(self, kind: Any) -> bool:
        return kind.get_class() in self.numbers and kind.get_size() <= 16

    def is_short_text(self, kind: Any) -> bool:
        if kind.get_class() != self.h5.h5t.STRING or kind.is_variable_str():
            return False
        return kind.get_size() <= MAX_TEXT_BYTES

    def size(self, dataset: Any, width: int, name: str) -> None:
        """Refuse more numbers than are read, and many that are declared but not stored."""
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
        stored = dataset.get_storage_size()
        if size > MAX_ELEMENTS and size * width > MOST_PACKED * stored:
            raise self.refuse(
                name,
                f"declares {size} elements but stores only {stored} bytes",
                "copy or export the file again",
            )

    def attributes(self, holder: Any, name: str) -> None:
        count = self.h5.h5a.get_num_attrs(holder)
        if count > MAX_ATTRIBUTES:
            raise self.refuse(name, f"{count} attributes, at most {MAX_ATTRIBUTES}", "remove some")
        for i in range(count):
            attribute = self.h5.h5a.open(holder, index=i)
            kind = attribute.get_type()
            size = kind.get_size() * math.prod(attribute.shape or ())
            allowed = kind.get_class() in self.plain
            if allowed and size <= MAX_ATTRIBUTE_BYTES:
                continue
            label = f"{name or '/'}@{attribute.name.decode('utf-8', 'replace')}"
            what = (
                f"attribute of {size} bytes" if allowed else "attribute is neither number nor text"
            )
            raise self.refuse(label, what, "remove it")
