"""--memory of `render`: what does not fit is refused before the work, what fits stays within, whatever the threads."""

import math
import os
import re
import sys

import numpy as np
import pytest
from shared_memory import peak_private_mb

from btfpipe.compression import compress, shading_needs
from btfpipe.formats.images import write_picture
from btfpipe.rendering.scene import load_scene
from btfpipe.synthesis import CoordinateMap

PLANE = {"center": [0, 0, 0], "s": [1, 0, 0], "t": [0, 1, 0], "size": [2, 2]}
GREY = {"plane": PLANE, "albedo": [0.5, 0.5, 0.5]}
LAMPS = [
    {"type": "directional", "direction": [x, 0.2, 1], "irradiance": [1, 1, 1]}
    for x in (-0.6, -0.3, 0, 0.2, 0.4, 0.6)
]


@pytest.fixture
def refused(btfpipe, tmp_path):
    """Render with too little memory: the sentence, and the MB that it asks for."""

    def run(path, memory=1, *args):
        command = ("render", path, "-o", tmp_path / "not.exr", "--memory", f"{memory}M", *args)
        error = btfpipe(*command, code=3).stderr
        assert not (tmp_path / "not.exr").exists()
        return error, int(re.search(r"Pass --memory (\d+)M", error)[1])

    return run


def test_the_refusal_names_the_parts_largest_first_and_a_memory_that_does(
    make_sample, scene_file, refused, btfpipe, tmp_path
):
    make_sample(rows=160, cols=160).save(tmp_path / "m.sample.npz")
    compress([make_sample(rows=160, cols=160)], "svd", components=4).save(tmp_path / "m.model.npz")
    path = scene_file([{"plane": PLANE, "model": "$model"}])
    bind = ("--threads", 1, "--bind", f"model={tmp_path / 'm.sample.npz'}")
    error, need = refused(path, 64, *bind)
    copy = math.ceil(7 * 19 * 160 * 160 * 12 / 2**20)  # views, lights, texels, three numbers
    assert f"scene.yaml: rendering takes {need} MB of memory and --memory allows 64 MB: " in error
    assert f"the program itself 120 MB, {tmp_path / 'm.sample.npz'} {copy} MB, " in error
    assert len(error.splitlines()) == 1
    assert "or take a Model in the sample's place: `btfpipe compress`" in error
    refused(path, need - 1, *bind)
    btfpipe("render", path, "-o", tmp_path / "p.exr", "--memory", f"{need}M", *bind)
    bind = ("--threads", 1, "--bind", f"model={tmp_path / 'm.model.npz'}")
    assert need - refused(path, 64, *bind)[1] > copy - 5


def test_a_film_counts_by_its_pixels(scene_file, refused):
    path = scene_file([GREY])
    error, small = refused(path)
    assert "the film of 64 x 64" not in error  # parts below a MB are not worth their words
    error, large = refused(path, 1, "--width", 3000, "--height", 2000)
    assert "the film of 3000 x 2000 pixels 229 MB" in error  # ten numbers of four bytes
    assert "or take a smaller film" in error
    assert large - small > 228


def test_maps_count_one_by_one_while_they_are_made_into_lights(scene_file, refused, tmp_path):
    write_picture(tmp_path / "room.exr", np.ones((1024, 2048, 3), np.float32))
    light = {"type": "environment", "map": "room.exr", "visible": False}
    error, one = refused(scene_file([GREY], lights=[light]))
    assert f"{tmp_path / 'room.exr'} of 2048 x 1024 pixels 420 MB" in error
    assert "or take a smaller map" in error
    _, two = refused(scene_file([GREY], lights=[light, light]))
    assert 0 < two - one < 100  # what is kept of the first


def test_objects_of_one_model_share_its_shader_and_count_once(
    make_sample, scene_file, refused, tmp_path
):
    make_sample(rows=128, cols=128).save(tmp_path / "m.sample.npz")
    entry = {"plane": PLANE, "model": "m.sample.npz"}
    path = scene_file([entry, entry])
    error, two = refused(path)
    assert error.count("m.sample.npz") == 1
    assert two - refused(scene_file([entry], "one.yaml"))[1] <= 1
    # and so do its levels of detail, a third of it in half precision
    film = {"film": {"width": 64, "height": 64, "samples": 1, "texture_filter": True}}
    error, filtered = refused(scene_file([entry, entry], "two.yaml", **film))
    assert error.count("m.sample.npz") == 1
    assert filtered - refused(scene_file([entry], "one.yaml", **film))[1] <= 1
    assert filtered > two
    first, second = (thing.dressing.shader for thing in load_scene(path).objects)
    assert first is second


def test_threads_are_as_many_as_the_memory_is_for_and_never_show(scene_file, btfpipe, tmp_path):
    path = scene_file([GREY], film={"width": 600, "height": 600, "samples": 1})
    out = tmp_path / "p.exr"
    counts, pictures = [], []
    for memory in (190, 240, 2000):
        counts.append(load_scene(path, memory=memory << 20, threads=5).threads)
        btfpipe("render", path, "-o", out, "--force", "--memory", f"{memory}M", "--threads", 5)
        pictures.append(out.read_bytes())
    assert counts[0] == 1 < counts[1] < counts[2] == 5
    assert pictures[0] == pictures[1] == pictures[2]


@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("sample", {}),
        ("svd", {"components": 5}),
        ("factored", {"channel_components": (4, 3, 2)}),
        ("view-pca", {"components": 3}),
        ("local-pca", {"components": 3, "clusters": 4}),
        ("harmonics", {"view_harmonics": 4, "light_harmonics": 9}),
        ("coded", {"target_bytes": 20000}),
    ],
)
def test_what_is_told_beforehand_covers_the_arrays_that_shaders_hold(
    make_sample, tmp_path, method, options
):
    from btfpipe.compression import open_appearance

    sample = make_sample(rows=16, cols=12)
    path = tmp_path / "m.npz"
    (sample if method == "sample" else compress([sample], method, **options)).save(path)
    needs = shading_needs(path)
    shader = open_appearance(path).shader()
    holders = [shader, getattr(getattr(shader, "pairs", None), "tables", None)]
    held = [v for holder in holders if holder is not None for v in vars(holder).values()]
    held = [a for v in held for a in (v if isinstance(v, list | tuple) else [v])]
    held = {id(a): a for a in held if isinstance(a, np.ndarray) and not _is_mapped(a)}
    private = sum(a.nbytes for a in held.values())
    few = 6 << 10  # steps, ends, tables of codes: not worth counting
    assert private - few <= needs.kept <= 1.1 * private + few
    assert needs.slice_bytes == getattr(shader, "slice_bytes", 0)
    assert needs.many_lights == getattr(shader, "many_lights", 0)


def _is_mapped(array):
    while array is not None and not isinstance(array, np.memmap):
        array = getattr(array, "base", None)
    return array is not None


@pytest.mark.parametrize("filtered", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="needs Linux's /proc")
def test_a_render_stays_within_the_memory_that_it_is_given(
    make_sample, scene_file, sphere, refused, btfpipe, tmp_path, filtered
):
    density = 300.0 if filtered else 1.0  # several texels a pixel
    sample = make_sample(rows=96, cols=96)
    sample.save(tmp_path / "m.sample.npz")
    compress([sample], "view-pca", components=5).save(tmp_path / "v.npz")
    compress([sample], "coded", target_bytes=200_000).save(tmp_path / "c.npz")
    write_picture(tmp_path / "room.exr", np.ones((64, 128, 3), np.float32))
    worn = sphere(
        lambda lat, lon: (47 + 25 * lat, 15 + 10 * lon),
        rings=200,
        segments=400,
        texels_per_unit=density,
    )
    rng = np.random.default_rng(1)
    zero = np.zeros((2, 300 * 300), np.float32)
    domain = {"plane": [300, 300], "toroidal": True}
    row, col = rng.uniform(0, 95, (2, *zero.shape))  # no two neighbours in one piece
    CoordinateMap(row, col, zero, density, domain, zero + 0.5).save(tmp_path / "plane.map.npz")
    path = scene_file(
        [
            worn,
            {"plane": PLANE, "map": "plane.map.npz", "model": "c.npz"},
            worn | {"model": "v.npz"},
        ],
        lights=[*LAMPS, {"type": "environment", "map": "room.exr", "lights": 12}],
        film={"width": 384, "height": 288, "samples": 4, "texture_filter": filtered},
    )
    need = refused(path)[1]
    command = ["render", path, "-o", tmp_path / "p.exr", "--memory", f"{need}M", "-t", 2, "-q"]
    btfpipe(*command, "--width", 32, "--height", 24)  # compiles what is not yet compiled
    peak = peak_private_mb([sys.executable, "-m", "btfpipe", *map(str, command), "--force"])
    assert need / 2 < peak <= need


def test_memory_below_a_megabyte_is_not_called_none(scene_file, btfpipe, tmp_path):
    command = ("render", scene_file([GREY]), "-o", tmp_path / "p.exr", "--memory", "100K")
    assert "--memory allows 100 KB: " in btfpipe(*command, code=3).stderr
