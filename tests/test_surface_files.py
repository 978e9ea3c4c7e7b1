"""Surfaces as written, read by a library that does not know the writer."""

import numpy as np
import pytest
import trimesh

from jaxtrachea.files.surfaces import write_glb, write_ply


@pytest.mark.parametrize("write", [write_ply, write_glb])
@pytest.mark.parametrize("faces", [1, 2, 57])
def test_is_read_as_it_was_written(write, faces, tmp_path):
    rng = np.random.default_rng(faces)
    vertices = rng.normal(size=(40, 3)) * [1, 10, 100]
    rows = np.array([rng.permutation(40)[:3] for _ in range(faces)])
    path = tmp_path / f"surface.{write.__name__[-3:]}"
    write(path, vertices, rows)
    read = trimesh.load(path, force="mesh", process=False)
    np.testing.assert_array_equal(read.vertices, vertices.astype(np.float32))
    np.testing.assert_array_equal(read.faces, rows)


def test_says_its_extent(tmp_path):
    """The smallest and largest vertex stand in the head of a GLB, as the format demands."""
    vertices = np.array([[0.5, -2.0, 3.0], [1.5, 4.0, -5.0], [0.0, 1.0, 0.25]])
    write_glb(tmp_path / "a.glb", vertices, np.array([[0, 1, 2]]))
    content = (tmp_path / "a.glb").read_bytes()
    assert b'"min": [0.0, -2.0, -5.0], "max": [1.5, 4.0, 3.0]' in content
    assert int.from_bytes(content[8:12], "little") == len(content)
