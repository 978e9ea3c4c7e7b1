"""Information criteria against closed forms of the linear normal case; which model data choose."""

import csv
import dataclasses
import json
from types import SimpleNamespace

import beam_fem
import jax
import numpy as np
import pytest
import scipy.stats
import synthetic
from run_cli import GOOD, run

from jaxtrachea.cli import compare
from jaxtrachea.cli.compare import _left_out_notes
from jaxtrachea.cli.fit import describe
from jaxtrachea.cli.load import load
from jaxtrachea.cli.options import FitOptions
from jaxtrachea.cli.terminal import Stop
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.criteria import penalised
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise, Weighting
from jaxtrachea.fitting.onset import where_sought
from jaxtrachea.fitting.parameters import DEFAULTS
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference import cross_validation
from jaxtrachea.inference.comparison import Model, Row, compared, same_data, sentence, weights
from jaxtrachea.inference.cross_validation import leave_one_out, without
from jaxtrachea.inference.repeats import Missed, leave_repeats_out, repeats
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.runs.manifest import as_dict
from jaxtrachea.status import FitStatus
from jaxtrachea.trachea.geometry import table_1
from jaxtrachea.trachea.material import Material

pytestmark = pytest.mark.long

DEPTH = np.linspace(0.1, 3.0, 20)
SIGMA = 0.05
TOTAL = Options(coupling="total", onset_width=0.0, contact="bonded")
HUBER = Weighting(loss="huber")
LINEAR = {"lower": -1e3, "scale": "linear", "scope": "specimen"}


def noisy(seed=0, specimens=3):
    """Two curves of each specimen: force k_1 depth + k_3 depth^3 + scatter."""
    rng = np.random.default_rng(seed)
    return [
        Curve(f"T{i}", trial, None, 0.0, DEPTH, 1.5 * DEPTH + 0.05 * DEPTH**3
              + SIGMA * rng.standard_normal(20))
        for i in range(specimens) for trial in "ab"
    ]  # fmt: skip


def linear_study(curves, fixed=(), **settings):
    """Force is linear in k_1, k_3 and the offset: least squares in closed form."""
    table = [
        dataclasses.replace(
            DEFAULTS[name], **LINEAR, value=0.0 if name in fixed else 1.0, fixed=name in fixed
        )
        for name in ("k_1", "k_3", "force_offset")
    ]
    onset = DEFAULTS["onset"]
    return build_study(curves, table_1(), TOTAL, [*table[:2], onset, table[2]], **settings)


def by_hand(curves, powers, sigma=None):
    """Deviance, k and n by the normal equations and scipy's normal density."""
    X = np.concatenate([np.stack([c.displacement**p for p in powers], 1) for c in curves])
    y = np.concatenate([c.force for c in curves])
    r = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    scale = np.sqrt(np.mean(r**2)) if sigma is None else sigma
    return -2 * scipy.stats.norm.logpdf(r, 0, scale).sum(), len(powers) + (sigma is None), len(y)


@pytest.mark.parametrize("sigma", [None, SIGMA])
def test_linear_case_in_closed_form(sigma):
    """Deviance, AIC, AICc and BIC of three unknowns; statsmodels counts sigma only in the first."""
    curves = noisy()
    noise = Noise(force=sigma)
    result = fit(linear_study(curves, noise=noise), Settings(starts=1))
    found = result.criteria
    for lane in range(3):
        d, k, n = by_hand(curves[2 * lane : 2 * lane + 2], (1, 3, 0), sigma)
        assert found.unknowns[lane] == k
        np.testing.assert_allclose(found.deviance[lane], d, rtol=1e-9)
        np.testing.assert_allclose(found.AIC[lane], d + 2 * k, rtol=1e-9)
        np.testing.assert_allclose(found.AICc[lane], d + 2 * k * n / (n - k - 1), rtol=1e-9)
        np.testing.assert_allclose(found.BIC[lane], d + k * np.log(n), rtol=1e-9)


@pytest.mark.slow
@pytest.mark.compiling
def test_robust_losses_have_no_likelihood():
    result = fit(linear_study(noisy(), weighting=HUBER), Settings(starts=1))
    assert np.isnan(result.criteria.AIC).all()


def test_few_samples_and_weights():
    made = penalised(np.array([10.0, 10.0]), np.array([2, 5]), np.array([10, 6]))
    np.testing.assert_allclose(made.AICc[0], 14 + 12 / 7, rtol=1e-15)
    assert made.AICc[1] == np.inf
    # Burnham and Anderson: exp(-delta / 2), normalised.
    np.testing.assert_allclose(
        weights(np.array([100.0, 102.0, 110.0, np.inf])),
        np.array([1, np.exp(-1), np.exp(-5), 0]) / (1 + np.exp(-1) + np.exp(-5)),
        rtol=1e-14,
    )
    assert np.isnan(weights(np.array([np.nan, np.inf]))).all()


def row(model, AICc, k=3, left=np.nan, fair=None, worth=40.0):
    fair = float(AICc) if fair is None else fair
    return Row(
        "T", model, k, 40, 1.0, 0.0, 0.0, float(AICc), 0.0, 0.0, 0.0, left, left, "", fair, worth
    )


@pytest.mark.parametrize(
    ("rows", "left", "says"),
    [
        ([row("A", 0.0), row("B", 1.5)], "trials", "cannot tell A from B"),
        ([row("A", 5.0), row("B", 0.0)], "", "prefer B (AICc 5.0 below A), but not decisively"),
        ([row("A", 0.0), row("B", 30.0)], "", "prefer A decisively (AICc 30.0 below B)"),
        (
            [row("A", 0.0, worth=9.1), row("B", 30.0, fair=5.0)],
            "",
            "not decisively: 40 correlated samples count as 9.1 independent ones, which leave 5 to",
        ),
        (
            [row("A", 0.0, worth=9.1), row("B", 45743.0, fair=120.0)],
            "",
            "decisively (AICc 45743.0 below B; 40 correlated samples count as 9.1 independent ones,"
            " which leave 120 to B)",
        ),
        (
            [row("A", 0, left=0.1), row("B", 30, left=0.2)],
            "trials",
            "it predicts trials left out best",
        ),
        (
            [row("A", 0, left=0.2), row("B", 30, left=0.1)],
            "positions",
            "B predicts positions left out better",
        ),
        (
            [row("A", 0, left=0.1, worth=9.1), row("B", 30, left=0.2, fair=5.0)],
            "positions",
            "positions left out agree with it",
        ),
        ([row("A", np.inf), row("B", np.inf)], "", "too few samples"),
    ],
)
def test_sentences(rows, left, says):
    assert says in sentence(rows, left)


@pytest.mark.slow
def test_deflated_difference_is_that_by_hand():
    """AR(1) noise of 0.8: deviances of the normal equations times n_eff / n, unknowns in full."""
    rng = np.random.default_rng(2)
    curves = []
    for i in range(3):
        for trial in "ab":
            noise = rng.standard_normal(20)
            for k in range(1, 20):
                noise[k] = 0.8 * noise[k - 1] + 0.6 * noise[k]
            force = 1.5 * DEPTH + 0.05 * DEPTH**3 + SIGMA * noise
            curves.append(Curve(f"T{i}", trial, None, 0.0, DEPTH, force))
    fits = [
        Model(name, fit(linear_study(curves, fixed=fixed), Settings(starts=1)), None)
        for name, fixed in (("cubic", ("force_offset",)), ("straight", ("k_3", "force_offset")))
    ]
    rows, failed = compared(fits)
    assert failed == 0
    for i in range(3):
        pair = curves[2 * i : 2 * i + 2]
        X, F = (
            np.tile(np.stack([DEPTH, DEPTH**3], 1), (2, 1)),
            np.concatenate([c.force for c in pair]),
        )
        e = (F - X @ np.linalg.lstsq(X, F, rcond=None)[0]).reshape(2, 20)
        r = 2 * np.sum(e[:, 1:] * e[:, :-1]) / np.sum(e[:, 1:] ** 2 + e[:, :-1] ** 2)
        share = (1 - max(r, 0)) / (1 + max(r, 0))
        worth = []
        for powers in ((1, 3), (1,)):
            d, k, n = by_hand(pair, powers)
            worth.append(d * share + 2 * k * n / (n - k - 1))
        cubic, straight = (row for row in rows if row.specimen == f"T{i}")
        assert cubic.AICc < straight.AICc
        np.testing.assert_allclose(straight.deflated, worth[1] - worth[0], rtol=1e-6)
        np.testing.assert_allclose(cubic.effective_samples, 40 * share, rtol=1e-6)
        assert straight.deflated < straight.delta


def test_other_data_or_noise_are_refused():
    curves = noisy()
    a = linear_study(curves)
    same_data([a, linear_study(curves, fixed=("k_3",))], "ab")
    for other, says in (
        (linear_study(curves[:-1]), "different samples"),
        (linear_study(noisy(1)), "different samples"),
        (linear_study(curves, noise=Noise(force=0.1)), "noise or curves"),
        (linear_study(curves, weighting=HUBER), "likelihood"),
    ):
        with pytest.raises(ValueError, match=says):
            same_data([a, other], "ab")
    given = [linear_study(curves, noise=Noise(force=s)) for s in (0.1, 0.2)]
    with pytest.raises(ValueError, match="noise or curves"):
        same_data(given, "ab")


@pytest.mark.slow
def test_leaving_a_position_out_is_a_fit_without_it():
    """Curves of both trials at a position go together; against least squares of the others."""
    rng = np.random.default_rng(3)
    curves = [
        Curve("T", f"{s}{t}", s, 0.0, DEPTH, 1.5 * DEPTH + 0.01 * s + 0.1 * rng.normal(size=20))
        for s in (30.0, 60.0, 90.0) for t in "ab"
    ]  # fmt: skip
    study = linear_study(curves, fixed=("k_3",))
    missed = []
    for s in (30.0, 60.0, 90.0):
        kept = [c for c in curves if c.s_c != s]
        X = np.concatenate([np.stack([c.displacement, 1 + 0 * DEPTH], 1) for c in kept])
        b = np.linalg.lstsq(X, np.concatenate([c.force for c in kept]), rcond=None)[0]
        missed += [b[0] * DEPTH + b[1] - c.force for c in curves if c.s_c == s]
    want = np.sqrt(np.mean(np.square(missed))) / max(np.abs(c.force).max() for c in curves)
    found = leave_repeats_out(fit(study, Settings(starts=1)), Settings(starts=1))
    np.testing.assert_allclose(found.error, [want], rtol=1e-6)
    assert repeats(study).words == "positions"
    each = [np.sqrt(np.mean(np.square(missed[i : i + 2]))) for i in (0, 2, 4)]
    place = (30, 60, 90)[int(np.argmax(each))]
    assert found.worst[0].place == f"s = {place} mm"
    np.testing.assert_allclose(
        found.worst[0].error / found.error[0] * want,
        max(each) / max(np.abs(c.force).max() for c in curves),
        rtol=1e-6,
    )


def test_ratio_of_a_curve_left_out_is_that_of_least_squares():
    """Measured force over that of the other curve's line, as a slope through the origin."""
    curves = noisy(specimens=1)
    study = linear_study(curves, fixed=("k_3",))
    found = leave_one_out(fit(study, Settings(starts=1)), Settings(starts=1))
    for row, (kept, out) in enumerate((curves[::-1], curves)):
        X = np.stack([DEPTH, 1 + 0 * DEPTH], 1)
        model = X @ np.linalg.lstsq(X, kept.force, rcond=None)[0]
        slope = np.linalg.lstsq(model[:, None], out.force, rcond=None)[0][0]
        np.testing.assert_allclose(found.ratio[row], slope - 1, rtol=1e-6)


def test_without_a_second_position_trials_are_left_out():
    """As `sklearn.model_selection.LeaveOneGroupOut`: each trial once, specimens by themselves."""
    study = linear_study(noisy(), fixed=("k_3",))
    plan = repeats(study)
    assert (plan.words, plan.lanes.tolist()) == ("trials", [0, 0, 1, 1, 2, 2])
    assert plan.held.tolist() == [[True, False], [False, True]] * 3
    found = leave_repeats_out(fit(study, Settings(starts=1)), Settings(starts=1))
    got = found.error
    for lane, (a, b) in enumerate(zip(noisy()[::2], noisy()[1::2], strict=True)):
        missed = []
        for kept, out in ((a, b), (b, a)):
            X = np.stack([kept.displacement, 1 + 0 * DEPTH], 1)
            missed.append(X @ np.linalg.lstsq(X, kept.force, rcond=None)[0] - out.force)
        peak = max(np.abs(c.force).max() for c in (a, b))
        np.testing.assert_allclose(got[lane], np.sqrt(np.mean(np.square(missed))) / peak, rtol=1e-6)
        each = np.sqrt(np.mean(np.square(missed), axis=1)) / peak
        np.testing.assert_allclose(found.worst[lane].error, each.max(), rtol=1e-6)
        assert found.worst[lane].place == (b, a)[int(np.argmax(each))].trial


def pressed_by_elements():
    """Six presses of a specimen, 1 % of noise: the law by hand, the beam by finite elements."""
    rng, depth = np.random.default_rng(7), np.linspace(0, 0.6, 21)
    force = 6 * depth + 0.05 * depth**3
    noise = 0.01 * force.max()
    curves = []
    for s in (12.0, 35.0, 40.0, 58.0, 95.0, 140.0):
        x = 10.0 * np.arange(1, 16)
        c = float(beam_fem.solve(x, 160.0, np.full(16, 1300.0), np.full(15, 0.2), s, 1.0).w_C)
        seen = force + noise * rng.normal(size=21)
        curves.append(Curve("A", f"s{s:.0f}", s, 0.0, depth + c * force, seen))
    return curves, noise


@pytest.mark.slow
def test_refits_end_in_the_minimum_of_the_whole_fit():
    """From the first guess alone the fit without s = 12 mm ends at k_1 = 1e6 N/mm, 36 % off."""
    curves, noise = pressed_by_elements()
    study, one = build_study(curves, table_1()), Settings(starts=1)
    whole = fit(study, one)
    alone = fit(without(study, np.arange(6)[None] == 0), dataclasses.replace(one, verify=False))
    assert alone.value[0, 2] > 1e4
    assert alone.rms[0, 0] > 10 * whole.rms[0, 0]
    left = leave_one_out(whole, one)
    peak = [np.max(np.abs(c.force)) for c in curves]
    assert np.all(left.force * peak < 3 * noise)
    assert leave_repeats_out(whole, one).error < 3 * noise / max(peak)


def test_a_refit_that_does_not_converge_counts_and_is_said(monkeypatch):
    """One of six stops short at its minimum: the numbers stay; one that is lost costs its lane."""
    study = linear_study(noisy(), fixed=("k_3",))
    want = leave_repeats_out(fit(study, Settings(starts=1)), Settings(starts=1))

    def spoilt(status, theta):
        def refit(*arguments, **options):
            found = fit(*arguments, **options)
            result = (found.status.copy(), found.theta.copy())
            result[0][1], result[1][1] = status, theta * result[1][1]
            return dataclasses.replace(found, status=result[0], theta=result[1])

        monkeypatch.setattr(cross_validation, "fit", refit)
        return leave_repeats_out(fit(study, Settings(starts=1)), Settings(starts=1))

    slow = spoilt(FitStatus.MAX_ITERATIONS, 1.0)
    np.testing.assert_allclose(slow.error, want.error, rtol=1e-12)
    assert (slow.refits.tolist(), slow.unconverged.tolist()) == ([2, 2, 2], [1, 0, 0])
    lost = spoilt(FitStatus.NON_FINITE, np.nan)
    assert np.isnan(lost.error).tolist() == [True, False, False]
    assert lost.lost.tolist() == [1, 0, 0]
    result = fit(study, Settings(starts=1))
    assert _left_out_notes([Model("A", result, want)]) == []
    for missed, says in ((slow, "1 of 6 refits did not"), (lost, "1 of 6 refits give no finite")):
        (note,) = _left_out_notes([Model("A", result, missed)])
        assert says in note
    rows, _ = compared([Model("A", result, lost), Model("B", result, slow)])
    assert np.isnan(rows[-2].left_out)
    assert np.isfinite(rows[-1].left_out)
    assert (np.isnan(rows[-2].worst), rows[-2].worst_place) == (True, "")
    _, name, worst = max((w.error, study.lane_name(k)[0], w) for k, w in enumerate(slow.worst))
    assert (rows[-1].worst, rows[-1].worst_place) == (worst.error, f"{name}, {worst.place}")


def test_why_nothing_was_left_out():
    """A stiffness of single curves; an onset of single curves is no reason."""
    for names, says in ((("k_1", "onset"), "A: k_1 belongs to"), (("onset",), "no specimen has")):
        free = [dataclasses.replace(DEFAULTS[n], fixed=False, scope="trial") for n in names]
        result = SimpleNamespace(study=SimpleNamespace(free=free, holdout_groups=()))
        none = Missed(np.full(1, np.nan), *np.zeros((3, 1), int))
        (note,) = _left_out_notes([SimpleNamespace(name="A", result=result, left_out=none)])
        assert says in note


def test_check_says_where_onset_and_offset_start():
    table = [dataclasses.replace(DEFAULTS[n], fixed=False) for n in ("onset", "force_offset")]
    options = Options(contact="unilateral")
    change, force = (where_sought(p, table, options) for p in table)
    assert change == ("change point of the curve", "from its samples")
    assert force == ("force before first touch", "-10000 … 10000")
    given = dataclasses.replace(table[0], value=0.5, lower=-1.0)
    assert where_sought(given, [given], options) == ("0.5", "-1 … 100")
    assert where_sought(table[0], table, TOTAL) == ("0", "-100 … 100")


def test_what_can_be_left_out_within_one_lane():
    """Of several specimens that share all: positions of one, trials of another, a third whole."""
    places = [("A", "1", 30.0), ("A", "2", 30.0), ("A", "3", 60.0), ("B", "1", 30.0),
              ("B", "2", 30.0), ("C", "1", 45.0)]  # fmt: skip
    curves = [Curve(who, t, s, 0.0, DEPTH, 1.5 * DEPTH) for who, t, s in places]

    def held(scope):
        table = [
            dataclasses.replace(DEFAULTS[n], **LINEAR | {"scope": scope}, fixed=n != "k_1")
            for n in ("k_1", "k_3", "onset", "force_offset")
        ]
        found = repeats(build_study(curves, table_1(), TOTAL, table))
        return found.words, [np.flatnonzero(row).tolist() for row in found.held]

    both = [[0, 1], [2], [3], [4]]
    assert held("shared") == ("positions and trials and specimens", [*both, [5]])
    assert held("specimen") == ("positions and trials", [[0, 1], [2], [0], [1]])
    assert held("trial") == ("", [])


SPEC = """title = "{title}"
[data]
files = "data.csv"
[model]
coupling = "total"
contact = "bonded"
[parameters]
{parameters}
[fit]
starts = 1
"""


@pytest.fixture
def two(tmp_path, monkeypatch):
    """The data of `noisy` with the model behind them and one that lacks the cubic term."""
    monkeypatch.chdir(tmp_path)
    lines = ["specimen,trial,displacement [mm],force [N]"]
    for c in noisy():
        pairs = zip(c.displacement.tolist(), c.force.tolist(), strict=True)
        lines += [f"{c.specimen},{c.trial},{d!r},{f!r}" for d, f in pairs]
    (tmp_path / "data.csv").write_text("\n".join(lines) + "\n")
    for title, parameters in (("cubic", ""), ("straight", "k_3 = { fixed = 0 }")):
        text = SPEC.format(title=title, parameters=parameters)
        (tmp_path / f"{title}.toml").write_text(text)
    return tmp_path


def test_command_chooses_the_model_behind_the_data(two, monkeypatch, capsys):
    code, out, _ = run(monkeypatch, capsys, "compare", "straight.toml", "cubic.toml", "--out", "o")
    assert code == 0
    assert "(all): the data prefer cubic decisively" in " ".join(out.split())
    assert "it predicts trials left out best" in " ".join(out.split())
    assert {p.name for p in (two / "o").iterdir()} == {
        "compare.csv",
        "report.md",
        "provenance.json",
    }
    with (two / "o" / "compare.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(r["specimen"], r["model"]) for r in rows[-2:]] == [
        ("(all)", "straight"),
        ("(all)", "cubic"),
    ]
    curves = noisy()
    for i in range(3):
        for at, powers in ((2 * i, (1,)), (2 * i + 1, (1, 3))):
            d, k, n = by_hand(curves[2 * i : 2 * i + 2], powers)
            np.testing.assert_allclose(
                float(rows[at]["AICc"]), d + 2 * k * n / (n - k - 1), rtol=1e-6
            )
            np.testing.assert_allclose(float(rows[at]["BIC"]), d + k * np.log(n), rtol=1e-6)
    total = sum(float(rows[2 * i + 1]["AICc"]) for i in range(3))
    np.testing.assert_allclose(float(rows[-1]["AICc"]), total, rtol=1e-12)
    assert float(rows[-1]["weight"]) > 0.99
    assert f"({rows[-1]['worst_place']})" in (two / "o" / "report.md").read_text()
    made = json.loads((two / "o" / "provenance.json").read_text())
    assert [s["model"] for s in made["specifications"]] == ["straight", "cubic"]
    assert list(made["inputs"]) == ["data.csv"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["cubic.toml"], "two or more"),
        (["cubic.toml", "cubic.toml"], "the same specification"),
        (["cubic.toml", "other.toml"], "other.toml: data.files: other content"),
        (["cubic.toml", "given.toml"], "same [noise]"),
        (["cubic.toml", "window.toml"], "same [data] section"),
        (["cubic.toml", "robust.toml"], "use 'linear'"),
        (["cubic.toml", "straight.toml", "--leave-out", "holds"], "no curve is a whole record"),
        (["cubic.toml", "straight.toml", "--leave-out", "speeds"], "curves of two speeds with"),
    ],
)
def test_what_cannot_be_compared(arguments, says, two, monkeypatch, capsys):
    text = SPEC.format(title="x", parameters="")
    (two / "more.csv").write_text((two / "data.csv").read_text() + "\n")
    (two / "other.toml").write_text(text.replace("data.csv", "more.csv"))
    (two / "given.toml").write_text(text + '[noise]\nforce = "0.1 N"\n')
    (two / "window.toml").write_text(
        text.replace('"data.csv"', '"data.csv"\ndisplacement_max = "2 mm"')
    )
    (two / "robust.toml").write_text(text + 'loss = "huber"\n')
    code, out, err = run(monkeypatch, capsys, "compare", *arguments)
    assert (code, out) == (2, "")
    assert says in err
    assert err.count("\n") == 1
    assert not (two / "out").exists()


@pytest.mark.slow
@pytest.mark.compiling
def test_simulated_data_choose_the_beam_they_came_from():
    """Ten specimens of four positions, 0.3 % noise: Bernoulli-Euler or shear, told by the sum."""
    shear = True
    rng = np.random.default_rng(4)
    options = [Options(shear=s, onset_width=0.0) for s in (False, True)]
    truth = synthetic.draw(9, 10, 1.2, np.array([300.0, 1.0, 0.5, 0.2]))
    GA_L = 1.0

    def one(t, s, d):
        material = Material(*t, GA_L=jax.numpy.asarray(GA_L))
        return press(synthetic.GEOMETRY, material, s, d, options[shear]).force

    curve = jax.jit(jax.vmap(jax.vmap(one, (None, 0, None)), (0, None, None)))
    force = np.array(curve(truth, synthetic.S_C, synthetic.DEPTHS))
    force += 0.003 * force.max((1, 2), keepdims=True) * rng.standard_normal(force.shape)
    AICc = [
        np.sum(
            fit(
                build_study(
                    synthetic.curves(force), synthetic.GEOMETRY, o, synthetic.parameters(o)
                ),
                Settings(starts=2),
            ).criteria.AICc
        )
        for o in options
    ]
    assert AICc[shear] + 10 < AICc[not shear]


def test_notes_are_said_of_every_model_and_curves_named_once(tmp_path, monkeypatch, capsys):
    """What is true of the second model alone is told, though the first was silent about it."""
    bad = "".join(f"T02,1,35,{d},{f}\n" for d, f in ((0, 0), (1, "x"), (1.5, 2)))
    (tmp_path / "data.csv").write_text(GOOD + bad)
    for title, contact in (("sections", '\ncontact = "bonded"'), ("linear", "")):
        (tmp_path / f"{title}.toml").write_text(
            f'title = "{title}"\n[data]\nfiles = "data.csv"\n[trachea]\nradius = "11.7 mm"\n'
            f'[model]\nskeleton = "{title}"{contact}\n[fit]\nbatch = 64\n'
        )

    def stop(specs, titles):
        raise Stop("far enough")

    monkeypatch.setattr(compare, "_names", stop)
    monkeypatch.chdir(tmp_path)
    code, _, err = run(monkeypatch, capsys, "compare", "sections.toml", "linear.toml")
    said = " ".join(err.split())
    assert (code, "far enough" in said) == (2, True)
    assert said.count("skeleton = 'linear' was tested to 1.17 mm") == 1
    assert said.count("not usable: T02 1:") == 1
    # Sections take one lane at a time on a CPU, whatever was asked for.
    alone = jax.default_backend() == "cpu"
    assert said.count("fit.batch = 64 is not used: sections take one lane at a time") == alone
    _, _, err = run(monkeypatch, capsys, "check", "linear.toml")
    assert "fit.batch" not in err


def test_the_batch_that_is_recorded_is_the_one_used(tmp_path):
    (tmp_path / "data.csv").write_text(GOOD)
    alone = 1 if jax.default_backend() == "cpu" else 64
    for skeleton, batch in (("linear", 64), ("sections", alone)):
        path = tmp_path / f"{skeleton}.toml"
        path.write_text(
            f'[data]\nfiles = "data.csv"\n[model]\nskeleton = "{skeleton}"\ncontact = "bonded"\n'
            "[fit]\nbatch = 64\n"
        )
        options = FitOptions(spec=path)
        now = describe(options, *load(path, None), analyses=[], devices=[])
        assert as_dict(now)["chunk"] == batch
