"""Noise given for one kind and estimated for the other, or given for some curves: closed forms."""

import dataclasses

import numpy as np
import pytest
import scipy.stats
import synthetic
from run_cli import run

from jaxtrachea.fitting import minima
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lane import size
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.cross_validation import leave_one_out
from jaxtrachea.prediction.predict import predict

QUICK = Settings(starts=1, verify=False)
TRUTH = np.array([[100.0, 1.0, 1.0, 0.01]])
FORCE, MARKER = 0.02, 0.005
RINGS = np.arange(15)


def marked(specimen, seed=0, markers=True):
    """Curves of one specimen with noise, their forces and markers as the truth has them."""
    force, joints = synthetic.forces(TRUTH)
    draw = np.random.default_rng(seed)
    curves = []
    for t, curve in enumerate(synthetic.curves(force)):
        seen = joints[0, t] + MARKER * draw.normal(size=joints[0, t].shape)
        noisy = curve.force + FORCE * draw.normal(size=curve.force.shape)
        curves.append(dataclasses.replace(curve, specimen=specimen, force=noisy))
        if markers:
            given = {"joint_rings": RINGS, "joint_displacement": seen}
            curves[-1] = dataclasses.replace(curves[-1], **given)
    return curves


def fitted(curves, noise):
    table = synthetic.parameters(joints=any(c.joint_rings is not None for c in curves))
    study = build_study(curves, synthetic.GEOMETRY, synthetic.OPTIONS, table, noise=noise)
    return fit(study, QUICK)


def slopes(values):
    """Derivatives of forces and markers by log parameters, central differences; (P, n) each."""
    rows = []
    for i in range(4):
        up, down = values.copy(), values.copy()
        up[i], down[i] = values[i] * np.exp(1e-4), values[i] * np.exp(-1e-4)
        high, low = synthetic.forces([up]), synthetic.forces([down])
        rows.append([((a - b) / 2e-4).ravel() for a, b in zip(high, low, strict=True)])
    return (np.array(v) for v in zip(*rows, strict=True))


@pytest.mark.long
def test_errors_are_of_each_kinds_own_noise():
    """(J_f^T J_f / s^2 + J_m^T J_m / sigma^2)^-1, s from forces alone.

    Residuals of markers with a cautious sigma (0.05 mm) counted for forces too: errors were a
    quarter of these, smaller than without markers.
    """
    given = 0.05
    result = fitted(marked("A"), Noise(joints=given))
    force, marker = slopes(result.value[0])
    s = result.sigma[0, 0]
    assert abs(s / FORCE - 1) < 0.15
    want = np.linalg.inv(force @ force.T / s**2 + marker @ marker.T / given**2)
    got = result.standard_error[0] / result.value[0]
    np.testing.assert_allclose(got, np.sqrt(np.diag(want)), rtol=2e-3)


@pytest.mark.slow
def test_a_specimen_is_as_by_itself():
    """Beside another with markers of unknown noise, errors were a fifth, and Student's t."""
    noise, alone = Noise(force=0.1), marked("B", markers=False)
    by_itself, both = fitted(alone, noise), fitted(marked("A") + alone, noise)
    np.testing.assert_allclose(both.standard_error[1], by_itself.standard_error[0], rtol=1e-6)
    half = both.uncertainty.half_width
    assert half[1] == pytest.approx(scipy.stats.norm.ppf(0.975))
    assert half[0] > half[1]


@pytest.mark.slow
def test_criteria_are_of_the_likelihood_whatever_the_lengths_of_others():
    """Long curves of another specimen multiplied a deviance, to a false "decisively"."""
    short = [
        dataclasses.replace(c, displacement=c.displacement[::n], force=c.force[::n])
        for c, n in zip(marked("B", markers=False), (10, 10, 5, 5), strict=True)
    ]
    noise, long = Noise(force=FORCE), marked("A", seed=1, markers=False)
    by_itself, both = fitted(short, noise), fitted(short + long, noise)
    for name in ("deviance", "AIC", "AICc", "BIC"):
        of_both, of_one = (getattr(r.criteria, name)[0] for r in (both, by_itself))
        assert of_both == pytest.approx(of_one, rel=1e-9)
    modelled, _ = synthetic.forces(by_itself.value)
    off = [c.force - m[:: 50 // len(c.force)] for c, m in zip(short, modelled[0], strict=True)]
    logs = scipy.stats.norm.logpdf(np.concatenate(off), scale=FORCE)
    assert by_itself.criteria.deviance[0] == pytest.approx(-2 * np.sum(logs), rel=1e-6)


@pytest.mark.long
def test_markers_beyond_their_noise_are_told():
    """A cautious sigma is not: it says what the model may miss."""
    for given, told in ((MARKER / 10, True), (MARKER, False), (10 * MARKER, False)):
        result = fitted(marked("A"), Noise(force=FORCE, joints=given))
        found = result.misfit
        assert found.flagged[0].tolist() == [False, told]
        assert found.ratio[0, 1] == pytest.approx(MARKER / given, rel=0.1)


@pytest.mark.slow
def test_some_curves_with_a_sigma_and_others_without_are_refused():
    """1 / N and a pure number were summed: bands of 1.9 N where 0.04 are right."""
    curves = marked("A", markers=False) + marked("B", markers=False)
    own = np.full(50, FORCE)
    mixed = [dataclasses.replace(c, sigma=own) if c.specimen == "A" else c for c in curves]
    with pytest.raises(ValueError, match="'B' trial 't0': no sigma, as 4 of 8 curves, where"):
        fitted(mixed, Noise())
    result = fitted(mixed, Noise(force=2 * FORCE))
    np.testing.assert_allclose(result.sigma[:, 0], [FORCE, 2 * FORCE])


def test_a_file_without_sigma_beside_one_with_is_named(tmp_path, monkeypatch, capsys):
    lines = [f"{d},{0.4 * d + 0.002 * (-1) ** i}" for i, d in enumerate(np.linspace(0.1, 3, 20))]
    with_sigma = "specimen,trial,s [mm],displacement [mm],force [N],sigma [N]\n"
    (tmp_path / "a.csv").write_text(with_sigma + "".join(f"A,t,75,{x},0.002\n" for x in lines))
    without = with_sigma.replace(",sigma [N]", "")
    (tmp_path / "b.csv").write_text(without + "".join(f"B,t,75,{x}\n" for x in lines))
    spec = '[data]\nfiles = "*.csv"\n[model]\ncoupling = "total"\n'
    (tmp_path / "fit.toml").write_text(spec)
    monkeypatch.chdir(tmp_path)
    code, _, err = run(monkeypatch, capsys, "check", "fit.toml")
    assert code == 2
    assert "specimen 'B' trial 't': no sigma, as 1 of 2 curves" in " ".join(err.split())
    (tmp_path / "fit.toml").write_text(spec + '[noise]\nforce = "0.01 N"\n')
    assert run(monkeypatch, capsys, "check", "fit.toml")[0] == 0


@pytest.mark.slow
def test_the_share_of_markers_counts_from_first_touch():
    """A record whose zero lies 10 mm before the touch: errors were 5.7 to 6.7 times as large."""
    noise = Noise(force=FORCE, joints=MARKER, joints_share=0.1)

    def fitted_from(zero):
        moved = [
            dataclasses.replace(c, displacement=c.displacement + zero) for c in marked("A", seed=2)
        ]
        table = synthetic.parameters(joints=True, onset={"fixed": True, "value": zero})
        study = build_study(moved, synthetic.GEOMETRY, synthetic.OPTIONS, table, noise=noise)
        return fit(study, QUICK)

    here, there = fitted_from(0.0), fitted_from(10.0)
    np.testing.assert_allclose(there.value[0], here.value[0], rtol=1e-5)
    np.testing.assert_allclose(there.standard_error[0], here.standard_error[0], rtol=1e-4)
    left = [leave_one_out(result, QUICK).joints for result in (here, there)]
    np.testing.assert_allclose(left[1], left[0], rtol=1e-3)
    sigma = []
    for result, trial, D in ((here, None, 2.0), (there, None, 2.0), (there, "t1", 12.0)):
        found = predict(result, s=45.0, displacement=[D], trial=trial)
        sigma.append(float(found.joint_sigma[0]))
    np.testing.assert_allclose(sigma, np.hypot(MARKER, 0.1 * 2.0), rtol=1e-6)


@pytest.mark.long
def test_lanes_without_markers_do_not_compute_those_of_others(monkeypatch):
    """As in a study of their own; of 33 specimens each took 16 times as long for the one marked."""
    curves = [c for i in range(32) for c in marked(f"p{i:02d}", i, markers=False)]
    sizes, solve = [], minima.levenberg_marquardt

    def counted(objective, *arguments, **options):
        sizes.append((len(objective.lower), size(objective.lane)))
        return solve(objective, *arguments, **options)

    monkeypatch.setattr(minima, "levenberg_marquardt", counted)
    result = fitted([*curves[:64], *marked("m", 40), *curves[64:]], Noise())
    samples = len(synthetic.DEPTHS)
    assert set(sizes) == {(32, samples), (1, 16 * samples)}
    alone, one = fitted(curves, Noise()), fitted(marked("m", 40), Noise())
    names = [lane[0].specimen for lane in result.study.curves]
    assert names == [*(f"p{i:02d}" for i in range(16)), "m", *(f"p{i:02d}" for i in range(16, 32))]
    for name in ("value", "standard_error", "lower", "upper", "sigma", "status", "cost"):
        expected = np.insert(getattr(alone, name), 16, getattr(one, name)[0], axis=0)
        np.testing.assert_allclose(getattr(result, name), expected, rtol=1e-6, err_msg=name)
