"""Flattening the triangles around a vertex into its (s, t) plane, and laying a square of texels over them.

The fan of the centre keeps its edge lengths, its angles are stretched to a full turn; every further vertex is placed by its
distances to the two placed ones of the triangle it is reached through, breadth first. So lengths away
from the centre are kept, and what curvature takes from the rings around it is spread over them.
"""

import math
from collections import namedtuple

import numpy as np

from btfpipe.compiled import njit
from btfpipe.errors import InputError
from btfpipe.sample.orientation import step_to_texels

PATCH = 48  # vertices of a patch that are remembered; a square of 5 x 5 texels has about 29 at one a texel
_PLACED = 4096  # vertices that one patch may place
_FAN = 128  # triangles about one vertex

# What flattening gives for n centres and a square of p texels, row-major as in the sample's picture.
# pixel_vertex (n, p, 3) int32 and pixel_weight (n, p, 3) float32: the triangle over each texel (-1: none).
# patch_vertex (n, PATCH) int32: vertices inside the square widened by half a texel, the centre first, nearest rings first (-1: none).
# patch_step (n, PATCH, 2) float32: change of (row, col) from such a vertex to the centre.
Patches = namedtuple("Patches", "pixel_vertex pixel_weight patch_vertex patch_step")


class Flattener:
    """Flattens patches of one mesh.

    Parameters
    ----------
    level : btfpipe.surface.Level
    texels_per_unit : float
    turn : float
        Angle of the sample's s axis against the frames' s axis, counter-clockwise, radians.

    Raises
    ------
    InputError
        If an edge has more than two faces, or two of one direction.
    """

    def __init__(self, level, texels_per_unit, turn=0.0):
        self.vertices = np.ascontiguousarray(level.vertices, np.float64)
        self.faces = np.ascontiguousarray(level.faces, np.int32)
        self.normals = np.ascontiguousarray(level.normals, np.float32)
        self.tangents = turned(level, turn)
        self.texels_per_unit = float(texels_per_unit)
        self.twin, self.start = _connect(self.faces, len(self.vertices))

    def squares(self, centres, side):
        """Flatten the surroundings of vertices and lay a square of side x side texels on each.

        Parameters
        ----------
        centres : (n,) int32
        side : int
            Odd.

        Returns
        -------
        Patches
        """
        centres = np.ascontiguousarray(centres, np.int32)
        n = len(centres)
        out = Patches(
            np.empty((n, side * side, 3), np.int32),
            np.empty((n, side * side, 3), np.float32),
            np.empty((n, PATCH), np.int32),
            np.empty((n, PATCH, 2), np.float32),
        )
        nowhere = np.zeros((0, 3), np.float32)
        self._run(
            centres, np.zeros(0, np.int32), nowhere, nowhere, nowhere, side, out.pixel_vertex,
            out.pixel_weight, out.patch_vertex, out.patch_step,
        )  # fmt: skip
        return out

    def squares_at(self, face, weights, normals, tangents, side):
        """Squares about places inside triangles, along the frames given for them.

        Parameters
        ----------
        face : (n,) int32
        weights : (n, 3) float32
            Barycentric coordinates of the place.
        normals, tangents : (n, 3) float32
            Frames that the squares are laid along (those of the finer level's vertices), turn included.
        side : int

        Returns
        -------
        pixel_vertex : (n, side * side, 3) int32
        pixel_weight : (n, side * side, 3) float32
        """
        face = np.ascontiguousarray(face, np.int32)
        n = len(face)
        heaviest = np.argmax(weights, axis=1)
        centres = np.ascontiguousarray(self.faces[face, heaviest])
        pixel_vertex = np.empty((n, side * side, 3), np.int32)
        pixel_weight = np.empty((n, side * side, 3), np.float32)
        self._run(
            centres, face, *(np.ascontiguousarray(a, np.float32) for a in (weights, normals, tangents)),
            side, pixel_vertex, pixel_weight, np.empty((0, PATCH), np.int32), np.empty((0, PATCH, 2), np.float32),
        )  # fmt: skip
        return pixel_vertex, pixel_weight

    def _run(self, *job):
        _flatten(
            self.vertices, self.faces, self.normals, self.tangents, self.twin, self.start,
            self.texels_per_unit, *job,
        )  # fmt: skip


def turned(level, turn):
    """The frames' s axes, turned by `turn` radians towards t; (n, 3) float32."""
    if turn == 0:
        return np.ascontiguousarray(level.tangents, np.float32)
    bitangents = np.cross(level.normals, level.tangents)
    return (math.cos(turn) * level.tangents + math.sin(turn) * bitangents).astype(np.float32)


def _connect(faces, n):
    """Twin of every half-edge (-1 at a border), and the half-edge that each vertex's fan starts with.

    Half-edge 3 f + i runs from corner i of face f to the next one. A fan runs counter-clockwise and starts at the border, if
    there is one; -1 for a vertex without faces.
    """
    tail = faces.ravel().astype(np.int64)
    head = np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    key = np.minimum(tail, head) * n + np.maximum(tail, head)
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    if (same[1:] & same[:-1]).any():
        i = order[1 + np.flatnonzero(same[1:] & same[:-1])[0]]
        raise InputError(
            f"edge ({tail[i]}, {head[i]}) is shared by more than two faces; `btfpipe surface` makes a mesh"
            " without such edges."
        )
    first, second = order[:-1][same], order[1:][same]
    if (tail[first] == tail[second]).any():
        i = first[np.flatnonzero(tail[first] == tail[second])[0]]
        raise InputError(
            f"the two faces of edge ({tail[i]}, {head[i]}) are wound in opposite senses; `btfpipe surface`"
            " makes an oriented mesh."
        )
    twin = np.full(len(tail), -1, np.int32)
    twin[first] = second
    twin[second] = first
    start = np.full(n, -1, np.int32)
    start[tail[::-1]] = np.arange(len(tail))[::-1]
    border = np.flatnonzero(twin < 0)
    start[tail[border]] = border
    return twin, start


@njit(cache=True, inline="always")
def _next(h):
    return h - 2 if h % 3 == 2 else h + 1


@njit(cache=True, inline="always")
def _previous(h):
    return h + 2 if h % 3 == 0 else h - 1


@njit(cache=True)
def frame_angle(normal, tangent, other_normal, other_tangent):
    """Angle of the other frame's s axis in this frame, the other normal turned onto this one the short way."""
    nx, ny, nz = normal[0], normal[1], normal[2]
    mx, my, mz = other_normal[0], other_normal[1], other_normal[2]
    ax, ay, az = other_tangent[0], other_tangent[1], other_tangent[2]
    cosine = nx * mx + ny * my + nz * mz
    # Turning m onto n the short way takes a to a - (a.n) (n + m) / (1 + n.m), as a.m = 0.
    share = (ax * nx + ay * ny + az * nz) / max(1.0 + cosine, 1e-3)
    ax -= share * (nx + mx)
    ay -= share * (ny + my)
    az -= share * (nz + mz)
    sx, sy, sz = tangent[0], tangent[1], tangent[2]
    tx, ty, tz = ny * sz - nz * sy, nz * sx - nx * sz, nx * sy - ny * sx
    return math.atan2(ax * tx + ay * ty + az * tz, ax * sx + ay * sy + az * sz)


@njit(cache=True, inline="always")
def _distance(vertices, a, b):
    x = vertices[a, 0] - vertices[b, 0]
    y = vertices[a, 1] - vertices[b, 1]
    z = vertices[a, 2] - vertices[b, 2]
    return math.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True)
def _lay(x, y, a, b, c, va, vb, vc, half, pixel_vertex, pixel_weight):
    """Give the texels of the square that lie in triangle (a, b, c) to it, unless they have one."""
    xa, ya, xb, yb, xc, yc = x[a], y[a], x[b], y[b], x[c], y[c]
    area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
    if area <= 1e-12:
        return
    slack = 1e-6
    left = max(-half, math.ceil(min(xa, xb, xc) - slack))
    right = min(half, math.floor(max(xa, xb, xc) + slack))
    low = max(-half, math.ceil(min(ya, yb, yc) - slack))
    high = min(half, math.floor(max(ya, yb, yc) + slack))
    for t in range(low, high + 1):
        for s in range(left, right + 1):
            # Row runs against t (see sample.orientation): the texel at step (s, t) is (-t, s).
            pixel = (half - t) * (2 * half + 1) + half + s
            if pixel_vertex[pixel, 0] >= 0:
                continue
            wb = ((s - xa) * (yc - ya) - (xc - xa) * (t - ya)) / area
            wc = ((xb - xa) * (t - ya) - (s - xa) * (yb - ya)) / area
            wa = 1.0 - wb - wc
            if min(wa, wb, wc) < -slack:
                continue
            wb = max(wb, 0.0)
            wc = min(max(wc, 0.0), 1.0 - wb)
            pixel_vertex[pixel, 0] = va
            pixel_vertex[pixel, 1] = vb
            pixel_vertex[pixel, 2] = vc
            pixel_weight[pixel, 0] = 1.0 - wb - wc
            pixel_weight[pixel, 1] = wb
            pixel_weight[pixel, 2] = wc


@njit(cache=True, nogil=True)
def _fan(vertices, faces, normals, tangents, twin, first, v, scale, placed, x, y, ring):
    """Place the fan of v about the origin; the half-edges out of v go to `ring`.

    Returns the number of placed vertices, of triangles.
    """
    count = 0
    turn = 0.0
    x[0] = 0.0
    y[0] = 0.0
    placed[0] = v
    h = first
    closed = False
    while h >= 0 and count < ring.shape[0] - 1:
        ring[count] = h
        a = faces.ravel()[_next(h)]
        b = faces.ravel()[_previous(h)]
        la, lb, lab = (
            _distance(vertices, v, a),
            _distance(vertices, v, b),
            _distance(vertices, a, b),
        )
        cosine = (la * la + lb * lb - lab * lab) / max(2.0 * la * lb, 1e-300)
        placed[1 + count] = a
        x[1 + count] = la * scale
        y[1 + count] = turn
        turn += math.acos(min(1.0, max(-1.0, cosine)))
        count += 1
        h = twin[_previous(h)]
        if h == first:
            closed = True
            break
    total = 1 + count
    if not closed and count > 0:
        b = faces.ravel()[_previous(ring[count - 1])]
        placed[total] = b
        x[total] = _distance(vertices, v, b) * scale
        y[total] = turn
        total += 1
    stretch = 2.0 * math.pi / turn if closed and turn > 0.0 else 1.0
    # The turn that brings the fan's angles to those of its edges in the frame, on average.
    nx, ny, nz = normals[v, 0], normals[v, 1], normals[v, 2]
    sx, sy, sz = tangents[v, 0], tangents[v, 1], tangents[v, 2]
    tx, ty, tz = ny * sz - nz * sy, nz * sx - nx * sz, nx * sy - ny * sx
    along = 0.0
    across = 0.0
    for i in range(1, total):
        u = placed[i]
        ex = vertices[u, 0] - vertices[v, 0]
        ey = vertices[u, 1] - vertices[v, 1]
        ez = vertices[u, 2] - vertices[v, 2]
        seen = math.atan2(ex * tx + ey * ty + ez * tz, ex * sx + ey * sy + ez * sz)
        along += math.cos(seen - stretch * y[i])
        across += math.sin(seen - stretch * y[i])
    offset = math.atan2(across, along)
    for i in range(1, total):
        angle = stretch * y[i] + offset
        radius = x[i]
        x[i] = radius * math.cos(angle)
        y[i] = radius * math.sin(angle)
    return total, count


@njit(cache=True, nogil=True)
def _flatten(
    vertices, faces, normals, tangents, twin, start, scale, centres, place_face, place_weight,
    place_normal, place_tangent, side, pixel_vertex, pixel_weight, patch_vertex, patch_step,
):  # fmt: skip
    """See `Flattener.squares` and `Flattener.squares_at` (with `place_face`)."""
    half = side // 2
    reach = half + 0.5
    corner = faces.ravel()
    slot = np.full(vertices.shape[0], -1, np.int32)  # place in `placed`, while a patch is built
    seen = np.full(faces.shape[0], -1, np.int32)  # the last patch that laid this face
    placed = np.empty(_PLACED, np.int32)
    x = np.empty(_PLACED)
    y = np.empty(_PLACED)
    ring = np.empty(_FAN, np.int32)
    queue = np.empty(4 * _PLACED, np.int32)
    for i in range(centres.shape[0]):
        v = centres[i]
        pixel_vertex[i] = -1
        pixel_weight[i] = 0.0
        total, count = _fan(
            vertices, faces, normals, tangents, twin, start[v], v, scale, placed, x, y, ring
        )
        for j in range(total):
            slot[placed[j]] = j
        if place_face.shape[0] > 0:
            # Move the plane so that the place is the origin and its frame the axes.
            px = 0.0
            py = 0.0
            for j in range(3):
                k = slot[faces[place_face[i], j]]
                px += place_weight[i, j] * x[k]
                py += place_weight[i, j] * y[k]
            angle = frame_angle(normals[v], tangents[v], place_normal[i], place_tangent[i])
            cosine = math.cos(angle)
            sine = math.sin(angle)
            for j in range(total):
                dx = x[j] - px
                dy = y[j] - py
                x[j] = dx * cosine + dy * sine
                y[j] = dy * cosine - dx * sine
        head = 0
        tail = 0
        for j in range(count):
            h = ring[j]
            a, b = corner[_next(h)], corner[_previous(h)]
            seen[h // 3] = i
            _lay(x, y, 0, slot[a], slot[b], v, a, b, half, pixel_vertex[i], pixel_weight[i])
            queue[tail] = _next(h)
            tail += 1
        while head < tail:
            h = queue[head]
            head += 1
            g = twin[h]
            if g < 0 or seen[g // 3] == i:
                continue
            vb, va, vc = corner[g], corner[_next(g)], corner[_previous(g)]
            a, b = slot[va], slot[vb]
            if (
                min(x[a], x[b]) > reach or max(x[a], x[b]) < -reach
                or min(y[a], y[b]) > reach or max(y[a], y[b]) < -reach
            ):  # fmt: skip
                continue
            seen[g // 3] = i
            if slot[vc] < 0:
                if total == _PLACED:
                    continue
                ex, ey = x[a] - x[b], y[a] - y[b]
                base = math.sqrt(ex * ex + ey * ey)
                bc = _distance(vertices, vb, vc) * scale
                ac = _distance(vertices, va, vc) * scale
                if base < 1e-12:
                    continue
                along = (base * base + bc * bc - ac * ac) / (2.0 * base)
                # Where curvature stretched the base beyond both sides, keep a sliver's height.
                height = math.sqrt(max(bc * bc - along * along, 1e-4 * bc * bc))
                ex /= base
                ey /= base
                x[total] = x[b] + along * ex - height * ey
                y[total] = y[b] + along * ey + height * ex
                placed[total] = vc
                slot[vc] = total
                total += 1
            _lay(x, y, b, a, slot[vc], vb, va, vc, half, pixel_vertex[i], pixel_weight[i])
            if tail + 2 <= queue.shape[0]:
                queue[tail] = _next(g)
                queue[tail + 1] = _previous(g)
                tail += 2
        if patch_vertex.shape[0] > 0:
            n = 0
            for j in range(total):
                if n == PATCH:
                    break
                if abs(x[j]) <= reach and abs(y[j]) <= reach:
                    u = placed[j]
                    # Half-way between the two frames: a run through a turning field stays as it is, to second order,
                    # whichever of its vertices it is continued from.
                    angle = 0.5 * frame_angle(normals[v], tangents[v], normals[u], tangents[u])
                    cosine = math.cos(angle)
                    sine = math.sin(angle)
                    ds = -(x[j] * cosine + y[j] * sine)
                    dt = -(y[j] * cosine - x[j] * sine)
                    drow, dcol = step_to_texels(ds, dt, 0.0)
                    patch_vertex[i, n] = u
                    patch_step[i, n, 0] = drow
                    patch_step[i, n, 1] = dcol
                    n += 1
            for j in range(n, PATCH):
                patch_vertex[i, j] = -1
                patch_step[i, j] = 0.0
        for j in range(total):
            slot[placed[j]] = -1
