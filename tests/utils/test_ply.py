"""PLY files are written as others read them, and one that is cut short is known."""

import io

import numpy as np
import pytest
from plyfile import PlyData

from sparsestyle_ns.utils.ply import RGB, encode_ply, floats, is_whole_ply

VERTICES = np.array([((0.5 * i, 1, -i), (i, 2, 255)) for i in range(5)], dtype=[("at", "<f4", 3), ("rgb", "u1", 3)])
FACES = np.array([(3, (0, 1, 2)), (3, (2, 3, 4))], dtype=[("count", "u1"), ("corners", "<i4", 3)])
MESH = encode_ply(
    ("vertex", (*floats("x", "y", "z"), *RGB), VERTICES), ("face", ("list uchar int vertex_indices",), FACES)
)


def test_elements_are_read_as_they_were_given():
    read = PlyData.read(io.BytesIO(MESH))
    assert read["vertex"]["x"].tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert read["vertex"]["red"].tolist() == [0, 1, 2, 3, 4]
    assert np.stack(read["face"]["vertex_indices"]).tolist() == [[0, 1, 2], [2, 3, 4]]


def as_text():
    read = PlyData.read(io.BytesIO(MESH))
    read.text, file = True, io.BytesIO()
    read.write(file)
    return file.getvalue()


def big_endian():
    read = PlyData.read(io.BytesIO(MESH))
    read.byte_order, file = ">", io.BytesIO()
    read.write(file)
    return file.getvalue()


@pytest.mark.parametrize("content", [MESH, as_text(), big_endian()], ids=["binary", "text", "big endian"])
def test_a_file_is_whole_unless_it_lacks_bytes(tmp_path, content):
    path = tmp_path / "a.ply"
    path.write_bytes(content)
    assert is_whole_ply(path)
    for length in (0, 2, 40, len(content) - 20, len(content) - 1):
        path.write_bytes(content[:length])
        assert not is_whole_ply(path)


def test_nothing_but_a_header_is_whole_where_it_announces_nothing(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(encode_ply(("vertex", floats("x"), np.empty(0, "<f4"))))
    assert is_whole_ply(path)
