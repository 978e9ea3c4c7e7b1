"""Analyses of fits of deforming cross-sections, against refits by SciPy on single presses."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from run_cli import run
from scipy.optimize import least_squares

from jaxtrachea.config import DesignSection, FitSpec, SpecError
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.lane import size
from jaxtrachea.fitting.lanes import Noise
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.inference.analyses import influence as analysis
from jaxtrachea.inference.design.candidates import Candidates, candidates_of
from jaxtrachea.inference.design.choice import next_points
from jaxtrachea.inference.design.situation import situation
from jaxtrachea.inference.influence import _external, influence
from jaxtrachea.inference.profile import profiles
from jaxtrachea.measurements.read import Curve, Measurements, write_hdf5
from jaxtrachea.mechanics.press import Options
from jaxtrachea.mechanics.sections.material import SectionMaterial, from_wall
from jaxtrachea.mechanics.sections.press import press_sections
from jaxtrachea.status import ProfileEnd
from jaxtrachea.trachea.geometry import Geometry

pytestmark = pytest.mark.compiling
GEOMETRY = Geometry.create(30.0, [10.0, 20.0], radius=11.7)
SECTIONS = Options(skeleton="sections", contact="bonded")
#: Position and angle of each press; all along the normal.
PLACES = ((15.0, 0.0), (8.0, 0.0), (15.0, 0.6))
PATH = np.linspace(0.5, 3.0, 6)
#: What is fitted, and its truth; all else stays as the wall gives it.
TRUTH = {"EI_C": 31.0, "bed_n": 0.013}
FIXED = {name: {"fixed": True} for name in ("bed_t", "Et_L", "D_L", "c_W")}
SIGMA = 0.01
ONE = Settings(starts=1, more_starts=0, verify=False)
#: Threshold of chi^2 with one degree of freedom at 95 %.
CHI2 = 3.841458820694124


@functools.cache
def wall():
    """Parameters of the wall by name, as the fits begin."""
    given = from_wall(GEOMETRY)
    return {f.name: np.median(getattr(given, f.name)) for f in dataclasses.fields(given)}


@functools.cache
def program():
    """Force and side force of all presses by the logarithms of what is fitted; (presses, 2, N)."""
    given = wall()

    def one(theta, place):
        material = SectionMaterial(**(given | dict(zip(TRUTH, jnp.exp(theta), strict=True))))
        s, phi = place
        got = press_sections(GEOMETRY, material, s, phi, jnp.asarray(PATH), (1.0, 0.0))
        cos, sin = jnp.cos(phi), jnp.sin(phi)
        y, z = got.force[:, 1], got.force[:, 2]
        return jnp.stack([-cos * y - sin * z, -sin * y + cos * z])

    return jax.jit(jax.vmap(one, (None, 0)))


def shown(theta):
    """As `program`, numpy."""
    return np.array(program()(jnp.asarray(theta), jnp.asarray(PLACES)))


def measured(seed, sigma=SIGMA, specimen="one", **truth):
    """Curves with noise, as the presses show them."""
    clean = shown(np.log(list((TRUTH | truth).values())))
    noisy = clean + sigma * np.random.default_rng(seed).normal(size=clean.shape)
    return [
        Curve(specimen, f"{s:g} {phi:g}", s, phi, PATH, force, side_force=side if phi else None)
        for (s, phi), (force, side) in zip(PLACES, noisy, strict=True)
    ]


def residual(theta, curves, sigma=SIGMA):
    """Whitened differences that count, of one specimen."""
    parts = []
    for (force, side), c in zip(shown(theta), curves, strict=True):
        parts += [force - c.force] + ([] if c.side_force is None else [side - c.side_force])
    return np.concatenate(parts) / sigma


def refit(curves, fixed=(), sigma=SIGMA):
    """SciPy's minimum, some unknowns pinned, `fixed` (index, value): theta and the cost."""
    pinned = dict(fixed)
    free = [i for i in range(len(TRUTH)) if i not in pinned]

    def full(x):
        theta = np.zeros(len(TRUTH))
        theta[free], theta[list(pinned)] = x, list(pinned.values())
        return theta

    start = np.log(list(TRUTH.values()))[free]
    found = least_squares(
        lambda x: residual(full(x), curves, sigma), start, "3-point", xtol=1e-12, ftol=1e-14
    )
    return full(found.x), found.cost


def study_of(curves, table=None, sigma=SIGMA, **more):
    return build_study(
        curves, GEOMETRY, SECTIONS, FIXED | (table or {}), noise=Noise(force=sigma), **more
    )


@pytest.fixture(scope="module")
def result():
    return fit(study_of(measured(0)), ONE)


@pytest.mark.slow
def test_profile_is_the_refit_at_every_point(result):
    """Estimate, whole grid and ends of the interval, against SciPy with one unknown pinned."""
    curves = result.study.curves[0]
    assert [p.name for p in result.study.free] == list(TRUTH)
    theta, lowest = refit(curves)
    np.testing.assert_allclose(result.theta[0], theta, atol=1e-6)
    found = profiles(result, ONE, points=3)
    assert np.all(found.end == ProfileEnd.CLOSED)
    for k, i in enumerate(found.unknown):
        at, rise = found.coordinate[k], found.statistic[k]
        assert rise[3] == 0
        assert at[3] == result.theta[0, i]
        wanted = [2 * (refit(curves, [(int(i), v)])[1] - lowest) for v in at]
        np.testing.assert_allclose(rise, wanted, rtol=1e-5, atol=1e-6)
        for end in (found.lower[k], found.upper[k]):
            there = 2 * (refit(curves, [(int(i), float(np.log(end)))])[1] - lowest)
            assert there == pytest.approx(CHI2, rel=1e-5)


@pytest.mark.slow
def test_predicted_error_is_that_of_a_fit_with_the_press_added():
    """The chosen press, measured without noise: the new standard errors are those predicted."""
    curves = measured(0)
    # Beside a specimen of three curves there is room for the one to come: the same programs.
    room = study_of(curves[:2] + measured(0, specimen="two")).take(np.array([0]))
    result = fit(room, ONE)
    places = np.array(PLACES)
    at = Candidates(places[:, 0], np.full(3, PATH[-1]), places[:, 1])
    choice = next_points(situation(result), at, 1)
    k = int(choice.chosen[0])
    (s, phi), (force, side) = PLACES[k], shown(result.theta[0])[k]
    more = Curve("one", "next", s, phi, PATH, force, side_force=side if phi else None)
    after = fit(study_of([*curves[:2], more]), ONE)
    np.testing.assert_allclose(after.theta, result.theta, atol=1e-6)
    # Bounds count as a prior in the prediction: no more than a thousandth here.
    np.testing.assert_allclose(choice.error[1], after.uncertainty.se[0], rtol=1e-3)
    np.testing.assert_allclose(choice.error[0], result.uncertainty.se[0], rtol=1e-3)


def test_angles_of_candidates():
    """Of the measured curves where none are named; each position and depth at every angle."""
    study = study_of([Curve("one", str(p), *p, PATH, PATH) for p in PLACES])
    spec = FitSpec.model_validate({"data": {"files": "a.csv"}})

    def at(**section):
        design = DesignSection.model_validate(section)
        return candidates_of(spec.model_copy(update={"design": design}), study)

    plain = at()
    assert len(plain.s) == 250
    np.testing.assert_array_equal(np.unique(plain.phi), [0.0, 0.6])
    both = set(zip(plain.s[plain.phi == 0], plain.depth[plain.phi == 0], strict=True))
    assert both == set(zip(plain.s[plain.phi > 0], plain.depth[plain.phi > 0], strict=True))
    assert at(phi=["0 deg"]).phi is None
    np.testing.assert_allclose(np.unique(at(phi=["90 deg", "90 deg"]).phi), [np.pi / 2])
    for section, words in (
        (
            {"phi": ["130 deg"]},
            "design.phi: 130 deg; deforming cross-sections are right within 90 deg",
        ),
        ({"depth": ["1 mm", "12 mm"]}, "design.depth: 12 mm, a tube is pressed no deeper"),
    ):
        with pytest.raises(SpecError, match=words):
            at(**section)
    line = build_study([Curve("one", "1", 15.0, 0.0, PATH, PATH)], GEOMETRY, Options())
    named = spec.model_copy(update={"design": DesignSection.model_validate({"phi": ["30 deg"]})})
    with pytest.raises(SpecError, match="design.phi: .* on the midline alone; leave it out"):
        candidates_of(named, line)
    assert len(candidates_of(spec, line).s) == 10_000


def test_entries_of_influence_have_names():
    """Of a row of all kinds: where each entry stands in the lane is where its name says."""
    n, rings = 6, 2
    full = {
        "side_force": PATH, "joint_rings": np.arange(2), "joint_displacement": np.ones((n, 2)),
        "joint_side_displacement": np.ones((n, 2)), "end_rings": np.arange(2),
        "end_U": np.ones((n, 2, 2)), "end_V": np.ones((n, 2, 2)),
    }  # fmt: skip
    study = study_of([Curve("one", "1", 18.0, 0.6, PATH, PATH, **full)])
    shapes = {
        "force": ((n,), [("force", None)]),
        "side_force": ((n,), [("side force", None)]),
        "joints": ((n, rings), [("marker", r) for r in range(rings)]),
        "joint_side": ((n, rings), [("sideward marker", r) for r in range(rings)]),
        "ends": (
            (n, rings, 2, 2),
            [(f"end {e} {c}", r) for r in range(rings) for e in "UV" for c in "yz"],
        ),
    }
    first = 0
    for name, (shape, names) in shapes.items():
        lanes = study.lanes
        seen = lanes.force if name == "force" else lanes.others[name].data
        assert seen.shape == (1, 1, *shape)
        for i in range(int(np.prod(shape))):
            sample, place = divmod(i, len(names))
            observed, ring = names[place]
            assert analysis._place(study.lanes, first + i) == (sample, observed, ring)
        first += int(np.prod(shape))
    assert first == size(study.lanes)
    assert analysis._place(study.lanes, n + 2).label(1.5) == "1.5 mm, side force"
    assert analysis._place(study.lanes, 2 * n + 5).label(1.5) == "1.5 mm, ring 2"
    assert analysis._place(study.lanes, 6 * n + 1).label(0.5) == "0.5 mm, ring 1, end U z"


def perturbed(curves, keep, shift, sigma):
    """SciPy's minimum with entries left out or moved; `keep` and `shift` (presses, 2, N)."""
    data = np.stack([np.stack([c.force, c.force if c.side_force is None else c.side_force])
                     for c in curves])  # fmt: skip

    def off(theta):
        return ((shown(theta) - data - shift)[keep] / sigma).ravel()

    start = np.log(list(TRUTH.values()))
    return least_squares(off, start, "3-point", xtol=1e-13, ftol=1e-15).x


@pytest.mark.slow
def test_influence_is_that_of_refits():
    """Samples and curves left out, and samples moved, of forces and side forces; little noise."""
    sigma = SIGMA / 30
    curves = measured(3, sigma)
    result = fit(study_of(curves, sigma=sigma), ONE)
    found = influence(result)
    keep = np.ones((3, 2, len(PATH)), bool)
    keep[:2, 1] = False  # no side force on the midline
    none, se = np.zeros(keep.shape), result.uncertainty.se[0]
    best = perturbed(curves, keep, none, sigma)
    np.testing.assert_allclose(result.theta[0], best, atol=1e-7)
    assert np.nansum(found.of.leverage) == pytest.approx(len(TRUTH), rel=1e-9)
    np.testing.assert_array_equal(np.isfinite(found.of.leverage[0]), keep.reshape(3, -1))
    for t, kind, n in ((0, 0, 5), (2, 0, 5), (2, 1, 5), (1, 0, 2)):
        entry, without, moved = kind * len(PATH) + n, keep.copy(), none.copy()
        without[t, kind, n], moved[t, kind, n] = False, sigma
        gone = (perturbed(curves, without, none, sigma) - best) / se
        np.testing.assert_allclose(found.of.left_out[0, t, :, entry], gone, atol=2e-3)
        ahead, back = (perturbed(curves, keep, s * moved, sigma) for s in (1, -1))
        slope = (ahead - back) / 2 / se
        np.testing.assert_allclose(found.of.per_sigma[0, t, :, entry], slope, atol=2e-3)
    for t in range(3):
        without = keep.copy()
        without[t] = False
        gone = (perturbed(curves, without, none, sigma) - best) / se
        np.testing.assert_allclose(found.of.curve_left_out[0, t], gone, atol=1e-2)
    # Where sigma is estimated it is that of all forces: 24 of them, less their share of unknowns.
    estimated = dataclasses.replace(result.study, noise_given=(False, False))
    t = found.of.studentised
    n = 24 - len(TRUTH)
    np.testing.assert_allclose(
        _external(dataclasses.replace(result, study=estimated), np.asarray(t)),
        t * np.sqrt((n - 1) / (n - t**2)),
    )


SPEC = """title = "{title}"
[data]
files = "{files}"
[trachea]
length = "30 mm"
rings = ["10 mm", "20 mm"]
radius = "11.7 mm"
[model]
skeleton = "{title}"
contact = "bonded"
[parameters]
{parameters}
[noise]
force = "0.01 N"
[fit]
starts = 1
{more}
"""
PINNED = """bed_t = {{ fixed = "{bed_t} N/mm^3" }}
Et_L = {{ fixed = "{Et_L} N/mm" }}
D_L = {{ fixed = "{D_L} N mm" }}
c_W = {{ fixed = "{c_W} 1/N/mm" }}
"""


def specification(title, files="data.h5", more=""):
    parameters = PINNED.format(**wall()) if title == "sections" else ""
    return SPEC.format(title=title, files=files, parameters=parameters, more=more)


def stored(path, curves):
    write_hdf5(path, Measurements(tuple(curves), (), ()))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["compare", "sections.toml", "linear.toml"], "presses along the normal, from a file"),
        (["compare", "sections.toml", "other.toml"], "other.toml: data.files: other content"),
        (["fit", "posterior.toml"], "uncertainty.posterior is not available for the skeleton"),
        (["design", "deep.toml"], "design.depth: 12 mm, a tube is pressed no deeper"),
        (
            ["design", "behind.toml"],
            "design.phi: 130 deg; deforming cross-sections are right within 90 deg",
        ),
        (["design", "line.toml"], "design.phi: this model presses on the midline alone"),
    ],
)
def test_what_is_refused_is_refused_before_the_fit(arguments, says, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    data = [Curve("one", f"{p}", *p, PATH, 0.8 * PATH) for p in PLACES]
    stored("data.h5", data)
    stored("other.h5", data[:2])
    for name, text in {
        "sections": specification("sections"),
        "linear": specification("linear"),
        "other": specification("sections", "other.h5"),
        "posterior": specification("sections", more="[uncertainty]\nposterior = 100"),
        "deep": specification("sections", more='[design]\ndepth = ["1 mm", "12 mm"]'),
        "behind": specification("sections", more='[design]\nphi = ["130 deg"]'),
        "line": specification("linear", "other.h5", '[design]\nphi = ["30 deg"]'),
    }.items():
        Path(f"{name}.toml").write_text(text)
    code, out, err = run(monkeypatch, capsys, *arguments)
    assert (code, out) == (2, "")
    assert says in " ".join(err.split())
    assert not Path("out").exists()
