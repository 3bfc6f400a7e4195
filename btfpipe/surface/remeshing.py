"""Even resampling of a mesh to a wanted number of vertices.

Isotropic remeshing after Botsch and Kobbelt 2004 (section 4): long edges are split, short ones collapsed, edges
flipped, and vertices moved to the middle of their neighbours within the surface, then brought back to the input.
Split, collapse and flip are the only changes of connectivity, so components, boundaries and genus stay.
"""

from dataclasses import dataclass

import numpy as np

from btfpipe.errors import InputError
from btfpipe.surface import _edges, _moves
from btfpipe.surface.deviation import Deviation, closest, measure, points_between
from btfpipe.surface.feature_lines import feature_lines
from btfpipe.surface.projection import walk_faces, walk_lines
from btfpipe.surface.topology import (
    edge_normals_angle,
    face_normals,
    half_edges,
    mean_edge,
    mesh_area,
)

_TOO_LONG, _TOO_SHORT = 4 / 3, 4 / 5
_MORE_ROUNDS = 12
_HELD, _LEFT = 0.3, 0.4  # spacings that a point of the input may lie off, on the way and in the end
_MOST_MENDS = 8
_MOST_REVERTS = 3
_BENT_DEG = 20  # of edges along which points are held
_MOST_GROWTH = 16  # times the vertices wanted and given; sound meshes stay below twice


class _Mesh:
    """The tables that the compiled edits work on, with room to grow."""

    def __init__(self, source, lines):
        self.source, self.lines = source, lines
        n, m = len(source.vertices), len(source.faces)
        self.n_vertices, self.n_faces = n, m
        start, _ = half_edges(source.faces)
        half = np.arange(3 * m)
        rim = source.opposite < 0
        leave, place = np.empty(n, np.int32), np.empty(n, np.int32)
        leave[start] = half
        leave[start[rim]] = half[rim]
        place[start] = half // 3
        along = np.full(n, -1, np.int32)
        along[lines.ends.ravel()] = np.arange(len(lines.ends)).repeat(2)
        self.corner = source.faces.ravel().astype(np.int32)
        self.opposite, self.feature = source.opposite.copy(), np.zeros(3 * m, np.int32)
        self._mark(lines.half, 1 + np.arange(len(lines.half)))
        self.across = np.where(self.feature > 0, -1, source.opposite).astype(np.int32)
        self.origin = np.arange(m, dtype=np.int32)
        self.leave, self.kind, self.place, self.along = leave, lines.kind.copy(), place, along
        self.points, self.flat = source.vertices.copy(), source.vertices.copy()
        self.most = np.inf
        self.normals = face_normals(source.vertices, source.faces)

    def _mark(self, half, numbers):
        """Set the numbers of feature edges, on both sides of each."""
        self.feature[half] = numbers
        other = self.opposite[half]
        self.feature[other[other >= 0]] = numbers[other >= 0]

    def cut(self, target):
        """Cut the faces of the input down to edges of about `target`, without leaving the faces.

        From the longest edges down, so that faces stay in shape. All edges of the input count as features on the way: what flips lies within a face, and a long thin face is cut along
        its long edges only.
        """
        n = self.n_vertices
        start, end = half_edges(self.faces())
        longest = np.linalg.norm(self.points[start] - self.points[end], axis=1).max()
        halvings = int(np.ceil(np.log2(longest / target)))
        if halvings <= 0:
            return
        once = np.flatnonzero(np.arange(len(self.opposite)) > self.opposite)
        number = np.zeros(1 + len(once), np.int32)  # of the feature lines among all edges
        number[1:] = self.feature[once]
        self._mark(once, 1 + np.arange(len(once), dtype=np.int32))
        for i in range(halvings, -1, -1):
            self.split(_TOO_LONG * target * 2.0**i, _TOO_SHORT * target)
            self.flip(False)
        made = slice(n, self.n_vertices)
        line = number[1 + self.along[made]]
        self.kind[made], self.along[made] = line > 0, line - 1
        self.feature[: 3 * self.n_faces] = number[self.feature[: 3 * self.n_faces]]

    def _grow(self):
        if len(self.points) > self.most:
            raise InputError(
                f"edges are split without end (over {self.most} vertices): a corner sticks out far beyond its surroundings."
                " Try without smoothing (--no-smooth)."
            )
        for name in (
            "corner", "opposite", "feature", "origin", "leave", "kind", "place", "along", "points", "flat",
        ):  # fmt: skip
            array = getattr(self, name)
            setattr(self, name, np.concatenate([array, np.zeros_like(array)]))

    def _tables(self):
        return self.corner, self.opposite, self.feature, self.leave

    def split(self, longest, thin=0.0):
        done = False
        while not done:
            self.n_vertices, self.n_faces, done = _edges.split_long(
                *self._tables(), self.kind, self.place, self.along, self.origin,
                self.points, self.flat, self.n_vertices, self.n_faces, longest, thin,
            )  # fmt: skip
            if not done:
                self._grow()

    def collapse(self, shortest, longest):
        _edges.collapse_short(
            *self._tables(), self.kind, self.points, self.flat, self.n_faces, shortest, longest
        )
        self._compact()

    def collapse_of(self, faces):
        _edges.collapse_of(*self._tables(), self.kind, self.points, self.flat, faces)
        self._compact()

    def _compact(self):
        self.n_vertices, self.n_faces = _edges.compact(
            *self._tables(), self.kind, self.place, self.along, self.origin, self.points, self.flat,
            self.n_vertices, self.n_faces,
        )  # fmt: skip

    def pin(self, face, point, place):
        """Pin the nearest free corner of a face to a point of the input, or a new vertex if all are bound."""
        corners = self.corner[3 * face : 3 * face + 3]
        free = corners[self.kind[corners] == 0]
        if len(free):
            v = free[np.linalg.norm(self.flat[free] - point, axis=1).argmin()]
        else:
            if self.n_vertices + 1 > len(self.points) or 3 * (self.n_faces + 2) > len(self.corner):
                self._grow()
            v = self.n_vertices
            self.n_vertices += 1
            self.n_faces = _edges.insert_vertex(*self._tables(), self.origin, face, v, self.n_faces)
            self.along[v] = -1
        self.flat[v] = self.points[v] = point
        self.kind[v], self.place[v] = 2, place

    def flip(self, by_degree):
        return _edges.flip_edges(*self._tables(), self.points, self.n_faces, by_degree)

    def smooth(self, reach):
        """Move vertices within the surface; returns the face and weights of each on the input."""
        step = np.zeros((self.n_vertices, 3))
        _moves.relax(*self._tables(), self.kind, self.points, self.n_vertices, step)
        return self.settle(step, reach)

    def settle(self, step, reach):
        """Bring flat positions plus `step` back to the input and lift them onto the smooth surface.

        A vertex that would jump, or turn a face over, stays where it was. Returns the face and weights of each.
        """
        n = self.n_vertices
        wanted = self.flat[:n] + step
        place, along, weights, nearest, blocked = self._project(
            wanted, self.kind[:n], self.place[:n], self.along[:n]
        )
        blocked[self.kind[:n] > 0] = 0
        stay = np.flatnonzero((np.linalg.norm(nearest - wanted, axis=1) > reach) | (blocked > 0))
        for _ in range(_MOST_REVERTS):
            if len(stay):
                place[stay], along[stay], weights[stay], nearest[stay], _ = self._project(
                    self.flat[stay], self.kind[stay], self.place[stay], self.along[stay]
                )
            keep = np.zeros(n, np.uint8)
            if not _moves.folded(
                self.corner, self.n_faces, self.flat, self.place, nearest, place, self.normals, keep
            ):
                break
            stay = np.flatnonzero(keep)
        self.place[:n], self.along[:n], self.flat[:n] = place, along, nearest
        self.points[:n] = self.source.lift(place, weights)
        _moves.name_origins(self.corner, self.n_faces, self.kind, self.place, self.origin)
        return place, weights

    def _project(self, wanted, kind, place, along):
        """Places, feature edges, weights and positions of the closest points of the input, near known ones."""
        source, lines = self.source, self.lines
        place, along = place.copy(), along.copy()
        weights, nearest = np.empty((len(wanted), 3)), np.empty((len(wanted), 3))
        blocked = np.zeros(len(wanted), np.uint8)
        walk_faces(
            source.vertices, source.faces, self.across, wanted, place, weights, nearest, blocked
        )
        bound = np.flatnonzero(kind == 1)
        if len(bound):
            edge, part, x = along[bound], np.empty(len(bound)), np.empty((len(bound), 3))
            walk_lines(source.vertices, lines.ends, lines.after, wanted[bound], edge, part, x)
            half, rows = lines.half[edge], np.arange(len(bound))
            w = np.zeros((len(bound), 3))
            w[rows, half % 3], w[rows, (half + 1) % 3] = 1 - part, part
            along[bound], place[bound], weights[bound], nearest[bound] = edge, half // 3, w, x
        return place, along, weights, nearest, blocked

    def faces(self):
        return self.corner[: 3 * self.n_faces].reshape(-1, 3)


@dataclass
class Resampling:
    """A resampled surface, as places on its input.

    Attributes
    ----------
    faces : (m, 3) int32
    place_face : (n,) int32
        Face of the input that holds each vertex.
    place_weights : (n, 3) float64
        Barycentric coordinates there. `SmoothInput.lift`, `flat` and `normals` give positions and normals.
    spacing : float
        Mean length of the edges on the flat faces of the input.
    deviation : Deviation
        Of the flat result from the input.
    """

    faces: np.ndarray
    place_face: np.ndarray
    place_weights: np.ndarray
    spacing: float
    deviation: Deviation

    def __iter__(self):
        """Faces, faces of the input and weights, to be unpacked."""
        return iter((self.faces, self.place_face, self.place_weights))


def resample(source, n_vertices, report=lambda done, total: None, polish=5, settle=6):
    """Resample a smooth input to about `n_vertices` evenly spaced vertices.

    Parameters
    ----------
    source : SmoothInput
    n_vertices : int
        Wanted number; met within 5 % unless the components and features need more.
    report : callable
        Called with (rounds done, rounds in all).

    Returns
    -------
    Resampling

    Raises
    ------
    InputError
        If splitting edges does not shorten them.
    """
    # an even mesh has 2 faces a vertex, each of area sqrt(3)/4 times the squared edge
    target = np.sqrt(mesh_area(source.vertices, source.faces) / n_vertices * 2 / np.sqrt(3))
    lines = feature_lines(source.vertices, source.faces, source.opposite, source.crease, target)
    mesh = _Mesh(source, lines)
    mesh.cut(target)
    mesh.most = _MOST_GROWTH * (n_vertices + mesh.n_vertices)
    held = _Held(source, lines, target)
    rounds = polish + settle
    for i in range(polish + _MORE_ROUNDS):
        _round(mesh, target)
        if i % 2:
            held.pin(mesh, _HELD * target, target)
        off = mesh.n_vertices / n_vertices
        if i + 1 >= polish and abs(off - 1) < 0.02:
            break
        # aim at the wanted number; edges between too short and too long stay, so aim beyond at first
        target *= np.clip(off, 0.8, 1.25) if i < polish else np.clip(off, 0.9, 1.1) ** 0.5
        report(min(i, polish), rounds)
    for i in range(settle):
        face, weights = mesh.smooth(0.5 * target)
        mesh.flip(i < settle // 2)
        report(polish + i, rounds)
    best = None
    for i in range(_MOST_MENDS + 1):
        flat, faces = mesh.flat[: mesh.n_vertices], mesh.faces()
        spacing = mean_edge(flat, faces)
        deviation = measure(flat, faces, source.vertices, source.faces, spacing)
        off = deviation.distances / spacing
        if best is None or off.max() < best[0]:
            points = mesh.points[: mesh.n_vertices]
            made = Resampling(*_in_order(faces, points, face, weights), spacing, deviation)
            best = off.max(), made
        if i == _MOST_MENDS or off.max() <= _LEFT:
            return best[1]
        _mend(mesh, deviation, spacing)
        for _ in range(2):
            face, weights = mesh.smooth(0.5 * target)
            mesh.flip(False)


def _mend(mesh, deviation, spacing):
    """Pin vertices to what the mesh lost of the input; where it leaves the input, it is folded, and the fold goes."""
    lost = np.flatnonzero(deviation.distances > _LEFT * spacing)
    lost = lost[np.argsort(-deviation.distances[lost], kind="stable")]
    ours = lost >= len(deviation.from_input)
    theirs = lost[~ours]
    _pin(mesh, deviation.points[theirs], deviation.place[theirs], deviation.face[theirs], spacing)
    mesh.collapse_of(np.unique(deviation.face[lost[ours]]))


def _pin(mesh, points, place, face, spacing):
    """Pin vertices to points of the input, of points closer to each other than 0.7 spacings to the first.

    Parameters
    ----------
    mesh : _Mesh
    points : (k, 3) float64
    place : (k,) int
        The face of the input that holds each.
    face : (k,) int
        The face of the mesh that is closest to each.
    spacing : float
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    taken = np.zeros(len(points), bool)
    for i in range(len(points)):
        if not taken[i]:
            taken[tree.query_ball_point(points[i], 0.7 * spacing)] = True
            mesh.pin(face[i], points[i], place[i])


class _Held:
    """Points of the input that a resampling must not lose: its vertices, and places on sharp edges that are no lines."""

    def __init__(self, source, lines, spacing):
        start, end = half_edges(source.faces)
        angle = edge_normals_angle(source.vertices, source.faces, source.opposite)
        angle[lines.half] = 0
        sharp = np.flatnonzero(
            (np.arange(len(start)) > source.opposite) & (angle > np.deg2rad(_BENT_DEG))
        )
        along, edge = points_between(
            source.vertices[start[sharp]], source.vertices[end[sharp]], spacing / 2
        )
        face = np.empty(len(source.vertices), np.int64)
        face[start] = np.arange(len(start)) // 3
        self.points = np.concatenate([source.vertices, along])
        self.face = np.concatenate([face, sharp[edge] // 3])

    def pin(self, mesh, bound, spacing):
        """Pin a vertex to each held point that lies farther from the mesh than `bound`."""
        distance, face, _ = closest(self.points, mesh.flat[: mesh.n_vertices], mesh.faces())
        lost = np.flatnonzero(distance > bound)
        lost = lost[np.argsort(-distance[lost], kind="stable")]
        _pin(mesh, self.points[lost], self.face[lost], face[lost], spacing)


def _round(mesh, length):
    mesh.split(_TOO_LONG * length)
    mesh.collapse(_TOO_SHORT * length, _TOO_LONG * length)
    mesh.flip(True)
    mesh.smooth(0.5 * length)
    mesh.flip(False)


def _in_order(faces, points, face, weights):
    """Vertices along a Morton curve, faces by their first vertex: neighbours in space are near in memory."""
    span = max(np.ptp(points, axis=0).max(), 1e-300)
    grid = np.minimum((points - points.min(axis=0)) / span * 2**20, 2**20 - 1).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for bit in range(20):
        for axis in range(3):
            code |= ((grid[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    order = np.argsort(code, kind="stable")
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    faces = rank[faces]
    faces = faces[np.lexsort((faces.max(axis=1), faces.min(axis=1)))]
    return np.ascontiguousarray(faces), face[order], weights[order]
