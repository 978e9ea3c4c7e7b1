"""Fits of deforming cross-sections: residual, Jacobian, lanes, recovery of known parameters."""

import dataclasses
import functools

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxtrachea.cli.specification import options_of, parameters_of
from jaxtrachea.config import SpecError, load_fit_spec
from jaxtrachea.fitting import information, shared, structure
from jaxtrachea.fitting.build import build_study
from jaxtrachea.fitting.effective import effective_samples
from jaxtrachea.fitting.fit import fit
from jaxtrachea.fitting.force_share import with_shares
from jaxtrachea.fitting.information import Information
from jaxtrachea.fitting.lane import (
    data_weight,
    force_entries,
    observations,
    size,
    without_data,
)
from jaxtrachea.fitting.lanes import Noise, Weighting
from jaxtrachea.fitting.model import values_of
from jaxtrachea.fitting.parameters import DEFAULTS, defaults_of
from jaxtrachea.fitting.refusals import Size, check_curve
from jaxtrachea.fitting.residual import inputs, residual, residual_value
from jaxtrachea.fitting.settings import Settings
from jaxtrachea.fitting.study import Shares
from jaxtrachea.inference.analysis import AnalysisResults
from jaxtrachea.inference.comparison import same_data
from jaxtrachea.inference.posterior import posterior
from jaxtrachea.inference.repeats import repeats
from jaxtrachea.measurements.read import Curve
from jaxtrachea.mechanics.oblique import ObliqueOptions, press_oblique
from jaxtrachea.mechanics.press import Options, press
from jaxtrachea.mechanics.sections.material import SECTION_VALUES, SectionMaterial, Wall, from_wall
from jaxtrachea.mechanics.sections.press import press_sections
from jaxtrachea.optimisation.trust_region import Tolerances
from jaxtrachea.results.hdf5 import write_hdf5
from jaxtrachea.results.store import _observed
from jaxtrachea.status import FitStatus
from jaxtrachea.trachea.geometry import Geometry
from jaxtrachea.trachea.material import Material

pytestmark = pytest.mark.compiling
RINGS = [10.0, 20.0, 30.0]
GEOMETRY = Geometry.create(40.0, RINGS, radius=11.7)
SECTIONS = Options(skeleton="sections", contact="bonded")
#: Position, angle and direction of each press; 0.6 and 0.8 are oblique.
PLACES = [(20.0, 0.0, (1.0, 0.0)), (14.0, 0.5, (1.0, 0.0)), (23.0, np.pi / 2, (0.8, -0.6))]
PATH = np.array([0.5, 2.0, 5.0])
QUICK = {"xla_backend_optimization_level": 0}  # most of the time here is compilation
FREE = {"fixed": False}
#: Every kind of parameter: of rings, spans, ends, contact, bed, and of the press.
NAMED = {
    "Gt_L": FREE, "c_K": FREE | {"value": 5.0}, "k_end": FREE, "footprint": FREE, "c_t": FREE,
    "onset": FREE | {"scope": "specimen"}, "force_offset": FREE | {"scope": "specimen"},
}  # fmt: skip
NOISE = Noise(force=0.05, joints=0.2)


def curve(place, path=PATH, **changes):
    """A press whose data are numbers of no meaning."""
    s, phi, direction = place
    n, rng = len(path), np.random.default_rng(3)
    fields = {
        "displacement": np.array(path), "force": rng.normal(size=n),
        "side_force": rng.normal(size=n), "joint_rings": np.array([0, 2]),
        "joint_displacement": rng.normal(size=(n, 2)),
        "joint_side_displacement": rng.normal(size=(n, 2)), "end_rings": np.array([1]),
        "end_U": rng.normal(size=(n, 1, 2)), "end_V": rng.normal(size=(n, 1, 2)),
    }  # fmt: skip
    trial = f"{s} {phi:.2f} {direction}"
    return Curve("one", trial, s, phi, direction=direction, **(fields | changes))


def study_of(curves, table=NAMED, **changes):
    return build_study(curves, GEOMETRY, SECTIONS, table, noise=NOISE, **changes)


@functools.cache
def programs(model):
    """Residual with Jacobian, and its value; compiled once for lanes of equal shapes."""
    both = jax.jit(functools.partial(residual, model), compiler_options=QUICK)
    value = jax.jit(functools.partial(residual_value, model), compiler_options=QUICK)
    return both, value


@pytest.mark.parametrize("share", [0.0, 0.06])
def test_markers_err_by_a_share_of_the_displacement(share):
    """Of joints, sideward markers and ring ends alike; forces keep their own noise."""
    given = Noise(force=0.05, joints=0.2, joints_share=share)
    lanes = build_study([curve(PLACES[1])], GEOMETRY, SECTIONS, NAMED, noise=given).lanes
    variance = 0.2**2 + (share * PATH) ** 2
    for name in ("joints", "joint_side", "ends"):
        kept = lanes.others[name].precision[0, 0].reshape(len(PATH), -1)
        kept = kept[:, kept[0] > 0]
        assert kept.shape[1] >= 2
        np.testing.assert_allclose(kept, np.tile(variance[:, None] ** -0.5, kept.shape[1]))
    np.testing.assert_allclose(lanes.precision[0, 0], 1 / 0.05)
    np.testing.assert_allclose(lanes.others["side_force"].precision[0, 0], 1 / 0.05)


@pytest.mark.parametrize(("share", "says"), [(-0.1, "0 or more"), (0.1, "needs joints")])
def test_a_share_without_meaning(share, says):
    with pytest.raises(ValueError, match=says):
        Noise(force=0.05, joints_share=share)


def lane_of(study, dtype=np.float64):
    def cast(v):
        return jnp.asarray(v[0] if v.dtype == np.int32 else v[0].astype(dtype))

    return jax.tree.map(cast, study.lanes)


def point_of(study):
    """Near the guess; the onset and the offset are not zero."""
    guess = [p.to_scaled(p.value) for p, _, _ in study.unknowns[0]]
    names = [p.name for p, _, _ in study.unknowns[0]]
    off = np.random.default_rng(1).uniform(-0.1, 0.1, len(guess))
    off[[names.index("onset"), names.index("force_offset")]] = 0.05, 0.3
    return jnp.asarray(np.array(guess) + off)


_single = jax.jit(
    lambda m, s, phi, D, along: press_sections(GEOMETRY, m, s, phi, D, along),
    compiler_options=QUICK,
)


def single(values, *at):
    """One press, whatever its place: compiled once, for plain numbers are made arrays."""
    material = SectionMaterial(**{name: jnp.asarray(np.array(v)) for name, v in values.items()})
    return _single(material, *(jnp.asarray(v) for v in at))


def shown(study, theta, k):
    """What `press_sections` shows of trial k, with frames written out here; by kind."""
    c = study.curves[0][k]
    values = {p.name: p.value for p in study.parameters}
    values |= {
        p.name: p.from_scaled(float(v))
        for (p, _, _), v in zip(study.unknowns[0], theta, strict=True)
    }
    onset, offset = values.pop("onset"), values.pop("force_offset")
    got = single(values, c.s_c, c.phi_c, c.displacement - onset, c.direction)
    normal = np.array([0, -np.cos(c.phi_c), -np.sin(c.phi_c)])
    around = np.array([0, -np.sin(c.phi_c), np.cos(c.phi_c)])
    a, b = c.direction
    F, J = np.asarray(got.force), np.asarray(got.joints)
    ends = np.stack([got.end_U, got.end_V], 2)[..., 1:]
    return {
        "force": F @ (a * normal + b * around) + offset,
        "side": F @ (-b * normal + a * around),
        "joints": J @ normal, "aside": J @ around, "ends": ends,
    }  # fmt: skip


@pytest.fixture(scope="module")
def evaluated():
    study = study_of([curve(place) for place in PLACES])
    both, value = programs(study.model)
    theta, lane = point_of(study), lane_of(study)
    return study, theta, lane, both(theta, lane), value(theta, lane)


@pytest.mark.slow
def test_row_is_what_a_press_shows(evaluated):
    """Force, side force, markers, sideward markers, ends; in this order, over their sigma."""
    study, theta, lane, r, value = evaluated
    assert np.all(np.isfinite(value))
    np.testing.assert_allclose(r.value, value, rtol=0, atol=1e-9)
    n = len(PATH)
    assert size(lane) == value.shape[1] == n * (2 + 3 + 3 + 12)
    assert observations(lane)[1] == 2 * n
    for k in range(len(PLACES)):
        got, c = shown(study, theta, k), study.curves[0][k]
        row = {
            "force": (got["force"] - c.force) / 0.05,
            # Of a normal press on the midline it is 0 by symmetry, and does not count.
            "side": (got["side"] - c.side_force) / 0.05 * (k > 0),
        }
        for name, data in (
            ("joints", c.joint_displacement), ("aside", c.joint_side_displacement),
        ):  # fmt: skip
            row[name] = np.zeros((n, 3))
            row[name][:, [0, 2]] = (got[name][:, [0, 2]] - data) / 0.2
        row["aside"] *= k > 0
        row["ends"] = np.zeros((n, 3, 2, 2))
        data = np.stack([c.end_U, c.end_V], 2)[:, 0]
        row["ends"][:, 1] = (got["ends"][:, 1] - data) / 0.2
        wanted = np.concatenate([v.ravel() for v in row.values()])
        np.testing.assert_allclose(value[k], wanted, rtol=1e-7, atol=1e-7)


@pytest.mark.slow
def test_jacobian_against_central_differences(evaluated):
    """To 5 mm, at 90 degrees and obliquely, by every kind of parameter; one path each way."""
    study, theta, lane, r, _ = evaluated
    _, value = programs(study.model)
    names = [p.name for p, _, _ in study.unknowns[0]]
    for i, name in enumerate(names):
        h = 1e-4
        ahead, back = (value(theta.at[i].add(sign * h), lane) for sign in (1, -1))
        numeric = (ahead - back) / (2 * h)
        largest = float(jnp.max(jnp.abs(numeric)))
        assert largest > 1e-6, name
        np.testing.assert_allclose(
            r.jacobian[:, i], numeric, rtol=1e-5, atol=2e-6 * largest, err_msg=name
        )


@pytest.mark.slow
def test_what_is_not_observed_counts_nothing(evaluated):
    """NaN in a curve, and a sample past any equilibrium: exact zeros, the others as they were."""
    study, theta, lane, before, _ = evaluated
    both, _ = programs(study.model)
    curves = [curve(place) for place in PLACES]
    side, moved, end = (np.array(v) for v in (curves[1].side_force, curves[1].joint_displacement,
                                              curves[1].end_V))  # fmt: skip
    side[0], moved[2, 1], end[1, 0, 1] = np.nan, np.nan, np.nan
    curves[1] = dataclasses.replace(curves[1], side_force=side, joint_displacement=moved, end_V=end)
    sparse = study_of(curves)
    got = both(theta, lane_of(sparse))
    gone = np.zeros(before.value.shape, bool)
    n = len(PATH)
    ends = 2 * n + 2 * 3 * n
    gone[1, [n, 2 * n + 3 * 2 + 2, ends + 12 + 4 + 3]] = True
    assert np.all(np.asarray(got.value)[gone] == 0)
    assert np.all(np.asarray(got.jacobian).transpose(0, 2, 1)[gone] == 0)
    np.testing.assert_allclose(np.asarray(got.value)[~gone], np.asarray(before.value)[~gone])
    # A trial that nothing observes is not pressed, wherever it would go.
    far = study_of([curve(place) for place in PLACES])
    far.lanes.displacement[0, 2] = [0.5, 2.0, 60.0]  # no curve of a study goes as deep
    lost = both(theta, lane_of(far))
    assert np.all(np.isfinite(lost.value[:2]))
    assert np.isnan(lost.value[2]).any()
    assert not np.isfinite(np.sum(np.square(lost.value)))
    hidden = without_data(far.lanes, np.array([[False, False, True]]))
    blind = lane_of(dataclasses.replace(far, lanes=hidden))
    kept = both(theta, blind)
    assert np.all(np.asarray(kept.value[2]) == 0)
    assert np.all(np.asarray(kept.jacobian[2]) == 0)
    np.testing.assert_allclose(kept.value[:2], before.value[:2], rtol=1e-9)


def pressed(values, place, path=PATH):
    """A curve as `press_sections` shows it, with vectors."""
    s, phi, direction = place
    got = jax.tree.map(np.asarray, single(values, s, phi, path, direction))
    frame = np.array([[0, -np.cos(phi), -np.sin(phi)], [0, -np.sin(phi), np.cos(phi)]])
    F, moved = got.force @ frame.T, got.joints @ frame.T
    a, b = direction
    return curve(
        place, path, force=F @ [a, b], side_force=F @ [-b, a],
        joint_rings=np.arange(3), joint_displacement=moved[..., 0],
        joint_side_displacement=moved[..., 1], end_rings=np.arange(3),
        end_U=got.end_U[..., 1:], end_V=got.end_V[..., 1:],
    )  # fmt: skip


TRUTH = {"EI_C": 31.0, "bed_n": 0.013, "bed_t": 0.0031, "Et_L": 0.9, "D_L": 5.5, "c_W": 1.4}


@pytest.mark.slow
def test_known_parameters_are_found(tmp_path):
    """From vectors of three presses, to rounding; nothing on a bound, nothing open."""
    start = from_wall(GEOMETRY)
    fields = {f.name: np.median(getattr(start, f.name)) for f in dataclasses.fields(start)}
    study = study_of([pressed(fields | TRUTH, place) for place in PLACES], {})
    assert {p.name for p in study.free} == set(TRUTH)
    result = fit(study, Settings(starts=1, more_starts=0))
    assert result.status[0] == FitStatus.CONVERGED
    found = {p.name: v for (p, _, _), v in zip(study.unknowns[0], result.value[0], strict=True)}
    for name, true in TRUTH.items():
        assert found[name] == pytest.approx(true, rel=1e-4), name
    assert np.all(np.isfinite(result.standard_error))
    assert not result.undetermined.any()
    with pytest.raises(ValueError, match="the posterior is not available.*'sections'"):
        posterior(result)
    write_hdf5(tmp_path / "r.h5", AnalysisResults(result), {})
    with h5py.File(tmp_path / "r.h5") as file:
        data = {name: file["data"][name][()] for name in file["data"]}
    curves, n = study.curves[0], len(PATH)
    for i, c in enumerate(curves):
        row = slice(i * n, (i + 1) * n)
        np.testing.assert_array_equal(data["side_force"][row], c.side_force)
        np.testing.assert_array_equal(data["joint_side"][row], c.joint_side_displacement)
        unread = np.isnan(data["joint_side_residual"][row])  # by symmetry it is 0 on the midline
        assert np.all(unread == (c.phi_c == 0))
        np.testing.assert_array_equal(data["ends"][row, :, 1], c.end_V)
        np.testing.assert_array_equal(data["direction"][i], c.direction)
    for name in ("side", "joint_side", "end"):
        assert np.nanmax(np.abs(data[f"{name}_residual"])) < 1e-4


def test_lanes():
    """On the midline the small program; markers under the tool do not count, ends far away do."""
    plain = study_of([curve((20.0, 0.0, (1.0, 0.0)))]).lanes
    assert plain.phi_c is None
    assert plain.direction is None
    near = study_of([curve((10.5, 0.5, (1.0, 0.0)))], tool_radius=1.0).lanes
    np.testing.assert_array_equal(near.phi_c, [[0.5]])
    for seen in (near.others["joints"].precision, near.others["joint_side"].precision):
        np.testing.assert_array_equal(np.any(seen > 0, axis=(0, 1, 2)), [False, False, True])
    assert np.sum(near.others["ends"].precision > 0) == 3 * 4
    # Under the tool, off the midline: both ends are far round the ring, V 15 mm, U 34 mm.
    under = curve((20.5, 0.8, (1.0, 0.0)))
    for given, count in ((True, 3 * 4), (False, 0)):
        seen = study_of([under], tool_radius=1.0, weighting=Weighting(pressed_ends=given))
        assert np.sum(seen.lanes.others["ends"].precision > 0) == count
    without = Weighting(pressed_ends=False)
    beside = study_of([curve((10.5, 0.5, (1.0, 0.0)))], tool_radius=1.0, weighting=without)
    assert np.sum(beside.lanes.others["ends"].precision > 0) == 3 * 4
    with pytest.raises(ValueError, match="pressed_ends=False needs tool_radius"):
        study_of([under], weighting=without)
    at_end = curve((20.0, np.pi / 2, (1.0, 0.0)))  # 30 degrees from it, 5.9 mm
    ends = study_of([at_end], tool_radius=7.0).lanes.others["ends"].precision
    assert np.sum(ends[..., 0, :] > 0) == np.sum(ends > 0) == 3 * 2
    bare = {name: None for name in ("side_force", "joint_side_displacement", "end_U", "end_V",
                                    "end_rings", "joint_rings", "joint_displacement")}  # fmt: skip
    force = study_of([curve(PLACES[1], **bare)]).lanes
    assert force.others == {}
    only_ends = bare | {"end_rings": np.array([0]), "end_U": np.ones((3, 1, 2))}
    lanes = study_of([curve(PLACES[1], **only_ends)]).lanes
    assert np.sum(lanes.others["ends"].precision > 0) == 6
    assert np.sum(lanes.others["joints"].precision > 0) == 0


def test_a_share_of_the_force_weighs_side_forces_too():
    study = study_of([curve(PLACES[1])])
    plain = np.asarray(study.lanes.precision)
    found = with_shares(study, Shares(np.array([0.1]), None, plain), plain / 2).lanes
    np.testing.assert_array_equal(found.others["side_force"].precision, plain / 2)
    np.testing.assert_array_equal(found.others["ends"].precision[0, 0, :, 1], 1 / 0.2)


def test_curves_of_a_stored_fit_have_what_it_read(tmp_path):
    """Of markers and ends what has a residual; the side force as measured."""
    n, rings, rng = 4, 3, np.random.default_rng(5)
    joints, ends = rng.normal(size=(n, rings)), rng.normal(size=(n, rings, 2, 2))
    left = {"joint": np.zeros((n, rings)), "end": np.zeros(ends.shape)}
    left["joint"][:, 1], left["end"][2, 0, 1, 0] = np.nan, np.nan
    with h5py.File(tmp_path / "data.h5", "w") as file:
        stored = {"joints": joints, "ends": ends, "side_force": np.arange(4.0)}
        for name, values in (stored | {f"{k}_residual": v for k, v in left.items()}).items():
            file[name] = values
        found = _observed(file)
    np.testing.assert_array_equal(found["joint_displacement"], joints + left["joint"])
    np.testing.assert_array_equal(found["end_U"], ends[:, :, 0])
    np.testing.assert_array_equal(found["end_V"], (ends + left["end"])[:, :, 1])
    np.testing.assert_array_equal(found["side_force"], np.arange(4.0))
    np.testing.assert_array_equal(found["end_rings"], range(rings))


def test_weight_of_the_data_is_that_of_all_forces():
    """Side forces, curve weights and noise count, of one lane and of the lanes of a joint fit."""
    presses = zip(("one", "one", "two"), PLACES, (3, 5, 4), strict=True)
    curves = [
        dataclasses.replace(curve(place, np.linspace(0.5, 5.0, n)), specimen=specimen)
        for specimen, place, n in presses
    ]
    table = NAMED | {"EI_C": {"scope": "shared"}}
    study = study_of(curves, table, joint=True)
    sigma = np.array([[2.0, 1.0], [2.0, 1.0]])
    # A normal press on the midline has no side force to tell; every curve weighs as one of 4.
    squares = [np.sum(c.force**2) + (c.phi_c != 0) * np.sum(c.side_force**2) for c in curves]
    each = [
        4 / len(c.force) * s / (0.05 * 2.0) ** 2 / 2 for c, s in zip(curves, squares, strict=True)
    ]
    wanted = np.array([each[0] + each[1], each[2]])
    np.testing.assert_allclose(data_weight(study.lanes, sigma), wanted, rtol=1e-12)
    one = lane_of(study)
    np.testing.assert_allclose(data_weight(one, jnp.asarray(sigma[0])), wanted[0], rtol=1e-12)
    # Nothing is left of the cost but roundings: a hundred of each force, in each of two lanes.
    task = shared._Task(study, sigma, Tolerances(), 1, np.float64, study.shared)
    none, P = np.zeros(2), study.size
    here = shared.Evaluated(np.zeros((2, P)), none, np.zeros((2, P)), np.zeros((2, P, P)))
    exact = np.sum(wanted) / 2 * (100 * np.finfo(float).eps) ** 2
    np.testing.assert_allclose(shared._floor(task, here, none == 0), exact, rtol=1e-12)


def test_noise_of_a_joint_fit_is_of_all_forces(monkeypatch):
    """With a robust loss it is a median: side forces are forces there, and no markers."""
    curves = [curve(PLACES[1]), dataclasses.replace(curve(PLACES[2]), specimen="two")]
    study = study_of(
        curves, NAMED | {"EI_C": {"scope": "shared"}}, joint=True, weighting=Weighting(loss="huber")
    )
    lane = study.lanes
    row = np.full((2, 1, size(lane)), 5.0)
    row[..., : force_entries(lane)] = [1.0] * 3 + [3.0] * 3
    monkeypatch.setattr(information, "map_lanes", lambda *_, **__: row)
    one, two, P = np.ones(2), np.ones((2, 2)), study.size
    none = np.zeros((2, P, P))
    info = Information(none, none, np.zeros((2, P)), *[two] * 5, one)
    found = information.pooled(study, info, np.zeros((2, P)), one > 0)
    np.testing.assert_array_equal(found.spread, [[2.0, 5.0]] * 2)


def test_repeats_are_of_the_same_angle_and_direction():
    places = [(20.0, 0.0, (1.0, 0.0)), (20.0, 0.5, (1.0, 0.0)), (20.0, 0.5, (0.8, 0.6))]
    study = study_of([curve(place) for place in places])
    assert [row.sum() for row in repeats(study).held] == [1, 1, 1]


def test_a_fit_begins_at_the_wall():
    """Medians of `from_wall`, whatever the declared defaults; a wall for another model is none."""
    uneven = Geometry.create(40.0, [10.0, 14.0, 30.0], radius=11.7)
    wall = Wall(E_C=8.0)
    begun, there = defaults_of(SECTIONS, uneven, wall), from_wall(uneven, wall)
    for name in SECTION_VALUES:
        value = np.median(getattr(there, name))
        if np.isfinite(value):
            assert begun[name].value == pytest.approx(value, rel=1e-12)
    assert defaults_of(Options(), uneven) is DEFAULTS
    with pytest.raises(ValueError, match="wall: .*'sections' alone; leave it out"):
        defaults_of(Options(), uneven, wall)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"contact": "unilateral"}, "contact='bonded', found 'unilateral'"),
        ({"shear": True}, "shear=False, found True"),
        ({"local": "two-material"}, "local='uniform'"),
        ({"coupling": "total"}, "coupling='series'"),
        ({"split": "independent"}, "split='continuous'"),
        ({"form": "reactions"}, "form='recursion'"),
        ({"transition": 2.0}, "transition=None"),
    ],
)
def test_options_that_exclude_each_other(change, words):
    with pytest.raises(ValueError, match=f"skeleton='sections' needs {words}"):
        Options(**({"skeleton": "sections", "contact": "bonded"} | change))


def test_presses_of_a_line_refuse():
    material = Material(1.0, 1.0, 1.0, 0.0, EA_L=1.0, EI_C=1.0, k_t=1.0)
    with pytest.raises(ValueError, match="use press_sections"):
        press(GEOMETRY, material, 20.0, 1.0, SECTIONS)
    with pytest.raises(ValueError, match="use press_sections"):
        press_oblique(
            GEOMETRY, material, 20.0, 0.0, jnp.ones((1, 3)), ObliqueOptions(press=SECTIONS)
        )
    study = study_of([curve(PLACES[0])])
    with pytest.raises(ValueError, match="no compliance"):
        inputs(study.model, point_of(study), lane_of(study))
    with pytest.raises(ValueError, match="fit.method = 'adam' is not available"):
        fit(study, Settings(method="adam"))


def test_curves_that_a_model_cannot_press():
    aside = curve((20.0, 0.5, (1.0, 0.0)))
    with pytest.raises(ValueError, match="phi = 28.6 deg.*choose skeleton = 'sections'"):
        check_curve(aside, Size.of(GEOMETRY), Options())
    turned = curve((20.0, 0.0, (0.8, 0.6)))
    with pytest.raises(ValueError, match=r"\(0.8, 0.6\).*choose skeleton = 'sections'"):
        check_curve(turned, Size.of(GEOMETRY), Options())
    check_curve(turned, Size.of(GEOMETRY), SECTIONS)
    behind = curve((20.0, 2.2, (1.0, 0.0)))
    with pytest.raises(ValueError, match="phi = 126 deg, expected on the cartilage, within 120"):
        check_curve(behind, Size.of(GEOMETRY), SECTIONS)
    for phi in (np.pi / 2, -np.pi / 2):
        check_curve(curve((20.0, phi, (1.0, 0.0))), Size.of(GEOMETRY), SECTIONS)
    with pytest.raises(ValueError, match="phi = -115 deg, expected within 90 deg.*too stiff"):
        check_curve(curve((20.0, -2.0, (1.0, 0.0))), Size.of(GEOMETRY), SECTIONS)
    with pytest.raises(ValueError, match="end of ring 4 of 3"):
        check_curve(curve(PLACES[0], end_rings=np.array([3])), Size.of(GEOMETRY), SECTIONS)
    with pytest.raises(ValueError, match="12 mm deep, expected no more than the radius, 11.7 mm"):
        check_curve(curve(PLACES[0], np.array([0.5, 2.0, 12.0])), Size.of(GEOMETRY), SECTIONS)
    # From first touch, where that is known.
    check_curve(curve(PLACES[0], np.array([10.5, 12.0])), Size.of(GEOMETRY), SECTIONS, 10.0)
    with pytest.raises(ValueError, match="pressed 12 mm deep"):
        check_curve(curve(PLACES[0], np.array([10.5, 22.0])), Size.of(GEOMETRY), SECTIONS, 10.0)


def test_lanes_pressed_otherwise_are_of_another_kind():
    """Their structure is decided at their own displacements, angles and observations."""
    kinds = structure._kinds(
        study_of([
            curve(PLACES[0]), dataclasses.replace(curve(PLACES[1]), specimen="two", s_c=20.0),
        ])
    )  # fmt: skip
    np.testing.assert_array_equal(kinds[0], [0, 1])


def test_a_kind_of_few_samples_is_taken_for_as_alike_as_the_forces():
    """Ends seen at every tenth sample have no neighbours, and zeros no correlation at all."""
    n = 4000
    noise = np.random.default_rng(0).normal(size=n + 1)
    alike = np.zeros(n)
    for i in range(n):
        alike[i] = 0.8 * (alike[i - 1] if i else 0) + noise[i]
    ends = np.full((1, 1, n, 1, 2, 2), np.nan)
    ends[..., ::10, :, :, :] = 1.0
    share = (1 - 0.8) / (1 + 0.8)
    force = alike[None, None]
    for more, count in (({}, n), ({"ends": ends}, n + 4 * n / 10),
                        ({"side_force": np.zeros((1, 1, n))}, 2 * n)):  # fmt: skip
        found = effective_samples({"force": force, **more})
        np.testing.assert_allclose(found, count * share, rtol=0.15)


def test_a_comparison_says_which_model_reads_more():
    plain = dataclasses.replace(
        curve(PLACES[0]), joint_rings=None, joint_displacement=None, joint_side_displacement=None
    )
    with pytest.warns(UserWarning, match="not read: side force"):
        line = build_study([plain], GEOMETRY, Options(contact="bonded"), noise=NOISE)
    both = study_of([plain]), line
    with pytest.raises(ValueError, match="'sections' reads side forces.*from a file without those"):
        same_data(both, ["a.toml", "b.toml"])


SPEC = """
[data]
files = "a.h5"
[model]
skeleton = "{}"
contact = "{}"
{}
"""


def test_specification(tmp_path):
    """The [wall] table is read with units; what cannot be is named by its key."""
    path = tmp_path / "fit.toml"

    def table(skeleton="sections", contact="bonded", more=""):
        path.write_text(SPEC.format(skeleton, contact, more))
        spec = load_fit_spec(path)
        return {p.name: p for p in parameters_of(spec, options_of(spec), joints=True)}

    found = table(more='[wall]\nE_M = "600 kPa"\nbed_n = "30 kPa/mm"\n[parameters]\nGt_L = {}')
    assert found["Et_M"].value == pytest.approx(1.08 * 0.6 * 2.0)
    assert found["bed_n"].value == pytest.approx(0.03)
    assert not found["Gt_L"].fixed
    assert found["Et_M"].fixed
    held = table(more='[wall]\nbed_n = "30 kPa/mm"\n[parameters]\nbed_n = { fixed = true }')
    kept = held["bed_n"]
    assert (kept.value, kept.fixed) == (found["bed_n"].value, True)
    for arguments, words in (
        ({"more": '[wall]\nh = "1 mm"'}, "wall.h_C is 1.56 mm; expected at most"),
        ({"more": "[wall]\nnu = 0.5"}, "wall.nu is 0.5"),
        ({"more": '[wall]\nE_C = "3 mm"'}, "wall.E_C"),
        ({"contact": "unilateral"}, "model: skeleton='sections' needs contact='bonded'"),
        ({"skeleton": "linear", "more": "[wall]"}, "wall: moduli and thicknesses are read by"),
        ({"more": "[parameters]\nk_M = {}"}, "parameters.k_M: not seen by this model"),
        ({"more": "[parameters]\nfootprint = { fixed = 0.5 }"}, "expected 1 or more"),
        ({"more": '[parameters]\nc_K = { fixed = "-5 mm^2" }'}, "expected 0 or more"),
    ):
        with pytest.raises(SpecError) as error:
            table(**arguments)
        assert words in str(error.value), str(error.value)


def test_results_from_before_a_parameter_was_there_have_its_default():
    """Without `c_end`, which older results do not name: all of c_W at the ends, as then."""
    study = study_of([curve(PLACES[0])])
    columns = study.model.columns
    keep = [j for j, column in enumerate(columns) if column.name != "c_end"]
    assert len(keep) == len(columns) - 1
    older = dataclasses.replace(study.model, columns=tuple(columns[j] for j in keep))
    value = jnp.asarray(study.lanes.value[0, 0, np.array(keep)])
    free = jnp.array([p.to_scaled(p.value) for p in study.parameters if not p.fixed])
    values = values_of(older, free, value)
    material = older.level.material(values)
    assert "c_end" not in values
    assert material.c_end == 1
    assert material.c_W == values["c_W"]
