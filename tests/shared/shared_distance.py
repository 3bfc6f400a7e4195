"""Distances between meshes, evenness and topology, measured apart from the package's own measure."""

import numpy as np

_PER_VERTEX = 8  # random points on each mesh, for a vertex of the result
_SHARP_DEG = 60


def spread(vertices, faces):
    """Mean length of the edges, and its standard deviation over the mean."""
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    a, b = np.unique(sides, axis=0).T
    length = np.linalg.norm(vertices[a] - vertices[b], axis=1)
    return length.mean(), length.std() / length.mean()


def areas(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def distance_to(points, vertices, faces):
    """Distance of each point to the closest one of a mesh."""
    import igl

    squared, _, _ = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points, dtype=np.float64),
        np.ascontiguousarray(vertices, dtype=np.float64),
        np.ascontiguousarray(faces, dtype=np.int64),
    )
    return np.sqrt(np.maximum(squared, 0))


def points_on(vertices, faces, count, random):
    """Random points of even density on a mesh: the corners of a square folded onto each triangle."""
    area = areas(vertices, faces)
    face = random.choice(len(faces), count, p=area / area.sum())
    u, w = random.random((2, count))
    over = u + w > 1
    u[over], w[over] = 1 - u[over], 1 - w[over]
    a, b, c = (vertices[faces[face, k]] for k in range(3))
    return a + u[:, None] * (b - a) + w[:, None] * (c - a)


def _along_edges(vertices, faces, step):
    """Points on the edges of a mesh, about a step apart, for edges longer than that."""
    sides = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    a, b = vertices[sides[:, 0]], vertices[sides[:, 1]]
    parts = np.minimum(np.linalg.norm(b - a, axis=1) / step, 2000).astype(int)
    edge = np.repeat(np.arange(len(a)), parts)
    which = np.concatenate([np.arange(n) for n in parts]) if len(edge) else np.zeros(0)
    fraction = ((which + 0.5) / np.maximum(parts[edge], 1))[:, None]
    return a[edge] + fraction * (b[edge] - a[edge])


def sharp_points(vertices, faces, step):
    """Points on corners sharper than 60 degrees: edges between two faces, and vertices like tips of cones."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort(sides.T)
    one, two = order[:-1], order[1:]
    same = (sides[one] == sides[two]).all(axis=1)
    one, two = one[same], two[same]
    turn = np.einsum("kx,kx->k", normal[one // 3], normal[two // 3])
    knife = sides[one[turn < -np.cos(np.deg2rad(_SHARP_DEG))]]
    total = np.zeros(len(vertices))
    for k in range(3):
        p, q, r = (vertices[faces[:, (k + i) % 3]] for i in range(3))
        u, w = q - p, r - p
        cosine = np.einsum("fx,fx->f", u, w) / np.maximum(
            np.linalg.norm(u, axis=1) * np.linalg.norm(w, axis=1), 1e-300
        )
        np.add.at(total, faces[:, k], np.arccos(np.clip(cosine, -1, 1)))
    counts = np.unique(sides, axis=0, return_counts=True)
    total[counts[0][counts[1] == 1].ravel()] = np.inf  # the rim of an open mesh is no cone
    total[np.setdiff1d(np.arange(len(vertices)), faces)] = np.inf
    tips = vertices[total < 2 * np.pi * np.sin(np.deg2rad(_SHARP_DEG / 2))]
    if not len(knife):
        return tips
    # two lone triangles that make an edge are enough for `_along_edges`
    lone = np.stack([knife[:, 0], knife[:, 1], knife[:, 1]], axis=1)
    return np.concatenate([tips, vertices[knife.ravel()], _along_edges(vertices, lone, step)])


def compare(vertices, faces, source_vertices, source_faces, seed=7):
    """How far a mesh lies from its input, in its own mean edge lengths, as a dict.

    `from_input` and `to_input` are the largest distances of points on the input and on the mesh, `mean_*` their
    means over the area, `beyond` the largest that is farther than a spacing from every corner sharper than 60 degrees.
    """
    from scipy.spatial import cKDTree

    random = np.random.default_rng(seed)
    spacing, variation = spread(vertices, faces)
    count = _PER_VERTEX * len(vertices)
    inside = [
        points_on(*mesh, count, random)
        for mesh in ((source_vertices, source_faces), (vertices, faces))
    ]
    theirs = np.concatenate(
        [
            inside[0],
            source_vertices[np.unique(source_faces)],
            _along_edges(source_vertices, source_faces, spacing / 4),
        ]
    )
    corners = vertices[faces]
    middles = 0.5 * (corners + np.roll(corners, -1, axis=1)).reshape(-1, 3)
    ours = np.concatenate([inside[1], vertices[np.unique(faces)], middles])
    from_input = distance_to(theirs, vertices, faces) / spacing
    to_input = distance_to(ours, source_vertices, source_faces) / spacing
    points, distances = np.concatenate([theirs, ours]), np.concatenate([from_input, to_input])
    off = np.flatnonzero(distances > 0.45)
    sharp = sharp_points(source_vertices, source_faces, spacing)
    blunt = off
    if len(off) and len(sharp):
        # a spacing from the corner itself; points on the mesh may lie as far from it again
        blunt = off[cKDTree(sharp).query(points[off])[0] > spacing * (1 + distances[off])]
    return {
        "vertices": len(vertices),
        "from_input": from_input.max(),
        "to_input": to_input.max(),
        "mean_from_input": from_input[:count].mean(),
        "mean_to_input": to_input[:count].mean(),
        "beyond": distances[blunt].max(initial=min(distances.max(), 0.45)),
        "worst": points[distances.argmax()],
        "area": areas(vertices, faces).sum() / areas(source_vertices, source_faces).sum(),
        "variation": variation,
        "spacing": spacing,
    }


def topology(faces, n):
    """Components, Euler characteristic, boundary edges' loops, and edges with more than two faces."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    used, local = np.unique(faces, return_inverse=True)
    local = local.reshape(-1, 3)
    sides = np.sort(local[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edge, count = np.unique(sides, axis=0, return_counts=True)
    k = len(used)

    def parts(pairs, among):
        graph = coo_matrix((np.ones(len(pairs)), pairs.T), (k, k))
        label = connected_components(graph, directed=False)[1]
        return len(np.unique(label[among]))

    rim = edge[count == 1]
    return {
        "components": parts(edge, np.arange(k)),
        "euler": k - len(edge) + len(faces),
        "boundaries": parts(rim, np.unique(rim)) if len(rim) else 0,
        "overfull": int((count > 2).sum()),
    }
