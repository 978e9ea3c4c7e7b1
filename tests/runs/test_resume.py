"""Runs that are stopped, damaged or changed, and go on: the numbers are those of a run in peace."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from interrupted import kill_often, numbers
from run_cli import run, tree
from stopped import FIT, begun, from_peace, set_failed, stop_at

import jaxtrachea
from jaxtrachea.files.provenance import source_digest
from jaxtrachea.fitting import fit
from jaxtrachea.runs import folder as run_folder
from jaxtrachea.runs import manifest


def test_stopped_and_resumed(peace, study, monkeypatch, capsys):
    """Ctrl-C in the third shard, a damaged shard, and on: two shards anew, numbers as in peace."""
    with monkeypatch.context() as patch:
        stop_at(patch, 3)
        code, _, err = run(patch, capsys, *FIT)
    assert code == 130
    assert "2 of 3 shards are kept in out" in err
    assert "--out out --resume" in err
    assert "nothing was written" not in err
    so_far = (study / "out" / run_folder.SO_FAR).read_text().splitlines()
    assert so_far == (peace / "out" / "summary.csv").read_text().splitlines()[:7]
    code, _, err = run(monkeypatch, capsys, *FIT)
    assert (code, "go on with --resume" in err) == (2, True)
    path = study / "out" / ".run" / "00001.npz"
    path.write_bytes(path.read_bytes()[:-500])
    again = stop_at(monkeypatch, -1)
    code, _, err = run(monkeypatch, capsys, *FIT, "--resume")
    assert code == 0, err
    assert "damaged, fitted again: 00001.npz" in err
    assert "1 of 3 shards are there" in err
    assert again == [3, 3]
    assert numbers(study / "out") == numbers(peace / "out")
    assert sorted(tree(study / "out")) == sorted(tree(peace / "out"))


def test_an_error_while_files_are_written_keeps_the_shards(peace, study, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        patch.setattr(
            "jaxtrachea.report.plots.draw_all", lambda *_: (_ for _ in ()).throw(OSError(28, ""))
        )
        code, _, err = run(patch, capsys, *FIT)
    assert (code, "3 of 3 shards are kept" in err) == (2, True)
    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", None)
    assert run(monkeypatch, capsys, *FIT, "--resume")[0] == 0
    assert numbers(study / "out") == numbers(peace / "out")


def test_stopped_while_files_move(peace, study, monkeypatch, capsys):
    """From the renaming on nothing is computed again, and nothing is lost."""
    shutil.copytree(peace / "out", study / "out" / ".written")
    (study / "out" / ".run").mkdir()
    (study / "out" / ".written" / "summary.csv").replace(study / "out" / "summary.csv")
    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", None)
    code, _, err = run(monkeypatch, capsys, *FIT, "--resume")
    assert (code, "out is finished" in err) == (0, True)
    assert tree(study / "out") == tree(peace / "out")


@pytest.mark.slow
@pytest.mark.compiling
def test_killed_runs_give_the_same_numbers(tmp_path):
    kill_often(tmp_path, 2)


def changed_spec(folder):
    path = folder / "spec.toml"
    path.write_text(path.read_text().replace("starts = 2", "starts = 3"))


def changed_dtype(folder):
    path = folder / "spec.toml"
    path.write_text(path.read_text() + 'precision = "float32"\n')


def changed_input(folder):
    path = folder / "curves.csv"
    path.write_text(path.read_text().replace("T0000,0,30,0.1,", "T0000,0,30,0.11,"))


def fewer_lanes(folder):
    path = folder / "curves.csv"
    rows = path.read_text().splitlines()
    path.write_text("\n".join(row for row in rows if not row.startswith("T0008")) + "\n")


CHANGES = {
    "specification": (changed_spec, ["the specification has changed", "--force"]),
    "dtype": (changed_dtype, ["dtype was float64 and is float32"]),
    "input": (changed_input, ["curves.csv has changed", "another --out"]),
    "another study": (fewer_lanes, ["lanes was 9 and is 8", "the run there is of another study"]),
}


@pytest.mark.long
def test_refusals(peace, study, monkeypatch, capsys):
    """Unfinished and finished runs of something else; nothing is touched, one line says why."""

    def refused(*arguments, says):
        before = tree(study)
        code, _, err = run(monkeypatch, capsys, *arguments)
        assert (code, len(err.splitlines())) == (2, 1), err
        for words in says:
            assert words in err
        assert tree(study) == before

    refused(*FIT, "--resume", says=["out holds no unfinished run"])
    refused("fit", "spec.toml", "--resume", says=["--out"])
    refused(*FIT, "--force", says=["--force goes with --resume"])
    with monkeypatch.context() as patch:
        stop_at(patch, 2)
        assert run(patch, capsys, *FIT)[0] == 130
    shutil.copytree(peace / "out", study / "finished")
    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", None)
    refused(*FIT, "--rerun-failed", says=["not finished; use --resume first"])
    for change, says in CHANGES.values():
        kept = {p.name: p.read_text() for p in (study / "spec.toml", study / "curves.csv")}
        change(study)
        refused(*FIT, "--resume", says=says)
        for option in ("--resume", "--rerun-failed"):
            refused(*FIT[:3], "finished", option, says=["finished is finished, and", says[0]])
        for name, text in kept.items():
            (study / name).write_text(text)
    with monkeypatch.context() as patch:
        patch.setattr(jaxtrachea, "__version__", "99")
        refused(*FIT, "--resume", says=["jaxtrachea was 0", "and is 99"])
    with monkeypatch.context() as patch:
        patch.setattr(manifest, "source_digest", lambda: "0123")
        says = ["the source of jaxtrachea was ", " and is 0123; ", "another --out", "--force"]
        refused(*FIT, "--resume", says=says)
    strip_manifests(study / "out" / ".run")
    (study / "out" / ".run" / "run.json").write_text("{")
    refused(*FIT, "--resume", says=["its run.json cannot be read", "none of its 1 shards says"])


def strip_manifests(folder):
    """Shards as they were before each held the manifest of its run; its copy is gone."""
    for path in folder.glob("*.npz"):
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files if name != "journal"}
        np.savez(path, **arrays)
    (folder / "previous-run.json").unlink(missing_ok=True)


def test_the_digest_of_the_source_follows_every_file(tmp_path, monkeypatch):
    """And nothing else: neither the folder that it is installed in nor what is compiled there."""
    package = Path(jaxtrachea.__file__).parent

    def digest(change=None):
        shutil.rmtree(tmp_path, ignore_errors=True)
        shutil.copytree(package, tmp_path, ignore=shutil.ignore_patterns("__pycache__", "*.json"))
        if change is not None:
            change()
        monkeypatch.setattr(jaxtrachea, "__file__", str(tmp_path / "__init__.py"))
        return source_digest.__wrapped__()

    as_it_is = source_digest()
    assert digest() == as_it_is
    law = tmp_path / "mechanics" / "force_law.py"
    assert digest(lambda: law.write_text(law.read_text().replace("1", "2", 1))) != as_it_is
    assert digest(lambda: law.rename(law.with_name("law.py"))) != as_it_is


def test_a_manifest_of_an_earlier_version_is_read():
    """Written out by hand, with the keys that the fields of today have on file; and back."""
    run = {
        "schema": "jaxtrachea-run", "schema_version": 1, "id": "a", "specification": "b",
        "inputs": {"c.csv": "d"}, "versions": {"jax": "1"}, "dtype": "float64", "device": "cpu",
        "lanes": 9, "chunk": 64, "save_every": 3, "options": ["profile"],
        "rerun": {"former": "e", "lanes": [1, 5], "count": 2}, "forced": [],
    }  # fmt: skip
    read = manifest.from_dict(run)
    assert (read.batch, read.save_every, read.lanes) == (64, 3, 9)
    assert read.rerun == manifest.Rerun(results="e", lanes=[1, 5], count=2)
    assert manifest.as_dict(read) == run


def test_force_goes_on_and_says_so(study, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        stop_at(patch, 2)
        assert run(patch, capsys, *FIT)[0] == 130
    changed_input(study)
    again = stop_at(monkeypatch, -1)
    assert run(monkeypatch, capsys, *FIT, "--resume", "--force")[0] == 0
    assert again == [3, 3]
    made = json.loads((study / "out" / "provenance.json").read_text())
    assert made["run"]["forced"] == ["curves.csv has changed"]


@pytest.mark.long
def test_failed_lanes_are_fitted_again(peace, study, monkeypatch, capsys):
    """Lanes 1 and 5 are made to fail; the rerun gives them an estimate and touches no other bit."""
    shutil.copytree(peace / "out", study / "out")
    set_failed(study / "out" / "results.h5", [1, 5])
    before = tree(study / "out")
    with monkeypatch.context() as patch:
        stop_at(patch, 1)
        assert run(patch, capsys, *FIT, "--rerun-failed")[0] == 130
    assert tree(study / "out") == before
    seen = []
    real = fit.fit

    def fit_and_tell(part, settings, progress):
        seen.append((part.lanes.lower.shape[0], settings.starts, settings.seed))
        return real(part, settings, progress)

    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", fit_and_tell)
    code, _, err = run(monkeypatch, capsys, *FIT, "--rerun-failed")
    assert code == 0, err
    assert seen == [(2, 8, 1)]
    old, new = numbers(peace / "out"), numbers(study / "out")
    for name in ("lanes/status", "lanes/specimen"):
        assert new[name] == old[name]
    shapes = np.frombuffer(old["unknowns/value"]).reshape(9, -1)
    found = np.frombuffer(new["unknowns/value"]).reshape(9, -1)
    others = [k for k in range(9) if k not in (1, 5)]
    assert np.array_equal(found[others], shapes[others])
    np.testing.assert_allclose(found[[1, 5]], shapes[[1, 5]], rtol=1e-6)
    code, _, err = run(monkeypatch, capsys, *FIT, "--rerun-failed")
    assert (code, "no lane of out failed" in err) == (0, True)


def garbled(path):
    """run.json, damaged in one way after another; yields what is to be said of it."""
    text = path.read_text()
    for content in (text[: len(text) // 2], "", "\0\xff" * 40, "[1, 2]", "5", '{"schema": 1}',
                    text.replace('"lanes": 9', '"lanes": "9"'), "[" * 100_000):  # fmt: skip
        path.write_bytes(content.encode("latin-1"))
        yield
    path.unlink()
    yield


@pytest.mark.slow
@pytest.mark.compiling
def test_a_damaged_manifest_costs_no_shard(peace, study, monkeypatch, capsys):
    """Every shard holds the manifest of its run: rebuilt, still checked, and said."""
    begun(peace, study, monkeypatch, capsys)
    shutil.copytree(study / "out", study / "kept")
    path = study / "out" / ".run" / "run.json"
    fitted = from_peace(peace)
    for _ in garbled(path):
        (path.parent / "previous-run.json").unlink(missing_ok=True)
        with monkeypatch.context() as patch:
            changed_input(study)
            code, _, err = run(patch, capsys, *FIT, "--resume")
            assert (code, "curves.csv has changed" in err) == (2, True), err
            shutil.copy(peace / "curves.csv", study)
            asked = []
            patch.setattr(
                "jaxtrachea.fitting.fit.fit", lambda p, *a, n=asked: n.append(p) or fitted(p, *a)
            )
            code, _, err = run(patch, capsys, *FIT, "--resume")
        assert code == 0, err
        assert "its run.json cannot be read" in err
        assert "it was rebuilt from its 2 shards" in err
        assert len(asked) == 1
        assert numbers(study / "out") == numbers(peace / "out")
        shutil.rmtree(study / "out")
        shutil.copytree(study / "kept", study / "out")


def test_options_and_force_outlive_the_manifest(peace, study, monkeypatch, capsys):
    """What a resume added is in the copy of the manifest, or in the shards saved since.

    Without both and without shards nothing is lost, and the run starts anew.
    """
    begun(peace, study, monkeypatch, capsys)
    folder = study / "out" / ".run"
    changed_input(study)
    with monkeypatch.context() as patch:
        stop_at(patch, 1)
        assert run(patch, capsys, *FIT, "--resume", "--force", "--influence")[0] == 130
    text = (folder / "run.json").read_text()
    (folder / "previous-run.json").write_text(text)
    (folder / "run.json").write_text(text[:-30])
    found, note = run_folder.known_manifest(study / "out")
    assert found is not None
    assert (found.options, found.forced) == (["influence"], ["curves.csv has changed"])
    assert "rebuilt from its 2 shards" in note
    for path in folder.glob("*.npz"):
        path.unlink()
    assert run_folder.known_manifest(study / "out")[0] == manifest.from_dict(json.loads(text))
    (folder / "previous-run.json").unlink()
    monkeypatch.setattr("jaxtrachea.fitting.fit.fit", from_peace(peace))
    shutil.copy(peace / "curves.csv", study)
    code, _, err = run(monkeypatch, capsys, *FIT, "--resume")
    assert (code, "nothing was saved yet" in err) == (0, True), err
    assert numbers(study / "out") == numbers(peace / "out")
