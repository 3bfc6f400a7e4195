"""How coordinates on vertices become values between them."""

import numpy as np
import pytest

from btfpipe.directions import bonn81
from btfpipe.errors import InputError
from btfpipe.rendering.objects import dress, patch
from btfpipe.sample import Sample
from btfpipe.synthesis import CoordinateMap
from btfpipe.synthesis.coherence import find_coherent

PLANE = {"center": [0, 0, 0], "s": [1, 0, 0], "t": [0, 1, 0], "size": [2, 2]}
VIEW = {"type": "orthographic", "position": [0, 0, 5], "target": [0, 0, 0], "height": 2}
FILM = {"width": 48, "height": 48, "samples": 1, "filter": "box"}


def plane_map(tmp_path, row, col, angle=None, weight=None, toroidal=True, name="c.map.npz"):
    rows, cols = row.shape[-2:]
    flat = [
        None if a is None else np.reshape(a, (-1, rows * cols)) for a in (row, col, angle, weight)
    ]
    if angle is None:
        flat[2] = np.zeros_like(flat[0])
    domain = {"plane": [rows, cols], "toroidal": toroidal}
    CoordinateMap(flat[0], flat[1], flat[2], 1.0, domain, flat[3]).save(tmp_path / name)
    return {"plane": PLANE, "model": "m.sample.npz", "map": name}


@pytest.mark.parametrize("toroidal", [True, False])
def test_map_that_changes_nothing_shows_the_sample(
    make_sample, scene_file, render_file, tmp_path, toroidal
):
    make_sample(rows=16, cols=16, toroidal=toroidal).save(tmp_path / "m.sample.npz")
    row, col = np.mgrid[:16.0, :16.0]
    entry = plane_map(tmp_path, row, col, toroidal=toroidal)
    plain = {"plane": PLANE, "model": "m.sample.npz"}
    mapped, bare = (render_file(scene_file([e], camera=VIEW, film=FILM)) for e in (entry, plain))
    np.testing.assert_allclose(mapped[..., :3], bare[..., :3], atol=2e-5)


def test_rolled_map_rolls_the_sample_across_its_border(
    make_sample, scene_file, render_file, tmp_path
):
    make_sample(rows=16, cols=16, toroidal=True).save(tmp_path / "m.sample.npz")
    row, col = np.mgrid[:16.0, :16.0]
    entry = plane_map(tmp_path, (row + 5) % 16, (col + 11) % 16)
    plain = {"plane": PLANE, "model": "m.sample.npz"}
    film = FILM | {"width": 16, "height": 16}
    mapped, bare = (render_file(scene_file([e], camera=VIEW, film=film)) for e in (entry, plain))
    expected = np.roll(bare[..., :3], (-5, -11), axis=(0, 1))
    np.testing.assert_allclose(mapped[..., :3], expected, atol=2e-5)


@pytest.mark.parametrize("shift", [(5, 0), (0, 11), (5, 11)])
def test_a_rolled_map_is_interpolated_across_the_samples_border(
    make_sample, scene_file, render_file, tmp_path, shift
):
    """Three pixels a texel: inside the triangles that cross the border, too, coordinates go the short way."""
    make_sample(rows=16, cols=16, toroidal=True).save(tmp_path / "m.sample.npz")
    row, col = np.mgrid[:16.0, :16.0]
    entry = plane_map(tmp_path, (row + shift[0]) % 16, (col + shift[1]) % 16)
    plain = {"plane": PLANE, "model": "m.sample.npz"}
    mapped, bare = (render_file(scene_file([e], camera=VIEW, film=FILM)) for e in (entry, plain))
    expected = np.roll(bare, (-3 * shift[0], -3 * shift[1]), axis=(0, 1))
    np.testing.assert_allclose(mapped[..., :3], expected[..., :3], atol=5e-5)
    # and so do the layers that say which texel is seen
    difference = mapped[..., 8:] - expected[..., 8:]
    np.testing.assert_allclose((difference + 8) % 16 - 8, 0, atol=1e-4)


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("turn", [0.0, 0.6])
def test_frames_behind_a_surface_are_mirrored(scene_file, render_file, tmp_path, behind, turn):
    """The material of the back is the front's seen in a mirror that lies in the surface: s and t stay in place.

    Its value tells every direction of light and view from any other.
    """
    directions = bonn81()
    pair = np.arange(81 * 81)
    by_light, by_view = directions @ [0.31, 0.17, 0.9], directions @ [0.22, -0.29, 0.9]
    value = by_light[pair % 81] * (1 + by_view[pair // 81]) / 3
    codes = value[:, None, None, None] * np.ones((1, 2, 2, 3))
    sample = Sample(codes.astype(np.float32), directions, directions, pair % 81, pair // 81)
    sample.save(tmp_path / "m.sample.npz")
    s, t = [np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0]
    entry = {"plane": PLANE | {"s": s, "t": t}, "model": "m.sample.npz"}
    for light, view in ((20, 9), (35, 31), (50, 12)):
        side = np.array([1, 1, -1 if behind else 1])
        towards = [
            side * (d[0] * np.array(s) + d[1] * np.array(t) + [0, 0, d[2]])
            for d in directions[[light, view]]
        ]
        lamp = {"type": "directional", "direction": towards[0], "irradiance": [np.pi] * 3}
        camera = VIEW | {"position": 5 * towards[1], "height": 0.2}
        picture = render_file(scene_file([entry], camera=camera, film=FILM, lights=[lamp]))
        np.testing.assert_allclose(picture[..., :3], value[81 * view + light], rtol=1e-4)


def grid_mesh(n=9):
    """A flat unit grid: vertices, faces, normals, tangents."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n)))
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3).astype(np.int32)
    vertices = np.stack([x, y, 0 * x], axis=1)
    normals = np.tile(np.float32([0, 0, 1]), (n * n, 1))
    return vertices, faces, normals, np.tile(np.float32([1, 0, 0]), (n * n, 1))


def coherent(vertices, faces, normals, axis, row, col, tpu, size=64, toroidal=True):
    out = np.zeros(len(faces), bool)
    axis = np.ascontiguousarray(axis, np.float32)
    find_coherent(
        vertices, faces, normals, axis, row.astype(np.float32), col.astype(np.float32), tpu, size, size,
        toroidal, out,
    )  # fmt: skip
    return out


def crosses(side, faces):
    """Faces with vertices on both sides."""
    return side[faces].any(axis=1) & ~side[faces].all(axis=1)


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0, -1.5])
def test_rigid_pieces_of_the_sample_are_coherent_and_seams_are_not(angle):
    vertices, faces, normals, _ = grid_mesh()
    tpu = 40.0
    x, y = tpu * vertices[:, 0], tpu * vertices[:, 1]
    # DESIGN: a step (ds, dt) moves col by ds cos + dt sin and row by ds sin - dt cos
    row = 3 + x * np.sin(angle) - y * np.cos(angle)
    col = 5 + x * np.cos(angle) + y * np.sin(angle)
    axis = np.tile([np.cos(angle), np.sin(angle), 0], (len(row), 1))
    assert coherent(vertices, faces, normals, axis, row, col, tpu).all()
    assert coherent(vertices, faces, normals, axis, row % 64, col % 64, tpu).all()
    assert not coherent(
        vertices, faces, normals, axis, row % 64, col % 64, tpu, toroidal=False
    ).all()
    mirrored = coherent(vertices, faces, normals, axis, -row, col, tpu)
    assert not mirrored.any()
    shifted = row + np.where(vertices[:, 0] > 0.5, 7, 0)
    across = crosses(vertices[:, 0] > 0.5, faces)
    np.testing.assert_array_equal(
        coherent(vertices, faces, normals, axis, shifted, col, tpu), ~across
    )
    jitter = np.random.default_rng(1).uniform(-0.08, 0.08, row.shape)
    assert coherent(vertices, faces, normals, axis, row + jitter, col, tpu).all()
    turned = angle + np.where(vertices[:, 1] > 0.5, 0.2, 0)
    axis = np.stack([np.cos(turned), np.sin(turned), 0 * turned], axis=1)
    # above the middle the frame lies 0.2 radians off what the coordinates say: a whole texel over an edge
    below = ~(vertices[:, 1] > 0.5)[faces].any(axis=1)
    np.testing.assert_array_equal(coherent(vertices, faces, normals, axis, row, col, tpu), below)


def test_detail_finer_than_the_mesh_survives(sphere, lambertian, scene_file, render_file, tmp_path):
    """Twelve texels across a face: interpolated values would be a blur."""
    sample = lambertian(64, 64)
    checks = (np.indices((64, 64)).sum(axis=0) % 8 < 4).astype(np.float32)
    sample.codes *= checks[:, :, None]
    sample.save(tmp_path / "m.sample.npz")

    def coordinates(lat, lon):
        lon = (lon + np.pi) % (2 * np.pi) - np.pi
        return (31.5 - 150 * lat) % 64, (31.5 + 150 * lon) % 64

    entry = sphere(coordinates, 0.0, 150.0, rings=40, segments=80)
    camera = VIEW | {"height": 0.2}
    picture = render_file(scene_file([entry], camera=camera, film=FILM))
    x, y = np.meshgrid(
        (np.arange(48) + 0.5) / 48 * 0.2 - 0.1, 0.1 - (np.arange(48) + 0.5) / 48 * 0.2
    )
    lat = np.arcsin(y)
    row, col = coordinates(lat, np.arcsin(x / np.cos(lat)))
    expected = checks[np.round(row).astype(int) % 64, np.round(col).astype(int) % 64]
    assert np.corrcoef(picture[..., 0].ravel(), expected.ravel())[0, 1] > 0.85
    assert np.abs(picture[..., 8] - row).max() < 0.5
    assert np.abs(picture[..., 9] - col).max() < 0.5


def test_between_patches_the_three_values_are_blended(
    make_sample, scene_file, render_file, tmp_path
):
    sample = make_sample(rows=16, cols=16, toroidal=True)
    sample.save(tmp_path / "m.sample.npz")
    rng = np.random.default_rng(3)
    row, col = rng.integers(0, 16, (2, 4, 4)).astype(float)
    entry = plane_map(tmp_path, row, col)
    picture = render_file(scene_file([entry], camera=VIEW, film=FILM))
    # the triangles of one cell: texel centres are 12 pixels apart, the first at pixel 5.5
    frontal = sample.pictures([0])[0]
    value = frontal[row.astype(int), col.astype(int)]
    for i in range(3):
        for j in range(3):
            y, x = (np.indices((12, 12)) + 0.5) / 12
            v00, v01, v10, v11 = value[i, j], value[i, j + 1], value[i + 1, j], value[i + 1, j + 1]
            y, x = y[..., None], x[..., None]
            # the cell's diagonal runs from its upper left corner or from its lower left one
            one = np.where(
                x + (1 - y) <= 1,
                (1 - y) * v00 + y * v10 + x * (v11 - v10),
                (1 - x) * v00 + x * v01 + y * (v11 - v01),
            )
            two = np.where(
                x + y <= 1,
                v00 + x * (v01 - v00) + y * (v10 - v00),
                v11 + (1 - x) * (v10 - v11) + (1 - y) * (v01 - v11),
            )
            seen = picture[6 + 12 * i : 18 + 12 * i, 6 + 12 * j : 18 + 12 * j, :3]
            assert min(np.abs(seen - one).max(), np.abs(seen - two).max()) < 1e-4


def test_layers_are_blended_by_weight(make_sample, scene_file, render_file, tmp_path):
    make_sample(rows=16, cols=16, toroidal=True).save(tmp_path / "m.sample.npz")
    row, col = np.mgrid[:16.0, :16.0]
    other = (row + 4) % 16, (col + 9) % 16
    share = np.full((16, 16), 0.3)
    entries = [
        plane_map(tmp_path, row, col, name="a.npz"),
        plane_map(tmp_path, *other, name="b.npz"),
        plane_map(
            tmp_path, np.stack([row, other[0]]), np.stack([col, other[1]]),
            weight=np.stack([share, 1 - share]), name="both.npz",
        ),
    ]  # fmt: skip
    a, b, both = (render_file(scene_file([e], camera=VIEW, film=FILM))[..., :3] for e in entries)
    np.testing.assert_allclose(both, 0.3 * a + 0.7 * b, atol=1e-5)


def test_plain_picture_is_a_texture_under_a_moving_light(scene_file, render_file, tmp_path):
    """One view and one light: the texture times the cosine, whatever the direction."""
    texture = np.random.default_rng(2).random((1, 48, 48, 3)).astype(np.float32)
    up = np.array([[0, 0, 1.0]])
    Sample(texture, up, up, [0], [0]).save(tmp_path / "m.sample.npz")
    for direction in ([0, 0, 1], [1, 0, 1], [-0.5, 2, 0.5]):
        lamp = {"type": "directional", "direction": direction, "irradiance": [np.pi] * 3}
        picture = render_file(
            scene_file(
                [{"plane": PLANE, "model": "m.sample.npz"}], camera=VIEW, film=FILM, lights=[lamp]
            )
        )
        cosine = direction[2] / np.linalg.norm(direction)
        np.testing.assert_allclose(picture[..., :3], texture[0] * cosine, atol=1e-5)


def test_map_with_several_samples_is_refused(make_sample):
    vertices, faces, normals, tangents = grid_mesh()
    n = len(vertices)
    two = CoordinateMap(
        np.zeros(n), np.zeros(n), np.zeros(n), 1, {}, None, np.ones((1, n), np.int32)
    )
    with pytest.raises(InputError, match="refers to 2 samples and the object has one"):
        dress(vertices, faces, normals, tangents, two, make_sample(), "barycentric", "x.map.npz")


def test_scale_and_repeats_contradict(make_sample):
    with pytest.raises(InputError, match="texels_per_unit or repeats, not both"):
        patch(PLANE, make_sample(), "barycentric", texels_per_unit=3, repeats=2)
