"""Side forces, sideward markers, ring ends and directions: read, checked, written, left out."""

import dataclasses
import math
import re
from pathlib import Path

import h5py
import jax
import numpy as np
import pytest
from run_cli import run

from jaxtrachea.cli.main import _curve_table
from jaxtrachea.fitting.build import build_study
from jaxtrachea.measurements.read import (
    Curve,
    DataError,
    Measurements,
    ReadOptions,
    read_measurements,
    write_hdf5,
)
from jaxtrachea.mechanics.press import Options
from jaxtrachea.trachea.geometry import Geometry

VIRTUAL = Path(__file__).parents[1] / "fits" / "virtual_trachea"
#: Fields that only a press with vectors has.
ARRAYS = ("side_force", "joint_side_displacement", "end_rings", "end_U", "end_V")
NAN = math.nan


def full(specimen="T01", **changes):
    """A curve with every field, all numbers different."""
    n = np.arange(3.0)
    fields = {
        "s_c": 35.0,
        "phi_c": 0.5,
        "displacement": np.array([0.0, 1.0, 2.0]),
        "force": np.array([0.0, 0.5, 1.2]),
        "joint_rings": np.array([2, 6]),
        "joint_displacement": np.array([[0.0, NAN], [0.1, 0.02], [0.21, 0.03]]),
        "direction": (0.6, 0.8),
        "side_force": np.array([0.0, NAN, -1 / 3]),
        "joint_side_displacement": np.array([[NAN, 0.0], [1 / 7, 0.2], [0.3, 0.4]]),
        "end_rings": np.array([1, 8, 4]),
        "end_U": 0.1 + 0.01 * n[:, None, None] * np.array([[1, 2], [3, NAN], [5, 6]]),
        "end_V": -0.7 + 0.03 * n[:, None, None] * np.array([[1, 2], [3, 4], [5, 6]]),
    }
    return Curve(specimen, "1", **(fields | changes))


def stored(path, *curves):
    write_hdf5(path, Measurements(curves, (), ()))
    return path


def put(folder, text, name="study.csv"):
    path = folder / name
    path.write_text(text)
    return path


def read(path, **options):
    return read_measurements([path], ReadOptions(**options))


# --- HDF5 ---------------------------------------------------------------------------------------


def infinite(name):
    values = getattr(full(), name).copy()
    values[1] = np.inf
    return {name: values}


BAD_CURVES = {
    "side force infinite": (infinite("side_force"), "non_finite", "side force .* in sample 2"),
    "side force too large": ({"side_force": np.array([0, 0, 1e6])}, "absurd_scale", "sample 3"),
    "sides infinite": (infinite("joint_side_displacement"), "non_finite", "sideward .* sample 2"),
    "sides without rings": (
        {"joint_rings": None, "joint_displacement": None}, "shape", "expected 3 x 0"),
    "sides without markers": ({"joint_displacement": None}, "shape", "needs joint_displacement"),
    "ends without rings": ({"end_rings": None}, "shape", "expected 3 x 0 x 2"),
    "rings without ends": (
        {"end_U": None, "end_V": None}, "shape", "end_ring_number without end_U and end_V"),
    "ends of ring 0": (
        {"end_rings": np.array([-1, 0, 1])}, "shape", "end_ring_number is repeated or below 1"),
    "ends of a ring twice": ({"end_rings": np.array([2, 0, 2])}, "shape", "is repeated"),
    "ends infinite": (infinite("end_U"), "non_finite", "ends U is infinite in sample 2"),
    "ends too far": ({"end_U": full().end_U + 2e3}, "absurd_scale", "ends U is more than 1000 mm"),
    "direction nan": ({"direction": (NAN, 0.0)}, "direction", "expected two finite numbers"),
    "direction zero": (
        {"direction": (0.0, 0.0)}, "direction", r"\(0, 0\) has the length 0, expected 1"),
    "direction too long": ({"direction": (0.6, 0.802)}, "direction", "has the length 1.00"),
    "direction outward": ({"direction": (-0.6, 0.8)}, "direction", "points outward"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_CURVES)
def test_bad_curve(tmp_path, name):
    changes, kind, message = BAD_CURVES[name]
    path = stored(tmp_path / "m.h5", full(**changes), full("T02"))
    found = read(path)
    assert [c.specimen for c in found.curves] == ["T02"]
    (bad,) = found.bad
    assert bad.kind == kind
    assert bad.cure
    assert f"{path}:/curves[0]" in bad.message
    assert re.search(message, bad.message)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ((0.6, 0.8), (0.6, 0.8)),
        ((0.6004, 0.8), (0.6004 / math.hypot(0.6004, 0.8), 0.8 / math.hypot(0.6004, 0.8))),
        ((0.0, -1.0), (0.0, -1.0)),
        ((math.cos(math.pi / 2), 1.0), (math.cos(math.pi / 2), 1.0)),
    ],
)
def test_direction_is_made_of_length_1(tmp_path, given, expected):
    """Within 1e-3 a length is a rounded 1."""
    (curve,) = read(stored(tmp_path / "m.h5", full(direction=given))).curves
    assert curve.direction == pytest.approx(expected, rel=1e-15, abs=1e-18)


# --- tables -------------------------------------------------------------------------------------

TIDY = """\
{"direction": [0.8, -0.6]}
specimen,s [mm],phi [deg],displacement [mm],force [N],side_force [mN],joint_7 [mm],\
joint_7_side [um],joint_3 [mm],end_U_7_y [mm],end_U_7_z [cm],end_V_2_z [um]
T01,35,90,0,0,0,0,0,0,0,0,0
T01,35,90,1,0.5,-250,0.1,30,0.2,0.4,0.05,60
T01,35,90,2,1.2,,0.3,,0.5,0.8,,70
"""


def test_tidy_values_by_hand(tmp_path):
    found = read(put(tmp_path, TIDY))
    assert found.bad == ()
    (curve,) = found.curves
    assert curve.direction == (0.8, -0.6)
    np.testing.assert_allclose(curve.side_force, [0, -0.25, NAN], rtol=1e-15)
    # Ring number 7 in the file is index 6 in memory; a marker without a sideward column is NaN.
    np.testing.assert_array_equal(curve.joint_rings, [6, 2])
    np.testing.assert_array_equal(curve.joint_displacement, [[0, 0], [0.1, 0.2], [0.3, 0.5]])
    sides = [[0, NAN], [0.03, NAN], [NAN, NAN]]
    np.testing.assert_allclose(curve.joint_side_displacement, sides, rtol=1e-15)
    np.testing.assert_array_equal(curve.end_rings, [6, 1])
    U = [[[0, 0], [NAN, NAN]], [[0.4, 0.5], [NAN, NAN]], [[0.8, NAN], [NAN, NAN]]]
    V = [[[NAN, NAN], [NAN, z]] for z in (0, 0.06, 0.07)]
    np.testing.assert_allclose(curve.end_U, U, rtol=1e-15)
    np.testing.assert_allclose(curve.end_V, V, rtol=1e-15)


def test_columns_and_units_from_options(tmp_path):
    text = "s,D,F,T,marker,aside,Uy\n" + "".join(
        f"35,{i},{i},{2 * i},{3 * i},{4 * i},{5 * i}\n" for i in range(3)
    )
    columns = {"displacement": "D", "force": "F", "side_force": "T", "joint_7": "marker",
               "joint_7_side": "aside", "end_U_9_y": "Uy"}  # fmt: skip
    units = {"s": "mm", "displacement": "mm", "force": "N", "side_force": "mN", "joint": "mm",
             "joint_7_side": "um", "end": "cm"}  # fmt: skip
    (curve,) = read(put(tmp_path, text), columns=columns, units=units).curves
    np.testing.assert_allclose(curve.side_force, [0, 2e-3, 4e-3], rtol=1e-15)
    np.testing.assert_array_equal(curve.joint_displacement[:, 0], [0, 3, 6])
    np.testing.assert_allclose(curve.joint_side_displacement[:, 0], [0, 4e-3, 8e-3], rtol=1e-15)
    np.testing.assert_array_equal(curve.end_rings, [8])
    np.testing.assert_array_equal(curve.end_U[:, 0, 0], [0, 50, 100])
    assert np.isnan(curve.end_U[:, 0, 1]).all()
    assert curve.end_V is None


def test_machine_file(tmp_path):
    text = "Test: 7\ntime_s;displacement_mm;force_N;side_force_N;end_v_3_z_mm\n0;0;0;0;0\n"
    path = put(tmp_path, text + "1;1;2;0,5;0,1\n2;2;4;0,7;0,2\n", "T07.csv")
    (curve,) = read(path, specimen="{specimen}").curves
    np.testing.assert_array_equal(curve.side_force, [0, 0.5, 0.7])
    np.testing.assert_array_equal(curve.end_V[:, 0, 1], [0, 0.1, 0.2])
    assert list(curve.end_rings) == [2]


ROWS = "0,0,0\n1,1,1\n"
HEAD = "displacement [mm],force [N],"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD + "side_force\n" + ROWS, r"column 'side_force' has no unit.*data.units.side_force"),
        (HEAD + "side_force [mm]\n" + ROWS, "column 'side_force'.*'mm'"),
        (HEAD + "end_U_7_y\n" + ROWS, r"column 'end_U_7_y' has no unit.*data.units.end"),
        (HEAD + "end_U_0_y [mm]\n" + ROWS, "'end_U_0_y': ring below 1 or given twice"),
        (HEAD + "joint_0_side [mm]\n" + ROWS, "'joint_0_side': ring below 1"),
        (HEAD + "end_V_2_z [mm],end v 2 z [mm]\n0,0,0,0\n1,1,1,1\n", "ring below 1 or given twice"),
        ('{"direction": [1]}\n' + HEAD + "a\n" + ROWS, r"line 1: direction is \[1\], expected two"),
        ('{"direction": "x"}\n' + HEAD + "a\n" + ROWS, 'direction is "x", expected two numbers'),
    ],
)
def test_whole_table_refused(tmp_path, text, message):
    with pytest.raises(DataError, match=f"(?s){message}") as error:
        read(put(tmp_path, text), format="tidy")
    assert str(tmp_path / "study.csv") in str(error.value)


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        (
            HEAD + "joint_7_side [mm]\n" + ROWS,
            "column_missing",
            "joint_7_side and none for joint_7",
        ),
        (HEAD + "side_force [N]\n0,0,0\n1,1,inf\n", "non_finite", "side force .* in line 3"),
        (HEAD + "end_U_7_y [mm]\n0,0,0\n1,1,x\n", "unparsable", "line 3: end_U_7_y 'x'"),
        ('{"direction": [2, 0]}\n' + HEAD + "a\n" + ROWS, "direction", "has the length 2"),
    ],
)
def test_bad_table(tmp_path, text, kind, message):
    # Only a tidy table has a first line with a direction.
    for format in ("tidy",) if kind == "direction" else ("tidy", "machine"):
        (bad,) = read(put(tmp_path, text), format=format).bad
        assert bad.kind == kind
        assert re.search(message, bad.message)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"columns": {"end": "w"}}, "which end of which ring"),
        ({"columns": {"end_W_7_y": "w"}}, "role 'end_W_7_y' in columns; .*end_U_<ring>_y"),
        ({"columns": {"end_U_0_y": "w"}}, "role 'end_U_0_y'"),
        ({"columns": {"joint_7_up": "w"}}, "role 'joint_7_up'"),
        ({"units": {"side_force": "mm"}}, "units.side_force"),
        ({"units": {"end_U_7_y": "N"}}, "units.end_U_7_y"),
    ],
)
def test_options_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ReadOptions(**options)


# --- what every curve goes through --------------------------------------------------------------


def cycles(tmp_path):
    """Two loadings with a hold and a way back; every array tells the number of its sample."""
    up = np.linspace(0, 2, 41)
    displacement = np.concatenate([up, up[-2::-1], up[1:], np.full(60, 2.0), up[-2:0:-1]])
    number = np.arange(displacement.size, dtype=np.float64)
    curve = full(
        displacement=displacement,
        force=displacement + 1e-6 * number,
        side_force=number,
        joint_displacement=np.stack([number, -number], axis=1),
        joint_side_displacement=np.stack([-number, number], axis=1),
        end_rings=np.array([4]),
        end_U=np.stack([number, 2 * number], axis=1)[:, None] / 2,
        end_V=np.stack([-number, 3 * number], axis=1)[:, None] / 4,
    )
    return curve, stored(tmp_path / "m.h5", curve)


@pytest.mark.parametrize("loading", ["first", "last", "all"])
@pytest.mark.parametrize("window", [{}, {"displacement_min": 0.33, "displacement_max": 1.77}])
def test_the_same_samples_are_kept_of_every_array(tmp_path, loading, window):
    curve, path = cycles(tmp_path)
    (found,) = read(path, loading=loading, **window).curves
    # The force tells the sample: 1e-6 N for each beside that of the displacement.
    kept = np.round((found.force - found.displacement) * 1e6).astype(int)
    assert loading == "all" or kept.size < curve.force.size / 2
    assert not window or found.displacement.min() > 0.33
    for name in ("displacement", "side_force", "joint_displacement", "joint_side_displacement",
                 "end_U", "end_V"):  # fmt: skip
        np.testing.assert_array_equal(getattr(found, name), getattr(curve, name)[kept])
        assert getattr(found, name).dtype == np.float64


def test_signs(tmp_path):
    """A load cell turned round turns both components; what else is measured keeps its axes."""
    turned = full(displacement=-full().displacement, force=-full().force)
    path = stored(tmp_path / "m.h5", turned)
    (found,) = read(path, force_sign=-1, displacement_sign=-1).curves
    np.testing.assert_array_equal(found.force, full().force)
    np.testing.assert_array_equal(found.side_force, -full().side_force)
    assert found.direction == full().direction
    for name in ("joint_displacement", "joint_side_displacement", "end_U", "end_V"):
        np.testing.assert_array_equal(getattr(found, name), getattr(full(), name))


# --- the presses of the virtual trachea ----------------------------------------------------------


@pytest.fixture(scope="module")
def virtual():
    """The presses by position (mm) and angle (deg)."""
    found = read_measurements(VIRTUAL / "off_midline.h5")
    assert found.bad == ()
    return {(c.s_c, round(math.degrees(c.phi_c))): c for c in found.curves}


MIDLINE = (22, 35, 50, 58, 70, 75, 80, 100, 107, 125)


def test_presses_of_the_virtual_trachea(virtual):
    off = {(s, phi) for s in (70, 75) for phi in (30, 90)}
    assert set(virtual) == {(s, 0) for s in MIDLINE} | off
    for curve in virtual.values():
        assert (curve.displacement[0], curve.displacement[-1]) == (0, 6)
        assert curve.usage.used == curve.usage.recorded
        np.testing.assert_array_equal(curve.end_rings, np.arange(15))
    assert (VIRTUAL / "off_midline.h5").stat().st_size < 300_000


def test_midline_presses_are_those_of_the_file_without_vectors(virtual):
    for plain in read_measurements(VIRTUAL / "finite_strain.h5").curves:
        curve = virtual[plain.s_c, 0]
        for name in ("displacement", "force", "joint_rings", "joint_displacement"):
            np.testing.assert_array_equal(getattr(curve, name), getattr(plain, name))


@pytest.mark.parametrize("s", MIDLINE)
def test_midline_presses_are_symmetric(virtual, s):
    """No force and no motion of markers aside; the ends move as images in the midline plane."""
    curve = virtual[s, 0]
    assert np.abs(curve.side_force).max() <= 1e-12
    assert np.abs(curve.joint_side_displacement).max() <= 1e-12
    np.testing.assert_allclose(curve.end_U, curve.end_V * [1, -1], atol=1e-12)
    assert np.abs(curve.end_V[-1]).max() > 0.1


def test_specimen_is_symmetric_about_its_middle(virtual):
    """35 and 125 mm are mirror positions: ring i of one moves as ring 16 - i of the other."""
    near, far = virtual[35, 0], virtual[125, 0]
    np.testing.assert_allclose(near.force, far.force, rtol=1e-6)
    for name in ("joint_displacement", "end_U", "end_V"):
        np.testing.assert_allclose(getattr(near, name), getattr(far, name)[:, ::-1], atol=1e-6)


@pytest.mark.parametrize(("s", "phi"), [(s, phi) for s in (70, 75) for phi in (30, 90)])
def test_the_near_end_moves_most(virtual, s, phi):
    """Pressed at phi > 0, the end V at +120 deg gives way, and towards the other side."""
    curve = virtual[s, phi]
    ring = 6  # at 70 mm
    U, V = curve.end_U[-1, ring], curve.end_V[-1, ring]
    assert np.hypot(*V) > 2 * np.hypot(*U)
    # At 90 deg the tool comes from the side of positive phi and pushes all towards negative z.
    if phi == 90:
        assert V[1] < U[1] < 0
    # On a ring the marker lies under the punch, and moves with it alone.
    if s == 70:
        np.testing.assert_allclose(curve.joint_displacement[:, ring], curve.displacement, atol=1e-9)
        np.testing.assert_allclose(curve.joint_side_displacement[:, ring], 0, atol=1e-9)


def test_small_presses_are_those_of_the_linear_solution(virtual):
    """Secants of 0.25, 0.5 and 1 mm, continued to 0 by a parabola, against `vectors.h5`.

    That is a solution of its own (small strain); its axes x, y, z are those of the tube. The
    parabola leaves out terms of the third order: 5e-5 of the force, 2.5e-5 per mm of the ends.
    """
    with h5py.File(VIRTUAL / "vectors.h5") as file:
        linear = {name: file[name][()] for name in file}
    assert len(linear["s_c"]) == len(virtual)
    for i, (s, phi) in enumerate(zip(linear["s_c"], linear["phi_c"], strict=True)):
        curve = virtual[s, round(math.degrees(phi))]
        D = curve.displacement[1:4]
        # Lagrange's polynomial at 0.
        weights = [np.prod([b / (b - a) for b in D if b != a]) for a in D]

        def slope(values, weights=weights, D=D):
            return np.tensordot(weights / D, values[1:4], axes=1)

        normal, side = [[-np.cos(phi), -np.sin(phi)], [-np.sin(phi), np.cos(phi)]]
        pairs = [
            (curve.force, linear["force"][i, 1:] @ normal),
            (curve.side_force, linear["force"][i, 1:] @ side),
            (curve.joint_displacement, linear["joints"][i, :, 1:] @ normal),
            (curve.joint_side_displacement, linear["joints"][i, :, 1:] @ side),
            (curve.end_U, linear["end_U"][i, :, 1:]),
            (curve.end_V, linear["end_V"][i, :, 1:]),
        ]
        for values, expected in pairs:
            np.testing.assert_allclose(slope(values), expected, atol=5e-5)


# --- what a model of presses along the normal does with them --------------------------------------

TUBE = Geometry.create(160.0, 10.0 * np.arange(1, 16))
OPTIONS = Options(contact="bonded")


def test_a_study_of_normal_presses_leaves_vectors_out_and_says_so(virtual):
    curves = [virtual[s, 0] for s in (35, 70)]
    plain = [c for c in read_measurements(VIRTUAL / "finite_strain.h5").curves if c.s_c in (35, 70)]
    plain = [dataclasses.replace(a, trial=b.trial) for a, b in zip(plain, curves, strict=True)]
    message = (
        "side force in 2, sideward motion of markers in 2, "
        "motion of ring ends U in 2, motion of ring ends V in 2 of 2"
        " curves"
    )
    with pytest.warns(UserWarning, match=message) as warned:
        study = build_study(curves, TUBE, OPTIONS)
    assert len(warned) == 1
    expected = build_study(plain, TUBE, OPTIONS)
    jax.tree.map(np.testing.assert_array_equal, study.lanes, expected.lanes)
    assert all(getattr(c, name) is None for c in study.curves[0] for name in ARRAYS)


def test_nothing_is_said_of_what_was_not_observed(virtual):
    nothing = np.full(11, NAN)
    curve = virtual[70, 0]
    left = dict.fromkeys(ARRAYS) | {"side_force": nothing}
    build_study([dataclasses.replace(curve, **left)], TUBE, OPTIONS)


@pytest.mark.parametrize("coupling", ["series", "total"])
def test_a_tool_that_moves_aside_is_refused(virtual, coupling):
    curve = dataclasses.replace(virtual[70, 0], direction=(0.8, 0.6))
    with pytest.raises(ValueError, match=r"trial 's070.0 phi00'.*\(0.8, 0.6\).*\(1, 0\) only"):
        build_study([curve], TUBE, Options(coupling=coupling, contact="bonded"))


def test_an_end_of_a_ring_that_the_tube_has_not(virtual):
    with pytest.raises(ValueError, match="end of ring 15 of 3"):
        build_study(
            [dataclasses.replace(virtual[70, 0], joint_rings=None, joint_displacement=None)],
            Geometry.create(160.0, np.array([10.0, 20.0, 30.0])),
            OPTIONS,
        )


SPEC = """
[data]
files = "study.csv"
[model]
coupling = "total"
[parameters]
k_3 = { fixed = 0.0 }
onset = { fixed = 0.0 }
force_offset = { fixed = 0.0 }
[fit]
starts = 1
"""
STUDY = "specimen,trial,displacement [mm],force [N],side_force [N],end_U_2_y [mm]\n" + "".join(
    f"T01,1,{i},{0.5 * i},{0.1 * i},0\nT01,1,{i + 0.5},{0.5 * i + 0.25},0,0\n" for i in range(4)
)


@pytest.fixture
def spec(tmp_path):
    put(tmp_path, STUDY)
    return put(tmp_path, SPEC, "study.toml")


@pytest.mark.slow
@pytest.mark.compiling
def test_commands_say_once_what_is_not_read(spec, tmp_path, monkeypatch, capsys):
    said = "Measured and not read: side force in 1, ring ends U in 1 of 1 curves"
    code, out, err = run(monkeypatch, capsys, "check", spec)
    assert code == 0
    assert " ".join(err.split()).count(said) == 1
    assert "ends" not in out
    code, out, err = run(monkeypatch, capsys, "fit", spec, "--out", tmp_path / "out")
    assert code == 0
    assert " ".join(err.split()).count(said) == 1
    assert (tmp_path / "out" / "report.md").read_text().count(said) == 1
    code, out, err = run(
        monkeypatch, capsys, "predict", tmp_path / "out", "--data", tmp_path / "study.csv",
        "--out", tmp_path / "predicted",
    )  # fmt: skip
    assert code == 0
    assert " ".join(err.split()).count(said) == 1
    assert (tmp_path / "predicted" / "report.md").read_text().count(said) == 1


def test_table_of_curves_shows_vectors(virtual):
    shown = _curve_table([virtual[70, 0], virtual[70, 30], full()])
    row = dict(zip(shown.head, shown.cells[1], strict=True))
    assert row["phi [deg]"] == "30"
    ends = "motion of ring ends U, motion of ring ends V"
    assert row["vectors"] == f"side force, sideward motion of markers, {ends}"
    assert shown.cells[2][-1].endswith(f"{ends}, tool 53.1° off the normal")
    # A column that is empty for this curve tells nothing of it.
    curve = virtual[70, 30]
    nothing = {name: np.full_like(getattr(curve, name), np.nan) for name in ("side_force", "end_U")}
    shown = _curve_table([dataclasses.replace(curve, **nothing)])
    assert shown.cells[0][-1] == "sideward motion of markers, motion of ring ends V"
    plain = dataclasses.replace(virtual[70, 0], **dict.fromkeys(ARRAYS))
    assert {"phi [deg]", "vectors"}.isdisjoint(_curve_table([plain]).head)
