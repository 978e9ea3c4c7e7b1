"""Design against repeated simulated experiments, closed forms and exhaustive search."""

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import synthetic
from run_cli import run, tree

from jaxtrachea.cli.run import refuse
from jaxtrachea.config import FitSpec, SpecError, load_fit_spec
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lanes import Noise, Weighting
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.analyses import left_out
from jaxtrachea.inference.analysis import Request
from jaxtrachea.inference.design.candidates import (
    Candidates,
    candidates_of,
    extrapolation,
    grid,
    pressed_curves,
    pressed_specimen,
)
from jaxtrachea.inference.design.choice import gains, next_points, scores
from jaxtrachea.inference.design.identifiability import identifiability
from jaxtrachea.inference.design.situation import situation
from jaxtrachea.measurements.read import Curve
from jaxtrachea.status import FitStatus

pytestmark = pytest.mark.long

#: No one reads verdicts here.
ONE = Settings(starts=1, verify=False)
CLEAR = np.array([300.0, 1.0, 0.5, 0.2])
BEFORE = np.array([22.0, 75.0, 80.0])
SIGMA = 0.05


def make_study(force, s_c):
    changes = {n: {"value": float(v)} for n, v in zip(synthetic.NAMES, CLEAR, strict=True)}
    return build_study(
        synthetic.curves(force, s_c=s_c),
        synthetic.GEOMETRY,
        synthetic.OPTIONS,
        synthetic.parameters(**changes),
        noise=Noise(force=SIGMA),
    )


def simulated(s_c, count, seed):
    force, _ = synthetic.forces(CLEAR[None], s_c=s_c)
    noise = np.random.default_rng(seed).normal(size=(count, *force.shape[1:]))
    return force + SIGMA * noise


@pytest.fixture(scope="module")
def result():
    return fit(make_study(simulated(BEFORE, 4, 1), BEFORE), ONE)


@pytest.fixture(scope="module")
def known(result):
    return situation(result)


@pytest.mark.slow
@pytest.mark.compiling
def test_predicted_errors_come_true(known):
    """1,000 repetitions with the chosen point: standard deviation within 20 % of the prediction."""
    depth = float(synthetic.DEPTHS[-1])
    choice = next_points(known, grid((10.0, 150.0), (depth, depth), 500))
    s = grid((10.0, 150.0), (depth, depth), 500).s[choice.chosen[0]]
    after = np.append(BEFORE, s)
    done = fit(make_study(simulated(after, 1000, 2), after), ONE)
    realised = np.std(done.theta, axis=0)
    np.testing.assert_allclose(choice.error[1], realised, rtol=0.2)
    # And the point was worth it: the error without it is larger than what was realised.
    without = fit(make_study(simulated(BEFORE, 1000, 3), BEFORE), ONE)
    assert np.exp(np.mean(np.log(realised / np.std(without.theta, axis=0)))) < 0.9


@pytest.mark.slow
@pytest.mark.compiling
def test_information_of_a_candidate_is_that_of_finite_differences(known):
    """At s = 51 mm to 4 mm: central differences of `press`, with the noise of the study."""
    theta, h = known.theta[0], 1e-5
    displacement = 4.0 * np.arange(1, 51) / 50

    def press(theta):
        return synthetic.forces(np.exp(theta)[None], np.array([51.0]), displacement)[0][0, 0]

    J = np.stack([(press(theta + h * e) - press(theta - h * e)) / (2 * h) for e in np.eye(4)])
    found = gains(known, Candidates(np.array([51.0]), np.array([4.0])))[0, 0]
    np.testing.assert_allclose(found, J @ J.T / SIGMA**2, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.compiling
def test_criteria_are_their_definitions_and_greedy_takes_the_best(known):
    candidates = grid((10.0, 150.0), (2.0, 6.0), 300)
    added = gains(known, candidates)
    # Curves weigh the same and the noise is given: the information alone.
    total = known.base[:, None] + added
    by_d = np.mean(np.log(np.linalg.det(total)), axis=0)
    np.testing.assert_allclose(scores(total, total, "D"), by_d, rtol=1e-9)
    trace = np.trace(np.linalg.inv(total), axis1=-2, axis2=-1) / 4
    by_a = -np.log(np.mean(trace, axis=0))
    np.testing.assert_allclose(scores(total, total, "A"), by_a, rtol=1e-9)
    smallest = np.linalg.eigvalsh(total)[..., 0]
    by_e = np.mean(np.log(smallest), axis=0)
    np.testing.assert_allclose(scores(total, total, "E"), by_e, rtol=1e-6)
    for criterion in ("D", "A", "E"):
        choice = next_points(known, candidates, 3, criterion)
        base = known.base
        for step, best in enumerate(choice.chosen):
            each = scores(base[:, None] + added, base[:, None] + added, criterion)
            np.testing.assert_allclose(choice.score[step], each, rtol=1e-6)
            assert each[best] >= each.max() - 1e-6
            base = base + added[:, best]
        assert np.all(np.diff(choice.error, axis=0) < 0)
    # Deeper is never worse: samples of a deeper press say more of every unknown.
    assert candidates.depth[next_points(known, candidates).chosen[0]] == 6.0


def test_map_knows_that_one_place_is_not_enough(known):
    """The same place twice leaves EI_L and k_M apart by rounding only; two places do not."""
    s = np.linspace(15.0, 145.0, 27)
    found = identifiability(known, s, 6.0)
    assert np.all(np.diag(found.pairs) > 1e5)
    assert found.pairs.min() < 1e3
    np.testing.assert_allclose(found.pairs, found.pairs.T, rtol=1e-6)
    assert np.all(found.condition >= 1)
    np.testing.assert_allclose(np.linalg.norm(found.weakest, axis=1), 1)


UNEQUAL = (15, 120, 15, 60)


def unequal_study(theta, *, more=(), noise=None, weighting=Weighting()):  # noqa: B008
    """Curves of so many samples at the standard places, and those of `more`: (s, depth, samples).

    Of the model itself, or with normal noise by a generator.
    """
    presses = [(s, 6.0, n) for s, n in zip(synthetic.S_C, UNEQUAL, strict=True)] + list(more)
    curves = []
    for j, (s, depth, n) in enumerate(presses):
        D = depth * np.arange(1, n + 1) / n
        force = pressed(theta, s, D)
        if noise is not None:
            force = force + SIGMA * noise.normal(size=n)
        curves.append(Curve("T", f"t{j}", float(s), 0.0, D, force))
    changes = {n: {"value": float(v)} for n, v in zip(synthetic.NAMES, CLEAR, strict=True)}
    return build_study(
        curves, synthetic.GEOMETRY, synthetic.OPTIONS, synthetic.parameters(**changes),
        noise=Noise(force=SIGMA if noise is None else None), weighting=weighting,
    )  # fmt: skip


def pressed(theta, s, displacement):
    """Force of a press; theta: logarithms."""
    return synthetic.forces(np.exp(theta)[None], np.array([s]), displacement)[0][0, 0]


def sandwich_errors(theta, presses, balance):
    """Standard errors by numpy: central differences of `press`, weights of whole curves."""
    h, grams = 1e-5, []
    for s, depth, n in presses:
        D = depth * np.arange(1, n + 1) / n
        step = h * np.eye(4)
        J = np.stack([(pressed(theta + e, s, D) - pressed(theta - e, s, D)) / (2 * h)
                      for e in step])  # fmt: skip
        grams.append(J @ J.T / SIGMA**2)
    samples = np.array([n for _, _, n in presses])
    square = np.mean(samples) / samples if balance == "curve" else np.ones(len(samples))
    bread = sum(b * g for b, g in zip(square, grams, strict=True))
    meat = sum(b * b * g for b, g in zip(square, grams, strict=True))
    inverse = np.linalg.inv(bread)
    return np.sqrt(np.diag(inverse @ meat @ inverse))


@pytest.mark.slow
@pytest.mark.compiling
def test_expected_errors_are_those_of_the_refit():
    """Curves of 15 to 120 samples: errors before and after two presses, and those of a refit.

    They were those of even weights: 27 to 42 % too small with the default weights.
    """
    balance = "curve"
    theta, how = np.log(CLEAR), Weighting(balance=balance)
    result = fit(unequal_study(theta, weighting=how), ONE)
    candidates = grid((10.0, 150.0), (3.0, 6.0), 100)
    choice = next_points(situation(result), candidates, 2)
    presses = [(s, 6.0, n) for s, n in zip(synthetic.S_C, UNEQUAL, strict=True)]
    more = [(candidates.s[k], candidates.depth[k], max(UNEQUAL)) for k in choice.chosen]
    # Bounds count as a prior: no more than a thousandth here.
    np.testing.assert_allclose(choice.error[0], result.relative_se[0], rtol=1e-3)
    for step, error in enumerate(choice.error):
        expected = sandwich_errors(theta, presses + more[:step], balance)
        np.testing.assert_allclose(error, expected, rtol=1e-3)
    again = fit(unequal_study(theta, more=more[:1], weighting=how), ONE)
    np.testing.assert_allclose(choice.error[1], again.relative_se[0], rtol=1e-3)


def test_errors_before_any_press_are_those_of_the_fit():
    """Where the noise is estimated."""
    study = unequal_study(np.log(CLEAR), noise=np.random.default_rng(5))
    result = fit(study, ONE)
    choice = next_points(situation(result), grid((10.0, 150.0), (6.0, 6.0), 10))
    np.testing.assert_allclose(choice.error[0], result.relative_se[0], rtol=1e-3)


OWN_K_1 = np.array([3.0, 1.0, 0.3])


def joint_study(extra=None, **scopes):
    """Three specimens that share what `scopes` says, two curves each; `extra`: (specimen, s)."""
    presses = [(i, s) for i in range(3) for s in (22.0, 80.0)]
    presses += [] if extra is None else [extra]
    curves = []
    for j, (i, s) in enumerate(presses):
        theta = np.log(CLEAR * [1, 1, OWN_K_1[i] / CLEAR[2], 1])
        force = pressed(theta, s, synthetic.DEPTHS)
        curves.append(Curve(f"S{i}", f"t{j}", s, 0.0, synthetic.DEPTHS, force))
    values = {n: {"value": float(v)} for n, v in zip(synthetic.NAMES, CLEAR, strict=True)}
    changes = {n: values[n] | {"scope": scopes.get(n, "shared")} for n in synthetic.NAMES}
    table = synthetic.parameters(**changes)
    return build_study(
        curves, synthetic.GEOMETRY, synthetic.OPTIONS, table, noise=Noise(force=SIGMA)
    )


def log_volume(result):
    return -np.linalg.slogdet(result.uncertainty.covariance[0])[1]


@pytest.mark.slow
@pytest.mark.compiling
def test_a_joint_fit_presses_the_specimen_that_tells_most():
    """Gains of a press on each specimen are those of refits with it; the first was always taken."""
    study = joint_study(k_1="specimen")
    result, s, depth = fit(study, ONE), 110.0, float(synthetic.DEPTHS[-1])
    curves = pressed_curves(study)
    assert [pressed_specimen(study, c) for c in curves] == ["S0", "S1", "S2"]
    at = Candidates(np.full(3, s), np.full(3, depth), curve=np.array(curves))
    known = situation(result)
    choice = next_points(known, at)
    gain = choice.score[0] - scores(known.base[:, None], known.meat[:, None], "D")
    refits = [fit(joint_study((i, s), k_1="specimen"), ONE) for i in range(3)]
    realised = np.array([log_volume(r) for r in refits]) - log_volume(result)
    np.testing.assert_allclose(gain, realised, rtol=0.02)
    assert choice.chosen[0] == np.argmax(realised)
    assert choice.chosen[0] != 0
    # Of independent residuals: those of noise-free fits are roundings, alike as it happens.
    alone = choice.error[1] / result.effective.factor[0]
    np.testing.assert_allclose(alone, refits[choice.chosen[0]].relative_se[0], rtol=1e-3)
    # Pairs of presses on one specimen tell of it alone.
    chart = identifiability(known, np.linspace(20.0, 140.0, 7), depth, curve=curves[1])
    assert chart.pairs.min() < 1e3


def test_candidates_of_a_joint_fit_are_on_every_specimen():
    """Where all are alike, or each is a lane, one place stands for all."""
    spec = FitSpec.model_validate({"data": {"files": "a.csv"}, "design": {"candidates": 300}})
    study = joint_study(k_1="specimen")
    at = candidates_of(spec, study)
    assert at.curve is not None
    np.testing.assert_array_equal(np.unique(at.curve), [0, 2, 4])
    assert len(at.s) == 300
    alike = joint_study()
    assert candidates_of(spec, alike).curve is None
    assert pressed_specimen(alike) == "(any)"
    lanes = joint_study(**dict.fromkeys(synthetic.NAMES, "specimen"))
    assert candidates_of(spec, lanes).curve is None
    assert pressed_specimen(lanes) == "(each)"


def test_depths_beyond_the_tube_are_refused_and_beyond_the_data_told():
    """A radius of 11.3 mm, data to 6 mm, a linear skeleton tested to a tenth of the radius."""
    study = make_study(simulated(BEFORE, 1, 1), BEFORE)

    def candidates(deepest):
        section = {"depth": ["1 mm", f"{deepest} mm"]}
        spec = FitSpec.model_validate({"data": {"files": "a.csv"}, "design": section})
        return candidates_of(spec, study)

    assert candidates(11.3).depth.max() == 11.3
    with pytest.raises(SpecError, match=r"design.depth: 30 mm.* at most 11.3 mm; give less"):
        candidates(30)
    assert extrapolation(study, 1.0) == ""
    assert extrapolation(study, 6.0) == "the model was tested to D = 1.13 mm"
    assert extrapolation(study, 6.1).startswith("extrapolated from data at D = 0.1 to 6 mm; the")


def late_study(onset, late=10.0):
    """Records of 5 mm that touch `late` mm from their zero, 2 mm after they begin."""
    D = late - 2.0 + np.linspace(0, 5.0, 51)
    pressed = synthetic.forces(CLEAR[None], BEFORE, np.maximum(D - late, 0))[0]
    changes = {n: {"value": float(v)} for n, v in zip(synthetic.NAMES, CLEAR, strict=True)}
    table = synthetic.parameters(**changes, onset=onset)
    curves = synthetic.curves(pressed, BEFORE, D)
    return build_study(
        curves, synthetic.GEOMETRY, synthetic.OPTIONS, table, noise=Noise(force=SIGMA)
    )


@pytest.mark.slow
@pytest.mark.compiling
def test_depths_of_presses_are_from_first_touch():
    """Records from 8 to 13 mm that touch at 10 mm: presses of 3 mm; 13 mm were taken for them."""
    study = late_study({})
    spec = FitSpec.model_validate({"data": {"files": "a.csv"}})
    result = fit(study, ONE)
    known = situation(result)
    # The corner is rounded over the noise, some 0.05 mm.
    near = {"atol": 0.01}
    np.testing.assert_allclose(result.first_touch, 10.0, **near)
    for at in (candidates_of(spec, study), candidates_of(spec, study, known.reach)):
        # A change point is a start, an estimate of exact data the truth.
        np.testing.assert_allclose([at.depth.min(), at.depth.max()], [1.5, 3.0], atol=0.05)
    np.testing.assert_allclose(known.reach, [0.0, 3.0], **near)
    np.testing.assert_allclose(known.approach, 2.0, **near)
    assert "extrapolated" not in extrapolation(study, 2.9, known.reach)
    says = "extrapolated from data at D = 0 to 3 mm from first touch; the model was tested to "
    assert extrapolation(study, 3.1, known.reach) == f"{says}D = 1.13 mm from first touch"


@pytest.mark.slow
@pytest.mark.compiling
def test_where_a_record_has_its_zero_tells_nothing():
    """A press as deep tells the same whatever the displacement at first touch; it told nothing."""
    candidates = Candidates(np.array([51.0, 75.0]), np.array([3.0, 3.0]))
    here, late = (
        gains(situation(fit(late_study({"fixed": True, "value": v}, v), ONE)), candidates)
        for v in (0.0, 10.0)
    )
    np.testing.assert_allclose(late, here, rtol=1e-6, atol=1e-6 * np.max(here))
    # Of a press from 2 mm before the touch to 3 mm, by central differences of the law and beam.
    h, D = 1e-5, np.maximum(-2.0 + 5.0 * np.arange(1, 52) / 51, 0)
    theta = np.log(CLEAR)
    J = np.stack([(pressed(theta + e, 51.0, D) - pressed(theta - e, 51.0, D)) / (2 * h)
                  for e in h * np.eye(4)])  # fmt: skip
    np.testing.assert_allclose(late[0, 0], J @ J.T / SIGMA**2, rtol=1e-4)


def test_what_cannot_be_designed_is_said(result):
    force = simulated(BEFORE, 1, 1)
    table = synthetic.parameters(**{n: {"scope": "trial"} for n in synthetic.NAMES})
    own = build_study(
        synthetic.curves(force, s_c=BEFORE), synthetic.GEOMETRY, synthetic.OPTIONS, table
    )
    with pytest.raises(ValueError, match="every free parameter belongs to single trials"):
        situation(dataclasses.replace(result, study=own))
    nothing = np.full_like(result.status, FitStatus.MAX_ITERATIONS)
    with pytest.raises(ValueError, match="no lane has an estimate"):
        situation(dataclasses.replace(result, status=nothing))


@pytest.mark.slow
@pytest.mark.compiling
def test_command_writes_its_files_or_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rows = ["specimen,trial,s [mm],displacement [mm],force [N]"]
    force = simulated(BEFORE[:2], 1, 1)[0]
    for j, s in enumerate(BEFORE[:2]):
        rows += [f"T,{j},{s},{d},{f}" for d, f in zip(synthetic.DEPTHS, force[j], strict=True)]
    Path("data.csv").write_text("\n".join(rows) + "\n")
    text = '[data]\nfiles = "data.csv"\n[design]\ncandidates = 200\n'
    asked = 's = ["20 mm", "140 mm"]\ndepth = ["3 mm", "8 mm"]\npoints = 2\n'
    Path("spec.toml").write_text(text + asked)
    code, out, err = run(monkeypatch, capsys, "design", "spec.toml", "--out", "out")
    assert code == 0
    assert "note: spec.toml" not in err
    assert max(map(len, out.splitlines())) <= 80
    page = (Path(__file__).parents[1] / "docs" / "after_a_fit.md").read_text()
    for name in ("next_points", "candidates", "identifiability"):
        with Path(f"out/{name}.csv").open(newline="") as stream:
            found = list(csv.DictReader(stream))
        body = page.partition(f"## {name}.csv")[2].partition("##")[0]
        for column in found[0]:
            word = column.replace("k_1", "NAME").replace("k_3", "NAME")
            assert f"`{word.replace('EI_L', 'NAME').replace('k_M', 'NAME')}`" in body
        if name == "next_points":
            assert [row["press"] for row in found] == ["0", "1", "2"]
            assert all(20 <= float(row["s_mm"]) <= 140 for row in found[1:])
            assert [row["specimen"] for row in found] == ["", "T", "T"]
            deep = [float(row["depth_mm"]) > 6.0 for row in found[1:]]
            beyond = ["extrapolated from data at D = 0.1 to 6 mm" in r["message"] for r in found]
            assert beyond == [False, *deep]
            assert any(deep)
            assert all("tested to D = 1.13 mm" in row["message"] for row in found[1:])
            assert "Press 1: extrapolated" in " ".join(out.split())
    assert Path("out/identifiability.png").read_bytes()[:4] == b"\x89PNG"
    before = tree(tmp_path)
    for line, says in (
        ('s = ["20 mm", "200 mm"]', "design.s: 20 to 200 mm, tube spans 0 to 160 mm"),
        ('s = ["90 mm", "20 mm"]', "swap them"),
        ('depth = ["1 mm", "30 mm"]', "design.depth: 30 mm, a tube is pressed no deeper"),
        (
            "[parameters]\nonset = {}\n"
            + "\n".join(f'{n} = {{ scope = "trial" }}' for n in synthetic.NAMES),
            "every free parameter belongs to single trials",
        ),
    ):
        Path("spec.toml").write_text(text + line)
        code, _, err = run(monkeypatch, capsys, "design", "spec.toml")
        assert code == 2
        assert says in err
    assert tree(tmp_path).keys() == before.keys()


def test_analyses_of_a_fit_that_design_leaves_out_are_named(tmp_path, monkeypatch, capsys):
    """They were passed over in silence; the bootstrap is used (docs/after_a_fit.md), not named."""
    monkeypatch.chdir(tmp_path)
    asked = 'profile = "k_M"\nbootstrap = 40\ninfluence = true\nposterior = 100\n'
    spec = Path("spec.toml")
    spec.write_text('[data]\nfiles = "data.csv"\n[uncertainty]\n' + asked)
    study = make_study(simulated(BEFORE, 1, 1), BEFORE)
    request = Request(load_fit_spec(spec), study, ONE, command="design")
    refuse(spec, request)
    said = " ".join(capsys.readouterr().err.split())
    names = said.removeprefix("note: spec.toml: ").partition(": left out by design")[0]
    assert sorted(names.split(", ")) == [
        "uncertainty.influence", "uncertainty.posterior", "uncertainty.profile"
    ]  # fmt: skip
    assert left_out(dataclasses.replace(request, command="fit")) == []
