"""What a command does beside its work."""

import sys
import threading

import pytest

from jaxtrachea.cli.beside import beside, load_beside


def test_both_are_at_work_at_once_and_have_ended_after_the_block():
    """Each waits for the other, which would never end one after the other."""
    meet, ended = threading.Barrier(2, timeout=30), []

    def draw(name):
        meet.wait()
        ended.append(name)
        return name

    with beside(draw, "picture") as drawing:
        meet.wait()
    assert ended == ["picture"]
    assert drawing.result() == "picture"


def test_an_error_is_raised_where_it_is_asked_for():
    def fail():
        raise OSError(28, "no space left")

    with beside(fail) as drawing:
        pass
    with pytest.raises(OSError, match="no space"):
        drawing.result()


def test_a_module_is_loaded_and_a_bad_one_says_nothing_yet(tmp_path, monkeypatch, capfd):
    (tmp_path / "loaded_beside.py").write_text("value = 3\n")
    (tmp_path / "broken_beside.py").write_text("raise ValueError('broken')\n")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("loaded_beside", "broken_beside"):
        load_beside(name)
    for thread in threading.enumerate():
        if thread.name == "load":
            thread.join()
    assert sys.modules.pop("loaded_beside").value == 3
    assert "broken_beside" not in sys.modules
    assert capfd.readouterr().err == ""
