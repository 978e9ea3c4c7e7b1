"""Clean records keep what they had: coverage, verdicts and false alarms of many specimens.

    python tests/bench/clean_coverage.py [--package DIR] [--label NAME] [--specimens 1000]
        [--against NAME]

Specimens of presses.py with truths around EI_L 900 N mm^2, k_M 0.3 N/mm, k_1 8 N/mm (log-normal,
20 %; every second one has a k_3 that adds 5 to 50 % of k_1 at the deepest indentation), pressed at
2 to 5 positions to 2 to 6 mm, 20 to 100 samples a curve, noise of 0.2 to 3 % of the peak. Each
hundred are one table, fitted by `[data] files = "d.csv"` alone. Rows go to
results/clean_coverage.jsonl under NAME, others stay there.

coverage: share of the unknowns with a verdict whose 95 % interval (low95 to high95 of
    parameters.csv) holds the truth.
verdicts: how many unknowns have each, and with `--against NAME` how many of those "identifiable"
    (or weak) under that label are so still.
sentences: how many specimens are told each kind of sentence (without its numbers and names;
    verdicts and lists of them left out). The report tells of 12 specimens of a table only, the
    remarks in the tables of all. Sentences that name no specimen: of how many tables, and what
    their "N of M" add up to.
"""

import argparse
import json
import re
import tempfile
from collections import Counter
from pathlib import Path

import common
import numpy as np
import presses
from presses import PARAMETERS, Record, Specimen, percent
from sentences import SHARE, kind, of_all, of_specimens, parts
from situations import CENTRE, SOLVED, SPREAD

CHUNK = 100
#: Beginnings of what is said of every lane by its verdicts.
VERDICTS = re.compile(r"^(- )?(NAME: )?(verdict|identifiable|weak|(practically|structurally) non|"
                      r"at bound|not shown|inconclusive)")  # fmt: skip


def make(index: int) -> tuple[Specimen, list[Record]]:
    """A specimen and its curves; all that is random follows from the index."""
    rng = np.random.default_rng(index)
    count, samples = int(rng.integers(2, 6)), int(rng.integers(20, 101))
    depth, noise = rng.uniform(2.0, 6.0), np.exp(rng.uniform(np.log(0.002), np.log(0.03)))
    truth = {name: v * np.exp(SPREAD * rng.standard_normal()) for name, v in CENTRE.items()}
    positions = np.sort(rng.choice(np.arange(10.0, 151.0, 5.0), count, replace=False)).tolist()
    linear = Specimen(f"T{index:04d}", truth | {"k_3": 0.0}, positions)
    D = np.linspace(0.0, depth, samples)
    k_3 = 0.0
    if index % 2:
        deepest = max(linear.force(p, D)[-1] for p in positions) / truth["k_1"]
        k_3 = truth["k_1"] * rng.uniform(0.05, 0.5) / deepest**2
    specimen = Specimen(linear.name, truth | {"k_3": k_3}, positions)
    forces = [specimen.force(p, D) for p in positions]
    sigma = noise * max(F[-1] for F in forces)
    return specimen, [
        Record(specimen.name, f"s{p:g}", p, D, F + rng.normal(0.0, sigma, samples))
        for p, F in zip(positions, forces, strict=True)
    ]


def told(run: presses.Run) -> tuple[Counter, dict[str, np.ndarray]]:
    """Specimens by kind of sentence said of them; of those that name none 1 and their N and M."""
    by_name = Counter()
    for found in of_specimens(run).values():
        kinds = {kind(part) for sentence in found for part in parts(sentence)}
        by_name.update(k for k in kinds if not VERDICTS.match(k))
    of_table = {}
    for sentence in of_all(run):
        counted = SHARE.search(sentence)
        N, M = map(int, counted.groups()) if counted else (0, 0)
        of_table[kind(sentence)] = np.array([1, N, M])
    return by_name, of_table


def main() -> None:
    """Fit all in tables of a hundred and count."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--package", type=Path, default=Path(__file__).parents[2])
    parser.add_argument("--label", default="", help="left out: nothing is written")
    parser.add_argument("--specimens", type=int, default=1000)
    parser.add_argument("--keep", type=Path, help="folder for data and output; a run there is read")
    parser.add_argument("--against", help="label of an earlier run")
    asked = parser.parse_args()
    presses.agree(asked.package, [make(i)[0] for i in range(8)])
    found, status, specimens_told, tables_told = [], Counter(), Counter(), {}
    indices = range(asked.specimens)
    chunks = [indices[i : i + CHUNK] for i in range(0, len(indices), CHUNK)]
    seconds = 0.0
    with tempfile.TemporaryDirectory() as base:
        for i, chunk in enumerate(chunks):
            made = [make(index) for index in chunk]
            specimens = [specimen for specimen, _ in made]
            records = [record for _, curves in made for record in curves]
            folder = (asked.keep or Path(base)) / f"table_{i}"
            run = presses.fit(asked.package, folder, records)
            found += presses.estimates(run, specimens)
            said = {row["specimen"]: row["status"] for row in run.tables.get("summary", ())}
            status.update(said.get(s.name, "missing") for s in specimens)
            by_name, of_table = told(run)
            specimens_told += by_name
            for sentence, counts in of_table.items():
                tables_told[sentence] = tables_told.get(sentence, 0) + counts
            seconds += run.seconds
            print(f"table {i + 1} of {len(chunks)}: {run.seconds:.0f} s", flush=True)
    row = {
        "kind": "row",
        "table": "clean_coverage",
        "case": f"{asked.specimens} specimens",
        "specimens": asked.specimens,
        "tables": len(chunks),
        "unknowns": len(PARAMETERS) * asked.specimens,
        "verdicts": dict(Counter(e.verdict for e in found)),
        "verdict_of": letters(found, asked.specimens),
        "coverage": coverage(found),
        "status": dict(status),
        "failing": sum(n for word, n in status.items() if word not in SOLVED),
        "seconds": round(seconds, 1),
        "sentences": dict(specimens_told.most_common()),
        "sentences_of_tables": {k: list(map(int, n)) for k, n in tables_told.items()},
    }
    show(row)
    if asked.against:
        print(still(asked.against, row))
    if asked.label:
        presses.keep("clean_coverage", asked.label, asked.package, [row])


def coverage(found: list[presses.Estimate]) -> dict[str, list[int]]:
    """Intervals that hold the truth, and all, by parameter and verdict, both added up, too."""
    count: dict[str, list[int]] = {}
    for e in found:
        if e.verdict not in ("identifiable", "weak"):
            continue
        both = "identifiable or weak"
        for verdict, of in ((e.verdict, "all"), (e.verdict, e.parameter), (both, "all"),
                            (both, e.parameter)):  # fmt: skip
            cell = count.setdefault(f"{verdict}, {of}", [0, 0])
            cell[0] += not e.missed
            cell[1] += 1
    return dict(sorted(count.items()))


def letters(found: list[presses.Estimate], specimens: int) -> dict[str, str]:
    """By parameter a letter for each specimen: I (identifiable), W (weak) or - (neither)."""
    letter = {"identifiable": "I", "weak": "W"}
    rows = {(e.specimen, e.parameter): letter.get(e.verdict, "-") for e in found}
    return {
        p: "".join(rows.get((f"T{i:04d}", p), "-") for i in range(specimens)) for p in PARAMETERS
    }


def still(label: str, row: dict) -> str:
    """How many unknowns that were called identifiable (or weak) under a label are so now.

    Raises:
        ValueError: the label has no row, or one of other specimens.
    """
    path = common.RESULTS / "clean_coverage.jsonl"
    old = [r for r in map(json.loads, path.read_text().splitlines()) if r["label"] == label]
    old = [r for r in old if r["kind"] == "row" and r["specimens"] == row["specimens"]]
    if not old:
        raise ValueError(f"{path} has no row {label!r} of {row['specimens']} specimens")
    pairs = [
        pair
        for p in PARAMETERS
        for pair in zip(old[0]["verdict_of"][p], row["verdict_of"][p], strict=True)
    ]
    were = [now for before, now in pairs if before == "I"]
    or_weak = [now for before, now in pairs if before in "IW"]
    same, kept = were.count("I"), sum(now in "IW" for now in or_weak)
    return (
        f"identifiable under {label!r}: {len(were)}, of these still {same}, "
        f"{percent(same, len(were))}; or weak: {len(or_weak)}, still {kept}, "
        f"{percent(kept, len(or_weak))}"
    )


def show(row: dict) -> None:
    """The tables of a row."""
    lines = [[k, f"{a} of {n}", percent(a, n)] for k, (a, n) in row["coverage"].items()]
    print(presses.markdown(["95 % intervals with the truth", "", ""], lines))
    lines = [[k, str(n), percent(n, row["unknowns"])] for k, n in row["verdicts"].items()]
    print(presses.markdown(["verdict", "unknowns", "share"], lines))
    print(f"failing: {row['failing']} of {row['specimens']}; status: {row['status']}")
    lines = [[k, str(n), percent(n, row["specimens"])] for k, n in row["sentences"].items()]
    print(presses.markdown(["sentence of a specimen", "specimens", "share"], lines))
    lines = [[k[:150], *map(str, n)] for k, n in row["sentences_of_tables"].items()]
    print(presses.markdown(["sentence of all", "tables", "N", "of M"], lines))


if __name__ == "__main__":
    main()
