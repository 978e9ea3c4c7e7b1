"""Presses of synthetic specimens by a beam of their own, fitted through the command line.

What situations.py, clean_coverage.py and turns.py share. The specimens follow the model that
`[data] files` alone selects (series coupling, one local law, a point, no shear), solved here a
second way: Hermite finite elements of a beam clamped at both ends on a spring k_M at every ring,
whose compliance c at the contact stands in series with the local law: d + c F = D,
F = k_1 d + k_3 d^3. `agree` compares it with the package under test.
"""

import csv
import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import common
import numpy as np

os.sched_setaffinity(0, common.ALL_CORES)  # figures here are no times of one core

PARAMETERS = ("EI_L", "k_M", "k_1", "k_3")
#: Largest difference from the package, relative to the peak force.
TOLERANCE = 1e-9


@dataclass(frozen=True)
class Tube:
    """A tube of rings: its length and the positions of the rings, mm."""

    length: float
    rings: tuple[float, ...]


TABLE_1 = Tube(160.0, tuple(np.arange(10.0, 151.0, 10.0)))


@dataclass(frozen=True)
class Specimen:
    """A name, the true parameters, the positions pressed at (mm), and its tube."""

    name: str
    truth: Mapping[str, float]
    positions: Sequence[float]
    tube: Tube = TABLE_1

    def force(self, position: float, displacement: np.ndarray) -> np.ndarray:
        """Force, N, of a tool at a position, mm, displaced by `displacement`, mm; 0 before touch.

        Newton's method from above: the equilibrium is convex and rises, so it converges.
        """
        k_1, k_3 = self.truth["k_1"], self.truth["k_3"]
        c = compliance(self.tube, self.truth["EI_L"], self.truth["k_M"], position)
        D = np.maximum(displacement, 0.0)
        d = D / (1 + c * k_1)
        for _ in range(60):
            d = d - (d + c * (k_1 + k_3 * d**2) * d - D) / (1 + c * (k_1 + 3 * k_3 * d**2))
        return (k_1 + k_3 * d**2) * d


def compliance(tube: Tube, EI: float, k: float, position: float) -> float:
    """Deflection per unit force, mm/N, at a position: cubic Hermite elements between all nodes.

    Exact for a uniform beam under point loads, which lie on nodes.
    """
    nodes = np.unique([0.0, *tube.rings, position, tube.length])
    K = np.zeros((2 * len(nodes), 2 * len(nodes)))
    for i, h in enumerate(np.diff(nodes)):
        K[2 * i : 2 * i + 4, 2 * i : 2 * i + 4] += (EI / h**3) * np.array(
            [
                [12, 6 * h, -12, 6 * h],
                [6 * h, 4 * h * h, -6 * h, 2 * h * h],
                [-12, -6 * h, 12, -6 * h],
                [6 * h, 2 * h * h, -6 * h, 4 * h * h],
            ]
        )
    springs = 2 * np.searchsorted(nodes, tube.rings)
    K[springs, springs] += k
    load = np.zeros(len(K))
    contact = 2 * np.searchsorted(nodes, position)
    load[contact] = 1.0
    return float(np.linalg.solve(K[2:-2, 2:-2], load[2:-2])[contact - 2])


@dataclass
class Record:
    """One curve: names, position (mm), displacement (mm), force (N), further columns by header."""

    specimen: str
    trial: str
    position: float
    displacement: np.ndarray
    force: np.ndarray
    columns: Mapping[str, float] = field(default_factory=dict)


def write_csv(path: Path, records: Sequence[Record]) -> None:
    """A tidy table of all curves, units in its header."""
    more = list(records[0].columns)
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["specimen", "trial", "s [mm]", "displacement [mm]", "force [N]", *more])
        for record in records:
            head = [record.specimen, record.trial, f"{record.position:g}"]
            tail = [f"{record.columns[name]:g}" for name in more]
            for D, F in zip(record.displacement, record.force, strict=True):
                rows.writerow([*head, f"{D:.6f}", f"{F:.6f}", *tail])


def environment(package: Path, cache: Path | None = None) -> dict[str, str]:
    """Of a command that runs the checkout `package` on all cores; wide lines, so none is broken."""
    pinned = ("XLA_FLAGS", "JAX_ENABLE_X64", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS",
              "MKL_NUM_THREADS")  # fmt: skip
    kept = {name: value for name, value in os.environ.items() if name not in pinned}
    kept |= {"PYTHONPATH": str(package.resolve()), "COLUMNS": "400"}
    return kept | ({} if cache is None else {"XDG_CACHE_HOME": str(cache)})


@dataclass
class Run:
    """What one fit left: its texts by name, exit code, time, tables by name (rows of dicts)."""

    texts: dict[str, str]
    code: int
    seconds: float
    tables: dict[str, list[dict[str, str]]] = field(default_factory=dict)


def fit(package: Path, folder: Path, records: Sequence[Record]) -> Run:
    """Write the curves, fit them with the shortest specification, read what came out.

    A folder that holds a run already is read, not fitted anew.
    """
    out, kept = folder / "out", folder / "run.json"
    if not kept.exists():
        folder.mkdir(parents=True)
        write_csv(folder / "d.csv", records)
        (folder / "spec.toml").write_text('[data]\nfiles = "d.csv"\n')
        command = [sys.executable, "-m", "jaxtrachea", "fit", "spec.toml", "--out", "out"]
        begin = time.perf_counter()
        done = subprocess.run(
            command, cwd=folder, env=environment(package), capture_output=True, text=True
        )
        seconds = time.perf_counter() - begin
        texts = {"stdout": done.stdout, "stderr": done.stderr}
        kept.write_text(json.dumps({"texts": texts, "code": done.returncode, "seconds": seconds}))
    run = Run(**json.loads(kept.read_text()))
    if out.is_dir():
        run.texts["report.md"] = (out / "report.md").read_text("utf-8")
        names = ("parameters", "summary", "curves")
        run.tables.update({name: read_csv(out / f"{name}.csv") for name in names})
    return run


def read_csv(path: Path) -> list[dict[str, str]]:
    """Rows of a table."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@dataclass
class Estimate:
    """One unknown of one specimen as the tables have it, beside the truth."""

    specimen: str
    parameter: str
    truth: float
    value: float
    low: float
    high: float
    verdict: str

    @property
    def missed(self) -> bool:
        """Whether the 95 % interval leaves the truth out (to rounding); one that is empty does."""
        slack = 1e-9 * abs(self.truth)
        return not self.low - slack <= self.truth <= self.high + slack


def estimates(run: Run, specimens: Sequence[Specimen]) -> list[Estimate]:
    """Every unknown with a truth that has a row in parameters.csv."""
    truths = {specimen.name: specimen.truth for specimen in specimens}

    def number(text: str) -> float:
        return float(text) if text else float("nan")

    return [
        Estimate(
            row["specimen"],
            row["parameter"],
            truths[row["specimen"]][row["parameter"]],
            value=number(row["value"]),
            low=number(row["low95"]),
            high=number(row["high95"]),
            verdict=row["verdict"],
        )
        for row in run.tables.get("parameters", ())
        if row["specimen"] in truths and row["parameter"] in PARAMETERS
    ]


PRESSED = """
import json, sys
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import jaxtrachea
from jaxtrachea import Geometry, Material, press
print(jaxtrachea.__file__)
for length, rings, truth, s, D in json.load(sys.stdin):
    tube = Geometry.create(length, rings)
    print(json.dumps(np.asarray(press(tube, Material(**truth), s, np.asarray(D)).force).tolist()))
"""


def agree(package: Path, specimens: Sequence[Specimen]) -> float:
    """Largest difference of `Specimen.force` from the package's own press, over the peak.

    Raises:
        AssertionError: more than `TOLERANCE`, or another package was imported.
    """
    D = np.linspace(-0.5, 5.0, 23)
    cases = [(s, position) for s in specimens for position in s.positions]
    asked = [[s.tube.length, s.tube.rings, dict(s.truth), p, D.tolist()] for s, p in cases]
    done = subprocess.run(
        [sys.executable, "-c", PRESSED], input=json.dumps(asked), capture_output=True, text=True,
        env=environment(package), cwd=package,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    where, *lines = done.stdout.splitlines()
    assert Path(where).is_relative_to(package.resolve()), f"imported {where}"
    return max(
        common.close(f"{s.name} at {p:g} mm", json.loads(line), s.force(p, D), TOLERANCE)
        for (s, p), line in zip(cases, lines, strict=True)
    )


def keep(suite: str, label: str, package: Path, rows: Sequence[dict]) -> None:
    """Write rows under a label into results/SUITE.jsonl; those of other labels stay.

    Other cases of the label stay, too, if they are of the same commit. The first row of a label
    says where, when and of which commit it was measured, as `common.Writer` does.
    """
    environment = common.Writer(suite).rows[0] | {
        "commit": common.commit(package),
        "cores_used": len(common.ALL_CORES),
    }
    path = common.RESULTS / f"{suite}.jsonl"
    old = list(map(json.loads, path.read_text().splitlines())) if path.exists() else []
    others = [row for row in old if row["label"] != label]
    ours = [row for row in old if row["label"] == label]
    same = any(row.get("commit") == environment["commit"] for row in ours)
    new = {row["case"] for row in rows}
    kept = [row for row in ours if same and row["kind"] == "row" and row["case"] not in new]
    labelled = [{"label": label} | row for row in (environment, *kept, *rows)]
    path.write_text("".join(json.dumps(row) + "\n" for row in others + labelled))


def markdown(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    rows = [header, ["---"] * len(header), *lines]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def percent(part: float, of: float) -> str:
    """A share; a dash where there is nothing to have one of."""
    return f"{100 * part / of:.3g} %" if of else "-"
