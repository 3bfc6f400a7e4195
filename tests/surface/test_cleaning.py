import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from scipy.spatial.transform import Rotation
from shared_manifold import boundary_edges, euler_characteristics, faults

from btfpipe.errors import InputError
from btfpipe.surface import cleaning
from btfpipe.surface.cleaning import clean
from btfpipe.surface.topology import describe, opposite_half_edges


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.einsum("fx,fx->", a, np.cross(b, c)) / 6


def area(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


def cleaned(vertices, faces):
    """As `clean`, after a look at whether the result is what it should always be."""
    made = clean(vertices, np.asarray(faces, np.int32))
    assert not faults(*made[:2])
    return made


def welded(vertices, faces):
    """One vertex a position."""
    vertices, index = np.unique(vertices, axis=0, return_inverse=True)
    return vertices, index.ravel()[faces]


def soup(vertices, faces):
    """Every face with corners of its own, as STL has them."""
    return vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)


def inside_out(vertices, faces):
    return vertices, faces[:, ::-1]


def joined(*meshes):
    """Several meshes in one file."""
    count = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])
    return (
        np.concatenate([vertices for vertices, _ in meshes]),
        np.concatenate([faces + n for (_, faces), n in zip(meshes, count, strict=False)]),
    )


def box(shapes, *size):
    """A solid of cubes with a corner in the origin."""
    vertices, faces = shapes.boxes(np.ones(size, bool))
    return vertices - 1, faces


def even_cube():
    """A unit cube whose opposite sides are divided alike: neighbours share whole triangles."""
    corners = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))])


def moved(mesh, by):
    return mesh[0] + by, mesh[1]


def test_a_clean_mesh_passes_unchanged(shapes):
    vertices, faces = shapes.torus()
    cleaned, same, repairs = clean(vertices, faces)
    np.testing.assert_array_equal(cleaned, vertices)
    np.testing.assert_array_equal(same, faces)
    assert not any(repairs.values())


def test_every_repair_is_made_and_counted(shapes, rng):
    vertices, faces = shapes.sphere(2)
    n = len(vertices)
    soup = vertices[faces].reshape(-1, 3)  # every corner a vertex of its own
    corners = np.arange(len(soup), dtype=np.int32).reshape(-1, 3)
    flipped = rng.permutation(len(faces))[:50]
    corners[flipped] = corners[flipped][:, ::-1]
    corners = np.concatenate([corners, corners[:3], [[0, 0, 5]]]).astype(np.int32)
    soup = np.concatenate([soup, [[np.nan, 0, 0], [9, 9, 9]]])
    cleaned, made, repairs = clean(soup, corners)
    assert repairs["unreferenced_vertices"] == 2
    assert repairs["merged_vertices"] == len(soup) - 2 - n
    assert repairs["duplicate_faces"] == 3
    assert repairs["degenerate_faces"] == 1
    assert repairs["turned_faces"] in (50, len(faces) - 50)
    assert (len(cleaned), len(made)) == (n, len(faces))
    assert (opposite_half_edges(made) >= 0).all()
    assert volume(cleaned, made) == pytest.approx(volume(vertices, faces))


def test_closed_components_are_turned_outward(shapes):
    vertices, faces = shapes.sphere(1)
    cleaned, made, repairs = clean(vertices + 5, faces[:, ::-1])
    assert volume(cleaned, made) > 0
    assert repairs["turned_faces"] == len(faces)


def test_spheres_that_touch_in_a_vertex_are_parted(shapes):
    vertices, faces = shapes.sphere(1)
    top = vertices[:, 1].argmax()
    turn = Rotation.align_vectors([[0, 1, 0]], [vertices[top]])[0].as_matrix()
    vertices = vertices @ turn.T
    other = vertices * (1, -1, 1) + (0, 2, 0)
    cleaned, made, repairs = clean(
        np.concatenate([vertices, other]), np.concatenate([faces, faces[:, ::-1] + len(vertices)])
    )
    assert repairs["merged_vertices"] == repairs["split_vertices"] == 1
    assert describe(made, len(cleaned))[0].tolist() == [2, 2]


def moebius(n=30):
    u = np.arange(n) * 2 * np.pi / n
    rows = []
    for w in (-0.3, 0.3):
        reach = 1 + w * np.cos(u / 2)
        rows.append(np.stack([reach * np.cos(u), reach * np.sin(u), w * np.sin(u / 2)], 1))
    vertices = np.concatenate(rows)
    low, high = np.arange(n), np.arange(n) + n
    # after one turn the strip's lower side meets its upper one
    next_low, next_high = np.r_[low[1:], high[0]], np.r_[high[1:], low[0]]
    faces = np.concatenate(
        [np.stack([low, next_low, next_high], 1), np.stack([low, next_high, high], 1)]
    )
    return vertices, faces.astype(np.int32)


def loose(shapes):
    points = np.random.default_rng(1).random((60, 3))
    return points, np.arange(60, dtype=np.int32).reshape(-1, 3)


def not_finite(shapes):
    vertices, faces = shapes.sphere(1)
    vertices[7, 1] = np.inf
    return vertices, faces


def without_area(shapes):
    return np.linspace((0, 0, 0), (1, 2, 3), 9), np.array([(0, 1, 2), (1, 2, 3)], np.int32)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (
            loose,
            r"20 of 20 faces share no edge with another .first at \(0.7627, 0.5572, 0.3724\).*"
            "meshing_merge_close_vertices.*Merge by Distance",
        ),
        (
            not_finite,
            r"1 of 42 vertices are not finite .first: vertex 7, counted from 0, \(.*inf.*"
            "remove_infinite_values of trimesh",
        ),
        (without_area, r"nothing is left after cleaning .*first at \(0.125, 0.25, 0.375\)"),
    ],
)
def test_what_cannot_be_dressed_is_refused_with_counts_and_places(shapes, make, says):
    with pytest.raises(InputError, match=f"^thing.obj: .*{says}"):
        clean(*make(shapes), name="thing.obj")


def test_cubes_that_share_an_edge_and_are_apart_in_the_file_stay_two(shapes):
    cube = shapes.cube()
    vertices, faces, repairs = cleaned(*joined(cube, moved(cube, (1, 1, 0))))
    assert (len(vertices), len(faces)) == (16, 24)
    assert euler_characteristics(faces) == [2, 2]
    assert volume(vertices, faces) == pytest.approx(2)
    assert {key: n for key, n in repairs.items() if n} == {
        "merged_vertices": 2,
        "parted_edges": 1,
        "split_vertices": 2,
    }


@settings(max_examples=80, deadline=None)
@given(
    st.lists(st.tuples(*[st.integers(0, 2)] * 3), min_size=1, max_size=12, unique=True),
    st.sampled_from(["parts", "parts turned", "soup", "welded", "soup inside out"]),
    st.booleans(),
    st.randoms(use_true_random=False),
)
def test_cubes_stay_as_many_closed_parts_however_they_touch_and_are_stored(
    shapes, cells, stored, even, random
):
    cube = even_cube() if even else box(shapes, 1, 1, 1)
    parts = [moved(cube, cell) for cell in cells]
    if stored == "parts turned":
        parts = [inside_out(*part) if random.random() < 0.5 else part for part in parts]
    mesh = joined(*parts)
    if "soup" in stored:
        mesh = soup(*mesh)
    if stored == "welded":
        mesh = welded(*mesh)
    if "inside out" in stored:
        mesh = inside_out(*mesh)
    turn = Rotation.from_euler("xyz", [random.random() for _ in range(3)]).as_matrix()
    order = random.sample(range(len(mesh[1])), len(mesh[1]))
    vertices, faces, _ = cleaned(mesh[0] @ turn.T, mesh[1][order])
    assert euler_characteristics(faces) == [2] * len(cells)
    assert boundary_edges(faces) == 0
    assert volume(vertices, faces) == pytest.approx(len(cells))


def test_of_two_cubes_that_share_an_edge_one_may_be_inside_out(shapes):
    cube = box(shapes, 1, 1, 1)
    for second in (inside_out(*moved(cube, (1, 1, 0))), moved(cube, (1, 1, 0))):
        for mesh in (joined(cube, second), joined(second, cube)):
            vertices, faces, _ = cleaned(*soup(*mesh))
            assert euler_characteristics(faces) == [2, 2]
            assert volume(vertices, faces) == pytest.approx(2)


def with_slit(vertices, faces, a, b):
    """The same with a copy of corner a in one face, and faces without area in the slit."""
    n = len(vertices)
    here = int(np.flatnonzero((faces == a).any(1) & (faces == b).any(1))[0])
    others = [c for c in faces[here] if c not in (a, b)]
    faces = faces.copy()
    faces[here][faces[here] == a] = n
    return np.r_[vertices, vertices[[a]]], np.r_[faces, [(a, n, b), (n, a, others[0])]]


@pytest.mark.parametrize("slit", [False, True])
@pytest.mark.parametrize("turn", [1, -1])
def test_a_closed_part_flush_in_the_corner_of_another_stays_whole(shapes, slit, turn):
    long, short = box(shapes, 2, 1, 1), box(shapes, 1, 1, 1)
    # begin with a side that they share
    first = np.argsort(long[0][long[1]][:, :, 0].max(axis=1) > 0, kind="stable")
    long = long[0], long[1][first]
    both = [long, (short[0], short[1][:, ::turn])]
    if slit:
        both = [with_slit(*part, *part[1][1, :2]) for part in both]
    vertices, faces, repairs = cleaned(*joined(*both))
    assert repairs["degenerate_faces"] == 4 * slit
    assert repairs["duplicate_faces"] == repairs["double_sided_faces"] == 0
    assert euler_characteristics(faces) == [2, 2]
    assert volume(vertices, faces[: len(long[1])]) == pytest.approx(2)
    assert abs(volume(vertices, faces[len(long[1]) :])) == pytest.approx(1)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**48 - 1), st.booleans())
def test_solids_of_cubes_have_the_parts_and_holes_that_digital_topology_counts(shapes, bits, loose):
    solid = np.array([bits >> i & 1 for i in range(48)], bool).reshape(4, 4, 3)
    if not solid.any():
        return
    mesh = shapes.boxes(solid)
    if loose:
        mesh = soup(*mesh)
    vertices, faces, repairs = cleaned(*mesh)
    # cubes are connected by faces, what is around them by corners
    n_solids = ndimage.label(solid)[1]
    n_around = ndimage.label(~np.pad(solid, 1), np.ones((3, 3, 3)))[1]
    euler = euler_characteristics(faces)
    assert len(euler) == n_solids + n_around - 1
    assert boundary_edges(faces) == 0
    assert volume(vertices, faces) == pytest.approx(solid.sum())
    assert area(vertices, faces) == pytest.approx(area(*mesh))
    assert sum(euler) == 2 * _digital_euler(solid)
    assert repairs["cut_edges"] == repairs["duplicate_faces"] == repairs["double_sided_faces"] == 0


def _digital_euler(solid):
    """Euler characteristic of cubes that faces connect: cubes - pairs + fours - eights."""
    total = 0
    for spread in np.ndindex(2, 2, 2):
        block = np.pad(solid, 1)
        for axis in np.flatnonzero(spread):
            block = block & np.roll(block, 1, axis)
        total += (-1) ** sum(spread) * int(block.sum())
    return total


def test_an_edge_whose_ends_stay_connected_is_halved(shapes):
    """Two blocks meet in an edge between a floor and a ceiling, which keep its ends connected."""
    solid = np.ones((4, 4, 3), bool)
    solid[1:3, 1:3, 1] = [[True, False], [False, True]]
    solid[0] = solid[3] = solid[:, 0] = solid[:, 3] = False
    solid[:, :, 0] = solid[:, :, 2] = True
    vertices, faces, repairs = cleaned(*shapes.boxes(solid))
    assert repairs["bisected_edges"] == 1
    assert volume(vertices, faces) == pytest.approx(solid.sum())
    assert euler_characteristics(faces) == [0]  # two blocks between two plates: a ring


def test_halved_edges_keep_the_pairing_that_corners_tell(shapes, rng):
    vertices, faces = shapes.grid()
    opposite = opposite_half_edges(faces)
    for _ in range(3):
        some = rng.permutation(len(opposite))[:200]
        some = some[(opposite[some] < 0) | (opposite[some] > some)]
        some = cleaning._apart(np.sort(some), opposite, len(faces))
        count, whole = len(vertices), area(vertices, faces)
        vertices, faces, opposite = cleaning._halved(vertices, faces, opposite, some)
        assert len(vertices) == count + len(some) > count
        np.testing.assert_array_equal(opposite, opposite_half_edges(faces))
        assert area(vertices, faces) == pytest.approx(whole)
        assert not faults(vertices, faces)


def fin_outside(shapes):
    """A triangle on a cube's edge, outward."""
    vertices, faces = box(shapes, 1, 1, 1)
    a, b = np.flatnonzero((vertices[:, 0] == 1) & (vertices[:, 1] == 1))
    return np.r_[vertices, [(2, 2, 0.5)]], np.r_[faces, [(a, b, len(vertices))]]


def flange(shapes):
    """A square frame around a cube's top: it goes straight on, but the cube is what is closed."""
    vertices, faces = box(shapes, 1, 1, 1)
    top = np.array([(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)], float)
    outer = (top - (0.5, 0.5, 1)) * 3 + (0.5, 0.5, 1)
    ring = np.concatenate(
        [[(i, i + 4, (i + 1) % 4), ((i + 1) % 4, i + 4, (i + 1) % 4 + 4)] for i in range(4)]
    )
    return welded(*joined((vertices, faces), (np.r_[top, outer], ring)))


def inner_wall(shapes):
    """A wall across a long box, which it divides into two chambers."""
    vertices, faces = box(shapes, 2, 1, 1)
    square = np.array([(1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)], float)
    return welded(*joined((vertices, faces), (square, np.array([(0, 1, 2), (0, 2, 3)]))))


@pytest.mark.parametrize("store", [lambda *mesh: mesh, soup])
@pytest.mark.parametrize(("turn", "wrong"), [(1, 0), (-1, 0), (1, 1)])
@pytest.mark.parametrize(
    ("make", "edges", "inside", "sheet"),
    [(fin_outside, 1, 1, (1, 3)), (flange, 4, 1, (0, 8)), (inner_wall, 4, 2, (1, 4))],
)
def test_a_third_face_at_an_edge_becomes_a_part_with_a_boundary(
    shapes, make, edges, inside, sheet, store, turn, wrong
):
    vertices, faces = make(shapes)
    n = {fin_outside: 1, flange: 8, inner_wall: 2}[make]
    faces[-n:] = faces[-n:, ::turn]
    faces[:wrong] = faces[:wrong, ::-1]
    whole = area(vertices, faces)
    vertices, faces, repairs = cleaned(*store(vertices, faces))
    assert repairs["parted_edges"] == edges
    assert euler_characteristics(faces) == sorted([2, sheet[0]])
    assert boundary_edges(faces) == sheet[1]
    closed = faces[: len(faces) - n]
    assert boundary_edges(closed) == 0
    assert volume(vertices, closed) == pytest.approx(inside)
    assert area(vertices, faces) == pytest.approx(whole)


@pytest.mark.parametrize("turn", [1, -1])
def test_what_meets_on_a_closed_part_s_edge_is_joined_as_if_it_were_not_there(shapes, turn):
    edge = [(1, 1, 0), (1, 1, 1)]
    one = np.array([*edge, (3, 1, 0.5)], float), np.array([(0, 1, 2)])
    two = np.array([*edge, (1, 3, 0.5)], float), np.array([(0, 1, 2)[::turn]])
    _, faces, repairs = cleaned(*joined(box(shapes, 1, 1, 1), one, two))
    assert repairs["parted_edges"] == 1
    assert repairs["turned_faces"] == (turn > 0)
    assert euler_characteristics(faces) == [1, 2]
    assert boundary_edges(faces) == 4


def test_sheets_that_cross_come_apart_flat(shapes):
    sheet = shapes.grid(3, 3, 1, 1)
    upright = sheet[0][:, [1, 0, 2]] + (0.5, -0.5, 0), sheet[1]
    made, faces, repairs = cleaned(*welded(*joined(sheet, upright)))
    assert repairs["parted_edges"] == 2
    assert euler_characteristics(faces) == [1, 1]
    normals = np.cross(made[faces[:, 1]] - made[faces[:, 0]], made[faces[:, 2]] - made[faces[:, 0]])
    _, component = describe(faces, len(made))[1:]
    for part in (0, 1):
        flat = normals[component[faces[:, 0]] == part]
        np.testing.assert_allclose(flat, flat[:1].repeat(len(flat), 0), atol=1e-12)


@pytest.mark.parametrize("store", [lambda *mesh: mesh, welded, soup])
def test_a_sheet_with_a_back_becomes_one_and_says_so(shapes, store):
    sheet = shapes.grid()
    made, faces, repairs = cleaned(*store(*joined(sheet, inside_out(*sheet))))
    assert repairs["double_sided_faces"] == len(sheet[1])
    assert repairs["parted_edges"] == repairs["cut_edges"] == repairs["duplicate_faces"] == 0
    assert euler_characteristics(faces) == [1]
    assert area(made, faces) == pytest.approx(1.5)


@pytest.mark.parametrize("store", [lambda *mesh: mesh, soup])
@pytest.mark.parametrize(("turn", "key"), [(1, "duplicate_faces"), (-1, "double_sided_faces")])
def test_a_closed_part_that_is_there_twice_is_taken_once(shapes, store, turn, key):
    vertices, faces = shapes.sphere(1)
    made, found, repairs = cleaned(
        *store(
            *joined((vertices, faces), moved((vertices, faces), 3), (vertices, faces[:, ::turn]))
        )
    )
    assert repairs[key] == len(faces)
    assert euler_characteristics(found) == [2, 2]
    assert volume(made, found) == pytest.approx(2 * volume(vertices, faces))


def test_a_back_on_part_of_a_sheet_is_left_out(shapes):
    vertices, faces = shapes.grid()
    made, found, repairs = cleaned(vertices, np.concatenate([faces, faces[5:30, ::-1]]))
    assert repairs["double_sided_faces"] == 25
    assert euler_characteristics(found) == [1]
    assert area(made, found) == pytest.approx(1.5)
    assert boundary_edges(found) == boundary_edges(faces)


def klein(n=24, m=12):
    """A torus whose tube comes back turned around, in the "figure 8" shape."""
    u, v = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    a, b = u * 2 * np.pi / n, v * 2 * np.pi / m
    reach = 3 + np.cos(a / 2) * np.sin(b) - np.sin(a / 2) * np.sin(2 * b)
    height = np.sin(a / 2) * np.sin(b) + np.cos(a / 2) * np.sin(2 * b)
    points = np.stack([reach * np.cos(a), reach * np.sin(a), height], -1).reshape(-1, 3)

    def at(i, j):
        return i % n * m + np.where(i == n, -j, j) % m

    p, q, r, s = at(u, v), at(u + 1, v), at(u + 1, v + 1), at(u, v + 1)
    return points, np.concatenate(
        [np.stack([p, q, r], -1).reshape(-1, 3), np.stack([p, r, s], -1).reshape(-1, 3)]
    )


def test_a_moebius_strip_is_cut_across_into_a_strip():
    vertices, faces = moebius()
    made, found, repairs = cleaned(vertices, faces)
    assert repairs["cut_edges"] == repairs["split_vertices"] - 1 == 1
    assert euler_characteristics(found) == [1]
    assert (
        boundary_edges(found) == boundary_edges(faces[::1]) * 0 + 62
    )  # 60 of the rim, 2 of the cut
    assert area(made, found) == pytest.approx(area(vertices, faces))


def test_a_klein_bottle_is_cut_and_keeps_its_area():
    vertices, faces = klein()
    made, found, repairs = cleaned(vertices, faces)
    assert 0 < repairs["cut_edges"] <= 60
    assert boundary_edges(found) == 2 * repairs["cut_edges"]
    assert len(euler_characteristics(found)) == 1
    assert area(made, found) == pytest.approx(area(vertices, faces))


@pytest.mark.parametrize(
    ("radii", "facing", "expected"),
    [
        ((3, 2), (1, -1), (1, -1)),  # hollow
        ((3, 2), (-1, 1), (1, -1)),  # hollow, and the file inside out
        ((3, 2), (1, 1), (1, 1)),  # a solid in a solid
        ((3, 2), (-1, -1), (1, 1)),
        ((3, 2, 1), (1, -1, 1), (1, -1, 1)),  # something lies in the hollow
        ((3, 2, 1), (-1, 1, -1), (1, -1, 1)),
        ((1, 1), (1, -1), (1, 1)),  # side by side
    ],
)
def test_cavities_face_what_is_in_them_and_nothing_else_does(shapes, radii, facing, expected):
    vertices, faces = shapes.sphere(1)
    parts = [(r * vertices, faces[:, ::way]) for r, way in zip(radii, facing, strict=True)]
    if radii == (1, 1):
        parts[1] = moved(parts[1], (2.5, 0, 0))
    made, found, repairs = cleaned(*joined(*parts))
    one = volume(vertices, faces)
    for i, (r, way) in enumerate(zip(radii, expected, strict=True)):
        part = found[i * len(faces) : (i + 1) * len(faces)]
        assert volume(made, part) == pytest.approx(way * r**3 * one)
    turned = sum(a != b for a, b in zip(facing, expected, strict=True))
    assert repairs["turned_faces"] == turned * len(faces)


def test_corners_that_only_faces_without_area_had_are_left_out(shapes):
    vertices, faces = shapes.sphere(1)
    n = len(vertices)
    made, _, repairs = cleaned(np.r_[vertices, [(5, 5, 5)]], np.r_[faces, [(0, n, n)]])
    assert (repairs["degenerate_faces"], repairs["unreferenced_vertices"]) == (1, 1)
    np.testing.assert_array_equal(made, vertices)


def test_a_book_of_many_pages_comes_apart_in_sheets():
    n = 150
    angle = np.arange(n) * 2 * np.pi / n
    pages = np.stack([np.cos(angle), np.sin(angle), 0 * angle + 0.5], 1)
    vertices = np.concatenate([[(0, 0, 0), (0, 0, 1)], pages])
    faces = np.stack([np.zeros(n, int), np.ones(n, int), np.arange(2, n + 2)], 1)
    faces[::3, :2] = 1, 0
    made, found, repairs = cleaned(vertices, faces)
    assert repairs["parted_edges"] == 1
    assert euler_characteristics(found) == [1] * (
        n - n // 3
    )  # a third of the pages finds a partner
    assert area(made, found) == pytest.approx(n / 2)


@settings(max_examples=250, deadline=None)
@given(st.integers(0, 2**32))
def test_any_list_of_faces_is_refused_or_becomes_a_manifold_of_the_area_it_had(seed):
    rng = np.random.default_rng(seed)
    n = rng.integers(3, 14)
    points = rng.integers(0, rng.integers(2, 4), (n, 3)).astype(float)
    faces = rng.integers(0, n, (rng.integers(1, 50), 3)).astype(np.int32)
    try:
        vertices, made, repairs = clean(points, faces, "thing")
    except InputError:
        return
    assert not faults(vertices, made)
    copies = repairs["duplicate_faces"] + repairs["double_sided_faces"]
    left = len(faces) - repairs["degenerate_faces"] - copies
    assert left <= len(made) <= left + 2 * repairs["bisected_edges"]
    # each set of three different positions is there, and once unless closed parts touch
    corners = [tuple(sorted(map(tuple, points[face].tolist()))) for face in faces]
    distinct = {corner for corner in corners if len(set(corner)) == 3}
    proper = [corner for corner in corners if corner in distinct]
    least, most = (
        sum(area(np.array(c), np.array([(0, 1, 2)])) for c in given) for given in (distinct, proper)
    )
    found = area(vertices, made)
    assert least - 1e-9 <= found <= most + 1e-9
    if not copies:
        assert found == pytest.approx(most)
