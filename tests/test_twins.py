"""Trials left out together: against least squares without all of them; what cannot be asked."""

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest
from run_cli import run

from jaxtrachea._errors import InputError
from jaxtrachea.config import load_fit_spec
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.parameters import DEFAULTS
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.cross_validation import curves_to_leave_out, leave_one_out
from jaxtrachea.inference.holdout_groups import companions, holdout_sentence, with_holdout_groups
from jaxtrachea.inference.repeats import leave_repeats_out, repeats
from jaxtrachea.measurements.read import BadCurve, Curve, read_measurements
from jaxtrachea.mechanics.press import Options
from jaxtrachea.trachea.geometry import table_1

DEPTH = np.linspace(0.1, 3.0, 20)
TOTAL = Options(coupling="total", onset_width=0.0, contact="bonded")
#: Presses of a tube of 120 mm: the third mirrors the first, and has its curve.
PLACES = (30.0, 60.0, 90.0, 40.0)
TWINS = [["s30", "s90"]]
FITS = Path(__file__).parents[1] / "fits" / "virtual_trachea"


def presses(specimens=("A", "B")):
    rng = np.random.default_rng(5)
    out = []
    for who in specimens:
        force = [(1 + 0.2 * rng.random()) * DEPTH + 0.1 * rng.normal(size=20) for _ in PLACES]
        force[2] = force[0] + 1e-3 * rng.normal(size=20)
        out += [
            Curve(who, f"s{s:.0f}", s, 0.0, DEPTH, f) for s, f in zip(PLACES, force, strict=True)
        ]
    return out


def study_of(curves, groups=TWINS, **scopes):
    """Force k_1 depth + offset at any place: least squares in closed form."""
    linear = {"lower": -1e3, "scale": "linear", "scope": "specimen"}
    table = [
        dataclasses.replace(DEFAULTS[n], **linear, value=float(n == "k_1"), fixed=n == "k_3")
        for n in ("k_1", "k_3", "onset", "force_offset")
    ]
    table[2] = DEFAULTS["onset"]
    table = [dataclasses.replace(p, scope=scopes.get(p.name, p.scope)) for p in table]
    study = build_study(curves, table_1(), TOTAL, table)
    return study if groups is None else with_holdout_groups(study, groups)


def missed_by_hand(curves, groups):
    """For each curve what a straight line through those outside its group misses of it."""
    out = []
    for curve in curves:
        away = next((g for g in groups if curve.trial in g), [curve.trial])
        kept = [c for c in curves if c.specimen == curve.specimen and c.trial not in away]
        X = np.concatenate([np.stack([c.displacement, 1 + 0 * DEPTH], 1) for c in kept])
        b = np.linalg.lstsq(X, np.concatenate([c.force for c in kept]), rcond=None)[0]
        out.append(b[0] * DEPTH + b[1] - curve.force)
    return np.array(out)


def by_specimen(missed, curves):
    force = np.array([c.force for c in curves]).reshape(2, -1)
    squares = np.mean(np.square(missed.reshape(2, -1)), axis=1)
    return np.sqrt(squares) / np.max(np.abs(force), axis=1)


def test_twins_are_left_out_together():
    """Neither sees its own curve through the other; one at a time they flatter the model."""
    curves = presses()
    study = study_of(curves)
    assert [np.flatnonzero(row).tolist() for row in repeats(study).held] == [[0, 2], [1], [3]] * 2
    want = by_specimen(missed_by_hand(curves, TWINS), curves)
    got = leave_repeats_out(fit(study, Settings(starts=1)), Settings(starts=1)).error
    np.testing.assert_allclose(got, want, rtol=1e-6)
    alone = by_specimen(missed_by_hand(curves, []), curves)
    study = study_of(curves, None)
    plain = leave_repeats_out(fit(study, Settings(starts=1)), Settings(starts=1)).error
    np.testing.assert_allclose(plain, alone, rtol=1e-6)
    assert np.all(np.abs(want - alone) > 0.01 * alone)


def test_one_curve_left_out_takes_its_twins_along():
    curves = presses()
    left = leave_one_out(fit(study_of(curves), Settings(starts=1)), Settings(starts=1))
    assert left.trial.tolist() == [0, 1, 2, 3] * 2
    missed = missed_by_hand(curves, TWINS)
    peak = [np.max(np.abs(c.force)) for c in curves]
    np.testing.assert_allclose(left.force, np.sqrt(np.mean(missed**2, axis=1)) / peak, rtol=1e-6)
    assert holdout_sentence(left.study.holdout_groups) == ["Left out together: s30, s90"]


def test_groups_merge_positions_and_repeats():
    """Repeats of a position go along; specimens never do; groups may chain through a position."""
    rows = [("A", "1", 30.0), ("A", "2", 30.0), ("A", "3", 60.0), ("A", "4", 90.0),
            ("A", "5", 45.0), ("B", "1", 30.0), ("B", "4", 90.0)]  # fmt: skip
    curves = [Curve(who, t, s, 0.0, DEPTH, 1.5 * DEPTH) for who, t, s in rows]

    def held(groups, among=curves, **scopes):
        found = repeats(study_of(among, groups, **scopes))
        return found.words, [np.flatnonzero(row).tolist() for row in found.held]

    assert held([["1", "4"]]) == ("positions", [[0, 1, 3], [2], [4]])
    assert held([["1", "4"], ["2", "5"]]) == ("positions", [[0, 1, 3, 4], [2]])
    both = {"k_1": "shared", "force_offset": "shared"}
    shared = [[0, 1, 3], [2], [4], [5, 6]]
    assert held([["1", "4"]], **both) == ("positions and specimens", shared)
    # Trials of a single place; and a place whose trials are all of one group tells nothing.
    three = [Curve("A", t, 30.0, 0.0, DEPTH, 1.5 * DEPTH) for t in "123"]
    assert held([["1", "3"]], three) == ("trials", [[0, 2], [1]])
    assert held([["1", "2", "3"]], three) == ("", [])
    assert companions(curves, [["1", "4"]])[:2] == [[0, 3], [1]]
    with pytest.raises(ValueError, match="not all left out together"):
        curves_to_leave_out(study_of(three, [["1", "2", "3"]]))


@pytest.mark.parametrize(
    ("groups", "says"),
    [
        ([["s30", "s91"]], "0: no curve has the trial 's91'; expected one of 's30', 's40'"),
        ([["s30", "s90"], ["s60", "s90"]], "1: trial 's90' stands in group 0, too; name each"),
        ([["s30", "s30"]], "0: trial 's30' stands twice"),
    ],
)
def test_groups_that_cannot_be(groups, says):
    with pytest.raises(InputError) as error:
        study_of(presses(), groups)
    assert str(error.value).startswith(says)


def test_a_group_across_specimens_and_a_bad_curve():
    curves = presses(("A",)) + [Curve("B", "mine", 30.0, 0.0, DEPTH, DEPTH)]
    with pytest.raises(InputError, match="0: no specimen has two of 's30', 'mine'"):
        study_of(curves, [["s30", "mine"]])
    # What is known but cannot be used is no mistake of the specification.
    bad = BadCurve("A", "s90", "x.csv", "position", "", "")
    few = [c for c in curves if c.trial != "s90"]
    study = with_holdout_groups(study_of(few, None), TWINS, [bad])
    assert [np.flatnonzero(row).tolist() for row in repeats(study).held] == [[0], [1], [2]]


SPEC = """title = "{title}"
[data]
files = "data.csv"
{together}
[model]
coupling = "total"
contact = "bonded"
[parameters]
k_3 = {{ fixed = 0 }}
{more}
[fit]
starts = 1
"""
WITH = 'together = [["s30", "s90"]]'


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = ["specimen,trial,s [mm],displacement [mm],force [N]"]
    for c in presses():
        pairs = zip(c.displacement.tolist(), c.force.tolist(), strict=True)
        lines += [f"{c.specimen},{c.trial},{c.s_c},{d!r},{f!r}" for d, f in pairs]
    (tmp_path / "data.csv").write_text("\n".join(lines) + "\n")
    free = 'force_offset = { scope = "specimen" }'
    for name, together, more in (
        ("line", WITH, free),
        ("through", WITH, ""),
        ("alone", "", ""),
        ("unknown", 'together = [["s30", "s91"]]', ""),
        ("two", 'together = [["s30", "s90"], ["s90", "s60"]]', ""),
        ("one", 'together = [["s30"]]', ""),
    ):
        text = SPEC.format(title=name, together=together, more=more)
        (tmp_path / f"{name}.toml").write_text(text)
    return tmp_path


def rows_of(path):
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.mark.slow
@pytest.mark.compiling
def test_commands_leave_twins_out_together(folder, monkeypatch, capsys):
    code, *_ = run(monkeypatch, capsys, "compare", "line.toml", "through.toml", "--out", "o")
    assert code == 0
    curves = presses()
    found = {
        (r["specimen"], r["model"]): float(r["left_out"])
        for r in rows_of(folder / "o" / "compare.csv")
    }
    want = by_specimen(missed_by_hand(curves, TWINS), curves)
    np.testing.assert_allclose([found["A", "line"], found["B", "line"]], want, rtol=1e-5)
    assert "Left out together: s30, s90." in (folder / "o" / "report.md").read_text()
    code, *_ = run(monkeypatch, capsys, "fit", "line.toml", "--leave-one-out", "--out", "f")
    assert code == 0
    missed = missed_by_hand(curves, TWINS)
    peak = [np.max(np.abs(c.force)) for c in curves]
    got = [float(r["rms_over_peak"]) for r in rows_of(folder / "f" / "left_out.csv")]
    np.testing.assert_allclose(got, np.sqrt(np.mean(missed**2, axis=1)) / peak, rtol=1e-5)
    assert "Left out together: s30, s90." in (folder / "f" / "report.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["compare", "line.toml", "alone.toml"], "give both the same data.together"),
        (["compare", "unknown.toml", "through.toml"], "unknown.toml: data.together.0: no curve"),
        (["fit", "two.toml", "--leave-one-out"], "two.toml: data.together.1: trial 's90' stands"),
        (["fit", "one.toml"], "one.toml: data.together.0: "),
    ],
)
def test_commands_refuse_groups_that_cannot_be(arguments, says, folder, monkeypatch, capsys):
    code, out, err = run(monkeypatch, capsys, *arguments)
    assert (code, out) == (2, "")
    assert says in err
    assert not (folder / "out").exists()


@pytest.mark.parametrize("name", ["linear", "softening", "sections"])
def test_shipped_twins_are_mirror_images(name):
    """At s and 160 mm - s of a tube of 160 mm, rings symmetric, with equal curves; no other two."""
    spec = load_fit_spec(FITS / f"compare_{name}.toml")
    curves = {c.trial: c for c in read_measurements([FITS / spec.data.files[0]]).curves}
    pairs = {
        tuple(sorted((a.trial, b.trial)))
        for a in curves.values() for b in curves.values()
        if a is not b and abs(a.s_c + b.s_c - 160) < 1e-9
    }  # fmt: skip
    assert pairs == {tuple(group) for group in spec.data.together or ()}
    for a, b in pairs:
        scale = np.max(np.abs(curves[a].force))
        np.testing.assert_allclose(curves[a].force, curves[b].force, atol=1e-9 * scale)
