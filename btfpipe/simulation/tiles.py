"""From loose triangles over one period to a tile whose shading normals run on across its borders."""

from dataclasses import dataclass

import numpy as np

from btfpipe.errors import InputError

_WELD = 1e-4  # of the shorter side of the tile: vertices closer than this are one


@dataclass
class TileMesh:
    """A triangle mesh over one period, in millimetres, with what its materials need.

    Attributes
    ----------
    vertices : (n, 3) array
        Positions (s, t, n) in mm; may lie outside the tile.
    faces : (m, 3) int array
        Counter-clockwise seen from outside.
    part : (m,) int array
        Index into `parts`.
    element : (n,) int array
        Yarn, leaf: what draws one colour of a palette.
    fibre : (n,) array
        Fine pattern of -1 to 1.
    parts : tuple of str
    """

    vertices: np.ndarray
    faces: np.ndarray
    part: np.ndarray
    element: np.ndarray
    fibre: np.ndarray
    parts: tuple


def joined(pieces, parts):
    """One TileMesh of several (vertices, faces, part index, element, fibre)."""
    vertices, faces, part, element, fibre = [], [], [], [], []
    start = 0
    for piece_vertices, piece_faces, piece_part, piece_element, piece_fibre in pieces:
        n = len(piece_vertices)
        vertices.append(piece_vertices)
        faces.append(np.asarray(piece_faces) + start)
        part.append(np.full(len(piece_faces), piece_part))
        element.append(np.full(n, piece_element))
        fibre.append(np.broadcast_to(piece_fibre, n))
        start += n
    return TileMesh(*(np.concatenate(a) for a in (vertices, faces, part, element, fibre)), parts)


def split(mesh, longest):
    """Cut edges at their middle until none is longer than `longest` (mm).

    Light is cached at vertices, so triangles must not be larger than what light varies over.
    """
    while True:
        sides = np.roll(mesh.vertices[mesh.faces], -1, axis=1) - mesh.vertices[mesh.faces]
        # rounded, so that both sides of an edge and its twin across the border decide alike
        long = np.linalg.norm(sides, axis=2).round(9) > longest
        if not long.any():
            return mesh
        start, end = mesh.faces, np.roll(mesh.faces, -1, axis=1)
        n = len(mesh.vertices)
        key = np.minimum(start, end) * n + np.maximum(start, end)
        cut, where = np.unique(key[long], return_inverse=True)
        middle = np.full(mesh.faces.shape, -1)
        middle[long] = n + where
        p, q = np.divmod(cut, n)

        # turn each triangle so that its uncut edges come last: patterns (x..), (xx.), (xxx)
        count = long.sum(axis=1)
        first = np.argmax(long & ~np.roll(long, 1, axis=1), axis=1)
        turn = (first[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(mesh.faces, turn, axis=1).T
        x, y, z = np.take_along_axis(middle, turn, axis=1).T
        pieces, owner = [], []
        for cuts, triangles in (
            (0, [(a, b, c)]),
            (1, [(a, x, c), (x, b, c)]),
            (2, [(a, x, c), (x, y, c), (x, b, y)]),
            (3, [(a, x, z), (x, b, y), (z, y, c), (x, y, z)]),
        ):
            at = np.flatnonzero(count == cuts)
            for triangle in triangles:
                pieces.append(np.stack(triangle, axis=1)[at])
                owner.append(at)
        mesh = TileMesh(
            np.concatenate([mesh.vertices, (mesh.vertices[p] + mesh.vertices[q]) / 2]),
            np.concatenate(pieces),
            mesh.part[np.concatenate(owner)],
            np.concatenate([mesh.element, mesh.element[p]]),
            np.concatenate([mesh.fibre, (mesh.fibre[p] + mesh.fibre[q]) / 2]),
            mesh.parts,
        )


def smooth_corners(mesh, size, crease_deg):
    """Which corners share a shading normal, and the normals.

    Parameters
    ----------
    mesh : TileMesh
    size : (float, float)
        Period along t and s, mm.
    crease_deg : float
        Faces that meet at a larger angle, or belong to different parts, do not share.

    Returns
    -------
    group : (m, 3) int array
        Group of each corner.
    normals : (groups, 3) array

    Raises
    ------
    InputError
        If every triangle is degenerate.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    same = _welded(mesh.vertices, size)[mesh.faces]
    corners = mesh.vertices[mesh.faces]
    sides = np.roll(corners, -1, axis=1) - corners
    face_normals = np.cross(sides[:, 0], sides[:, 1])
    length = np.linalg.norm(face_normals, axis=1)
    if not (length > 0).any():
        raise InputError("the meso-structure's mesh has no triangle with an area.")
    face_normals /= np.maximum(length, 1e-300)[:, None]

    m = len(mesh.faces)
    corner = np.arange(3 * m).reshape(m, 3)
    start, end = same, np.roll(same, -1, axis=1)
    turned = start > end
    low, high = np.where(turned, end, start).ravel(), np.where(turned, start, end).ravel()
    after = np.roll(corner, -1, axis=1)
    low_corner = np.where(turned, after, corner).ravel()
    high_corner = np.where(turned, corner, after).ravel()
    order = np.lexsort((high, low))
    a, b = order[:-1], order[1:]
    cosine = np.einsum("ij,ij->i", face_normals[a // 3], face_normals[b // 3])
    smooth = (low[a] == low[b]) & (high[a] == high[b]) & (mesh.part[a // 3] == mesh.part[b // 3])
    smooth &= cosine >= np.cos(np.radians(crease_deg)) - 1e-9
    a, b = a[smooth], b[smooth]
    links = (
        np.concatenate([low_corner[a], high_corner[a]]),
        np.concatenate([low_corner[b], high_corner[b]]),
    )
    graph = coo_array((np.ones(len(links[0]), np.int8), links), (3 * m, 3 * m))
    groups, group = connected_components(graph, directed=False)

    back = -np.roll(sides, 1, axis=1)
    scale = np.linalg.norm(sides, axis=2) * np.linalg.norm(back, axis=2)
    angle = np.arccos(
        np.clip(np.einsum("ijk,ijk->ij", sides, back) / np.maximum(scale, 1e-300), -1, 1)
    )
    normals = np.zeros((groups, 3))
    for axis in range(3):
        weight = angle * face_normals[:, axis, None]
        normals[:, axis] = np.bincount(group, weight.ravel(), groups)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return group.reshape(m, 3), normals


def _welded(vertices, size):
    """Number of the place of each vertex, the same for places one period apart."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    period = np.array([size[1], size[0]])
    places = np.array(vertices, float)
    places[:, :2] %= period
    places[:, :2] %= period  # a tiny negative number becomes the period itself
    places[:, 2] -= places[:, 2].min()
    tree = cKDTree(places, boxsize=[*period, 0])
    pairs = tree.query_pairs(_WELD * period.min(), output_type="ndarray")
    n = len(places)
    graph = coo_array((np.ones(len(pairs), np.int8), pairs.T), (n, n))
    return connected_components(graph, directed=False)[1]
