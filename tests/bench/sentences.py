"""Sentences of a fit's output by the specimen that they are about, for situations.py and others."""

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence

from presses import Run

#: Names of specimens as these scripts give them.
NAME = re.compile(r"\bT\d{4}\b")
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
#: One parameter or a list of them, with powers or changes.
PARAMETER = r"\b(?:EI_L|k_M|k_1|k_3)\b(?:\^[-+.e\d]+| [-+][.e\d]+ %)?"
LISTED = re.compile(rf"{PARAMETER}(?:(?:, | and | ){PARAMETER})*")
SHARE = re.compile(r"\b(\d+) of (\d+)\b")
MORE = re.compile(r"\band \d+ more\b")
#: Only lines of words are sentences: rows of tables, progress bars and pictures are not.
FURNITURE = re.compile(r"^\W*$|[─│━|]|^!\[|^#|\s{2,}\S+\s{2,}")


def kind(sentence: str) -> str:
    """A sentence without its numbers, names of specimens and of parameters."""
    return NUMBER.sub("#", LISTED.sub("P", NAME.sub("NAME", sentence))).strip(" .")


def of_specimens(run: Run) -> dict[str, set[str]]:
    """Sentences by specimen: of its rows in summary.csv and curves.csv, and lines that name it."""
    found = defaultdict(set)
    for table, columns in (("summary", ("message", "remarks")), ("curves", ("remarks",))):
        for row in run.tables.get(table, ()):
            for column in columns:
                found[row["specimen"]].add(row[column])
    for row in run.tables.get("parameters", ()):
        found[row["specimen"]].add(f"verdict: {row['verdict']}")
    for line in lines(run):
        for name in set(NAME.findall(line)):
            found[name].add(line)
    return found


def parts(cell: str) -> list[str]:
    """Sentences of a cell of a table, or of a line."""
    return [part.strip() for part in cell.split("; ") if part.strip()]


def lines(run: Run) -> list[str]:
    """Lines of the terminal and of the report that are sentences."""
    every = [line.strip() for text in run.texts.values() for line in text.splitlines()]
    return [line for line in every if not FURNITURE.search(line)]


def of_all(run: Run) -> list[str]:
    """Lines that name no specimen."""
    return [line for line in lines(run) if not NAME.search(line)]


def usual(run: Run) -> set[str]:
    """Kinds of sentences that most clean specimens get, or that name none ("N of M": of most)."""
    by_name = of_specimens(run)
    count = Counter(
        k for found in by_name.values() for k in {kind(p) for text in found for p in parts(text)}
    )
    common = {k for k, n in count.items() if 2 * n > len(by_name)}
    rare = {
        line for line in of_all(run) for a, b in SHARE.findall(line)[:1] if 2 * int(a) <= int(b)
    }
    every = {line for line in of_all(run) if line not in rare}
    return common | {kind(part) for line in every for part in parts(line)}


def named(run: Run, pattern: str, names: Sequence[str], known: Iterable[str]) -> tuple:
    """Share of specimens told a sentence that matches and is not `known`, and up to 3 such.

    A line that names no specimen, or a few of those that it counts ("N of M curves: ... and K
    more"), counts by its "N of M"; one that names none and counts none is said of all.
    """
    asked, known = re.compile(pattern, re.IGNORECASE), set(known)

    def hits(found):
        new = ("; ".join(part for part in parts(s) if kind(part) not in known) for s in found)
        return sorted(s for s in new if asked.search(s))

    by_name = of_specimens(run)
    told = {name: hits(by_name.get(name, ())) for name in names}
    general = hits(of_all(run))
    listed = hits(line for line in lines(run) if MORE.search(line))
    counted = [int(a) / int(b) for s in general + listed for a, b in SHARE.findall(s)[:1] if int(b)]
    share = max([sum(map(bool, told.values())) / len(names), *counted])
    if general and not share:
        share = 1.0
    examples = general + listed + [s for found in told.values() for s in found[:1]]
    return share, examples[:3]
