import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfpipe.errors import InputError
from btfpipe.formats.meshes import read_mesh, write_obj

VERTICES = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 0.5, 1)])
POLYGONS = [(3, 2, 1, 0), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)]
TRIANGLES = [(3, 2, 1), (3, 1, 0), *POLYGONS[1:]]


def ascii_ply():
    rows = [f"{x} 9 {y} {z}" for x, y, z in VERTICES]  # a property in between
    faces = [f"7 {len(p)} " + " ".join(map(str, p)) for p in POLYGONS]
    return "\n".join(
        ["ply", "format ascii 1.0", "comment none", f"element vertex {len(rows)}", "property float x",
         "property uchar red", "property float y", "property float z", f"element face {len(faces)}",
         "property int flags", "property list uchar int vertex_indices", "end_header", *rows, *faces, ""]
    ).encode()  # fmt: skip


def binary_ply(order, polygons):
    word = {"<": "little", ">": "big"}[order]
    header = (
        f"ply\nformat binary_{word}_endian 1.0\nelement vertex {len(VERTICES)}\nproperty double x\n"
        f"property double y\nproperty double z\nelement face {len(polygons)}\n"
        "property list uchar uint vertex_index\nend_header\n"
    )
    body = b"".join(struct.pack(order + "3d", *v) for v in VERTICES)
    body += b"".join(struct.pack(f"{order}B{len(p)}I", len(p), *p) for p in polygons)
    return header.encode() + body


def off():
    lines = ["# comment", "OFF", f"{len(VERTICES)} {len(POLYGONS)} 0"]
    lines += [f"{x} {y} {z}" for x, y, z in VERTICES]
    lines += [f"{len(p)} " + " ".join(map(str, p)) for p in POLYGONS]
    return "\n".join(lines).encode()


def obj():
    lines = [f"v {x} {y} {z} 1 nan 0" for x, y, z in VERTICES] + ["vn 0 0 1", "vt 0 0", "usemtl m"]
    lines += [
        "f 4/1/1 3/1/1 2/1/1 \\",
        " 1/1/1",
        "f 1//1 2//1 5//1",
        "f -4 -3 -1 # counted back",
        "f 3/1 4/1 5/1",
    ]
    return "\r\n".join([*lines, "f 4 1 5"]).encode()


INDEXED = {
    "a.ply": ascii_ply(),
    "little.ply": binary_ply("<", POLYGONS),
    "big.ply": binary_ply(">", POLYGONS),
    "triangles.ply": binary_ply("<", TRIANGLES),
    "a.off": off(),
    "A.OBJ": obj(),
}


@pytest.mark.parametrize("name", INDEXED)
def test_indexed_formats_give_the_same_triangles(tmp_path, name):
    (tmp_path / name).write_bytes(INDEXED[name])
    vertices, faces = read_mesh(tmp_path / name)
    np.testing.assert_array_equal(vertices, VERTICES)
    assert faces.tolist() == [list(t) for t in TRIANGLES]
    assert faces.dtype == np.int32


def test_stl_gives_three_vertices_a_facet_binary_and_ascii(tmp_path):
    corners = VERTICES[np.array(TRIANGLES)]
    binary = tmp_path / "b.stl"
    # a binary file may begin with the word that marks the text form
    binary.write_bytes(
        b"solid not text".ljust(80) + struct.pack("<I", len(corners))
        + b"".join(struct.pack("<12fH", 0, 0, 0, *c.ravel(), 0) for c in corners)
    )  # fmt: skip
    text = tmp_path / "t.stl"
    text.write_text(
        "solid x\n"
        + "".join(
            "facet normal 0 0 0\nouter loop\n" + "".join(f"vertex {x} {y} {z}\n" for x, y, z in c) + "endloop\nendfacet\n"
            for c in corners
        )
        + "endsolid x\n"
    )  # fmt: skip
    for path in (binary, text):
        vertices, faces = read_mesh(path)
        np.testing.assert_array_equal(vertices[faces], corners)


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(sorted(INDEXED)), st.floats(0, 0.999))
def test_a_truncated_file_is_refused_or_read_as_far_as_it_is_whole(tmp_path_factory, name, share):
    path = tmp_path_factory.mktemp("cut") / name
    data = INDEXED[name]
    path.write_bytes(data[: int(share * len(data))])
    try:
        vertices, faces = read_mesh(path)
    except InputError:
        return
    assert faces.max() < len(vertices)
    # only line formats without counts, or a last number that lost digits, can look whole
    assert not name.endswith(".ply") or len(faces) == len(TRIANGLES)


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("a.obj", b"v 0 0\n", "line 1: a vertex has 2 coordinates of 3"),
        ("a.obj", b"v 0 0 0\nf 0 1 1\n", "line 2: a face names vertex 0"),
        ("a.obj", b"\0\1\2", "binary data where text was expected"),
        ("a.obj", b"v 0 0 0\nf 1 1 -5\n", "name vertices that are not there"),
        ("a.off", b"OBJ\n", "does not start with OFF"),
        ("a.off", b"COFF\n", "is COFF; only plain OFF is read"),
        ("a.off", b"OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "1 of 2 faces are there"),
        ("a.ply", b"solid\n", "has no PLY header"),
        ("a.ply", ascii_ply()[:-12], "broken or cut short"),
        ("a.ply", binary_ply("<", POLYGONS)[:-1], "broken or cut short"),
        ("a.ply", ascii_ply().replace(b"vertex 5", b"vertex 5.5"), "broken or cut short"),
        ("a.ply", ascii_ply().replace(b"vertex 5", b"vertex"), "broken or cut short"),
        ("a.ply", binary_ply("<", POLYGONS).replace(b"vertex 5", b"vertex 99999999999999999999"), "broken or cut short"),
        ("a.obj", b"v 0 0 0\nf 1 1 99999999999999999999\n", "broken or cut short"),
        ("a.stl", b"solid x\nfacet\nvertex 0 0 0\nvertex 0 1\nvertex 1 1 0\nendsolid", "broken or cut short"),
        ("a.stl", b"solid x\nfacet\nvertex 0 0 0\n", "ends in the middle of a facet"),
        ("a.stl", b"x" * 100, "cut short or its ending is wrong"),
        ("a.txt", b"", "not a mesh that can be read"),
    ],
)  # fmt: skip
def test_broken_files_are_refused_by_name(tmp_path, name, data, says):
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(InputError, match=says) as caught:
        read_mesh(path)
    assert str(caught.value).startswith(str(path))


def test_what_is_written_is_read_back(tmp_path):
    write_obj(tmp_path / "a.obj", VERTICES, TRIANGLES)
    vertices, faces = read_mesh(tmp_path / "a.obj")
    np.testing.assert_allclose(vertices, VERTICES, atol=5e-6)
    assert faces.tolist() == [list(t) for t in TRIANGLES]


def test_a_signalling_nan_is_a_number_that_is_not_finite(tmp_path):
    corners = np.zeros((1, 12), "<f4")
    corners.view("<u4")[0, 3] = 0x7F800001
    data = bytes(80) + b"\1\0\0\0" + corners.tobytes() + b"\0\0"
    (tmp_path / "a.stl").write_bytes(data)
    vertices, _ = read_mesh(tmp_path / "a.stl")
    assert np.isnan(vertices[0, 0])
