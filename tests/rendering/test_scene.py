"""Scenes that cannot be rendered are refused by name; scenes that can agree with themselves."""

import numpy as np
import pytest
import yaml

from btfpipe.description import read_description
from btfpipe.errors import InputError
from btfpipe.rendering.scene import load_scene
from btfpipe.synthesis import CoordinateMap

PLANE = {"center": [0, 0, 0], "s": [1, 0, 0], "t": [0, 1, 0], "size": [2, 2]}
GREY = {"plane": PLANE, "albedo": [0.5, 0.5, 0.5]}
LIGHT = {"type": "directional", "direction": [0, 0, 1], "irradiance": [1, 1, 1]}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lamps": []}, "unknown key 'lamps' in the scene; expected camera, film, lights"),
        ({"lights": []}, "lights is empty"),
        (
            {"lights": [LIGHT | {"color": 1}]},
            "unknown key 'color' in lights[0]; expected type, direction",
        ),
        (
            {"lights": [{"type": "point", "position": [0, 0, 1]}]},
            "key 'intensity' is missing in lights[0]",
        ),
        ({"lights": [LIGHT | {"direction": [0, 0, 0]}]}, "lights[0]: direction is zero"),
        (
            {"objects": [GREY | {"albedo": [2, 0, 0]}]},
            "objects[0].albedo[0]: 2 is greater than the maximum",
        ),
        ({"objects": [{"plane": PLANE, "modle": "x"}]}, "unknown key 'modle' in objects[0]"),
        (
            {"objects": [{"surface": "s.npz", "map": "m.npz"}]},
            "key 'model' is missing in objects[0]",
        ),
        ({"objects": [{"plane": PLANE, "model": "none.npz"}]}, "there is no such file"),
        ({"objects": [{"plane": PLANE, "model": "$model"}]}, "--bind model=FILE"),
        ({"objects": [GREY | {"plane": PLANE | {"t": [2, 0, 0]}}]}, "objects[0]: plane: s and t"),
        (
            {"objects": [GREY | {"plane": PLANE | {"s": [1e155, 0, 0]}}]},
            "objects[0].plane.s[0]: 1e+155 is greater than the maximum",
        ),
        ({"film": {"samples": 4.0}}, "film.samples: 4.0 is not of type 'integer'"),
        ({"film": {"width": 0}}, "film.width: 0 is less than the minimum"),
        ({"camera": {"type": "fisheye"}}, "camera.type: 'fisheye' is not one of"),
        ({"camera": {"type": "perspective"}}, "either position and target, or direction"),
        (
            {"camera": {"type": "perspective", "direction": [0, 1, 0]}},
            "camera: it looks along its up direction",
        ),
        (
            {"camera": {"type": "perspective", "direction": [0, 0, 1], "height": 2}},
            "height does not belong",
        ),
        ({"lights": [LIGHT | {"type": "spot"}]}, "'spot'; expected 'directional' or 'point'"),
        ({"background": [0, float("nan"), 0]}, "background[1] is nan; expected a finite number"),
        (
            {"lights": [LIGHT | {"irradiance": [1, 1, float("inf")]}]},
            "lights[0].irradiance[2] is inf; expected a finite number",
        ),
        (
            {"objects": [GREY | {"plane": PLANE | {"size": [10**400, 1]}}]},
            "objects[0].plane.size[0] is a number of 1329 bits",
        ),
    ],
)
def test_unusable_scene_is_refused_by_key(changes, message, scene_file, btfpipe, tmp_path):
    path = scene_file([GREY], **changes) if "objects" not in changes else scene_file(**changes)
    done = btfpipe("render", path, "-o", tmp_path / "p.exr", code=3)
    assert message in done.stderr
    assert str(path) in done.stderr
    assert not (tmp_path / "p.exr").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty; expected a scene"),
        (b"# nothing but this\n", "empty; expected a scene"),
        (b"PK\x03\x04\xff\xfe\x00", "not a scene (YAML) but a binary file"),
        (b"a: 1\x00", "not a scene (YAML) but a binary file"),
        (b"lights: [1,", "not YAML (while parsing"),
        (b"film: 2026-99-99", "not YAML (month must be"),
        (b"film:\n  width: 1\n  width: 2\n", "'width' is given twice, in lines 2 and 3"),
        (b"{film: 1, 'film': 2}", "'film' is given twice, in lines 1 and 1"),
        (b"film: &a [*a]", "or one in itself"),
        (b"[" * 3000, "lists in lists beyond measure"),
    ],
)
def test_file_that_is_no_description_is_refused(content, message, btfpipe, tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_bytes(content)
    done = btfpipe("render", path, "-o", tmp_path / "p.exr", code=3)
    assert message in done.stderr
    assert str(path) in done.stderr


def test_merged_keys_are_not_taken_for_keys_given_twice(tmp_path):
    path = tmp_path / "merged.yaml"
    path.write_text(
        "base: &base {a: 1, b: 2}\nmore: &more {<<: *base, b: 3}\nlast: {<<: *more, a: 4}\n"
    )
    found = read_description(path, "a test")
    assert found["more"] == {"a": 1, "b": 3}
    assert found["last"] == {"a": 4, "b": 3}


def test_camera_inside_an_object_is_refused(sphere, lambertian, scene_file, tmp_path):
    lambertian().save(tmp_path / "m.sample.npz")
    entry = sphere(rings=12, segments=24)
    camera = {"type": "perspective", "position": [0, 0.4, 0], "target": [0, 0, 9]}
    with pytest.raises(InputError, match=r"position \[0, 0.4, 0\] is inside objects\[0\]"):
        load_scene(scene_file([entry], camera=camera))
    camera["position"] = [0.8, 0.8, 0.8]  # inside the box around it, outside the sphere
    assert load_scene(scene_file([entry], camera=camera))
    camera["position"] = [0, 0.4, 0]
    shifted = entry | {"transform": {"translate": [3, 0, 0]}}
    assert load_scene(scene_file([shifted], camera=camera))


def test_file_of_another_kind_is_refused(sphere, lambertian, scene_file, tmp_path):
    lambertian().save(tmp_path / "m.sample.npz")
    entry = sphere(rings=12, segments=24)
    with pytest.raises(InputError, match=r"holds a surface\. Expected a map"):
        load_scene(scene_file([entry | {"map": "sphere.surface.npz"}]))
    with pytest.raises(InputError, match=r"holds a map\. Expected a sample or model"):
        load_scene(scene_file([entry | {"model": "sphere.map.npz"}]))


def test_map_of_another_surface_is_refused(sphere, lambertian, scene_file, tmp_path):
    lambertian().save(tmp_path / "m.sample.npz")
    entry = sphere(rings=12, segments=24)
    (tmp_path / "sphere.map.npz").rename(tmp_path / "old.map.npz")
    sphere(rings=12, segments=25)
    with pytest.raises(
        InputError, match=r"old.map.npz: made for surface \w+; .*sphere.surface.npz is"
    ):
        load_scene(scene_file([entry | {"map": "old.map.npz"}]))
    n = 9
    CoordinateMap(np.zeros(n), np.zeros(n), np.zeros(n), 1, {"plane": [3, 3]}).save(
        tmp_path / "plane.map.npz"
    )
    with pytest.raises(InputError, match="a map over a plane; this object is a surface"):
        load_scene(scene_file([entry | {"map": "plane.map.npz"}]))
    with pytest.raises(InputError, match="a map over a surface; this object is a plane"):
        load_scene(scene_file([{"plane": PLANE, "model": "m.sample.npz", "map": "sphere.map.npz"}]))


def test_map_that_leaves_the_sample_is_refused(sphere, make_sample, scene_file, tmp_path):
    make_sample(rows=8, cols=8).save(tmp_path / "m.sample.npz")
    entry = sphere(lambda lat, lon: (0 * lat + 20, 0 * lat), rings=12, segments=24)
    with pytest.raises(InputError, match=r"row runs from 20\.0 to 20\.0 and the model has 8"):
        load_scene(scene_file([entry]))


def test_map_made_for_another_size_of_sample_is_refused(sphere, make_sample, scene_file, tmp_path):
    make_sample(rows=16, cols=20, seed=1, toroidal=True).save(tmp_path / "m.sample.npz")
    entry = sphere(rings=12, segments=24)
    on_plane = {"plane": PLANE, "model": "m.sample.npz", "map": "plane.map.npz"}
    zero = np.zeros(6, np.float32)
    for about, fits in (
        ({}, True),
        ({"sample_shape": [16, 20]}, True),
        ({"sample_shape": [20, 16]}, False),
    ):
        made = CoordinateMap.open(tmp_path / "sphere.map.npz")
        made.about |= about
        made.save(tmp_path / "sphere.map.npz")
        flat = CoordinateMap(
            zero, zero, zero, 1.0, {"plane": [2, 3], "toroidal": True}, about=about
        )
        flat.save(tmp_path / "plane.map.npz")
        for thing, name in ((entry, "sphere.map.npz"), (on_plane, "plane.map.npz")):
            path = scene_file([thing])
            if fits:
                assert load_scene(path).objects
                continue
            with pytest.raises(
                InputError, match=rf"{name}: made for a sample of 20 x 16 texels .* has 16 x 20"
            ):
                load_scene(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"repeats": 1000000000, "map": "plane.map.npz"},
            r"3e\+09 x 3e\+09 texels across and down",
        ),
        (
            {"repeats": 2000, "map": "plane.map.npz"},
            r"3.602e\+07 vertices; expected at most 20 million",
        ),
        ({"texels_per_unit": 1e300}, "expected at most 1048576. Lower texels_per_unit or repeats"),
    ],
)
def test_more_texels_than_can_be_held_are_refused(
    changes, message, make_sample, scene_file, tmp_path
):
    make_sample(toroidal=True).save(tmp_path / "m.sample.npz")
    zero = np.zeros(6, np.float32)
    domain = {"plane": [2, 3], "toroidal": True}
    CoordinateMap(zero, zero, zero, 1.0, domain).save(tmp_path / "plane.map.npz")
    with pytest.raises(InputError, match=message):
        load_scene(scene_file([{"plane": PLANE, "model": "m.sample.npz"} | changes]))


@pytest.mark.parametrize("name", ["width", "height", "samples"])
def test_film_may_be_what_its_schema_allows_on_the_command_line_too(
    scene_file, btfpipe, tmp_path, name
):
    from importlib import import_module, resources

    schema = resources.files("btfpipe.rendering").joinpath("scene.schema.yaml").read_text("utf-8")
    allowed = yaml.safe_load(schema)["properties"]["film"]["properties"][name]
    option = next(o for o in import_module("btfpipe.cli.render").render.params if o.name == name)
    assert (option.type.min, option.type.max) == (allowed["minimum"], allowed["maximum"])
    path = scene_file([GREY])
    wrong = allowed["maximum"] + 1
    done = btfpipe("render", path, "-o", tmp_path / "p.exr", f"--{name}", wrong, code=2)
    assert f"{wrong} is not in the range" in done.stderr


def test_binding_that_no_placeholder_asks_for_is_refused(scene_file):
    with pytest.raises(InputError, match=r"no file is named \$wool"):
        load_scene(scene_file([GREY]), {"wool": "x"})


def test_more_than_the_sample_is_refused_where_it_does_not_repeat(
    make_sample, scene_file, tmp_path
):
    make_sample(rows=8, cols=8).save(tmp_path / "m.sample.npz")
    with pytest.raises(
        InputError, match=r"16.0 x 16.0 texels across and down, and there are 8 x 8"
    ):
        load_scene(scene_file([{"plane": PLANE, "model": "m.sample.npz", "repeats": 2}]))


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
@pytest.mark.parametrize("width", [40, 100])
def test_automatic_framing_fits_the_objects_and_wastes_nothing(
    kind, width, sphere, lambertian, scene_file, tmp_path
):
    lambertian().save(tmp_path / "m.sample.npz")
    entry = sphere(rings=12, segments=24) | {
        "transform": {"scale": 3, "rotate_deg": 30, "axis": [1, 0, 0], "translate": [5, 1, -2]}
    }
    camera = {"type": kind, "direction": [0.4, 0.7, 1], "margin": 0.1}
    path = scene_file(
        [entry, {"ground": {}, "albedo": [1, 1, 1]}],
        camera=camera,
        film={"width": width, "height": 60},
    )
    scene = load_scene(path)
    local = (scene.objects[0].vertices - scene.camera.position) @ scene.camera.axes.T
    assert local[:, 2].min() > 0
    if kind == "perspective":
        local = local / local[:, 2:]
    reach = np.abs(local[:, :2] / scene.camera.extent)
    assert reach.max() == pytest.approx(0.9, abs=1e-6)
    # the object is in the middle along the tighter axis
    tight = int(reach.max(axis=0).argmax())
    place = local[:, tight] / scene.camera.extent[tight]
    assert place.max() == pytest.approx(-place.min(), abs=1e-6)


def test_same_seed_gives_the_same_bytes_for_any_number_of_threads(
    sphere, make_sample, scene_file, btfpipe, tmp_path
):
    make_sample(toroidal=True).save(tmp_path / "m.sample.npz")
    entry = sphere(
        lambda lat, lon: (9 * lat % 16, 9 * lon % 20), texels_per_unit=9.0, rings=24, segments=48
    )
    film = {"width": 300, "height": 200, "samples": 3}
    path = scene_file([entry, {"ground": {}, "albedo": [0.5, 0.4, 0.3]}], film=film)
    pictures = []
    for threads, seed in ((1, 5), (2, 5), (1, 6)):
        btfpipe(
            "render",
            path,
            "-o",
            tmp_path / "p.exr",
            "--threads",
            threads,
            "--seed",
            seed,
            "--force",
        )
        pictures.append((tmp_path / "p.exr").read_bytes())
    assert pictures[0] == pictures[1]
    assert b"1980:01:01" in pictures[0]  # the date of all pictures: no clock in the bytes
    assert pictures[0] != pictures[2]


def test_an_object_names_its_material_of_a_database(make_sample, tmp_path):
    from btfpipe.compression.local_pca import compress_local_pca
    from btfpipe.rendering.renderer import render

    samples = [make_sample(16, 16, seed=seed, toroidal=True) for seed in (1, 2)]
    compress_local_pca(samples, clusters=6, components=8, names=["wool", "felt"]).save(
        tmp_path / "cloth.npz"
    )
    for name, sample in zip(("wool", "felt"), samples, strict=True):
        sample.save(tmp_path / f"{name}.npz")

    def picture(model):
        (tmp_path / "s.yaml").write_text(
            "camera: {type: orthographic, position: [0, 0, 3], target: [0, 0, 0], height: 2}\n"
            "lights: [{type: directional, direction: [0, 0, 1], irradiance: [3, 3, 3]}]\n"
            "objects: [{plane: {center: [0, 0, 0], s: [1, 0, 0], t: [0, 1, 0], size: [2, 2]}, "
            f"model: {model}}}]\n"
        )
        scene = load_scene(tmp_path / "s.yaml", film={"width": 16, "height": 16, "samples": 1})
        return render(scene)[..., :3]

    for name in ("wool", "felt"):
        own, other = picture(f"cloth.npz, material: {name}"), picture(f"{name}.npz")
        assert np.abs(own - other).mean() < 0.1 * other.std()
        number = ("wool", "felt").index(name)
        np.testing.assert_array_equal(picture(f"cloth.npz, material: {number}"), own)
    with pytest.raises(InputError, match=r"cloth.npz: no material 'silk'.*: wool, felt"):
        picture("cloth.npz, material: silk")
