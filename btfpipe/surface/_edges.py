"""Compiled edits of a triangle mesh: split, collapse and flip of edges.

The mesh is a table of half-edges. Half-edge ``3 f + k`` leaves corner k of face f, whose vertex is
``corner[3 f + k]``, towards the next corner; ``opposite`` is the same edge seen from the other face,
or -1 on a boundary. ``leave[v]`` is a half-edge that leaves vertex v, the boundary one if v lies on a
boundary, so that turning counter-clockwise from it meets every face of v. Dead faces have
``corner[3 f] = -1``, dead vertices ``leave[v] = -1``.

``feature`` is 0, or 1 + the number of a feature edge of the input that the half-edge runs along; ``kind`` says whether a
vertex moves freely (0), along its two feature edges (1), or not at all (2). ``place`` is a face of the input at or near a
vertex, ``along`` a feature edge of the input at or near a vertex of kind 1, ``origin`` a face of the input at or near a face,
on the same side of all feature lines: walks start there (`projection`). All three edits keep the mesh a manifold of the same
genus.
"""

import numpy as np

from btfpipe.compiled import njit

_FLAT = 0.7  # cosine of the angle between faces; a flip must not bend faces more that meet at a sharper edge
_FOLD = 0.2  # cosine of the turn of a normal in a collapse that makes a fold
_STRETCH = 1.1  # by how much the square of a long edge may grow in a collapse
_NARROW = 0.4  # of the longest edge: where lines run closer to each other, edges along them are let be longer,
_WIDE = 1.5  # in square by this: those across are short, and vertices are better spent elsewhere
_RING = 96  # vertices of more neighbours than this are left alone


@njit(cache=True, nogil=True, inline="always")
def next_of(h):
    return h + 1 if h % 3 < 2 else h - 2


@njit(cache=True, nogil=True, inline="always")
def previous_of(h):
    return h - 1 if h % 3 > 0 else h + 2


@njit(cache=True, nogil=True, inline="always")
def _join(opposite, feature, h, g, mark):
    """Make h and g the two sides of one edge; either may be -1."""
    if h >= 0:
        opposite[h] = g
        feature[h] = mark
    if g >= 0:
        opposite[g] = h
        feature[g] = mark


@njit(cache=True, nogil=True)
def _settle(opposite, leave, v, h):
    """Set leave[v] from any half-edge h that leaves v, turning clockwise to the boundary if there is one."""
    start = h
    while True:
        g = opposite[h]
        if g < 0:
            break
        h = next_of(g)
        if h == start:
            break
    leave[v] = h


@njit(cache=True, nogil=True)
def _ring(corner, opposite, leave, v, out, around):
    """Half-edges leaving v, counter-clockwise, and the neighbours of v; their counts, or -1 if there are too many."""
    h = leave[v]
    n = 0
    while True:
        if n >= _RING - 1:
            return -1, -1
        out[n] = h
        around[n] = corner[next_of(h)]
        n += 1
        p = previous_of(h)
        g = opposite[p]
        if g < 0:
            around[n] = corner[p]
            return n, n + 1
        if g == leave[v]:
            return n, n
        h = g


@njit(cache=True, nogil=True, inline="always")
def _length2(points, a, b):
    return (
        (points[a, 0] - points[b, 0]) ** 2
        + (points[a, 1] - points[b, 1]) ** 2
        + (points[a, 2] - points[b, 2]) ** 2
    )


@njit(cache=True, nogil=True, inline="always")
def cross(ax, ay, az, bx, by, bz, cx, cy, cz):
    """Twice the area vector of the triangle a, b, c."""
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@njit(cache=True, nogil=True)
def _longest_beside(corner, opposite, points, h):
    """Squared length of the longest other edge of the faces at h."""
    longest = 0.0
    for i in range(2):
        g = h if i == 0 else opposite[h]
        if g >= 0:
            c = corner[previous_of(g)]
            longest = max(longest, _length2(points, c, corner[g]))
            longest = max(longest, _length2(points, c, corner[next_of(g)]))
    return longest


@njit(cache=True, nogil=True)
def _area2(points, corner, h):
    """The square of twice the area of the face at h."""
    a, b, c = corner[h], corner[next_of(h)], corner[previous_of(h)]
    x, y, z = cross(
        points[a, 0], points[a, 1], points[a, 2],
        points[b, 0], points[b, 1], points[b, 2],
        points[c, 0], points[c, 1], points[c, 2],
    )  # fmt: skip
    return x * x + y * y + z * z


@njit(cache=True, nogil=True)
def _is_crowded(corner, opposite, feature, kind, points, h, longest2):
    """Whether the edge at h runs along a line that another runs beside, closer than `_NARROW` of the longest edge."""
    if feature[h] == 0:
        return False
    most = _NARROW * _NARROW * longest2 * _length2(points, corner[h], corner[next_of(h)])
    for i in range(2):
        g = h if i == 0 else opposite[h]
        if g >= 0 and kind[corner[previous_of(g)]] and _area2(points, corner, g) < most:
            return True
    return False


@njit(cache=True, nogil=True, inline="always")
def _halve(corner, opposite, feature, origin, h, m, n_faces):
    """Cut the face (a, b, c) at h into (a, m, c) in place and (m, b, c) behind the last; returns the latter's first half-edge."""
    f, h1 = 3 * n_faces, next_of(h)
    outer, mark = opposite[h1], feature[h1]
    corner[f], corner[f + 1], corner[f + 2] = m, corner[h1], corner[previous_of(h)]
    corner[h1] = m
    origin[n_faces] = origin[h // 3]
    _join(opposite, feature, f + 1, outer, mark)
    _join(opposite, feature, f + 2, h1, 0)
    return f


@njit(cache=True, nogil=True)
def _split(
    corner, opposite, feature, leave, kind, place, along, origin, points, flat,
    n_vertices, n_faces, h, near,
):  # fmt: skip
    """Halve the edge at h; `near` says that feature lines are followed from its ends. Returns the new numbers."""
    a, b = corner[h], corner[next_of(h)]
    g = opposite[h]
    mark = feature[h]
    m = n_vertices
    n_vertices += 1
    for axis in range(3):
        points[m, axis] = 0.5 * (points[a, axis] + points[b, axis])
        flat[m, axis] = 0.5 * (flat[a, axis] + flat[b, axis])
    kind[m] = 1 if mark else 0
    along[m] = mark - 1
    if mark and near:
        # nearer than where the whole edge once was
        along[m] = along[a] if kind[a] == 1 else (along[b] if kind[b] == 1 else mark - 1)
    place[m] = origin[h // 3]
    f = _halve(corner, opposite, feature, origin, h, m, n_faces)
    n_faces += 1
    if g < 0:
        _join(opposite, feature, f, -1, mark)
        _join(opposite, feature, h, -1, mark)
    else:
        e = _halve(corner, opposite, feature, origin, g, m, n_faces)
        n_faces += 1
        _join(opposite, feature, e, h, mark)
        _join(opposite, feature, f, g, mark)
        if leave[a] == next_of(g):
            leave[a] = e + 1
    leave[m] = f
    if leave[b] == next_of(h):
        leave[b] = f + 1
    return n_vertices, n_faces


@njit(cache=True, nogil=True)
def split_long(
    corner, opposite, feature, leave, kind, place, along, origin, points, flat,
    n_vertices, n_faces, longest, thin,
):  # fmt: skip
    """Halve edges longer than `longest`, repeatedly, each when it is the longest of its faces.

    With `thin` above 0, edges along features are halved whatever lies beside them, and others only between faces
    that are higher than that.

    Stops early when the arrays are full. Returns the new numbers of vertices and faces and
    whether it finished.
    """
    limit = longest * longest
    changed = True
    while changed:
        changed = False
        h = -1
        while h + 1 < 3 * n_faces:
            h += 1
            if corner[h - h % 3] < 0 or opposite[h] > h:
                continue
            a, b = corner[h], corner[next_of(h)]
            length = _length2(points, a, b)
            if length <= limit:
                continue
            if (
                thin == 0.0
                and length <= _WIDE * limit
                and _is_crowded(corner, opposite, feature, kind, points, h, limit)
            ):
                continue
            free = thin > 0.0 and feature[h] > 0
            if not free and length < _longest_beside(corner, opposite, points, h):
                continue
            if n_vertices + 1 > len(points) or 3 * (n_faces + 2) > len(corner):
                return n_vertices, n_faces, False
            if feature[h] == 0 and thin > 0.0:
                low = min(_area2(points, corner, h), _area2(points, corner, opposite[h]))
                if low < thin * thin * length:
                    continue
            changed = True
            n_vertices, n_faces = _split(
                corner, opposite, feature, leave, kind, place, along, origin, points, flat,
                n_vertices, n_faces, h, thin == 0.0,
            )  # fmt: skip
    return n_vertices, n_faces, True


@njit(cache=True, nogil=True)
def insert_vertex(corner, opposite, feature, leave, origin, face, m, n_faces):
    """Cut a face into three around the new vertex m; two faces go behind the last. Returns the number of faces."""
    h, e, g = 3 * face, 3 * n_faces, 3 * n_faces + 3
    a, b, c = corner[h], corner[h + 1], corner[h + 2]
    beyond_b, mark_b = opposite[h + 1], feature[h + 1]
    beyond_c, mark_c = opposite[h + 2], feature[h + 2]
    corner[h + 2] = m
    corner[e], corner[e + 1], corner[e + 2] = b, c, m
    corner[g], corner[g + 1], corner[g + 2] = c, a, m
    origin[n_faces] = origin[n_faces + 1] = origin[face]
    _join(opposite, feature, e, beyond_b, mark_b)
    _join(opposite, feature, g, beyond_c, mark_c)
    _join(opposite, feature, h + 1, e + 2, 0)
    _join(opposite, feature, e + 1, g + 2, 0)
    _join(opposite, feature, g + 1, h + 2, 0)
    leave[m] = h + 2
    if leave[b] == h + 1:
        leave[b] = e
    if leave[c] == h + 2:
        leave[c] = g
    return n_faces + 2


@njit(cache=True, nogil=True)
def _folds(corner, points, out, n, skip1, skip2, x, y, z, least):
    """Whether moving the vertex that the half-edges `out` leave to (x, y, z) turns a face's normal so that the cosine is below `least`."""
    for i in range(n):
        h = out[i]
        if h // 3 == skip1 or h // 3 == skip2:
            continue
        a, b, c = corner[h], corner[next_of(h)], corner[previous_of(h)]
        ox, oy, oz = cross(
            points[a, 0], points[a, 1], points[a, 2],
            points[b, 0], points[b, 1], points[b, 2],
            points[c, 0], points[c, 1], points[c, 2],
        )  # fmt: skip
        nx, ny, nz = cross(
            x, y, z,
            points[b, 0], points[b, 1], points[b, 2],
            points[c, 0], points[c, 1], points[c, 2],
        )  # fmt: skip
        old = np.sqrt(ox * ox + oy * oy + oz * oz)
        new = np.sqrt(nx * nx + ny * ny + nz * nz)
        if ox * nx + oy * ny + oz * nz < least * old * new:
            return True
    return False


@njit(cache=True, nogil=True)
def _collapse(
    corner, opposite, feature, leave, kind, points, flat, h, bound, least,
    out_a, out_b, near_a, near_b,
):  # fmt: skip
    """Collapse the edge at h, from its start to its end, if nothing folds, tears or gets too long; returns whether."""
    g = opposite[h]
    a, b = corner[h], corner[next_of(h)]
    if kind[a] == 2 or (kind[a] == 1 and feature[h] == 0):
        return False
    h1, h2 = next_of(h), previous_of(h)
    if kind[a] == 1 and feature[h2]:
        return False
    boundary_a, boundary_b = opposite[leave[a]] < 0, opposite[leave[b]] < 0
    if boundary_a and boundary_b and g >= 0:
        return False
    faces_a, n_a = _ring(corner, opposite, leave, a, out_a, near_a)
    faces_b, n_b = _ring(corner, opposite, leave, b, out_b, near_b)
    if n_a < 0 or n_b < 0:
        return False
    common = 0
    for i in range(n_a):
        for j in range(n_b):
            common += near_a[i] == near_b[j]
    if common != (1 if g < 0 else 2):
        return False
    outer1, outer2 = opposite[h1], opposite[h2]
    if outer1 < 0 and outer2 < 0:
        return False
    if not _may_lose(corner, opposite, leave, corner[h2]):
        return False
    inner1, inner2 = -1, -1
    if g >= 0:
        g1, g2 = next_of(g), previous_of(g)
        inner1, inner2 = opposite[g1], opposite[g2]
        if inner1 < 0 and inner2 < 0:
            return False
        if kind[a] == 1 and feature[g1]:
            return False
        if not _may_lose(corner, opposite, leave, corner[g2]):
            return False
    both = kind[a] == 0 and kind[b] == 0
    share = 0.5 if both else 0.0
    x = points[b, 0] + share * (points[a, 0] - points[b, 0])
    y = points[b, 1] + share * (points[a, 1] - points[b, 1])
    z = points[b, 2] + share * (points[a, 2] - points[b, 2])
    stretched = False
    for i in range(n_a + n_b if both else n_a):
        v = near_a[i] if i < n_a else near_b[i - n_a]
        now = (points[v, 0] - x) ** 2 + (points[v, 1] - y) ** 2 + (points[v, 2] - z) ** 2
        if now > bound and now > _STRETCH * _length2(points, v, a if i < n_a else b):
            stretched = True
            break
    f0 = h // 3
    f1 = g // 3 if g >= 0 else -1
    if stretched or _folds(corner, points, out_a, faces_a, f0, f1, x, y, z, least):
        return False
    if both and _folds(corner, points, out_b, faces_b, f0, f1, x, y, z, least):
        return False
    points[b, 0], points[b, 1], points[b, 2] = x, y, z
    for axis in range(3):
        flat[b, axis] += share * (flat[a, axis] - flat[b, axis])
    c = corner[h2]
    d = corner[previous_of(g)] if g >= 0 else -1
    mark = max(feature[h1], feature[h2])
    inner_mark = max(feature[next_of(g)], feature[previous_of(g)]) if g >= 0 else 0
    for i in range(faces_a):
        corner[out_a[i]] = b
    corner[3 * f0] = -1
    _join(opposite, feature, outer1, outer2, mark)
    if g >= 0:
        corner[3 * f1] = -1
        _join(opposite, feature, inner1, inner2, inner_mark)
    leave[a] = -1
    _settle(opposite, leave, b, outer2 if outer2 >= 0 else next_of(outer1))
    _settle(opposite, leave, c, outer1 if outer1 >= 0 else next_of(outer2))
    if g >= 0:
        _settle(opposite, leave, d, inner1 if inner1 >= 0 else next_of(inner2))
    return True


@njit(cache=True, nogil=True)
def collapse_short(
    corner, opposite, feature, leave, kind, points, flat, n_faces, shortest, longest
):
    """Collapse edges shorter than `shortest` where nothing folds, tears or gets longer than `longest`.

    Returns the number of collapses. Features are shortened only along themselves, and a component
    or a hole never vanishes (link condition).
    """
    out_a, out_b = np.empty(_RING, np.int64), np.empty(_RING, np.int64)
    near_a, near_b = np.empty(_RING, np.int64), np.empty(_RING, np.int64)
    limit, bound = shortest * shortest, longest * longest
    done = 0
    for start in range(3 * n_faces):
        if corner[start - start % 3] < 0 or opposite[start] > start:
            continue
        length, wide = _length2(points, corner[start], corner[next_of(start)]), 1.0
        if length < _WIDE * limit and _is_crowded(
            corner, opposite, feature, kind, points, start, bound
        ):
            wide = _WIDE
        if length >= wide * limit:
            continue
        for side in range(2):
            h = start if side == 0 else opposite[start]
            if h >= 0 and _collapse(
                corner, opposite, feature, leave, kind, points, flat, h, wide * bound, _FOLD,
                out_a, out_b, near_a, near_b,
            ):  # fmt: skip
                done += 1
                break
    return done


@njit(cache=True, nogil=True)
def collapse_of(corner, opposite, feature, leave, kind, points, flat, chosen):
    """Collapse the shortest edge that may go of each face of `chosen`, whatever folds; returns how many did."""
    out_a, out_b = np.empty(_RING, np.int64), np.empty(_RING, np.int64)
    near_a, near_b = np.empty(_RING, np.int64), np.empty(_RING, np.int64)
    done = 0
    for f in chosen:
        tried = np.zeros(3, np.uint8)
        for _ in range(3):
            k, least = -1, np.inf
            for i in range(3):
                if corner[3 * f] >= 0 and tried[i] == 0:
                    length = _length2(points, corner[3 * f + i], corner[next_of(3 * f + i)])
                    if length < least:
                        k, least = i, length
            if k < 0:
                break
            tried[k] = 1
            for side in range(2):
                h = 3 * f + k if side == 0 else opposite[3 * f + k]
                if h >= 0 and _collapse(
                    corner, opposite, feature, leave, kind, points, flat, h, np.inf, -2.0,
                    out_a, out_b, near_a, near_b,
                ):  # fmt: skip
                    done += 1
                    tried[:] = 1
                    break
    return done


@njit(cache=True, nogil=True)
def _may_lose(corner, opposite, leave, v):
    """Whether v keeps a proper neighbourhood when one of its edges goes: three faces inside, one on a boundary."""
    if opposite[leave[v]] < 0:
        return True
    h = leave[v]
    n = 0
    while n < 4:
        n += 1
        h = opposite[previous_of(h)]
        if h == leave[v]:
            break
    return n > 3


@njit(cache=True, nogil=True)
def _excess(corner, opposite, n_faces, n_vertices):
    """How many edges more each vertex has than the 6, or 4 on a boundary, of an even mesh."""
    excess = np.full(n_vertices, -6, np.int32)
    for h in range(3 * n_faces):
        if corner[h - h % 3] >= 0:
            excess[corner[h]] += 1
            if opposite[h] < 0:
                # the boundary's other edge at this vertex has no half-edge that leaves it
                excess[corner[h]] += 3
    return excess


@njit(cache=True, nogil=True)
def flip_edges(corner, opposite, feature, leave, points, n_faces, by_degree):
    """Flip edges towards even degrees (`by_degree`) or towards Delaunay triangles; returns the number of flips."""
    done = 0
    excess = _excess(corner, opposite, n_faces, len(leave))
    for h in range(3 * n_faces):
        g = opposite[h]
        if corner[h - h % 3] < 0 or g < h or feature[h]:
            continue
        h1, h2 = next_of(h), previous_of(h)
        g1, g2 = next_of(g), previous_of(g)
        a, b, c, d = corner[h], corner[h1], corner[h2], corner[g2]
        if by_degree:
            before = excess[a] ** 2 + excess[b] ** 2 + excess[c] ** 2 + excess[d] ** 2
            after = (
                (excess[a] - 1) ** 2
                + (excess[b] - 1) ** 2
                + (excess[c] + 1) ** 2
                + (excess[d] + 1) ** 2
            )
            if after >= before:
                continue
        elif _cotangent(points, c, a, b) + _cotangent(points, d, a, b) > -1e-6:
            continue
        if _adjacent(corner, opposite, leave, c, d):
            continue
        ax, ay, az = points[a, 0], points[a, 1], points[a, 2]
        bx, by, bz = points[b, 0], points[b, 1], points[b, 2]
        cx, cy, cz = points[c, 0], points[c, 1], points[c, 2]
        dx, dy, dz = points[d, 0], points[d, 1], points[d, 2]
        px, py, pz = cross(ax, ay, az, bx, by, bz, cx, cy, cz)
        qx, qy, qz = cross(bx, by, bz, ax, ay, az, dx, dy, dz)
        ux, uy, uz = cross(ax, ay, az, dx, dy, dz, cx, cy, cz)
        vx, vy, vz = cross(dx, dy, dz, bx, by, bz, cx, cy, cz)
        sx, sy, sz = px + qx, py + qy, pz + qz
        size = np.sqrt(sx * sx + sy * sy + sz * sz)
        if ux * sx + uy * sy + uz * sz <= 0.3 * size * np.sqrt(
            ux * ux + uy * uy + uz * uz
        ) or vx * sx + vy * sy + vz * sz <= 0.3 * size * np.sqrt(vx * vx + vy * vy + vz * vz):
            continue
        bent = cosine(px, py, pz, qx, qy, qz)
        if bent < _FLAT and cosine(ux, uy, uz, vx, vy, vz) < bent:
            continue
        o_bc, m_bc = opposite[h1], feature[h1]
        o_ca, m_ca = opposite[h2], feature[h2]
        o_ad, m_ad = opposite[g1], feature[g1]
        o_db, m_db = opposite[g2], feature[g2]
        i, j = h - h % 3, g - g % 3
        corner[i], corner[i + 1], corner[i + 2] = a, d, c
        corner[j], corner[j + 1], corner[j + 2] = d, b, c
        _join(opposite, feature, i, o_ad, m_ad)
        _join(opposite, feature, i + 2, o_ca, m_ca)
        _join(opposite, feature, j, o_db, m_db)
        _join(opposite, feature, j + 1, o_bc, m_bc)
        _join(opposite, feature, i + 1, j + 2, 0)
        _settle(opposite, leave, a, i)
        _settle(opposite, leave, b, j + 1)
        _settle(opposite, leave, c, i + 2)
        _settle(opposite, leave, d, j)
        excess[a] -= 1
        excess[b] -= 1
        excess[c] += 1
        excess[d] += 1
        done += 1
    return done


@njit(cache=True, nogil=True, inline="always")
def cosine(px, py, pz, qx, qy, qz):
    """Cosine of the angle between two vectors, 1 if one is zero."""
    size = np.sqrt((px * px + py * py + pz * pz) * (qx * qx + qy * qy + qz * qz))
    return (px * qx + py * qy + pz * qz) / size if size > 0.0 else 1.0


@njit(cache=True, nogil=True)
def _adjacent(corner, opposite, leave, a, b):
    h = leave[a]
    for _ in range(1000):
        if corner[next_of(h)] == b:
            return True
        p = previous_of(h)
        if opposite[p] < 0:
            return corner[p] == b
        h = opposite[p]
        if h == leave[a]:
            return False
    return True


@njit(cache=True, nogil=True)
def _cotangent(points, v, a, b):
    """Cotangent of the angle at v in the triangle v, a, b."""
    ux, uy, uz = (
        points[a, 0] - points[v, 0],
        points[a, 1] - points[v, 1],
        points[a, 2] - points[v, 2],
    )
    wx, wy, wz = (
        points[b, 0] - points[v, 0],
        points[b, 1] - points[v, 1],
        points[b, 2] - points[v, 2],
    )
    cx, cy, cz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    area = np.sqrt(cx * cx + cy * cy + cz * cz)
    return (ux * wx + uy * wy + uz * wz) / max(area, 1e-300)


@njit(cache=True, nogil=True)
def compact(
    corner, opposite, feature, leave, kind, place, along, origin, points, flat,
    n_vertices, n_faces,
):  # fmt: skip
    """Move the living to the front, in order; returns their numbers."""
    renamed = np.empty(n_vertices, np.int64)
    n = 0
    for v in range(n_vertices):
        renamed[v] = n
        if leave[v] >= 0:
            leave[n], kind[n] = leave[v], kind[v]
            place[n], along[n] = place[v], along[v]
            for axis in range(3):
                points[n, axis] = points[v, axis]
                flat[n, axis] = flat[v, axis]
            n += 1
    moved = np.empty(n_faces, np.int64)
    m = 0
    for f in range(n_faces):
        moved[f] = m
        m += corner[3 * f] >= 0
    for f in range(n_faces):
        if corner[3 * f] < 0:
            continue
        origin[moved[f]] = origin[f]
        for k in range(3):
            h, g = 3 * f + k, 3 * moved[f] + k
            corner[g] = renamed[corner[h]]
            feature[g] = feature[h]
            o = opposite[h]
            opposite[g] = 3 * moved[o // 3] + o % 3 if o >= 0 else -1
    for v in range(n):
        leave[v] = 3 * moved[leave[v] // 3] + leave[v] % 3
    return n, m
