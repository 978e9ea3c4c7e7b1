"""What one damaged input is, and how it is put into a folder."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

HEAD = "specimen,trial,s [mm],displacement [mm],force [N]\n"
ROWS = ["0,0", "0.5,0.31", "1,0.66", "1.5,1.08"]
GOOD = HEAD + "".join(f"T01,1,35,{row}\n" for row in ROWS)
OTHER = HEAD + "".join(f"T02,1,45,{row}\n" for row in ROWS)
SPEC = '[data]\nfiles = "data.csv"\n'


@dataclasses.dataclass(frozen=True)
class Case:
    """One damaged input.

    Attributes:
        says: words that the message must hold: which file or key, and what is wrong with it.
        files: content by name; text is written as UTF-8.
        make: does to the folder what content cannot.
        command: arguments of the command line.
        codes: allowed exit codes; 1 where other curves stand, 0 where the damage may be harmless.
    """

    says: tuple[str, ...]
    files: Mapping[str, str | bytes] = dataclasses.field(default_factory=dict)
    make: Callable[[Path], None] | None = None
    command: tuple[str, ...] = ("fit", "spec.toml")
    codes: tuple[int, ...] = (2,)

    def put(self, folder: Path) -> None:
        """Write the input."""
        for name, content in self.files.items():
            data = content.encode() if isinstance(content, str) else content
            (folder / name).write_bytes(data)
        if self.make is not None:
            self.make(folder)


def flipped(data: bytes, seed: int, bits: int = 1) -> bytes:
    """`data` with some bits flipped, chosen by a linear congruential generator (Knuth's MMIX)."""
    out, state = bytearray(data), seed * 2 + 1
    for _ in range(bits):
        state = (state * 6364136223846793005 + 1442695040888963407) % 2**64
        at = (state >> 20) % (8 * len(out))
        out[at // 8] ^= 1 << at % 8
    return bytes(out)
