"""The cords of an anisotropic material run along the vector field, as seen in pictures of the dressed object."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from scipy import ndimage
from scipy.spatial import cKDTree

from btfpipe.formats.images import open_picture
from btfpipe.surface import Surface

SIDE = 256  # pixels
VIEWS = [(1, 0.4, 0.2), (-0.2, 0.1, 1), (-1, 0.3, -0.2), (0.2, -0.3, -1)]
TURNS = [0, 37, 90]


@pytest.fixture(scope="module")
def pebble(data, command, ingested, tmp_path_factory):
    """A pebble dressed in cords along its field, and turned from it by the other angles of TURNS."""
    folder = tmp_path_factory.mktemp("pebble")
    model, features = folder / "cords.model.npz", folder / "cords.features.npz"
    command("compress", ingested("cords"), "-o", model)
    command("textons", model, "-o", features)
    surface = folder / "pebble.surface.npz"
    command("surface", data / "meshes/pebble.obj", "--vertices", 20000, "-o", surface)
    maps = {turn: folder / f"{turn}.map.npz" for turn in TURNS}
    for turn, path in maps.items():
        command("synthesize", features, surface, "--turn-deg", turn, "-o", path)
    cords = yaml.safe_load((data / "cords.yaml").read_text())
    return SimpleNamespace(
        surface=surface,
        level=Surface.open(surface).levels[0],
        maps=maps,
        frontal=ingested("cords", "--frontal"),
        texels_per_cord=cords["texels"] / cords["structure"]["cords"]["count"],
    )


@pytest.fixture(scope="module")
def seen(pebble, command, tmp_path_factory):
    """What cameras see of the pebble under a turn: orientations (pixels,) and the field's s and t there (pixels, 2).

    Only where the surface faces the camera, half a cord's width from where it does not, two from singularities.
    """
    folder = tmp_path_factory.mktemp("pictures")

    @cache
    def look(turn):
        views = [_look(pebble, command, folder, turn, view) for view in VIEWS]
        vertices, *rest = (np.concatenate(part) for part in zip(*views, strict=True))
        share = len(np.unique(vertices)) / len(pebble.level.vertices)
        print(f"turned {turn}: {len(vertices)} pixels on {share:.0%} of the vertices")  # noqa: T201
        assert share > 0.1
        return rest

    return look


def _look(pebble, command, folder, turn, view):
    back = np.array(view) / np.linalg.norm(view)
    right = np.cross([0, 1, 0], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    level = pebble.level
    middle = level.vertices.mean(axis=0)
    height = 2.1 * np.linalg.norm(level.vertices - middle, axis=1).max()
    scene = {
        "camera": {
            "type": "orthographic",
            "position": (middle + 2 * height * back).tolist(),
            "target": middle.tolist(),
            "height": float(height),
        },
        "film": {"width": SIDE, "height": SIDE, "samples": 9},
        # irradiance pi from behind the camera: radiance is albedo times the cosine
        "lights": [{"type": "directional", "direction": list(view), "irradiance": [np.pi] * 3}],
        "objects": [
            {
                "surface": str(pebble.surface),
                "map": str(pebble.maps[turn]),
                "model": str(pebble.frontal),
            }
        ],
    }
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
    command("render", folder / "scene.yaml", "--float", "-o", folder / "p.exr", "--force")
    picture = open_picture(folder / "p.exr")
    layer = {name: picture.values[..., i] for i, name in enumerate(picture.channels)}
    facing = sum(layer[f"N.{axis}"] * back[i] for i, axis in enumerate("XYZ"))
    albedo = np.stack([layer[c] for c in "RGB"], -1) / np.maximum(facing, 0.05)[..., None]

    # the sample has one texel a mean edge of the surface unless told otherwise
    start, end = level.faces.ravel(), np.roll(level.faces, -1, axis=1).ravel()
    edge = np.linalg.norm(level.vertices[start] - level.vertices[end], axis=1).mean()
    cord = pebble.texels_per_cord * edge
    pixels = cord * SIDE / height
    good = facing > 0.8
    angle = orientation(albedo, good, fine=pixels / 8, wide=pixels / 2)

    at = (np.arange(SIDE) + 0.5) / SIDE * height - height / 2
    place = (
        middle
        + at[None, :, None] * right
        - at[:, None, None] * up
        + (2 * height - layer["Z"][..., None]) * back
    )
    good = ndimage.distance_transform_edt(good) > pixels / 2
    good &= cKDTree(singular_points(level)).query(place)[0] > 2 * cord
    assert pixels > 10
    vertex = cKDTree(level.vertices).query(place[good])[1]
    film = np.stack([right, up], axis=1)
    return vertex, angle[good], level.tangents[vertex] @ film, level.bitangents[vertex] @ film


def orientation(picture, where, fine, wide):
    """Direction of least change of a picture around each pixel, by the structure tensor.

    Parameters
    ----------
    picture : (rows, cols, channels)
    where : (rows, cols) bool
        Pixels that may speak.
    fine, wide : float
        Standard deviations of the derivative and of the smoothing of the tensor, pixels.

    Returns
    -------
    (rows, cols)
        Counter-clockwise from the picture's right, radians, modulo half a turn.
    """
    xx = yy = xy = 0
    for channel in np.moveaxis(picture, -1, 0):
        x = ndimage.gaussian_filter(channel, fine, order=(0, 1))
        y = -ndimage.gaussian_filter(channel, fine, order=(1, 0))
        xx, yy, xy = xx + x * x, yy + y * y, xy + x * y
    xx, yy, xy = (ndimage.gaussian_filter(part * where, wide) for part in (xx, yy, xy))
    return np.arctan2(2 * xy, xx - yy) / 2 + np.pi / 2


def singular_points(level):
    """Middles of the faces around which the field turns once more or less than the surface does."""
    corners = level.vertices[level.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    right = corners[:, 1] - corners[:, 0]
    up = np.cross(normal, right)
    s = level.tangents[level.faces].astype(float)
    angle = np.arctan2(np.einsum("fkx,fx->fk", s, up), np.einsum("fkx,fx->fk", s, right))
    step = np.roll(angle, -1, axis=1) - angle
    step -= 2 * np.pi * np.round(step / (2 * np.pi))
    return corners[np.abs(step.sum(axis=1)) > np.pi].mean(axis=1)


def errors_deg(found, along, across, turn_deg):
    """Angle between orientations and the field turned counter-clockwise by `turn_deg`, 0 to 90 degrees."""
    turn = np.radians(turn_deg)
    wanted = np.cos(turn) * along + np.sin(turn) * across
    difference = found - np.arctan2(wanted[:, 1], wanted[:, 0])
    return np.degrees(np.abs((difference + np.pi / 2) % np.pi - np.pi / 2))


@pytest.mark.parametrize("angle_deg", [0, 20, 75, 90, 140])
def test_the_orientation_of_painted_stripes_is_theirs(angle_deg):
    x, y = np.meshgrid(np.arange(120.0), -np.arange(120.0))
    a = np.radians(angle_deg)
    across = np.cos(a) * y - np.sin(a) * x
    picture = np.stack([np.cos(across / 2), np.sin(across / 5), 0 * across], axis=-1)
    found = orientation(picture, np.ones(x.shape, bool), fine=1.5, wide=8)[30:-30, 30:-30]
    assert np.abs(np.sin(found - a)).max() < np.sin(np.radians(1))


@pytest.mark.parametrize("turn_deg", TURNS)
def test_cords_run_along_the_field_turned_by_the_angle_asked_for(seen, turn_deg):
    found, along, across = seen(turn_deg)
    error = errors_deg(found, along, across, turn_deg)
    print(  # noqa: T201
        f"turned {turn_deg}: median {np.median(error):.2f}, 90 % under {np.quantile(error, 0.9):.1f} degrees"
    )
    assert np.median(error) < 10


def test_cords_turned_by_a_right_angle_run_across_the_field(seen):
    found, along, across = seen(90)
    assert np.median(errors_deg(found, along, across, 0)) > 45


def test_cords_are_turned_counter_clockwise(seen):
    found, along, across = seen(37)
    assert np.median(errors_deg(found, along, across, -37)) > 45
