"""Small scenes, made in code and written as files, since scenes are files."""

import numpy as np
import pytest
import yaml

from btfpipe.directions import bonn81
from btfpipe.sample import Sample
from btfpipe.surface import Surface
from btfpipe.surface.surface import Level
from btfpipe.synthesis import CoordinateMap


@pytest.fixture
def lambertian():
    """White Lambertian product samples: Bonn's directions, value cos(theta_i)."""

    def make(rows=2, cols=2, albedo=(1.0, 0.5, 0.25), lights=None, views=None):
        lights = bonn81() if lights is None else lights
        views = bonn81() if views is None else views
        cosine = np.tile(lights[:, 2], len(views)).astype(np.float32)
        codes = cosine[:, None, None, None] * np.array(albedo, np.float32)
        codes = np.ascontiguousarray(np.broadcast_to(codes, (len(cosine), rows, cols, 3)))
        pair = np.arange(len(cosine))
        return Sample(codes, lights, views, pair % len(lights), pair // len(lights), toroidal=True)

    return make


def uv_sphere(rings=96, segments=192):
    """A unit sphere with poles along y: level with tangents towards the east, latitudes and longitudes."""
    latitude = np.pi / 2 - np.pi * (np.arange(1, rings)) / rings
    longitude = 2 * np.pi * np.arange(segments) / segments
    lat, lon = (a.ravel() for a in np.meshgrid(latitude, longitude, indexing="ij"))
    lat, lon = np.concatenate([lat, [np.pi / 2, -np.pi / 2]]), np.concatenate([lon, [0, 0]])
    # longitude 0 faces +z, the east is +x there
    vertices = np.stack([np.cos(lat) * np.sin(lon), np.sin(lat), np.cos(lat) * np.cos(lon)], axis=1)
    east = np.stack([np.cos(lon), 0 * lon, -np.sin(lon)], axis=1)
    faces = []
    n = (rings - 1) * segments
    for i in range(rings - 2):
        for j in range(segments):
            a, b = i * segments + j, i * segments + (j + 1) % segments
            c, d = a + segments, b + segments
            faces += [(a, c, d), (a, d, b)]
    for j in range(segments):
        k = (j + 1) % segments
        faces += [(n, j, k), (n + 1, n - segments + k, n - segments + j)]
    level = Level(
        vertices, np.array(faces, np.int32), vertices.astype(np.float32), east.astype(np.float32)
    )
    return level, lat, lon


@pytest.fixture(name="uv_sphere")
def _uv_sphere():
    return uv_sphere


@pytest.fixture
def sphere(tmp_path):
    """Write a sphere's Surface and a map whose coordinates a function of latitude and longitude gives."""

    def make(
        coordinates=lambda lat, lon: (0 * lat, 0 * lat), angle=0.0, texels_per_unit=1.0, **size
    ):
        level, lat, lon = uv_sphere(**size)
        Surface([level]).save(tmp_path / "sphere.surface.npz")
        digest = Surface.open(tmp_path / "sphere.surface.npz").digest
        row, col = coordinates(lat, lon)
        turn = np.full(row.shape, angle)
        CoordinateMap(row, col, turn, texels_per_unit, {"surface": digest}).save(
            tmp_path / "sphere.map.npz"
        )
        return {"surface": "sphere.surface.npz", "map": "sphere.map.npz", "model": "m.sample.npz"}

    return make


@pytest.fixture
def scene_file(tmp_path):
    """Write a scene: camera in front along z over two units, film 64 x 64 with one ray a pixel."""

    def make(objects, name="scene.yaml", **changes):
        scene = {
            "camera": {
                "type": "orthographic",
                "position": [0, 0, 5],
                "target": [0, 0, 0],
                "height": 2.2,
            },
            "film": {"width": 64, "height": 64, "samples": 1, "filter": "box"},
            "lights": [
                {"type": "directional", "direction": [0, 0, 1], "irradiance": [np.pi] * 3},
            ],
            "objects": objects,
        } | changes
        # what one ray shows of one texel; averages over pixels have tests of their own (test_texture_filter.py)
        scene["film"] = {"texture_filter": False} | scene["film"]
        path = tmp_path / name
        path.write_text(yaml.safe_dump(_plain(scene)))
        return path

    return make


def _plain(thing):
    if isinstance(thing, dict):
        return {k: _plain(v) for k, v in thing.items()}
    if isinstance(thing, list | tuple | np.ndarray):
        return [_plain(v) for v in thing]
    return thing.item() if isinstance(thing, np.generic) else thing


@pytest.fixture
def render_file():
    """Render a scene file to its layers."""
    from btfpipe.rendering.renderer import render
    from btfpipe.rendering.scene import load_scene

    def run(path, **options):
        return render(load_scene(path), **options)

    return run
