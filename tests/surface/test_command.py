import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from btfpipe.surface import Surface

STROKES = "strokes: [{point: [1, 0, 0], vector: [0, 1, 0]}]"


def test_summary_says_what_was_found_repaired_and_made(shapes, btfpipe, tmp_path):
    vertices, faces = shapes.torus()
    mesh = shapes.obj(
        tmp_path / "torus.obj", vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
    )
    out = tmp_path / "torus.surface.npz"
    result = btfpipe("surface", mesh, "-o", out, "--vertices", 3000, "--levels", 2, "--json")
    facts = json.loads(result.stdout)
    assert abs(facts["vertices"] - 3000) <= 150
    assert (facts["components"], facts["genus"], facts["boundaries"]) == (1, 1, 0)
    assert facts["repaired"] == {"merged_vertices": faces.size - len(vertices)}
    assert facts["singularities"] == 0
    assert facts["inputs"][0]["path"] == str(mesh)
    surface = Surface.open(out)
    assert [len(level.vertices) for level in surface.levels] == facts["level_vertices"]
    assert facts["area"] == pytest.approx(4 * np.pi**2 * 0.4, rel=0.02)


def test_threads_do_not_change_a_byte(shapes, tmp_path):
    mesh = shapes.obj(tmp_path / "mesh.obj", *shapes.double_ring())
    written = []
    for threads in ("1", "2"):
        out = tmp_path / f"{threads}.npz"
        # a process each: libraries read their number of threads once
        subprocess.run(
            [sys.executable, "-c", "from btfpipe.cli import main; main()", "surface", str(mesh), "-o", str(out),
             "--vertices", "12000", "--threads", threads, "-q"],
            check=True, env=os.environ | {"NUMBA_NUM_THREADS": "2"},
        )  # fmt: skip
        written.append(out.read_bytes())
    assert written[0] == written[1]


def test_strokes_and_turn_are_taken_from_the_command_line(shapes, btfpipe, tmp_path):
    mesh = shapes.obj(tmp_path / "sphere.obj", *shapes.sphere(2))
    strokes = tmp_path / "strokes.yaml"
    strokes.write_text(STROKES)
    out = tmp_path / "s.npz"
    btfpipe(
        "surface",
        mesh,
        "-o",
        out,
        "--vertices",
        2000,
        "--levels",
        1,
        "--field",
        strokes,
        "--turn-deg",
        90,
    )
    level = Surface.open(out).levels[0]
    nearest = np.linalg.norm(level.vertices - (1, 0, 0), axis=1).argmin()
    np.testing.assert_allclose(level.tangents[nearest], (0, 0, 1), atol=0.1)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("strokes: [{point: [1, 0, 0], vector: [0, 1, 0], weight: 3}]", "stroke 1 has the unknown key 'weight'"),
        ("strokes: [{point: [1, 0, 0]}]", "stroke 1 lacks vector"),
        ("strokes: [{point: [1, 0], vector: [0, 1, 0]}]", "stroke 1: point is [1, 0]; expected three numbers"),
        ("strokes: [{point: [1, 0, .nan], vector: [0, 1, 0]}]", "strokes[0].point[2] is nan; expected a finite number"),
        ("strokes: []\nstrokes: []", "the key 'strokes' is given twice, in lines 1 and 2"),
        ("", "empty; expected strokes. Expected strokes: [{point"),
        ("strokes: [{point: [1, 0, 0], vector: [0, 0, 0]}]", "vector has no length"),
        ("strokes: [{point: [1, 0, 0], vector: [1.0e+200, 0, 0]}]", "three numbers of at most 1e+15"),
        ("strokes: []", "not a list of at least one stroke"),
        ("stroke: 3", "unknown key 'stroke'"),
        ("- 3", "the file lacks strokes"),
        ("strokes: [", "not YAML"),
    ],
)  # fmt: skip
def test_bad_strokes_exit_3_and_write_nothing(shapes, btfpipe, tmp_path, text, says):
    mesh = shapes.obj(tmp_path / "sphere.obj", *shapes.sphere(1))
    strokes = tmp_path / "strokes.yaml"
    strokes.write_text(text)
    result = btfpipe("surface", mesh, "-o", tmp_path / "s.npz", "--field", strokes, code=3)
    assert says in result.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["sphere.obj", "strokes.yaml"]


def test_too_few_vertices_for_the_mesh_exit_3(shapes, btfpipe, tmp_path):
    vertices, faces = shapes.sphere(1)
    many = [vertices + np.array((3 * i, 0, 0)) for i in range(60)]
    faces = np.concatenate([faces + i * len(vertices) for i in range(60)])
    mesh = shapes.obj(tmp_path / "many.obj", np.concatenate(many), faces)
    result = btfpipe(
        "surface", mesh, "-o", tmp_path / "s.npz", "--vertices", 100, "--levels", 1, code=3
    )
    assert "100 vertices asked for" in result.stderr
    assert "60 components" in result.stderr
    assert not (tmp_path / "s.npz").exists()


BROKEN = {
    "empty.obj": ("# nothing\n", "holds no vertices and no faces"),
    "points.ply": (
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
        "end_header\n0 0 0\n1 1 1\n",
        "holds 2 vertices and no faces",
    ),
    "short-face.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1// 2//\n", "line 5 has 2"),
    "nan.obj": (
        "v 0 0 0\nv 1 nan 0\nv 0 1 0\nf 1 2 3\n",
        "1 of 3 vertices are not finite (first: vertex 1",
    ),
    "beyond.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "number 3, counted from 0, of 3"),
    "flat.obj": ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "nothing is left"),
    "words.obj": ("v 0 0 0\nv 1 x 0\n", "line 2: expected numbers"),
    "mesh.fbx": ("Kaydara", "expected one of .obj, .ply, .off, .stl"),
    "short.stl": ("\0" * 90, "cut short"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_mesh_exits_3_and_writes_nothing(btfpipe, tmp_path, name):
    text, says = BROKEN[name]
    mesh = tmp_path / name
    mesh.write_text(text)
    result = btfpipe("surface", mesh, "-o", tmp_path / "s.npz", code=3)
    assert str(mesh) in result.stderr
    assert says in result.stderr
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_parts_that_touch_are_dressed_and_said_to_be_parted(shapes, btfpipe, tmp_path):
    vertices, faces = shapes.cube()
    both = np.concatenate([vertices, vertices + np.array((1, 1, 0))])
    mesh = shapes.obj(tmp_path / "cubes.obj", both, np.concatenate([faces, faces + 8]))
    out = tmp_path / "s.npz"
    ask = ("surface", mesh, "-o", out, "--vertices", 2000, "--levels", 1, "--no-smooth", "--json")
    facts = json.loads(btfpipe(*ask).stdout)
    assert facts["repaired"] == {"merged_vertices": 2, "parted_edges": 1, "split_vertices": 2}
    assert (facts["components"], facts["genus"], facts["boundaries"]) == (2, 0, 0)
    assert "parted edges: 1" in btfpipe("info", mesh).stdout


@pytest.mark.measured
@pytest.mark.parametrize(
    ("name", "code"),
    [("empty.obj", 3), ("joined_tetrahedra.obj", 0), ("notenoughindices.obj", 3), ("points_ascii.ply", 3),
     ("soup.stl", 3), ("nancolor.obj", 0), ("teapot.obj", 0)],
)  # fmt: skip
def test_broken_meshes_of_others_are_refused_or_repaired(
    measured_data, btfpipe, tmp_path, name, code
):
    mesh = measured_data / "meshes/broken" / name
    out = tmp_path / "s.npz"
    # few triangles with sharp corners have no shape to be smoothed into
    flags = ["--no-smooth"] if name == "joined_tetrahedra.obj" else []
    result = btfpipe("surface", mesh, "-o", out, "--vertices", 5000, "--json", *flags, code=code)
    assert out.exists() == (code == 0)
    if name == "joined_tetrahedra.obj":
        facts = json.loads(result.stdout)
        assert facts["repaired"] == {"parted_edges": 3, "split_vertices": 3}
        assert (facts["components"], facts["boundaries"]) == (2, 0)
    if name == "teapot.obj":
        facts = json.loads(result.stdout)
        assert facts["repaired"] == {"merged_vertices": 403, "split_vertices": 1}
        assert (facts["components"], facts["boundaries"]) == (4, 6)


def test_sample_meshes_are_remade_byte_for_byte(shapes, tmp_path):
    maker = shapes.make_meshes()
    maker.main(tmp_path)
    kept = Path(maker.__file__).parent / "meshes"
    assert {p.name for p in kept.iterdir()} == {"knot.obj", "knot-strokes.yaml", "pebble.obj"}
    for path in kept.iterdir():
        assert path.stat().st_size < 200_000
        assert path.read_bytes() == (tmp_path / path.name).read_bytes()


def test_sample_meshes_need_no_repair_and_have_genus_0_and_1(shapes):
    from btfpipe.surface.cleaning import clean
    from btfpipe.surface.topology import describe

    maker = shapes.make_meshes()
    for make, euler in ((maker.pebble, 2), (maker.knot, 0)):
        vertices, faces, repairs = clean(*make())
        assert not any(repairs.values())
        found, loops, _ = describe(faces, len(vertices))
        assert (found.tolist(), loops.tolist()) == ([euler], [0])


@pytest.mark.parametrize("factor", [1e200, 1e-200])
def test_a_mesh_in_an_impossible_unit_is_refused(shapes, btfpipe, tmp_path, factor):
    vertices, faces = shapes.sphere(1)
    mesh = tmp_path / "sphere.obj"
    rows = [f"v {x * factor} {y * factor} {z * factor}" for x, y, z in vertices.tolist()]
    rows += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    mesh.write_text("\n".join(rows))
    refused = btfpipe("surface", mesh, "-o", tmp_path / "s.npz", code=3).stderr
    assert f"{mesh}: spans" in refused
    assert "spans" in btfpipe("info", mesh).stdout


def test_a_spike_keeps_its_height_and_grows_no_thicker(btfpipe, tmp_path):
    n = 4
    places = [
        (i / n, j / n, 0.1 * np.sin(i) * np.cos(j)) for i in range(n + 1) for j in range(n + 1)
    ]
    places[21] = (1, 0.25, 90.0001)
    rows = ["v {:g} {:g} {:g}".format(*place) for place in places]
    for i in range(n):
        for j in range(n):
            a = i * (n + 1) + j + 1
            rows += [f"f {a} {a + n + 1} {a + 1}", f"f {a + 1} {a + n + 1} {a + n + 2}"]
    mesh = tmp_path / "spike.obj"
    mesh.write_text("\n".join(rows))
    out = tmp_path / "s.npz"
    done = btfpipe("surface", mesh, "-o", out, "--vertices", 1000, "--levels", 1, "--json")
    assert json.loads(done.stdout)["area_ratio"] == pytest.approx(1, abs=0.02)
    assert Surface.open(out).levels[0].vertices[:, 2].max() == pytest.approx(90.0001)


def test_a_stroke_off_the_surface_is_refused_with_the_mesh(shapes, btfpipe, tmp_path):
    mesh = shapes.obj(tmp_path / "sphere.obj", *shapes.sphere(1))
    strokes = tmp_path / "strokes.yaml"
    strokes.write_text("strokes: [{point: [9, 0, 0], vector: [1, 0, 0]}]")
    command = ["surface", mesh, "-o", tmp_path / "s.npz", "--vertices", 100, "--levels", 1]
    refused = btfpipe(*command, "--field", strokes, code=3).stderr
    assert f"{mesh}: stroke 1: its point is" in refused
