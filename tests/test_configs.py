"""Every scene in configs/ is run; every way to spoil one is refused in a line that helps."""

import json
import tomllib
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pandas as pd
import pytest
import trimesh
from late import late
from run_cli import run, tree

from jaxtrachea import table_1
from jaxtrachea.cli import scene as scenes
from jaxtrachea.scene.paths import path_of
from jaxtrachea.scene.spec import load_scene_spec
from jaxtrachea.status import PressStatus
from jaxtrachea.trachea.tube import make_tube

pytestmark = pytest.mark.compiling

CONFIGS = Path(__file__).parents[1] / "configs"
NAMES = sorted(path.stem for path in CONFIGS.glob("*.toml"))
#: Effects that a scene must have (or not): what it is there to show.
SHOWS = {
    "bonded_pull": {"contact law": "bonded", "second_plane": "off"},
    "capsule": {"contact": "on", "end_motion": "on", "axial": "on"},
    "deep": {"contact": "on", "skeleton": "softening", "width": "punch", "shear": "on"},
    "cross_sections": {"skeleton": "sections", "surface": "sections", "dent": "8"},
    "forceps": {"contact": "on"},
    "friction": {"friction": "on", "axial": "on", "contact_point": "fixed"},
    "imported": {"curved": "off", "rings": "arch2"},
    "imported_tool": {"contact": "on", "curved": "on"},
    "left_down": {"axial": "on", "rings": "arch2"},
    "no_surface": {"surface": "off", "joints": "off", "second_plane": "off"},
    "normal": {"axial": "off", "rings": "arch2"},
    "off_midline": {"contact": "on", "second_plane": "on", "rings": "arch2"},
    "pinch": {"tools": "coupled", "rings": "arch2", "contact": "on"},
    "relaxation": {"relaxation": "uniform", "contact": "on", "contact_point": "fixed"},
    "retractor": {"tools": "coupled", "contact": "on"},
    "right_down": {"axial": "on", "rings": "arch2"},
    "suture": {"tools": "coupled", "contact law": "mixed"},
    "two_fingers": {"tools": "coupled", "contact": "on"},
    "scan": {"contact_point": "per_step", "surface": "off"},
}


def bent_tube(path):
    """A trachea as a scanner might give it: bent, in metres, elsewhere, with relief.

    It bends as the one that `imported_tool.toml` is for: its middle lies behind the chord of its
    ends, so that the tool presses it by 4 mm (on one bent the other way by 14: TOO_DEEP).
    """
    mesh = make_tube(table_1(), around=40, along=120, flatten=0.25)
    x, y, z = np.asarray(mesh.vertices).T
    y, z = np.stack([y, z]) * (1 + 0.3 * np.exp(-x / 12))  # wider at the carina
    a = x / 900
    bent = np.stack([(900 - y) * np.sin(a), 900 - (900 - y) * np.cos(a), z], axis=1)
    path.parent.mkdir(exist_ok=True)
    body = trimesh.Trimesh(1e-3 * (bent + 700), np.asarray(mesh.faces), process=False)
    body.export(path)


def test_a_press_goes_in_equal_steps_to_its_end():
    """Six steps to 6 mm: 1, 2, ... 6 mm; the state at rest is none of them."""
    path = path_of(load_scene_spec(CONFIGS / "normal.toml"), CONFIGS, [], table_1())
    np.testing.assert_allclose(path.displacement[:, 1], -np.arange(1.0, 7), rtol=1e-12)
    assert path.s.tolist() == [60.0] * 6


@pytest.fixture
def scene(request, tmp_path):
    """A scene of configs/ beside the mesh that it may name."""
    text = (CONFIGS / f"{request.param}.toml").read_text()
    if "meshes/trachea.glb" in text:
        bent_tube(tmp_path / "meshes" / "trachea.glb")
    path = tmp_path / f"{request.param}.toml"
    path.write_text(text)
    return path


def test_each_shows_something():
    assert set(SHOWS) == set(NAMES)


#: The others take half a minute of compilation each.
EARLY = ["no_surface", "normal"]
EACH = [*EARLY, *late(*(n for n in NAMES if n not in EARLY))]


@pytest.mark.long
@pytest.mark.parametrize("scene", EACH, indirect=True)
def test_scene_runs(scene, monkeypatch, capsys):
    monkeypatch.chdir(scene.parent)
    text = tomllib.loads(scene.read_text())
    if scene.stem in ("friction", *EARLY):
        code, out, err = run(monkeypatch, capsys, "plan", scene.name)
        assert (code, err) == (0, "")
        assert "operations for" in out
    code, out, err = run(monkeypatch, capsys, "simulate", scene.name, "--out", "result")
    assert (code, err) == (0, "")
    assert ("contact patches: " in out) == ("tool" in text)
    result = scene.parent / "result"
    output = text.get("output", {})
    files = {"simulation.h5", "forces.csv", "provenance.json"}
    if output.get("surface", True):
        files |= {"deformed.ply", "deformed.glb"}
    if output.get("pictures", True):
        files |= {"series.png"} | ({"surface.png"} if output.get("surface", True) else set())
    assert {p.name for p in result.iterdir()} == files
    with h5py.File(result / "simulation.h5") as file:
        level = {row[0]: row[1] for row in json.loads(file.attrs["plan"])}
        assert SHOWS[scene.stem].items() <= level.items()
        force, status = file["series/force"][:], file["series/status"][:]
        surface = [file[n][()] for n in ("series/vertices", "rest/faces") if n in file]
        assert file["series/force"].attrs["units"] == "N"
    assert np.isfinite(force).all()
    table = pd.read_csv(result / "forces.csv")
    forces = table[[f"force_{axis}_N" for axis in "xyz"]]
    np.testing.assert_array_equal(forces, force.reshape(-1, 3))  # of several tools row by row
    assert [PressStatus[word] for word in table["status"]] == status.ravel().tolist()
    assert set(status.flat) <= {0, 1, PressStatus.LIFTED}
    assert np.abs(force[-1]).max() > 0
    if "deformed.ply" in files:
        vertices, faces = surface
        for suffix, scale in (("ply", 1), ("glb", 1e3)):
            mesh = trimesh.load_mesh(result / f"deformed.{suffix}", process=False)
            np.testing.assert_allclose(scale * mesh.vertices, vertices[-1], rtol=0, atol=2e-5)
            np.testing.assert_array_equal(mesh.faces, faces)


@pytest.mark.slow
def test_sweep_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code, out, _ = run(monkeypatch, capsys, "sweep", CONFIGS / "scan.toml", "--out", "maps")
    assert code == 0
    assert "112 contact points, 0 without a solution" in out
    assert "sweep: rings 'arch2', EI_C and k_t are given: a ring bends" in out
    assert "e_1 and e_2 in [material] soften" in " ".join(out.split())
    names = {p.name for p in (tmp_path / "maps").iterdir()}
    assert names == {"force.png", "compliance.png", "sweep.h5", "provenance.json"}
    with h5py.File(tmp_path / "maps" / "sweep.h5") as file:
        force = file["force"][:]
        assert force.shape == (len(file["s"]), len(file["phi"])) == (16, 7)
    np.testing.assert_allclose(force, force[:, ::-1], rtol=1e-9)  # a symmetric tube
    assert (force > 0).all()
    # A ring that bends gives way most between crown and end (docs/evidence/off_midline.md).
    assert (force[:, 1] < 0.9 * force[:, 3]).all()


@pytest.mark.slow
def test_a_sweep_names_the_statuses_of_its_points(tmp_path, monkeypatch, capsys):
    """Points that are solved, but too deep, counted as without a solution, and nothing said why."""
    monkeypatch.chdir(tmp_path)
    shown = "[output]\nsurface = false\npictures = false\n"
    grid = '[sweep]\ndepth = "30 mm"\nphi_count = 1\ns_count = 2\n'
    Path("scene.toml").write_text(GOOD + PRESS + shown + grid)
    code, out, _ = run(monkeypatch, capsys, "sweep", "scene.toml", "--out", "maps")
    said = " ".join(out.split())
    assert "2 contact points, 0 without a solution" in said
    assert f"2 point(s): {PressStatus.TOO_DEEP.message}" in said
    assert code == 1  # as `simulate` ends with such a row
    with h5py.File("maps/sweep.h5") as file:
        assert np.isfinite(file["force"][:]).all()
    Path("scene.toml").write_text(GOOD.replace('"0.02', '"-0.02') + PRESS + shown + grid)
    code, out, _ = run(monkeypatch, capsys, "sweep", "scene.toml", "--out", "past")
    said = " ".join(out.split())
    assert code == 1
    assert "2 contact points, 2 without a solution" in said
    assert f"2 point(s): {PressStatus.PAST_FOLD.message}" in said


@pytest.mark.slow
def test_a_sweep_of_a_skeleton_that_softens_is_one_of_the_midline(tmp_path, monkeypatch, capsys):
    """Off it the command names the cure; on it, it says which skeleton it pressed."""
    monkeypatch.chdir(tmp_path)
    law = 'e_1 = "0.1 1/mm"\ne_2 = "0.005 1/mm^2"\n'
    text = GOOD + law + PRESS + '[output]\nsurface = false\n[sweep]\ndepth = "2 mm"\ns_count = 3\n'
    Path("scene.toml").write_text(text)
    for command in ("plan", "sweep"):
        code, _, err = run(monkeypatch, capsys, command, "scene.toml")
        assert (code, err.count("\n"), "Traceback" in err) == (2, 1, False)
        for words in ("sweep: effects.skeleton", "second plane", "'linear'", "phi_count = 1"):
            assert words in err
    Path("scene.toml").write_text(text + "phi_count = 1")
    code, out, _ = run(monkeypatch, capsys, "sweep", "scene.toml", "--out", "maps")
    assert code == 0
    assert "sweep: skeleton 'softening', the wall is moved by 16 % of the" in " ".join(out.split())
    with h5py.File("maps/sweep.h5") as file:
        soft = file["force"][:]
    Path("scene.toml").write_text(text.replace(law, "") + "phi_count = 1")
    code, out, _ = run(monkeypatch, capsys, "sweep", "scene.toml", "--out", "linear")
    assert code == 0
    said = " ".join(out.split())
    assert "sweep: skeleton 'linear', but the wall is moved by 16 % of the" in said
    assert "[material] soften" in said
    assert "[sections] in the place of [material]" in said
    with h5py.File("linear/sweep.h5") as file:
        assert (soft < file["force"][:]).all()


@pytest.mark.parametrize("command", ["plan", pytest.param("simulate", marks=pytest.mark.slow)])
def test_sentences_with_tables_in_them_are_shown_whole(command, tmp_path, monkeypatch, capsys):
    """As markup [material] would be taken by rich, which shows nothing in its place."""
    monkeypatch.chdir(tmp_path)
    tail = '[output]\nsurface = false\npictures = false\n[sweep]\ndepth = "2 mm"\nphi_count = 1\n'
    Path("scene.toml").write_text(GOOD + PRESS + tail)
    choice = SimpleNamespace(sentence="as [plan] wishes")
    monkeypatch.setattr(scenes, "_chosen", lambda path, spec, staged: (staged, choice))
    code, out, _ = run(monkeypatch, capsys, command, "scene.toml")
    said = " ".join(out.split())
    assert code == 0
    assert "as [plan] wishes" in said
    if command == "plan":
        sweep = said[said.index("sweep: skeleton") :].partition("skeleton: linear")[0]
        assert "e_1 and e_2 in [material] soften a press" in sweep
        assert "[sections] in the place of [material]" in sweep


GOOD = """
[material]
EI_L = "1.862 N mm^2"
k_M = "0.1 N/mm"
k_1 = "0.3 N/mm"
k_3 = "0.02 N/mm^3"
"""
PRESS = '[path]\ns = "75 mm"\ndisplacement = ["0 mm", "-4 mm", "0 mm"]\n'
LINE = '[path]\nstart = ["75 mm", "19 mm", "0 mm"]\nend = ["75 mm", "16 mm", "0 mm"]\n'
BALL = '[tool]\nshape = "sphere"\nradius = "5 mm"\n'
RELAXES = '[relaxation]\nbranches = "prony-1"\ngamma_1 = 0.5\ntau_1 = "2 s"\n'
TIMED = PRESS + 'duration = "2 s"\n'
TWO_LEGS = PRESS.replace("[path]", "[[path]]") + TIMED.replace("[path]", "[[path]]")
#: name -> (scene, what stderr must say: key, what is wrong, the cure)
BAD = {
    "relaxation without a time": (
        GOOD + RELAXES + PRESS,
        ["effects.relaxation", "no times", "duration", "'off'"],
    ),
    "time in the wrong unit": (
        GOOD + RELAXES + PRESS + 'duration = "2 mm"',
        ["path.0.duration", "2 mm"],
    ),
    "one leg without a time": (GOOD + RELAXES + TWO_LEGS, ["path.0", "no duration", "path.1"]),
    "one step in time": (GOOD + TIMED + "steps = 1", ["path.0.steps", "at least 2"]),
    "times that fall": (
        GOOD + BALL + '[path]\nfile = "falling.csv"',
        ["falling.csv", "'t'", "row 2", "never fall"],
    ),
    "two kinds of time": (
        GOOD + BALL + '[path]\nfile = "rising.csv"\nduration = "1 s"',
        ["path.0.duration", "'t'"],
    ),
    "number of a law missing": (
        GOOD + RELAXES.replace("prony-1", "prony-2") + TIMED,
        ["relaxation", "gamma_2", "give"],
    ),
    "number of another law": (
        GOOD + RELAXES + "beta = 0.2\n" + TIMED,
        ["relaxation", "beta", "remove"],
    ),
    "beta beyond the law": (
        GOOD + '[relaxation]\nbranches = "power"\ngamma = 1\nbeta = 0.7\n' + TIMED,
        ["relaxation", "beta is 0.7", "0.05 to 0.4"],
    ),
    "parts with no numbers of the skeleton": (
        GOOD + RELAXES + TIMED + '[effects]\nrelaxation = "parts"',
        ["effects.relaxation", "skeleton", "uniform"],
    ),
    "no path": (GOOD, ["path", "missing"]),
    "no material": (PRESS, ["material: missing"]),
    "key mistyped": (GOOD + PRESS + "[efects]\naxial = 'on'", ["efects: unknown key", "effects"]),
    "key in path": (GOOD + PRESS + 'fi = "1 deg"', ["path.0.fi: unknown key", "phi"]),
    "wrong unit": (
        GOOD.replace('"0.1 N/mm"', '"0.1 N"') + PRESS,
        ["material.k_M", "stiffness"],
    ),
    "no unit": (GOOD + PRESS.replace('"75 mm"', "75"), ["path.0.s", "unit"]),
    "negative": (GOOD.replace("1.862", "-1") + PRESS, ["material.EI_L", "positive"]),
    "two numbers": (GOOD + PRESS.replace(', "0 mm"]', "]"), ["path.0.displacement", "3 items"]),
    "mesh missing": (GOOD + PRESS + '[trachea]\nfile = "a.stl"', ["trachea.file", "'a.stl'"]),
    "mesh no mesh": (GOOD + PRESS + '[trachea]\nfile = "bad.stl"', ["trachea.file", "bad.stl"]),
    "mesh and length": (
        GOOD + PRESS + '[trachea]\nfile = "a.stl"\nradius = "9 mm"',
        ["trachea", "file excludes radius", "remove"],
    ),
    "cartilage missing": (
        GOOD + PRESS + '[trachea]\nfile = "tube.stl"\ncartilage = "c.stl"',
        ["trachea.file", "cartilage='c.stl'", "no such file"],
    ),
    "no wall left": (
        GOOD + PRESS + '[trachea]\nradius = "0.2 mm"\nwall = "0.1 mm"\nrelief = "0.6 mm"',
        ["trachea: wall 0.1 mm", "positive radius"],
    ),
    "cloud missing": (
        GOOD + LINE + '[tool]\nshape = "cloud"\nfile = "c.csv"',
        ["tool.file", "'c.csv'"],
    ),
    "cloud without unit": (
        GOOD + LINE + '[tool]\nshape = "cloud"\nfile = "points.csv"',
        ["tool.file", "points.csv", "x [mm]"],
    ),
    "no tool": (GOOD + LINE, ["path", "needs [tool]"]),
    "tool half told": (GOOD + LINE + '[tool]\nshape = "box"', ["tool", "needs size"]),
    "tool told twice": (GOOD + LINE + BALL + 'length = "1 mm"', ["tool", "length", "remove"]),
    "path of two kinds": (GOOD + PRESS + 'end = ["0 mm", "0 mm", "0 mm"]', ["path", "end"]),
    "behind the rings": (GOOD + PRESS + 'phi = "150 deg"', ["path.0.phi", "150 deg", "120"]),
    "off the tube": (GOOD + PRESS.replace("75", "175"), ["path.0.s", "175 mm", "160 mm"]),
    "one step of a line": (GOOD + BALL + LINE + "steps = 1", ["path.0.steps", "at least 2"]),
    "stretch without EA_L": (
        GOOD + PRESS + "[effects]\naxial = 'on'",
        ["effects.axial", "EA_L is not given"],
    ),
    "friction without coefficient": (
        GOOD + PRESS + "[effects]\nfriction = 'on'",
        ["effects.friction", "tool.friction"],
    ),
    "dent without tool": (
        GOOD + PRESS + "[effects]\ndent = 16",
        ["effects.dent", "no tool", "use 8 or 'off'"],
    ),
    "softening without its law": (
        GOOD + PRESS + "[effects]\nskeleton = 'softening'",
        ["effects.skeleton", "e_1 and e_2 are not given", "give both"],
    ),
    "half a law of softening": (
        GOOD + 'e_1 = "0.1 1/mm"\n' + PRESS,
        ["material: e_1 needs e_2", "remove e_1"],
    ),
    "softening off the midline": (
        GOOD + 'e_1 = "0.1 1/mm"\ne_2 = "0.005 1/mm^2"\n' + PRESS + "phi = '20 deg'",
        ["effects.skeleton", "30 % of the radius", "second plane", "set skeleton 'linear'"],
    ),
    "cross-sections without their radius": (
        '[wall]\n[model]\ncontact = "bonded"\n' + PRESS,
        ["trachea.radius: missing", "mid-line"],
    ),
    "surface of a line of joints": (
        '[wall]\n[trachea]\nradius = "11.7 mm"\n[model]\ncontact = "bonded"\n'
        + PRESS
        + "[effects]\nsurface = 'hermite'",
        ["effects.surface", "a line of joints", "use 'sections'"],
    ),
    "thickness of deforming cross-sections": (
        '[wall]\n[trachea]\nradius = "11.7 mm"\nwall = "2 mm"\n' + PRESS,
        ["trachea.wall", "`offset` outside", "remove it"],
    ),
    "cross-sections that the tool may leave": (
        '[wall]\n[trachea]\nradius = "11.7 mm"\n[output]\nsurface = false\n' + PRESS,
        ["effects.skeleton", "contact='bonded'", "set contact = 'bonded'"],
    ),
    "wall that cannot be": (
        '[wall]\nh_C = "4 mm"\n[trachea]\nradius = "11.7 mm"\n' + PRESS,
        ["wall.h_C is 4.0 mm", "at most the thickness"],
    ),
    "two skeletons": (GOOD + "[wall]\n" + PRESS, ["wall", "not together with [material]"]),
    "friction of a glued tool": (
        GOOD
        + '[tool]\nshape = "sphere"\nradius = "5 mm"\nfriction = 0.3\ncontact = "bonded"\n'
        + PRESS,
        ["tool", "friction: not together with contact = 'bonded'", "remove one"],
    ),
    "plane too few": (
        GOOD + PRESS + "phi = '20 deg'\n[effects]\nsecond_plane = 'off'",
        ["effects.second_plane", "20 deg off the midline", "auto"],
    ),
    "tube of 1.2 m": (
        GOOD + LINE + BALL + '[trachea]\nlength = "1.2 m"\nrings = ["0.4 m", "0.8 m"]',
        ["trachea.length is 1200 mm", "expected 2 to 1000 mm", "is the unit wrong"],
    ),
    "rings of 4 m": (
        GOOD + PRESS + '[trachea]\nring_height = "4 m"',
        ["trachea.ring_height is 4000 mm", "expected 0.02 to 100 mm", "is the unit wrong"],
    ),
    "first touch of a metre": (
        GOOD + PRESS + '[model]\nonset_width = "1 m"',
        ["model.onset_width is 1000 mm", "expected 0 to 1.13 mm", "is the unit wrong"],
    ),
    "wall thicker than the radius": (
        GOOD + PRESS + '[trachea]\nwall = "26 mm"',
        ["wall is 26 mm, thicker than the radius"],
    ),
    "centreline beside the mesh": (
        GOOD + PRESS + "[trachea]\nfile = 'tube.stl'\nlarynx = [1, 0, 0]\n"
        "centreline = [[500, 0, 0], [600, 0, 0]]",
        ["trachea.file: tube.stl: the centreline, lengthened", "points inside", "centreline="],
    ),
    "direction of nothing": (
        GOOD + PRESS + "[trachea]\nfile = 'tube.stl'\nlarynx = [0, 0, 0]",
        ["trachea.file: tube.stl: larynx= is [0.0, 0.0, 0.0]", "three finite numbers"],
    ),
    "tool of a metre's radius": (
        GOOD + LINE + '[tool]\nshape = "sphere"\nradius = "1 m"',
        ["tool is 2000 mm across", "is the unit wrong"],
    ),
    "level unknown": (GOOD + PRESS + "[effects]\nrings = 'bow'", ["effects.rings", "'arch2'"]),
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "bad.stl").write_text("no mesh")
    mesh = make_tube(table_1(), around=9, along=40)
    tube = trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), process=False)
    tube.export(tmp_path / "tube.stl")
    (tmp_path / "points.csv").write_text("x,y,z\n0,0,0\n1,0,0\n0,1,0\n0,0,1\n")
    for name, times in (("falling", (1, 0.5)), ("rising", (0, 0.5))):
        rows = "".join(f"75,{18 - i},0,{t}\n" for i, t in enumerate(times))
        (tmp_path / f"{name}.csv").write_text("x [mm],y [mm],z [mm],t [s]\n" + rows)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", BAD)
def test_bad_scene_is_refused_in_a_line(name, folder, monkeypatch, capsys):
    text, says = BAD[name]
    (folder / "scene.toml").write_text(text)
    before = tree(folder)
    code, out, err = run(monkeypatch, capsys, "simulate", "scene.toml")
    assert (code, out) == (2, "")
    assert err.startswith("error: scene.toml: ")
    assert err.count("\n") == 1
    assert "Traceback" not in err
    for words in says:
        assert words in err
    assert tree(folder) == before


@pytest.mark.parametrize(
    ("sweep", "says"),
    [
        ("", "sweep: missing; give a table [sweep] with a depth"),
        (
            '[sweep]\ndepth = "1 mm"\nphi_max = "150 deg"',
            "sweep.phi_max: 150 deg; expected 0 to 120",
        ),
    ],
)
def test_bad_sweep_is_refused(sweep, says, folder, monkeypatch, capsys):
    (folder / "scene.toml").write_text(GOOD + PRESS + sweep)
    code, _, err = run(monkeypatch, capsys, "sweep", "scene.toml")
    assert (code, says in err) == (2, True), err
