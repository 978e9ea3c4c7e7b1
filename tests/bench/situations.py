"""Records as people record them, fitted by `[data] files = "d.csv"` alone: who is told what.

    python tests/bench/situations.py [--package DIR] [--label NAME] [--specimens 30] [--only A,B]

Thirteen situations and clean records, 30 synthetic specimens each, from the finite-element beam of
presses.py. Every specimen has its own truth (EI_L 900 N mm^2, k_M 0.3 N/mm, k_1 8 N/mm, each
log-normal with 20 %, k_3 0), is pressed to 5 mm at four positions, 60 samples each, with noise of
0.005 N; positions are one of `POSITIONS` in turn, of which the last determines little. The command
`fit` of the checkout DIR (this one if left out) runs in a process of its own on one table for each
situation. Rows go to results/situations.jsonl under NAME, others stay there; a table is printed.

identifiable: share of all unknowns (four for each specimen) with that verdict.
wrong: of those, how many have a 95 % interval (low95 to high95 of parameters.csv) without the
    truth; "or weak": of those with one of both verdicts. With two speeds, two temperatures or a
    softer third trial the truth is that of the slower, warmer and first trials.
error: median relative error of EI_L, k_M and k_1 that are called identifiable.
failing: specimens without a solved fit.
named: specimens of which some sentence (terminal, report, tables) names the situation: it matches
    the pattern below and is not said of clean records, too. `--keep DIR` keeps all output there,
    and reads what an earlier run left.
page: whether docs/read_a_fit.md has the pattern, for what a single loading cannot show.
"""

import argparse
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import presses
from presses import PARAMETERS, Record, Run, Specimen, Tube, estimates, percent
from sentences import named, usual

CENTRE, SPREAD = {"EI_L": 900.0, "k_M": 0.3, "k_1": 8.0}, 0.2
NOISE, DEPTH, SAMPLES = 0.005, 5.0, 60
POSITIONS = ((15.0, 35.0, 55.0, 75.0), (20.0, 45.0, 80.0, 125.0), (40.0, 60.0, 80.0, 100.0))
SHORT = Tube(100.0, tuple(np.arange(8.0, 93.0, 12.0)))
SHORT_POSITIONS = ((14.0, 32.0, 50.0, 68.0), (20.0, 40.0, 60.0, 80.0), (12.0, 35.0, 55.0, 85.0))
SOLVED = ("converged", "at_bound", "unidentifiable")
D = np.linspace(0.0, DEPTH, SAMPLES)


@dataclass(frozen=True)
class Press:
    """A press without noise: its specimen and position, and a source of what is random in it."""

    specimen: Specimen
    position: float
    rng: np.random.Generator

    def at(self, displacement: np.ndarray) -> np.ndarray:
        """Force without noise, N."""
        return self.specimen.force(self.position, displacement)

    def record(self, displacement, force, trial: str = "", **columns: float) -> Record:
        """A curve of these values, with noise."""
        force = force + self.rng.normal(0.0, NOISE, len(force))
        name = f"s{self.position:g}{trial}"
        return Record(self.specimen.name, name, self.position, displacement, force, columns)


def clean(press: Press) -> list[Record]:
    """From first touch on."""
    return [press.record(D, press.at(D))]


def air(press: Press) -> list[Record]:
    """0.6 mm before the touch, recorded too."""
    return [press.record(D, press.at(D - 0.6))]


def preload(press: Press) -> list[Record]:
    """Displacement zeroed where the force is 0.15 N."""
    fine = np.linspace(0.0, 2.0, 20001)
    return [press.record(D, press.at(D + np.interp(0.15, press.at(fine), fine)))]


def offset(press: Press) -> list[Record]:
    """Load cell 0.05 N off."""
    return [press.record(D, press.at(D) + 0.05)]


def slope(press: Press) -> list[Record]:
    """Baseline of -0.05 N/mm, with 1 mm before the touch, which shows it."""
    return [press.record(D, press.at(D - 1.0) - 0.05 * D)]


def slope_alone(press: Press) -> list[Record]:
    """Likewise without anything before the touch: nothing shows it."""
    return [press.record(D, press.at(D) - 0.05 * D)]


def clipped(press: Press) -> list[Record]:
    """Amplifier at its end from 65 % of the peak on, noise and all."""
    record = press.record(D, press.at(D))
    return [replace(record, force=np.minimum(record.force, 0.65 * press.at(D)[-1]))]


def breaking(press: Press) -> list[Record]:
    """Force falls by 30 % from one sample to the next, at 50 to 75 % of the way, and goes on."""
    broken = D > DEPTH * press.rng.uniform(0.5, 0.75)
    return [press.record(D, press.at(D) * np.where(broken, 0.7, 1.0))]


def drift(press: Press) -> list[Record]:
    """Load cell moves by 0.2 N, linearly in time, while the tool goes in and back out."""
    both = np.concatenate([D, D[::-1]])
    return [press.record(both, press.at(both) + np.linspace(0.0, 0.2, len(both)))]


def two(press: Press, column: str, values: tuple[float, float], factor: float) -> list[Record]:
    """Two trials, the second stiffer by the factor in all, and the column that goes with it."""
    return [
        press.record(D, press.at(D) * stiffer, f".{i + 1}", **{column: values[i]})
        for i, stiffer in enumerate((1.0, factor))
    ]


def stiffening(press: Press) -> float:
    """20 to 35 %, the same at all positions of a specimen."""
    return float(np.random.default_rng(int(press.specimen.name[1:])).uniform(1.2, 1.35))


def speeds(press: Press) -> list[Record]:
    """Trials at 0.1 and 10 mm/s, 20 to 35 % stiffer at the faster."""
    return two(press, "speed [mm/s]", (0.1, 10.0), stiffening(press))


def temperatures(press: Press) -> list[Record]:
    """Trials at 37 and 20 degrees Celsius, 20 to 35 % stiffer at the colder."""
    return two(press, "temperature [degC]", (37.0, 20.0), stiffening(press))


def softer(press: Press) -> list[Record]:
    """Three trials, the third 20 % softer."""
    return [press.record(D, press.at(D) * (0.8 if i == 3 else 1), f".{i}") for i in (1, 2, 3)]


def machine(press: Press) -> list[Record]:
    """Machine of 0.05 mm/N between what moves and the tool."""
    fine = np.linspace(0.0, DEPTH, 20001)
    return [press.record(D, np.interp(D, fine + 0.05 * press.at(fine), press.at(fine)))]


@dataclass(frozen=True)
class Situation:
    """How presses are recorded, and what names it (a regular expression, any case).

    Attributes:
        records: curves of one press.
        pattern: of a sentence of the output.
        page: of a sentence of docs/read_a_fit.md, where that has to have one.
        short: the tube is `SHORT`, and fitted as Table 1's.
        always: a sentence that clean records get as well names it, too.
    """

    records: Callable[[Press], list[Record]]
    pattern: str
    page: str = ""
    short: bool = False
    always: bool = False


SITUATIONS = {
    "clean": Situation(clean, r"(?!)"),
    "air": Situation(air, r"\bair\b|onset|first touch|before the touch|no force"),
    "preload": Situation(preload, r"preload|under load|already (loaded|in contact)|onset"),
    "offset": Situation(offset, r"offset|\bzero\b|load cell"),
    "slope": Situation(slope, r"slope|baseline"),
    "slope without air": Situation(slope_alone, r"slope|baseline", page=r"slope|baseline"),
    "clipped": Situation(clipped, r"\bflat|saturat|clip"),
    "break": Situation(breaking, r"\bfalls\b|break|broke|drops\b|\bslip|buckl"),
    "drift": Situation(drift, r"drift", page=r"\bdrift"),
    "two speeds": Situation(speeds, r"(differ|apart|softer|stiffer).*speed|speed.*(differ|apart)"),
    "two temperatures": Situation(
        temperatures, r"(differ|apart|softer|stiffer).*temperature|temperature.*(differ|apart)"
    ),
    "softer third trial": Situation(softer, r"trials.*(differ|apart)|softer|\bcycle"),
    "wrong tube": Situation(clean, r"\btube\b|table.1|rings from", short=True, always=True),
    "machine compliance": Situation(
        machine, r"compliance of the (machine|frame)|machine.?compliance",
        page=r"compliance of the (machine|frame)|machine.?compliance",
    ),
}  # fmt: skip


def make_specimens(count: int, seed: int, short: bool = False) -> list[Specimen]:
    """Specimens with random truths."""
    rng = np.random.default_rng(seed)
    tube, positions = (SHORT, SHORT_POSITIONS) if short else (presses.TABLE_1, POSITIONS)
    made = []
    for i in range(count):
        truth = {name: v * np.exp(SPREAD * rng.standard_normal()) for name, v in CENTRE.items()}
        chosen = positions[i % len(positions)]
        made.append(Specimen(f"T{i:04d}", truth | {"k_3": 0.0}, chosen, tube))
    return made


def measure(name: str, run: Run, specimens: list[Specimen]) -> dict:
    """Figures of one situation but for its sentences."""
    found = estimates(run, specimens)
    sure = [e for e in found if e.verdict == "identifiable"]
    known = [e for e in found if e.verdict in ("identifiable", "weak")]
    status = {row["specimen"]: row["status"] for row in run.tables.get("summary", ())}
    error = [abs(e.value / e.truth - 1) for e in sure if e.truth]
    signed = {
        p: [e.value / e.truth - 1 for e in found if e.parameter == p and np.isfinite(e.value)]
        for p in CENTRE
    }
    return {
        "kind": "row",
        "table": "situations",
        "case": name,
        "specimens": len(specimens),
        "unknowns": len(PARAMETERS) * len(specimens),
        "identifiable": len(sure),
        "identifiable_wrong": sum(e.missed for e in sure),
        "or_weak": len(known),
        "or_weak_wrong": sum(e.missed for e in known),
        "wrong_of": {p: sum(e.missed for e in known if e.parameter == p) for p in PARAMETERS},
        "error": float(np.median(error)) if error else None,
        "error_of": {p: float(np.median(v)) if v else None for p, v in signed.items()},
        "failing": sum(status.get(s.name) not in SOLVED for s in specimens),
        "exit_code": run.code,
        "seconds": round(run.seconds, 1),
    }


def line(row: dict) -> list[str]:
    """A row of the printed table."""
    error = "-" if row["error"] is None else f"{100 * row['error']:.2g} %"
    return [
        row["case"],
        percent(row["identifiable"], row["unknowns"]),
        f"{row['identifiable_wrong']} of {row['identifiable']} = "
        + percent(row["identifiable_wrong"], row["identifiable"]),
        f"{row['or_weak_wrong']} of {row['or_weak']} = "
        + percent(row["or_weak_wrong"], row["or_weak"]),
        error,
        percent(row["failing"], row["specimens"]),
        percent(row["named"], 1),
        {True: "yes", False: "no", None: ""}[row["page"]],
    ]


HEADER = ["situation", "identifiable", "wrong", "wrong, or weak", "error", "failing", "named",
          "page"]  # fmt: skip


def main() -> None:
    """Make, fit and measure the situations asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--package", type=Path, default=Path(__file__).parents[2])
    parser.add_argument("--label", default="", help="left out: nothing is written")
    parser.add_argument("--specimens", type=int, default=30)
    parser.add_argument("--only", default=",".join(SITUATIONS), help="names; clean runs always")
    parser.add_argument("--keep", type=Path, help="folder for data and output; a run there is read")
    asked = parser.parse_args()
    tried = make_specimens(3, 0) + make_specimens(3, 0, short=True)
    print(f"differs from the package by {presses.agree(asked.package, tried):.1e} of the peak")
    page = (asked.package / "docs" / "read_a_fit.md").read_text("utf-8")
    names = [name for name in SITUATIONS if name == "clean" or name in asked.only.split(",")]
    rows, common_kinds = [], set()
    with tempfile.TemporaryDirectory() as base:
        for name in names:
            situation = SITUATIONS[name]
            seed = list(SITUATIONS).index(name) + 1
            specimens = make_specimens(asked.specimens, seed, situation.short)
            rng = np.random.default_rng(seed + 1000)
            records = [
                record
                for specimen in specimens
                for position in specimen.positions
                for record in situation.records(Press(specimen, position, rng))
            ]
            folder = (asked.keep or Path(base)) / name.replace(" ", "_")
            run = presses.fit(asked.package, folder, records)
            common_kinds = common_kinds or usual(run)
            share, examples = named(
                run, situation.pattern, [s.name for s in specimens],
                () if situation.always else common_kinds,
            )  # fmt: skip
            row = measure(name, run, specimens) | {"named": share, "said": examples}
            has = re.search(situation.page, page, re.IGNORECASE) if situation.page else None
            row["page"] = bool(has) if situation.page else None
            rows.append(row)
            print(" | ".join(line(row)), f"({row['seconds']} s)", *examples, sep="\n    ")
    print(presses.markdown(HEADER, list(map(line, rows))))
    if asked.label:
        presses.keep("situations", asked.label, asked.package, rows)


if __name__ == "__main__":
    main()
