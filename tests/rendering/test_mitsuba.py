"""Shadows beside Mitsuba 3: the same triangles, normals, lights and camera in both programs.

`make peers` installs Mitsuba, runs these tests and prints their numbers; a picture goes to .benchmarks/shadows.png.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from btfpipe.formats.meshes import read_mesh
from btfpipe.rendering import objects
from btfpipe.rendering.camera import make_camera
from btfpipe.rendering.environment import Environment
from btfpipe.rendering.renderer import render
from btfpipe.rendering.scene import Film, Light, Scene
from btfpipe.surface.prepare import prepare

pytestmark = [pytest.mark.slow, pytest.mark.peer]

HERE = Path(__file__).parents[2]
SIDE = [-0.8, 0.45, 0.4]


@pytest.fixture(scope="module")
def peer():
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed; `make peers` installs it")
    import mitsuba_peer

    return mitsuba_peer.peer_pictures


@pytest.fixture(scope="module")
def meshes():
    """Raw meshes by name; the bunny of the measured data, or a torus with as many bumps where there are none."""
    import os

    from shared_meshes import torus

    bunny = Path(os.environ.get("BTFPIPE_DATA", "")) / "meshes" / "bunny" / "bunny.obj"
    complex_one = read_mesh(bunny) if bunny.is_file() else torus(80, 40, bumps=0.06)
    return {"bunny": complex_one, "knot": read_mesh(HERE / "data-sample" / "meshes" / "knot.obj")}


@pytest.fixture(scope="module")
def surfaces(meshes):
    """The finest level of a Surface, made once for each mesh and number of vertices."""
    made = {}

    def make(name, count):
        if (name, count) not in made:
            vertices, faces = meshes[name]
            vertices, faces = np.asarray(vertices, float), np.asarray(faces, np.int32)
            surface, _ = prepare(vertices, faces, count, threads=2, name=name)
            made[name, count] = surface.levels[0]
        return made[name, count]

    return make


def _object(level):
    return objects.diffuse_mesh(
        np.asarray(level.vertices, float), np.asarray(level.faces, np.int32),
        np.ascontiguousarray(level.normals, np.float32), [0.5] * 3,
    )  # fmt: skip


def _denser(thing):
    """The same surface of four times as many faces.

    New vertices lie at the middles of the edges on the parabola through both ends that their normals ask for.
    """
    v, n, f = thing.vertices, thing.normals.astype(float), thing.faces
    pairs = np.sort(np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]), axis=1)
    pairs, place = np.unique(pairs, axis=0, return_inverse=True)
    a, b = pairs.T
    middle = n[a] + n[b]
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    rise = ((v[b] - v[a]) * (n[b] - n[a])).sum(axis=1) / 8
    ab, bc, ca = len(v) + place.reshape(3, -1)
    a, b, c = f.T
    faces = np.concatenate(
        [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    )
    vertices = np.concatenate([v, v[pairs].mean(axis=1) + rise[:, None] * middle])
    normals = np.concatenate([n, middle]).astype(np.float32)
    return objects.diffuse_mesh(vertices, faces.astype(np.int32), normals, [0.5] * 3)


def _scene(things, lights, width=320, samples=64):
    points = things[0].vertices
    low, high = points.min(axis=0), points.max(axis=0)
    middle, size = (low + high) / 2, float((high - low).max())
    eye = middle + size * np.array([0.9, 0.7, 1.8])
    camera = {"type": "perspective", "position": eye, "target": middle, "fov_deg": 36.0}
    film = Film(width, width * 3 // 4, samples, "box", 0.5)
    return Scene(make_camera(camera, 4 / 3, points), film, lights, things)


def _sun(direction=SIDE, irradiance=3.0):
    direction = np.array(direction) / np.linalg.norm(direction)
    return Light(True, direction, np.full(3, float(irradiance)))


def _cosines(picture, scene, light):
    """Cosine (rows, cols) between the mean normal of each pixel and the light, from its mean point."""
    if light.directional:
        return picture[..., 5:8] @ light.place
    camera, (rows, cols) = scene.camera, picture.shape[:2]
    x, y = np.meshgrid(
        2 * (np.arange(cols) + 0.5) / cols - 1, 1 - 2 * (np.arange(rows) + 0.5) / rows
    )
    ray = np.stack([x * camera.extent[0], y * camera.extent[1], 1 + 0 * x], axis=-1) @ camera.axes
    toward = light.place - (camera.position + picture[..., 4:5] * ray)
    return (picture[..., 5:8] * toward).sum(axis=-1) / np.linalg.norm(toward, axis=-1)


def _inside(picture):
    """Pixels that an object covers, but for its outlines."""
    return binary_erosion(picture[..., 3] > 0.999, iterations=2)


def _dark_in_one(ours, theirs, inside):
    dark = 0.02 * np.median(theirs[inside & (theirs > 0.05)])
    return inside & ((ours < dark) != (theirs < dark))


def _write_beside(ours, theirs, covered):
    """Ours, theirs and ten times the difference, cut to what is covered."""
    from btfpipe.formats.images import encode_picture

    rows, cols = (np.flatnonzero(covered.any(axis=k)) for k in (1, 0))
    ours, theirs = (a[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1] for a in (ours, theirs))
    gap = np.ones((len(ours), 4))
    parts = [ours, gap, theirs, gap, 10 * np.abs(ours - theirs)]
    shown = np.concatenate(parts, axis=1).clip(0, 1) ** (1 / 2.2)
    shown = shown.repeat(2, axis=0).repeat(2, axis=1)
    codes = np.repeat(np.round(255 * shown).astype(np.uint8)[..., None], 3, axis=2)
    target = HERE / ".benchmarks" / "shadows.png"
    target.parent.mkdir(exist_ok=True)
    target.write_bytes(encode_picture(codes, ".png"))


@pytest.mark.parametrize("count", [30_000, 250_000])
def test_few_pixels_are_dark_in_one_program_only(count, peer, surfaces):
    """Lit faces as in Mitsuba; near the terminator as in Mitsuba on the same surface at four times the density."""
    light = _sun()
    thing = _object(surfaces("bunny", count))
    scene = _scene([thing], [light])
    picture = render(scene)
    ours, inside = picture[..., 1], _inside(picture)
    lit = _cosines(picture, scene, light) > 0.1
    same = peer(scene)[0, ..., 1]
    fine = peer(_scene([_denser(thing)], [light]))[0, ..., 1]
    far = (_dark_in_one(ours, same, inside) & lit).sum() / inside.sum()
    near = (_dark_in_one(ours, fine, inside) & ~lit).sum() / inside.sum()
    mean = np.abs(ours - same)[inside & lit].mean() / same[inside & lit].mean()
    sys.stdout.write(
        f"\nbunny, {count} vertices, directional: dark in one program only {100 * far:.2f} % of the object's"
        f" pixels where n.l > 0.1, {100 * near:.2f} % nearer the terminator (there Mitsuba at four times the"
        f" density); mean difference {100 * mean:.2f} %\n"
    )
    if count == 250_000:
        _write_beside(ours, same, picture[..., 3] > 0)
    assert inside.sum() > 10_000
    assert far <= 0.005
    assert near <= 0.01


def _sky(height=32):
    """A sky with a bright window: values of a latitude-longitude map."""
    rows, cols = 32 / height * (np.mgrid[:height, : 2 * height] + 0.5)
    values = np.full((height, 2 * height, 3), 0.3) * (1 + np.cos(np.pi * rows / 32))[..., None]
    values[(abs(rows - 8.5) < 3) & (abs(cols - 20.5) < 4)] += 20
    return values.astype(np.float32)


def _sky_lights(count=12, height=32, rotate_deg=0.0):
    turn = objects.rotation({"rotate_deg": rotate_deg})
    environment = Environment(_sky(height), turn=turn, name="sky")
    return [Light(True, *both) for both in zip(*environment.lights(count), strict=True)]


def _box_on_a_plane():
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (0, 1.2) for z in (-0.7, 0.7)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    vertices = corner[np.ravel(quads)]
    faces = (4 * np.arange(6)[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3)
    across = np.cross(*(vertices[faces[::2, k]] - vertices[faces[::2, 0]] for k in (1, 2)))
    normals = np.repeat(across / np.linalg.norm(across, axis=1, keepdims=True), 4, axis=0)
    box = objects.diffuse_mesh(
        vertices, faces.astype(np.int32), normals.astype(np.float32), [0.7] * 3
    )
    plane = {"center": [0, 0, 0], "s": [1, 0, 0], "t": [0, 0, -1], "size": [9, 9]}
    return [box, objects.flat(plane, [0.5] * 3)]


@pytest.mark.parametrize("lights", ["directional", "point", "environment"])
@pytest.mark.parametrize("name", ["bunny", "knot", "box"])
def test_pictures_are_those_of_mitsuba(name, lights, peer, surfaces):
    """Shadow borders included, wherever a light does not graze."""
    things = _box_on_a_plane() if name == "box" else [_object(surfaces(name, 30_000))]
    low, high = things[0].vertices.min(axis=0), things[0].vertices.max(axis=0)
    if lights == "point":
        place = (low + high) / 2 + np.array([-0.9, 1.1, 0.9]) * (high - low).max()
        lamps = [Light(False, place, np.full(3, 4 * float((high - low).max()) ** 2))]
    else:
        lamps = [_sun()] if lights == "directional" else _sky_lights()
    width, samples = (320, 64) if len(lamps) == 1 else (240, 36)
    scene = _scene(things, lamps, width, samples)
    theirs = peer(scene, samples)
    total, difference = 0.0, 0.0
    summed = np.zeros(theirs.shape[1:])
    for lamp, other in zip(lamps, theirs, strict=True):
        picture = render(_scene(things, [lamp], width, samples))
        counts = _inside(picture) & (_cosines(picture, scene, lamp) > 0.1)
        total += other[counts].sum()
        difference += np.abs(picture[..., :3] - other)[counts].sum()
        summed += picture[..., :3]
    sys.stdout.write(f"\n{name}, {lights}: mean difference {100 * difference / total:.2f} %\n")
    np.testing.assert_allclose(render(scene)[..., :3], summed, rtol=1e-4, atol=1e-4)
    assert total > 0
    assert difference <= 0.005 * total


@pytest.mark.parametrize("rotate_deg", [0, 75])
def test_a_map_shines_from_where_it_does_in_mitsuba(rotate_deg, peer):
    """Many lights that stand for a map, beside the map sampled at random: few per cent are noise and texels."""
    import mitsuba_peer

    things = _box_on_a_plane()
    scene = _scene(things, _sky_lights(300, 128, rotate_deg), 80, 256)
    scene.film.samples = 16
    picture = render(scene)
    theirs = mitsuba_peer.peer_picture_under_map(scene, _sky(128), rotate_deg, 256)
    inside = _inside(picture)
    difference = np.abs(picture[..., :3] - theirs)[inside].mean() / theirs[inside].mean()
    sys.stdout.write(
        f"\nbox under a map turned by {rotate_deg} degrees: mean difference {100 * difference:.2f} %\n"
    )
    assert difference <= 0.04
    mean = picture[inside][:, :3].mean() / theirs[inside].mean()
    assert mean == pytest.approx(1, abs=0.02)
