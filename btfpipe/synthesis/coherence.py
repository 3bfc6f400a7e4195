"""How much of a coordinate map is made of whole pieces of the sample."""

import numpy as np

from btfpipe.surface.flatten import turned

TOLERANCE = 0.25  # texels, by which a coherent step may differ from the vertices' own


def coherent_triangles(level, row, col, texels_per_unit, shape, toroidal, turn=0.0):
    """Triangles whose three coordinates differ as the vertices themselves do, to a quarter of a texel on each edge.

    Parameters
    ----------
    level : btfpipe.surface.Level
    row, col : (n,) float32
        Coordinates of the vertices in the sample.
    texels_per_unit : float
    shape : (int, int)
        Rows and cols of the sample.
    toroidal : bool
    turn : float
        Angle of the sample's s axis against the frames, radians.

    Returns
    -------
    (m,) bool
    """
    vertices, faces = np.asarray(level.vertices), np.asarray(level.faces)
    tangents = turned(level, turn)
    bitangents = np.cross(level.normals, tangents)
    whole = np.ones(len(faces), bool)
    for i in range(3):
        a, b = faces[:, i], faces[:, (i + 1) % 3]
        edge = (vertices[b] - vertices[a]) * texels_per_unit
        s = np.einsum("nd,nd->n", edge, tangents[a] + tangents[b])
        t = np.einsum("nd,nd->n", edge, bitangents[a] + bitangents[b])
        stretch = np.linalg.norm(edge, axis=1) / np.maximum(np.hypot(s, t), 1e-12)
        drow, dcol = row[b] - row[a] + stretch * t, col[b] - col[a] - stretch * s
        if toroidal:
            drow -= shape[0] * np.round(drow / shape[0])
            dcol -= shape[1] * np.round(dcol / shape[1])
        whole &= np.hypot(drow, dcol) <= TOLERANCE
    return whole


def coherence_facts(grown, surface, shape, toroidal):
    """Share of coherent triangles (or of a plane's steps), and the texels of the patch that a texel lies in, on average.

    Parameters
    ----------
    grown : CoordinateMap
    surface : Surface or None
        None for a plane.
    shape, toroidal
        Of the sample.

    Returns
    -------
    dict
        ``coherent_share`` of the domain, ``patch_texels``: mean size of the patches, each counted once a texel of it.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = grown.row.shape[1]
    if surface is not None:
        level = surface.levels[0]
        whole = coherent_triangles(
            level, grown.row[0], grown.col[0], grown.texels_per_unit, shape, toroidal,
            float(grown.angle[0, 0]),
        )  # fmt: skip
        faces = np.asarray(level.faces)[whole]
        first, second = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
        share = whole.mean()
        corners = np.asarray(level.vertices)[np.asarray(level.faces)]
        area = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        texels = 0.5 * area.sum() * grown.texels_per_unit**2 / n
    else:
        rows, cols = grown.domain["plane"]
        row, col = (a.reshape(rows, cols) for a in (grown.row[0], grown.col[0]))
        place = np.arange(n).reshape(rows, cols)
        first, second, steps = [], [], 0
        for axis in (0, 1):
            drow = np.roll(row, -1, axis) - row - (axis == 0)
            dcol = np.roll(col, -1, axis) - col - (axis == 1)
            if toroidal:
                drow, dcol = drow % shape[0], dcol % shape[1]
            whole = (drow == 0) & (dcol == 0)
            first.append(place[whole])
            second.append(np.roll(place, -1, axis)[whole])
            steps += whole.mean() / 2
        first, second, share, texels = np.concatenate(first), np.concatenate(second), steps, 1.0
    graph = coo_array((np.ones(len(first), np.int8), (first, second)), shape=(n, n))
    size = np.bincount(connected_components(graph, directed=False)[1]).astype(float)
    return {
        "coherent_share": float(share),
        "patch_texels": float((size**2).sum() / n * texels),
    }
