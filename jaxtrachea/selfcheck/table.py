"""The table of hard cases: what is hard, the inputs, the truth, and how close is close enough.

`cases.toml` is written by hand. `truth.json` holds values and first derivatives with 25 digits,
from models in high precision that share nothing with this package
(tests/reference/hard_cases_truth.py), together with the inputs that it was made for.
"""

import dataclasses
import json
import re
import tomllib
from importlib.resources import files

import numpy as np

from jaxtrachea import status as _status

DTYPES = ("float64", "float32")
#: Roundings allowed to every value, and to every derivative: chosen, not derived; a reverse
#: gradient takes up to four times the operations of its value (Griewank and Walther, "Evaluating
#: Derivatives", 2008, doi:10.1137/1.9780898717761). An error is at most this many epsilon times the
#: size of the truth and of what the truth moves when every input is moved by the fraction 1 (to
#: first order): eps (|y| + sum |x dy/dx|).
ROUNDINGS = {"value": 8.0, "gradient": 32.0}
CASES, TRUTH = (files("jaxtrachea.selfcheck") / name for name in ("cases.toml", "truth.json"))
_ENTRY = re.compile(r"(\w+)\[(\d+)\]")


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """Largest error allowed, in roundings of what the case itself moves (see `ROUNDINGS`).

    Attributes:
        value: of values.
        gradient: of derivatives.
        why: why it is not `ROUNDINGS`, or "".
    """

    value: float = ROUNDINGS["value"]
    gradient: float = ROUNDINGS["gradient"]
    why: str = ""


@dataclasses.dataclass(frozen=True)
class Case:
    """One row.

    Attributes:
        name: unique.
        function: of `functions.FUNCTIONS`.
        hard: what is hard about it.
        inputs: name to float or nested list, numbers that float32 holds exactly unless `only`.
        healthy: inputs of a neighbour in a batch, which must not be harmed.
        tolerance: by dtype.
        status: what the function must report, a member's name of `enumeration`.
        answer: whether the model has an answer; if not, there is no truth.
        entrywise: errors are relative to each entry, not to the largest of the array.
        only: the only dtype that can hold the inputs or the answer, or None.
        constant: inputs that are not differentiated.
        free: inputs ("s") or pairs ("u by s") whose derivative is not unique: finite, no more.
        natural: inputs whose derivatives are seen against y/x where they are far below it: what no
            longer depends on an input is known to rounding of y, not to its own.
        scale: least size that an error is seen against, of an output ("u") or of a derivative
            ("u by s"), where the truth is 0 or next to it.
        scale_why: where these sizes come from.
        one_sided: input to +1 or -1 where the model lives on one side only (for the truth).
        spans: inputs that are positions on one line, and enter by their differences.
        angles: inputs that enter by directions, known to rounding of 1 rad.
    """

    name: str
    function: str
    hard: str
    inputs: dict
    healthy: dict
    tolerance: dict[str, Tolerance]
    status: str = "OK"
    enumeration: str = "PressStatus"
    answer: bool = True
    entrywise: bool = False
    only: str | None = None
    constant: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    natural: tuple[str, ...] = ()
    scale: dict[str, float] = dataclasses.field(default_factory=dict)
    scale_why: str = ""
    one_sided: dict[str, int] = dataclasses.field(default_factory=dict)
    spans: tuple[str, ...] = ()
    angles: tuple[str, ...] = ()

    @property
    def code(self) -> int:
        """The status as a number."""
        return int(getattr(_status, self.enumeration)[self.status])

    @property
    def dtypes(self) -> tuple[str, ...]:
        """The dtypes the case is run in."""
        return DTYPES if self.only is None else (self.only,)


@dataclasses.dataclass(frozen=True)
class Truth:
    """Values by output; derivatives by output, then input: shape (*output, *input).

    Attributes:
        inputs: what it was made for.
        value: by output.
        gradient: by output, then input.
        spread: how far a value moves when each input in turn is moved by the same fraction, over
            that fraction, added: largest entry of the array, or all, flat, in `entrywise` cases.
        gradient_spread: likewise of derivatives.
    """

    inputs: dict
    value: dict[str, np.ndarray]
    gradient: dict[str, dict[str, np.ndarray]]
    spread: dict[str, np.ndarray]
    gradient_spread: dict[str, dict[str, np.ndarray]]


def read_cases() -> list[Case]:
    """Every row of cases.toml, in its order."""
    given = tomllib.loads(CASES.read_text("utf-8"))
    return [
        _case(function, group, row) for function, group in given.items() for row in group["case"]
    ]


def _case(function: str, group: dict, row: dict) -> Case:
    row, base = dict(row), group["base"]
    kept = {n: row.pop(n) for n in ("name", "hard")}
    optional = ("status", "answer", "entrywise", "only", "one_sided", "free", "scale", "natural")
    more = {n: row.pop(n) for n in optional if n in row}
    more |= {n: group[n] for n in ("constant", "enumeration", "spans", "angles") if n in group}
    more |= {
        n: tuple(more[n]) for n in ("constant", "free", "spans", "angles", "natural") if n in more
    }
    scale = dict(more.get("scale", {}))
    more["scale_why"] = scale.pop("why", "")
    more["scale"] = {n: float(v) for n, v in scale.items()}
    said = row.pop("exception", group.get("exception"))
    tolerance = {d: _tolerance(said, d) for d in DTYPES}
    rounded = "float64" if more.get("only") == "float64" else "float32"

    def round_(v):
        return np.asarray(v, rounded).astype(float).tolist()

    inputs = {n: round_(v) for n, v in _changed(base, row).items()}
    healthy = {n: round_(v) for n, v in base.items()}
    return Case(
        **kept, function=function, inputs=inputs, healthy=healthy, tolerance=tolerance, **more
    )


def _changed(base: dict, changes: dict) -> dict:
    """`base` with changes: a number fills an array, `"k[3]"` is one entry."""
    made = {n: np.array(v, float) for n, v in base.items()}
    for name, value in changes.items():
        entry = _ENTRY.fullmatch(name)
        if entry:
            made[entry[1]][int(entry[2])] = value
        else:
            made[name][...] = value
    return made


def _tolerance(said: dict | None, dtype: str) -> Tolerance:
    """An exception: `value = 8` for both dtypes, or `value_float32 = 40` for one."""
    if said is None:
        return Tolerance()

    def usual(name):
        return said.get(name, ROUNDINGS[name])

    def pick(name):
        return float(said.get(f"{name}_{dtype}", usual(name)))

    return Tolerance(pick("value"), pick("gradient"), said["why"])


def read_truth() -> dict[str, Truth]:
    """The truth of every case that has an answer, by its name."""
    given = json.loads(TRUTH.read_text("utf-8"))

    def array(v):
        return np.asarray(v, dtype=float)

    return {
        name: Truth(
            row["inputs"],
            {o: array(v) for o, v in row["value"].items()},
            {o: {i: array(v) for i, v in by.items()} for o, by in row["gradient"].items()},
            {o: array(v) for o, v in row["spread"]["value"].items()},
            {
                o: {i: array(v) for i, v in by.items()}
                for o, by in row["spread"]["gradient"].items()
            },
        )
        for name, row in given["cases"].items()
    }
