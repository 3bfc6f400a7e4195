"""Make an oriented manifold of a raw mesh, and say what was done.

`_pairing` decides which faces are neighbours. Here is what comes before it (one vertex for each
position, no face twice) and after it (which way parts face, vertices for parts that touch).
"""

import numpy as np

from btfpipe.errors import InputError
from btfpipe.surface import _pairing
from btfpipe.surface.surface import require_extent
from btfpipe.surface.topology import half_edges

MERGE_DISTANCE = 1e-7  # of the bounding box's diagonal
_WELD = (
    "Weld them first: Merge Close Vertices in MeshLab (meshing_merge_close_vertices in pymeshlab),"
    " Merge by Distance in Blender (bpy.ops.mesh.remove_doubles)."
)
_TINY = np.finfo(float).tiny
_OFF_SURFACE = 1e-4  # of the root of a face's area: from where it is asked what a part lies in


def clean(vertices, faces, name="mesh"):
    """Make an oriented manifold, with or without boundary, of a mesh.

    A part that is closed in the file's own indices stays as it is where it touches another. All
    else is welded by position. Where more than two faces meet at an edge, solids come apart as solids,
    and a third face (a fin, an inner wall) becomes a part of its own with a boundary. A one-sided
    surface is cut, because no field of frames goes around it.

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
        Counter-clockwise seen from outside, for closed parts. A closed part inside another one that
        the file turns the opposite way is a cavity, and faces what is in it. Open parts face as
        most of their area did.
    repairs : dict of str to int
        What was done how often. Left out: ``unreferenced_vertices``; ``degenerate_faces`` with two
        corners in one position; ``duplicate_faces``; ``double_sided_faces``, the backs of what is
        there twice in opposite directions (open parts are rendered from both sides).
        Joined: ``merged_vertices``, which shared the position of another. Parted: ``parted_edges``
        of more than two faces, ``cut_edges`` of a one-sided surface, ``split_vertices`` made where
        fans or parts touch. Changed: ``turned_faces``; ``bisected_edges``, of which two ran between
        the same two vertices.

    Raises
    ------
    InputError
        If a used vertex is not finite, or lengths are beyond `require_extent`; if nothing with an
        area is left, or most faces share no edge with another.
    """
    repairs = {}
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    _check_finite(vertices, used, name)
    points = vertices[used]
    if (points != points[:1]).any():  # what lies in one place is refused below
        require_extent(points, name)
    alias = (np.cumsum(used) - 1)[faces]
    position = _positions(points)
    faces = position[alias]
    proper = _proper(faces)
    alias = _united(alias, faces, proper, len(points))[proper]
    repairs["degenerate_faces"] = int((~proper).sum())
    first, faces = _in_order_of_file(position, faces[proper])
    met = np.isin(position, position[first])
    repairs["unreferenced_vertices"] = len(vertices) - int(met.sum())
    repairs["merged_vertices"] = int(met.sum()) - len(first)
    vertices = points[first]
    once = _first_copies(faces, alias)
    repairs["duplicate_faces"] = len(faces) - len(once)
    faces, alias = faces[once], alias[once]
    _check_area(vertices, faces, name)
    _check_connected(vertices, faces, name)
    opposite, sense, kept = _pair(vertices, faces, alias, repairs)
    return _manifold(vertices, faces[kept], opposite, sense, repairs)


def _place(point):
    return "(" + ", ".join(f"{x:.4g}" for x in point) + ")"


def _check_finite(vertices, used, name):
    bad = np.flatnonzero(used & ~np.isfinite(vertices).all(axis=1))
    if len(bad):
        raise InputError(
            f"{name}: {len(bad)} of {int(used.sum())} vertices are not finite (first: vertex"
            f" {bad[0]}, counted from 0, {_place(vertices[bad[0]])}). Remove their faces"
            " (remove_infinite_values of trimesh) or export the mesh again."
        )


def _positions(points):
    """A number for the position of each point, (n,); points closer than a hair share theirs."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    order = np.lexsort(points.T)
    new = np.r_[True, (np.diff(points[order], axis=0) != 0).any(axis=1)][: len(points)]
    same = np.empty(len(points), np.int64)
    same[order] = np.cumsum(new) - 1
    distinct = points[order[new]]
    hair = MERGE_DISTANCE * np.linalg.norm(np.ptp(points, axis=0))
    close = cKDTree(distinct).query_pairs(hair, output_type="ndarray")
    if not len(close):
        return same
    graph = coo_matrix(
        (np.ones(len(close), bool), (close[:, 0], close[:, 1])), (len(distinct),) * 2
    )
    return connected_components(graph, directed=False)[1][same]


def _proper(faces):
    """Which faces have three different corners."""
    a, b, c = faces.T
    return (a != b) & (b != c) & (c != a)


def _united(alias, faces, proper, n):
    """Corners as vertices of the file; a face without area makes one of those at one position.

    Otherwise the neighbours of such a face, which is left out, would not be connected.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    start, end = half_edges(alias[~proper])
    here, there = half_edges(faces[~proper])
    start, end = start[here == there], end[here == there]
    if not len(start):
        return alias
    graph = coo_matrix((np.ones(len(start), bool), (start, end)), (n, n))
    return connected_components(graph, directed=False)[1][alias]


def _in_order_of_file(position, faces):
    """The first point at each position that faces use, and faces that count these."""
    wanted = np.zeros(position.max(initial=0) + 1, bool)
    wanted[faces] = True
    points = np.flatnonzero(wanted[position])
    first = np.full(len(wanted), len(position))
    np.minimum.at(first, position[points], points)
    chosen = np.sort(first[wanted])
    rank = np.empty(len(position) + 1, np.int32)
    rank[chosen] = np.arange(len(chosen), dtype=np.int32)
    return chosen, rank[first][faces].reshape(-1, 3)


def _first_copies(faces, alias):
    """Indices of the faces that stay where several of one direction share their corners.

    A part that is closed in the file keeps all of its own: it may lie flush with another.
    """
    key = _directed_triples(faces)
    order, _, counts = _pairing.runs(key)
    if (counts == 1).all():
        return np.arange(len(faces))
    _, first = np.unique(_directed_triples(alias), return_index=True)
    again = np.ones(len(faces), bool)
    again[first] = False
    once = np.flatnonzero(~again)
    sealed = np.zeros(len(faces), bool)
    sealed[once] = _sealed(alias[once])
    # per position: the sealed ones, or else the first
    rest = order[~again[order]]
    rest = rest[np.lexsort((rest, ~sealed[rest], key[rest]))]
    leads = np.r_[True, np.diff(key[rest]) != 0]
    return np.sort(rest[leads | sealed[rest]])


def _triples(corners):
    """A number for each set of three corners, (m,) int64."""
    low, middle, high = np.sort(corners, axis=1).T.astype(np.int64)
    n = int(corners.max(initial=0)) + 1
    order, run, _ = _pairing.runs(low * n + middle)
    pair = np.empty(len(low), np.int64)
    pair[order] = run
    order, run, _ = _pairing.runs(pair * n + high)
    pair[order] = run
    return pair


def _directed_triples(corners):
    """As `_triples`, but different for the two directions around a face."""
    a, b, c = corners.T
    return 2 * _triples(corners) + ((a < b).astype(np.int64) + (b < c) + (c < a) == 1)


def _sealed(alias):
    """Which faces belong to parts that are closed in the file, each edge of exactly two faces."""
    order, run, counts = _pairing.runs(_pairing.undirected(*half_edges(alias)))
    opposite = np.full(alias.size, -1, np.int32)
    _pairing.join_twos(opposite, order, run, counts)
    return _pairing.closed_parts(opposite)[0]


def _pair(vertices, faces, alias, repairs):
    """Pair half-edges, leaving out one side of what the file has in both directions.

    Returns the pairing, the sense of faces, and which faces are kept.
    """
    kept = np.arange(len(faces))
    repairs["double_sided_faces"] = 0
    while True:
        opposite, sense, parted, cut = _pairing.pair_half_edges(vertices, faces[kept], alias[kept])
        again, against = _doubled(faces[kept], opposite)
        if not len(again):
            repairs |= {"parted_edges": parted, "cut_edges": cut}
            return opposite, sense, kept
        repairs["double_sided_faces"] += int(against.sum())
        repairs["duplicate_faces"] += int((~against).sum())
        kept = np.delete(kept, again)


def _doubled(faces, opposite):
    """Faces that lie on another one and are not needed, and which of them turn the other way.

    Where closed parts touch, both keep their faces. A face of an open part is not needed, nor is
    one of a closed part that covers another part, or itself, wholly.
    """
    nothing = np.zeros(0, np.int64), np.zeros(0, bool)
    triple = _triples(faces)
    order, run, counts = _pairing.runs(triple)
    crowd = order[counts[run] > 1]
    if not len(crowd):
        return nothing
    closed, part, count = _pairing.closed_parts(opposite)
    spare = ~closed | _covered(triple, part, count)[part]
    # in each crowd what cannot be spared comes first, then closed parts, then as in the file
    crowd = crowd[np.lexsort((crowd, part[crowd], ~closed[crowd], spare[crowd], triple[crowd]))]
    leads = np.r_[True, np.diff(triple[crowd]) != 0]
    leader = crowd[np.flatnonzero(leads)[np.cumsum(leads) - 1]]
    again = spare[crowd] & ~leads
    direction = _directed_triples(faces)
    return crowd[again], (direction[crowd] != direction[leader])[again]


def _covered(triple, part, count):
    """Which parts have the same faces as another part, or each of their own twice."""
    order = np.lexsort((triple, part))
    new = np.r_[True, (np.diff(part[order]) != 0) | (np.diff(triple[order]) != 0)]
    distinct = order[new]
    number = np.bincount(part[distinct], minlength=count)
    digest = np.zeros(count, np.uint64)
    scattered = np.random.default_rng(0).integers(0, 1 << 63, triple.max() + 1, np.uint64)
    np.add.at(digest, part[distinct], scattered[triple[distinct]])
    _, same, shared = np.unique(
        np.stack([number.astype(np.uint64), digest], 1),
        axis=0,
        return_inverse=True,
        return_counts=True,
    )
    return (shared[same.ravel()] > 1) | (np.bincount(part, minlength=count) == 2 * number)


def _check_area(vertices, faces, name):
    if not len(faces):
        raise InputError(
            f"{name}: nothing is left after cleaning; every face has two corners in one place."
        )
    extent = np.ptp(vertices, axis=0).max(initial=0)
    if _pairing.areas(vertices, faces).sum() <= 1e-9 * extent**2:
        raise InputError(
            f"{name}: nothing is left after cleaning but {len(faces)} faces without area, whose"
            f" corners lie on lines (first at {_place(vertices[faces[0]].mean(axis=0))}). Export the"
            " mesh again."
        )


def _check_connected(vertices, faces, name):
    _, first = np.unique(_triples(faces), return_index=True)
    faces = faces[np.sort(first)]
    order, run, counts = _pairing.runs(_pairing.undirected(*half_edges(faces)))
    shared = np.empty(faces.size, np.int64)
    shared[order] = counts[run]
    alone = np.flatnonzero((shared.reshape(-1, 3) == 1).all(axis=1))
    if len(faces) > 1 and len(alone) > len(faces) / 2:
        where = _place(vertices[faces[alone[0]]].mean(axis=0))
        raise InputError(
            f"{name}: {len(alone)} of {len(faces)} faces share no edge with another (first at"
            f" {where}): loose triangles, not a surface. {_WELD}"
        )


def _manifold(vertices, faces, opposite, sense, repairs):
    """Turn faces, and give each fan around a position a vertex of its own."""
    sense = _facing_out(vertices, faces, opposite, sense)
    turned = sense < 0
    repairs["turned_faces"] = int(turned.sum())
    faces, opposite = _turn(faces, opposite, turned)
    count = len(vertices)
    vertices, faces = _part_fans(vertices, faces, opposite)
    repairs["split_vertices"] = len(vertices) - count
    vertices, faces, repairs["bisected_edges"] = _bisect(vertices, faces, opposite)
    return vertices, np.ascontiguousarray(faces, np.int32), repairs


def _facing_out(vertices, faces, opposite, sense):
    """The sense of faces when closed parts face out, cavities in, open parts as most of them."""
    closed, part, count = _pairing.closed_parts(opposite)
    volume = _pairing.signed_volumes(vertices, faces, part, count, sense)
    area = np.bincount(part, sense * _pairing.areas(vertices, faces), count)
    whole = np.zeros(count, bool)
    whole[part[closed]] = True
    sense = np.where(np.where(whole, volume, area)[part] < 0, -sense, sense)
    # a part is inside out in the file if all of its faces are
    inward = whole & (np.bincount(part, sense > 0, count) == 0)
    if not inward.any() or inward[whole].all():
        return sense
    cavity = _in_the_opposite(vertices, faces, part, sense, closed, inward)
    return np.where(cavity[part], -sense, sense)


def _in_the_opposite(vertices, faces, part, sense, closed, inward):
    """Which closed parts lie in others that the file turns the opposite way, as `inward` says.

    Asked of winding numbers (Jacobson, Kavan and Sorkine-Hornung 2013) beside the largest face.
    """
    import igl

    whole = np.unique(part[closed])
    area = np.where(closed, _pairing.areas(vertices, faces), -1)
    order = np.lexsort((-area, part))
    largest = order[np.searchsorted(part[order], whole)]
    outward = np.where((sense < 0)[:, None], faces[:, ::-1], faces)
    a, b, c = (vertices[outward[largest, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    step = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), _TINY) ** 0.5
    middle, step = (a + b + c) / 3, _OFF_SURFACE * step
    turned = np.where(inward[part][:, None], outward[:, ::-1], outward)[closed]
    # What only touches the face, from outside or from inside, is on one side of it only.
    own = np.where(inward[whole], -1, 1)
    outside, inside = (
        np.round(igl.fast_winding_number(vertices, turned.astype(np.int64), middle + way * step))
        for way in (1, -1)
    )
    result = np.zeros(len(inward), bool)
    result[whole] = (outside * own < 0) & ((inside - own) * own < 0)
    return result


def _turn(faces, opposite, turned):
    """Reverse the corners of faces, and what the pairing calls their half-edges."""
    number = np.arange(faces.size).reshape(-1, 3)
    number = np.where(turned[:, None], number[:, [1, 0, 2]], number).ravel()
    # reversing swaps the first two half-edges, so a number maps both ways
    opposite = opposite[number]
    return (
        np.where(turned[:, None], faces[:, ::-1], faces),
        np.where(opposite >= 0, number[opposite], -1),
    )


def _part_fans(vertices, faces, opposite):
    """Give each fan of faces around a vertex a vertex of its own."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = faces.size
    h = np.flatnonzero(opposite >= 0)
    after = np.arange(n).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    here, there = np.r_[h, after[h]], np.r_[after[opposite[h]], opposite[h]]
    count, fan = connected_components(
        coo_matrix((np.ones(len(here), bool), (here, there)), (n, n)), directed=False
    )
    if count == len(vertices):
        return vertices, faces
    corner = faces.ravel()
    # the first fan of a vertex keeps its number, further ones are appended
    _, first = np.unique(fan, return_index=True)
    owner = corner[first]
    _, keeper = np.unique(owner, return_index=True)
    number = np.full(count, -1, np.int32)
    number[keeper] = owner[keeper]
    others = np.flatnonzero(number < 0)
    number[others] = len(vertices) + np.arange(len(others), dtype=np.int32)
    return np.concatenate([vertices, vertices[owner[others]]]), number[fan].reshape(-1, 3)


def _bisect(vertices, faces, opposite):
    """Halve edges until no two run between the same two vertices, where corners look alike."""
    made = 0
    while True:
        again = _repeated_edges(faces, opposite)
        if not len(again):
            return vertices, faces, made
        again = _apart(again, opposite, len(faces))
        made += len(again)
        vertices, faces, opposite = _halved(vertices, faces, opposite, again)


def _repeated_edges(faces, opposite):
    """A half-edge of each edge but the first between its vertices."""
    one = np.flatnonzero((opposite < 0) | (opposite > np.arange(len(opposite))))
    start, end = half_edges(faces)
    order, run, _ = _pairing.runs(_pairing.undirected(start[one], end[one]))
    return np.sort(one[order[1:][np.diff(run) == 0]])


def _apart(h, opposite, m):
    """Some of the half-edges, at least one, of which no two have a face in common."""
    rank = np.random.default_rng(0).permutation(len(h))
    g = opposite[h]
    least = np.full(m, len(h))
    np.minimum.at(least, h // 3, rank)
    np.minimum.at(least, g[g >= 0] // 3, rank[g >= 0])
    return h[(least[h // 3] == rank) & ((g < 0) | (least[g // 3] == rank))]


def _halved(vertices, faces, opposite, h):
    """Put a vertex in the middle of edges, given by half-edges, that have no face in common."""
    start, end = half_edges(faces)
    middle = len(vertices) + np.arange(len(h), dtype=faces.dtype)
    vertices = np.concatenate([vertices, 0.5 * (vertices[start[h]] + vertices[end[h]])])
    g = opposite[h]
    both = g >= 0
    split = np.r_[h, g[both]]
    middle = np.r_[middle, middle[both]]
    f, k = split // 3, split % 3
    second, third = (k + 1) % 3, (k + 2) % 3
    # (a, b, c) becomes (a, middle, c), in its position, and (middle, b, c)
    new = len(faces) + np.arange(len(split))
    more = np.stack([middle, faces[f, second], faces[f, third]], 1)
    faces = faces.copy()
    faces[f, second] = middle
    renamed = np.arange(len(opposite))
    renamed[3 * f + second] = 3 * new + 1
    opposite = np.where(opposite >= 0, renamed[opposite], -1)
    opposite = np.r_[opposite, np.full(3 * len(split), -1)]
    opposite[3 * new + 1] = opposite[3 * f + second]
    opposite[3 * new + 2] = 3 * f + second
    opposite[3 * f + second] = 3 * new + 2
    # the halves that face each other across the edge
    there = np.arange(len(h))[both], len(h) + np.arange(both.sum())
    opposite[split] = -1
    for a, b in (there, there[::-1]):
        opposite[split[a]] = 3 * new[b]
        opposite[3 * new[b]] = split[a]
    return vertices, np.concatenate([faces, more]), opposite
