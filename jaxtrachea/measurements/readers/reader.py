"""What a format of measured curves is: its name, how it is known, and what reads it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from jaxtrachea.measurements.curve import BadCurve, RawCurve, ReadOptions
from jaxtrachea.measurements.readers.table import Text

Records = list[RawCurve | BadCurve]


class Reader(NamedTuple):
    """A format of files; a new one is a file in `readers` and a line in `readers.READERS`.

    Attributes:
        name: by which `data.format` asks for it.
        read: reads a file by its path; None: text and sheets only.
        read_text: reads a text or a sheet of a workbook; None: files only.
        is_file: whether a file that begins with these bytes is of this format; `read` then gets
            it. Text, HDF5 and workbooks need no such sign.
        is_text: whether a text is of this format, with the columns that the options name.
        is_hdf5: whether an open HDF5 file is of this format.
        layout: by what an HDF5 file of this format is known, for messages; empty: there are none.
    """

    name: str
    read: Callable[[Path, ReadOptions], Records] | None = None
    read_text: Callable[[Text, ReadOptions], Records] | None = None
    is_file: Callable[[bytes], bool] = lambda head: False
    is_text: Callable[[Text, ReadOptions], bool] = lambda text, options: False
    is_hdf5: Callable[[Any], bool] = lambda file: False
    layout: str = ""
