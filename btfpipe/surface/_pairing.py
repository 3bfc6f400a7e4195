"""Which faces of a mesh are neighbours, also where more than two meet at an edge.

A pairing of half-edges decides everything else. Parts are what it connects. Each fan of faces that
it connects around a position gets a vertex of its own. What it leaves unpaired is a boundary. So
cutting along an edge, keeping apart what only touches, and splitting a vertex are one operation.
These are the local cuts of A. Guéziec, G. Taubin, F. Lazarus and B. Horn, *Cutting and stitching:
converting sets of polygons to manifold surfaces*, TVCG 2001; how faces are paired is our own.

Half-edge ``3 f + k`` leaves corner k of face f. An edge is where half-edges run between the same
two positions. Its faces are paired

1. if there are two of them;
2. if two of them, and no third, share the edge's two *vertices in the file*;
3. if directions alternate around the edge, as they do where solids touch: the two faces that bound
   one piece of inside;
4. else by opposite directions, best first: faces that are connected elsewhere, then faces of pieces
   without boundary, then the two that continue most nearly straight on.
"""

import numpy as np

from btfpipe.surface.topology import half_edges

SAME_ANGLE = 1e-7  # radians; faces that lie on each other


def pair_half_edges(vertices, faces, alias):
    """Pair the half-edges of neighbours.

    Parameters
    ----------
    vertices : (n, 3) float64
        Distinct positions.
    faces : (m, 3) int32
        Corners as positions, three different ones.
    alias : (m, 3) int
        Corners as vertices of the file.

    Returns
    -------
    opposite : (3 m,) int32
        The other half-edge of the pair, -1 on a boundary.
    sense : (m,) int8
        -1 for faces to be turned, so that the two half-edges of each pair run in opposite
        directions. Most of the area that rules 1 and 2 connect keeps its own direction.
    crowded : int
        Edges of more than two faces.
    cut : int
        Edges of two faces that are left unpaired because the surface is one-sided.
    """
    start, end = half_edges(faces)
    edge = order, run, counts = runs(undirected(start, end))
    opposite = np.full(faces.size, -1, np.int32)
    join_twos(opposite, *edge)
    crowded = np.flatnonzero(counts[run] > 2)
    left, number = _join_by_file(opposite, order[crowded], run[crowded], *half_edges(alias))
    sense, piece, cut = _orient_pieces(vertices, faces, opposite, start)
    if len(left):
        undecided = np.zeros(faces.size, bool)
        undecided[left] = True
        rim = np.zeros(piece.max() + 1, bool)
        rim[piece[np.flatnonzero((opposite < 0) & ~undecided) // 3]] = True
        facing = _facing(vertices, faces, sense, order, run)
        _match_crowded(vertices, faces, opposite, left, number, sense, piece, rim, facing)
    return opposite, sense, int((counts > 2).sum()), cut


def undirected(a, b):
    """One integer, (n,) int64, for each unordered pair of numbers below 2^31."""
    a, b = a.astype(np.int64), b.astype(np.int64)
    return (np.minimum(a, b) << 31) | np.maximum(a, b)


def runs(keys):
    """Put equal keys side by side.

    Returns their order, the run that each of the ordered keys belongs to, and the lengths of runs.
    """
    order = np.argsort(keys, kind="stable")
    new = np.r_[True, np.diff(keys[order]) != 0][: len(keys)]
    run = np.cumsum(new) - 1
    return order, run, np.bincount(run)


def join_twos(opposite, order, run, counts):
    """Pair the half-edges of runs of exactly two."""
    two = order[counts[run] == 2].reshape(-1, 2)
    opposite[two[:, 0]] = two[:, 1]
    opposite[two[:, 1]] = two[:, 0]


def _join_by_file(opposite, order, run, start, end):
    """Rule 2, then rule 1 for the rest; returns what is left, as `order` and `run`."""
    if not len(order):
        return order, run
    key = undirected(start[order], end[order])
    within = np.lexsort((key, run))
    new = np.r_[True, (np.diff(run[within]) != 0) | (np.diff(key[within]) != 0)]
    number = np.cumsum(new) - 1
    join_twos(opposite, order[within], number, np.bincount(number))
    left = opposite[order] < 0
    order, run = order[left], run[left]
    counts = np.bincount(run)
    join_twos(opposite, order, run, counts)
    left = counts[run] > 2
    return order[left], run[left]


def _facing(vertices, faces, sense, order, run):
    """-1 for faces of clusters that are inside out, else 1.

    A cluster is what edges connect, however many faces they have.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    same = np.flatnonzero(np.diff(run) == 0)
    m = len(faces)
    graph = coo_matrix((np.ones(len(same), bool), (order[same] // 3, order[same + 1] // 3)), (m, m))
    count, cluster = connected_components(graph, directed=False)
    volume = signed_volumes(vertices, faces, cluster, count, sense)
    return np.where(volume < 0, -1, 1)[cluster]


def signed_volumes(vertices, faces, part, count, sense):
    """Six times the volume of each part, (count,), about its middle; positive if it faces out."""
    corners = vertices[faces]
    size = np.maximum(np.bincount(part, minlength=count), 1)
    middle = [np.bincount(part, corners[..., x].mean(axis=1), count) / size for x in range(3)]
    a, b, c = np.moveaxis(corners - np.stack(middle, 1)[part][:, None], 1, 0)
    return np.bincount(part, sense * np.einsum("fx,fx->f", a, np.cross(b, c)), count)


def _orient_pieces(vertices, faces, opposite, start):
    """Spread orientation over pairs; where it disagrees with itself, unpair.

    Returns the sense (m,) int8, the piece of each face (m,) int32, and how many edges it unpaired.
    """
    paired = np.flatnonzero(opposite >= 0)
    agree = np.ones(len(opposite), bool)
    agree[paired] = start[paired] != start[opposite[paired]]
    if agree.all():
        return np.ones(len(faces), np.int8), components(opposite)[1], 0
    from btfpipe.surface._pairing_kernels import spread

    sense, piece = np.zeros(len(faces), np.int8), np.empty(len(faces), np.int32)
    cut = spread(opposite, agree, sense, piece)
    weight = np.bincount(piece, sense * areas(vertices, faces))
    sense[weight[piece] < 0] *= -1
    return sense, piece, cut


def components(opposite):
    """Number of parts that a pairing connects, and the part of each face (m,) int32."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    h = np.flatnonzero(opposite > np.arange(len(opposite)))
    m = len(opposite) // 3
    graph = coo_matrix((np.ones(len(h), bool), (h // 3, opposite[h] // 3)), shape=(m, m))
    return connected_components(graph, directed=False)


def closed_parts(opposite):
    """Which faces belong to parts without boundary, (m,) bool.

    Returns also the part of each face, (m,) int32, and the number of parts.
    """
    count, part = components(opposite)
    whole = np.ones(count, bool)
    whole[part[np.flatnonzero(opposite < 0) // 3]] = False
    return whole[part], part, count


def areas(vertices, faces):
    """Area of each face, (m,) float64."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _match_crowded(vertices, faces, opposite, order, run, sense, piece, rim, facing):
    """Rules 3 and 4, for half-edges `order` that lie edge by edge, as `run` counts."""
    from btfpipe.surface._pairing_kernels import match

    starts = np.flatnonzero(np.r_[True, np.diff(run) != 0])
    size = np.diff(np.r_[starts, len(run)])
    face, corner = order // 3, order % 3
    tail, head = faces[face, corner], faces[face, (corner + 1) % 3]
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    origin = vertices[low]
    axis = vertices[high] - origin
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    arm = vertices[faces[face, (corner + 2) % 3]] - origin
    arm -= np.einsum("hx,hx->h", arm, axis)[:, None] * axis
    right = np.repeat(arm[starts], size, axis=0)
    up = np.cross(axis, right)
    angle = np.arctan2(np.einsum("hx,hx->h", arm, up), np.einsum("hx,hx->h", arm, right))
    angle %= 2 * np.pi
    angle[angle > 2 * np.pi - SAME_ANGLE] = 0
    # Counter-clockwise around the axis, the inside ends at a face that runs along the axis, unless
    # the file is inside out.
    ends = (tail == low) == (sense * facing > 0)[face]
    within = np.lexsort((order, angle, run))
    ring = order[within]
    match(opposite, ring, starts, angle[within], ends[within], piece[face[within]], rim, SAME_ANGLE)
