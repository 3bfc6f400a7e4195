"""Bring a raw mesh into a state that can be dressed, and say what was done."""

import numpy as np

from btfpipe.errors import InputError
from btfpipe.surface.surface import require_extent
from btfpipe.surface.topology import edge_keys, half_edges, opposite_half_edges

MERGE_DISTANCE = 1e-7  # of the bounding box's diagonal


def clean(vertices, faces, name="mesh"):
    """Clean a mesh: merged vertices, proper faces, a consistent orientation, manifold vertices.

    Parameters
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int32
    name : str
        What messages call the mesh.

    Returns
    -------
    vertices : (n', 3) float64
    faces : (m', 3) int32
        An oriented manifold with or without boundary; closed components are seen counter-clockwise from outside.
    repairs : dict of str to int
        What was done how often: ``unreferenced_vertices``, ``merged_vertices``, ``degenerate_faces``,
        ``duplicate_faces``, ``turned_faces``, ``split_vertices``.

    Raises
    ------
    InputError
        If a used vertex is not finite, or lengths are beyond `require_extent`; if nothing with an area is left, faces are not connected, an edge has more
        than two faces, or the surface is one-sided.
    """
    repairs = {}
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    repairs["unreferenced_vertices"] = int((~used).sum())
    _check_finite(vertices, used, name)
    points = vertices[used]
    if (points != points[:1]).any():  # what lies in one place is refused below
        require_extent(points, name)
    vertices, faces, repairs["merged_vertices"] = _merge(vertices, faces)
    proper = (
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    )
    repairs["degenerate_faces"] = int((~proper).sum())
    faces = faces[proper]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    repairs["duplicate_faces"] = len(faces) - len(first)
    faces = faces[np.sort(first)]
    _check_area(vertices, faces, name)
    _check_connected(faces, name)
    _check_edges(vertices, faces, name)
    faces, repairs["turned_faces"] = _orient(vertices, faces, name)
    vertices, faces, repairs["split_vertices"] = _split_vertices(vertices, faces)
    return vertices, faces, repairs


def _place(point):
    return "(" + ", ".join(f"{x:.4g}" for x in point) + ")"


def _check_finite(vertices, used, name):
    bad = np.flatnonzero(used & ~np.isfinite(vertices).all(axis=1))
    if len(bad):
        raise InputError(
            f"{name}: {len(bad)} of {int(used.sum())} vertices are not finite (first: vertex {bad[0]},"
            f" counted from 0, {_place(vertices[bad[0]])}). Remove them or export the mesh again."
        )


def _merge(vertices, faces):
    """One vertex a place, and no others; vertices closer than a hair share their place."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    kept = np.unique(faces)
    renamed = np.zeros(len(vertices), np.int64)
    renamed[kept] = np.arange(len(kept))
    vertices, faces = vertices[kept], renamed[faces]
    place, same = np.unique(vertices, axis=0, return_inverse=True)
    hair = MERGE_DISTANCE * np.linalg.norm(np.ptp(place, axis=0))
    close = cKDTree(place).query_pairs(hair, output_type="ndarray")
    count, group = connected_components(
        coo_matrix((np.ones(len(close), bool), (close[:, 0], close[:, 1])), (len(place),) * 2),
        directed=False,
    )
    group = group[same.ravel()]
    # the group's first vertex stands for it, and groups keep the order of the file
    _, first = np.unique(group, return_index=True)
    order = np.argsort(first)
    rank = np.empty(count, np.int32)
    rank[order] = np.arange(count, dtype=np.int32)
    return vertices[np.sort(first)], rank[group][faces], len(vertices) - count


def _check_area(vertices, faces, name):
    corners = vertices[faces]
    area = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    extent = np.ptp(vertices, axis=0).max(initial=0)
    if not len(faces):
        raise InputError(
            f"{name}: nothing is left after cleaning; every face has two corners in one place."
        )
    if area.sum() <= 1e-9 * extent**2:
        raise InputError(
            f"{name}: nothing is left after cleaning but {len(faces)} faces without area, whose corners lie on"
            " lines. Export the mesh again."
        )


def _check_connected(faces, name):
    _, inverse, counts = np.unique(edge_keys(faces), return_inverse=True, return_counts=True)
    alone = (counts[inverse].reshape(-1, 3) == 1).all(axis=1)
    if len(faces) > 1 and alone.sum() > len(faces) / 2:
        raise InputError(
            f"{name}: {int(alone.sum())} of {len(faces)} faces share no edge with another: loose triangles, not"
            " a surface. Weld the vertices in a mesh editor first."
        )


def _check_edges(vertices, faces, name):
    keys, counts = np.unique(edge_keys(faces), return_counts=True)
    bad = np.flatnonzero(counts > 2)
    if len(bad):
        base = int(faces.max()) + 1
        first = keys[bad[0]]
        a, b = vertices[first // base], vertices[first % base]
        raise InputError(
            f"{name}: {len(bad)} edges are shared by more than 2 faces (first: {counts[bad[0]]} faces at the edge"
            f" from {_place(a)} to {_place(b)}); a texture needs a manifold. Cut the mesh there or remove inner"
            " faces."
        )


def _orient(vertices, faces, name):
    """Turn faces so that neighbours agree and closed components look outward."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import breadth_first_order, connected_components

    m = len(faces)
    opposite = opposite_half_edges(faces)
    h = np.flatnonzero(opposite > np.arange(3 * m))
    g = opposite[h]
    start, _ = half_edges(faces)
    agree = start[h] != start[g]  # neighbours run along their edge in opposite senses
    f, e = h // 3, g // 3
    graph = coo_matrix((np.ones(2 * len(f)), (np.r_[f, e], np.r_[e, f])), shape=(m, m)).tocsr()
    count, component = connected_components(graph, directed=False)
    # +1 and -1 spread along a spanning tree; a disagreeing edge that is left tells a one-sided surface
    sense = np.ones(m, np.int8)
    sign = coo_matrix(
        (np.tile(np.where(agree, 1, 2), 2), (np.r_[f, e], np.r_[e, f])), shape=(m, m)
    ).tocsr()
    if not agree.all():
        _, roots = np.unique(component, return_index=True)
        for root in roots:
            order, before = breadth_first_order(graph, root, directed=False)
            for child in order[1:]:
                parent = before[child]
                sense[child] = sense[parent] if sign[parent, child] == 1 else -sense[parent]
    wrong = (sense[f] == sense[e]) != agree
    if wrong.any():
        where = vertices[start[h[wrong][0]]]
        raise InputError(
            f"{name}: is one-sided like a Möbius strip ({int(wrong.sum())} edges where its two sides meet, first at"
            f" {_place(where)}); a texture needs two sides. Cut it open."
        )
    corners = vertices[faces] - vertices.mean(axis=0)
    volume = np.einsum("fx,fx->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    closed = np.bincount(component[np.flatnonzero(opposite < 0) // 3], minlength=count) == 0
    # closed: outward. Open: as most of its area was
    outward = np.bincount(component, sense * volume, count)
    most = np.bincount(component, sense * area, count)
    sense = np.where(np.where(closed, outward, most)[component] < 0, -sense, sense)
    turned = sense < 0
    faces = np.where(turned[:, None], faces[:, ::-1], faces)
    return np.ascontiguousarray(faces, np.int32), int(turned.sum())


def _split_vertices(vertices, faces):
    """Give each fan of faces around a vertex a vertex of its own."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = faces.size
    opposite = opposite_half_edges(faces)
    h = np.flatnonzero(opposite >= 0)
    after = np.arange(n).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    here, there = np.r_[h, after[h]], np.r_[after[opposite[h]], opposite[h]]
    count, fan = connected_components(
        coo_matrix((np.ones(len(here), bool), (here, there)), (n, n)), directed=False
    )
    corner = faces.ravel()
    extra = count - len(np.unique(corner))
    if not extra:
        return vertices, faces, 0
    # the first fan of a vertex keeps its number, further ones are appended
    _, first = np.unique(fan, return_index=True)
    owner = corner[first]
    _, keeper = np.unique(owner, return_index=True)
    number = np.full(count, -1, np.int32)
    number[keeper] = owner[keeper]
    others = np.flatnonzero(number < 0)
    number[others] = len(vertices) + np.arange(len(others), dtype=np.int32)
    return (
        np.concatenate([vertices, vertices[owner[others]]]),
        np.ascontiguousarray(number[fan].reshape(-1, 3)),
        int(extra),
    )
