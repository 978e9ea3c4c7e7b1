"""Readers of measured curves, one file format each; `measurements.read` is the door."""

from jaxtrachea._errors import InputError
from jaxtrachea.measurements.readers.afmformats import AFMFORMATS
from jaxtrachea.measurements.readers.hdf5 import HDF5
from jaxtrachea.measurements.readers.machine_file import MACHINE
from jaxtrachea.measurements.readers.reader import Reader
from jaxtrachea.measurements.readers.tidy import TIDY

#: In the order in which they are asked whether a file is theirs; the last takes any text.
READERS: tuple[Reader, ...] = (AFMFORMATS, HDF5, TIDY, MACHINE)


def reader_of(name: str) -> Reader | None:
    """The reader of a format; None for "auto".

    Raises:
        InputError: there is no such format.
    """
    if name == "auto":
        return None
    for reader in READERS:
        if reader.name == name:
            return reader
    known = ", ".join(repr(reader.name) for reader in READERS)
    raise InputError(f"expected 'auto', {known} (found {name!r})", key="format")
