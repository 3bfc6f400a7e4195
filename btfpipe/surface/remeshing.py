"""Even resampling of a mesh to a wanted number of vertices.

Isotropic remeshing after Botsch and Kobbelt 2004 (section 4): long edges are split, short ones collapsed, edges
flipped, and vertices moved to the middle of their neighbours within the surface, then brought back to the input.
Split, collapse and flip are the only changes of connectivity, so components, boundaries and genus stay.
"""

import numpy as np

from btfpipe.errors import InputError
from btfpipe.surface import _edges
from btfpipe.surface.topology import edge_keys, half_edges, opposite_half_edges

_TOO_LONG, _TOO_SHORT = 4 / 3, 4 / 5
_MORE_ROUNDS = 6
_MOST_GROWTH = 16  # times the vertices wanted and given; sound meshes stay below twice


class _Mesh:
    """The tables that the compiled edits work on, with room to grow."""

    def __init__(self, source, most):
        self.most = most
        n, m = len(source.vertices), len(source.faces)
        self.n_vertices, self.n_faces = n, m
        opposite = opposite_half_edges(source.faces)
        feature = np.isin(edge_keys(source.faces), _keys(source.features, source.faces))
        start, _ = half_edges(source.faces)
        leave = np.empty(n, np.int32)
        half = np.arange(3 * m)
        leave[start] = half
        rim = opposite < 0
        leave[start[rim]] = half[rim]
        self.corner = source.faces.ravel().astype(np.int32)
        self.opposite = opposite
        self.feature = (feature | rim).astype(np.uint8)
        self.leave, self.kind = leave, source.kind.copy()
        self.points, self.flat = source.vertices.copy(), source.vertices.copy()

    def _grow(self):
        if len(self.points) > self.most:
            raise InputError(
                f"edges are split without end (over {self.most} vertices): a corner sticks out far beyond its surroundings."
                " Mend the mesh, or try without smoothing."
            )
        for name in ("corner", "opposite", "feature", "leave", "kind", "points", "flat"):
            array = getattr(self, name)
            setattr(self, name, np.concatenate([array, np.zeros_like(array)]))

    def _tables(self):
        return self.corner, self.opposite, self.feature, self.leave

    def split(self, longest):
        done = False
        while not done:
            self.n_vertices, self.n_faces, done = _edges.split_long(
                *self._tables(), self.kind, self.points, self.flat,
                self.n_vertices, self.n_faces, longest,
            )  # fmt: skip
            if not done:
                self._grow()

    def collapse(self, shortest, longest):
        count = _edges.collapse_short(
            *self._tables(), self.kind, self.points, self.flat, self.n_faces, shortest, longest
        )
        self.n_vertices, self.n_faces = _edges.compact(
            *self._tables(), self.kind, self.points, self.flat, self.n_vertices, self.n_faces
        )
        return count

    def flip(self, by_degree):
        return _edges.flip_edges(*self._tables(), self.points, self.n_faces, by_degree)

    def smooth(self, source, reach):
        """Move vertices within the surface; returns the face and weights of each on the input."""
        n = self.n_vertices
        step = np.zeros((n, 3))
        _edges.relax(*self._tables(), self.kind, self.points, n, step)
        return self.place(source, step, reach)

    def place(self, source, step, reach):
        """Bring flat positions plus `step` back to the input and lift them onto the smooth surface.

        A vertex that would jump (to the other side of a thin wall) stays where it was.
        """
        n = self.n_vertices
        wanted = self.flat[:n] + step
        face, weights, nearest = source.closest(wanted)
        bound = np.flatnonzero(self.kind[:n] > 0)
        if len(bound):
            on = source.closest_on_features(wanted[bound])
            face[bound], weights[bound], nearest[bound] = on
        jump = np.linalg.norm(nearest - wanted, axis=1) > reach
        if jump.any() and step.any():
            back = np.flatnonzero(jump & (self.kind[:n] == 0))
            if len(back):
                face[back], weights[back], nearest[back] = source.closest(self.flat[back])
        self.flat[:n] = nearest
        self.points[:n] = source.lift(face, weights)
        return face, weights


def _keys(pairs, faces):
    base = int(faces.max(initial=0)) + 1
    return pairs.min(axis=1) * base + pairs.max(axis=1)


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
    faces : (m, 3) int32
    place_face : (n,) int64
        Face of the input that holds each vertex.
    place_weights : (n, 3) float64
        Barycentric coordinates there. `source.lift` and `source.normals` give position and normal.

    Raises
    ------
    InputError
        If splitting edges does not shorten them.
    """
    mesh = _Mesh(source, _MOST_GROWTH * (n_vertices + len(source.vertices)))
    area = (
        0.5
        * np.linalg.norm(
            np.cross(
                source.vertices[source.faces[:, 1]] - source.vertices[source.faces[:, 0]],
                source.vertices[source.faces[:, 2]] - source.vertices[source.faces[:, 0]],
            ),
            axis=1,
        ).sum()
    )
    # an even mesh has 2 faces a vertex, each of area sqrt(3)/4 times the squared edge
    target = np.sqrt(area / n_vertices * 2 / np.sqrt(3))
    mesh.place(source, np.zeros((mesh.n_vertices, 3)), np.inf)
    start, end = half_edges(source.faces)
    longest = np.linalg.norm(source.vertices[end] - source.vertices[start], axis=1).max()
    halvings = max(0, int(np.ceil(np.log2(longest / (2 * target)))))
    rounds = halvings + polish + settle
    for i in range(halvings):
        _round(mesh, source, target * 2.0 ** (halvings - i))
        report(i, rounds)
    for i in range(polish + _MORE_ROUNDS):
        _round(mesh, source, target)
        off = mesh.n_vertices / n_vertices
        if i + 1 >= polish and abs(off - 1) < 0.02:
            break
        # aim at the wanted number; edges between too short and too long stay, so aim beyond
        target *= np.clip(off, 0.8, 1.25)
        report(halvings + min(i, polish), rounds)
    for i in range(settle):
        face, weights = mesh.smooth(source, 0.5 * target)
        mesh.flip(i < settle // 2)
        report(halvings + polish + i, rounds)
    n, m = mesh.n_vertices, mesh.n_faces
    return _in_order(mesh.corner[: 3 * m].reshape(m, 3), mesh.points[:n], face, weights)


def _round(mesh, source, length):
    mesh.split(_TOO_LONG * length)
    mesh.collapse(_TOO_SHORT * length, _TOO_LONG * length)
    mesh.flip(True)
    mesh.smooth(source, 0.5 * length)
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
