"""The input mesh as a smooth surface: interpolated normals and Phong tessellation."""

from dataclasses import dataclass

import numpy as np

from btfpipe.surface.topology import edge_normals_angle, half_edges, opposite_half_edges

# Corners with the normals of a quadric give this quadric, and no other strength does. The paper takes 3/4 by looks.
PHONG_ALPHA, _PAPER_ALPHA = 0.5, 0.75
# angles between faces up to which their vertices are rounded off in full, and from which on not at all
_ROUND_DEG, _FLAT_DEG = 45, 75
# likewise for moves that make triangles agree with normals
_AGREE_DEG, _CORNER_DEG = 75, 90


@dataclass
class SmoothInput:
    """A cleaned input mesh that gives a smooth position and a normal for each place on its faces.

    Attributes
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int32
    corner_normals : (m, 3, 3) float64
        Unit normals per face corner: the angle-weighted mean over the faces around the vertex that are
        not cut off by creases.
    opposite : (3 m,) int32
        See `topology.opposite_half_edges`.
    crease : (3 m,) bool
        Half-edges across which normals are not averaged.
    sharpest : (n,) float64
        Largest angle between faces that meet at an edge of each vertex, degrees; 180 at creases. Sharp ones are
        corners rather than coarse pieces of something round, where the smooth surface stays on the faces.
    alpha : float
        Strength of the Phong tessellation, 0 for the flat faces.
    """

    vertices: np.ndarray
    faces: np.ndarray
    corner_normals: np.ndarray
    opposite: np.ndarray
    crease: np.ndarray
    sharpest: np.ndarray
    alpha: float

    def flat(self, face, weights):
        """Positions on the faces themselves, (k, 3) float64."""
        return np.einsum("kc,kcx->kx", weights, self.vertices[self.faces[face]])

    def lift(self, face, weights):
        """Positions on the smooth surface, (k, 3) float64 (Boubekeur and Alexa 2008, eq. 3).

        The point is pulled towards the mean of its projections onto the tangent planes of its face's
        corners. Unlike there corners on creases, where the two sides would part, and on sharp edges do not pull.
        """
        flat = self.flat(face, weights)
        if self.alpha == 0:
            return flat
        corners = self.vertices[self.faces[face]]
        normals = self.corner_normals[face]
        above = np.einsum("kcx,kcx->kc", flat[:, None] - corners, normals)
        eased = weights * _falling(self.sharpest, _ROUND_DEG, _FLAT_DEG)[self.faces[face]]
        return flat - self.alpha * np.einsum("kc,kc,kcx->kx", eased, above, normals)

    def largest_move(self):
        """How far the Phong tessellation of the paper's strength takes points off their faces at most, a float.

        Read at the middles of faces and of their edges.
        """
        face = np.arange(len(self.faces))
        most = 0.0
        for weights in ((1, 1, 1), (1, 1, 0), (0, 1, 1), (1, 0, 1)):
            w = np.tile(np.array(weights) / sum(weights), (len(face), 1))
            move = self.lift(face, w) - self.flat(face, w)
            most = max(most, np.linalg.norm(move, axis=1).max())
        return most * _PAPER_ALPHA / self.alpha

    def agreeing(self, face, weights):
        """Share of the move that makes triangles agree with normals, (k,) float64: normals of corners mean no shape."""
        share = _falling(self.sharpest, _AGREE_DEG, _CORNER_DEG)
        return np.einsum("kc,kc->k", weights, share[self.faces[face]])

    def widths(self, face, weights):
        """Widths of the faces around points, (k,) float64: heights over their longest edges, evened over neighbours."""
        corners = self.vertices[self.faces]
        edges = np.roll(corners, -1, axis=1) - corners
        area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        longest = np.sqrt((edges**2).sum(axis=2).max(axis=1))
        width = np.repeat(area / np.maximum(longest, 1e-300), 3)
        corner = self.faces.ravel()
        count = np.maximum(np.bincount(corner, minlength=len(self.vertices)), 1)
        around = np.bincount(corner, width, len(self.vertices)) / count
        return np.einsum("kc,kc->k", weights, around[self.faces[face]])

    def normals(self, face, weights):
        """Unit shading normals, (k, 3) float64, between those of the corners.

        Linear interpolation irons waves out: the ends of an edge on a slope between a valley and a hill have normals
        that look the same way, straight up. So the mean normal of two corners is turned until it is orthogonal to
        their edge, and normals between are quadratic, for the same purpose as those of PN triangles (Vlachos, Peters,
        Boyd and Mitchell 2001). Corners that `lift` leaves alone keep to linear ones.
        """
        corners = self.vertices[self.faces[face]]
        own = self.corner_normals[face]
        rounded = _falling(self.sharpest, _ROUND_DEG, _FLAT_DEG)[self.faces[face]]
        normals = np.einsum("kc,kcx->kx", weights, own)
        if self.alpha > 0:
            for i, j in ((0, 1), (1, 2), (2, 0)):
                along = corners[:, j] - corners[:, i]
                mean = (own[:, i] + own[:, j]) / 2
                square = np.maximum(_dot(along, along), 1e-300)
                share = 4 * weights[:, i] * weights[:, j] * np.minimum(rounded[:, i], rounded[:, j])
                normals = normals - (share * _dot(mean, along) / square)[:, None] * along
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        flat = self.corner_normals[face, 0]
        return np.where(length > 1e-6, normals / np.maximum(length, 1e-6), flat)


def _falling(angle, full, none):
    """1 up to `full` degrees, 0 from `none` on, and even between."""
    return np.clip((none - angle) / (none - full), 0, 1)


def barycentric(points, corners):
    """Barycentric coordinates, (k, 3) float64 in [0, 1], of points (k, 3) in triangles (k, 3, 3).

    Points beside the triangle are brought to its border; a triangle without area gives the place on its longest edge.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    u, w, p = b - a, c - a, points - a
    uu, uw, ww = _dot(u, u), _dot(u, w), _dot(w, w)
    pu, pw = _dot(p, u), _dot(p, w)
    det = uu * ww - uw * uw
    thin = det <= 1e-14 * np.maximum(uu, ww) ** 2
    det = np.where(thin, 1.0, det)
    wb = (ww * pu - uw * pw) / det
    wc = (uu * pw - uw * pu) / det
    weights = np.stack([1 - wb - wc, wb, wc], axis=1)
    if thin.any():
        weights[thin] = _on_longest_edge(points[thin], corners[thin])
    weights = np.clip(weights, 0, 1)
    return weights / weights.sum(axis=1, keepdims=True)


def _on_longest_edge(points, corners):
    rows = np.arange(len(points))
    edges = np.roll(corners, -1, axis=1) - corners
    k = (edges**2).sum(2).argmax(1)
    edge, start = edges[rows, k], corners[rows, k]
    share = _dot(points - start, edge) / np.maximum(_dot(edge, edge), 1e-300)
    weights = np.zeros((len(points), 3))
    weights[rows, k] = 1 - share
    weights[rows, (k + 1) % 3] = share
    return weights


def _dot(a, b):
    return np.einsum("kx,kx->k", a, b)


def smooth_input(vertices, faces, crease_deg=None, alpha=PHONG_ALPHA):
    """Prepare a cleaned mesh as a smooth surface.

    Parameters
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int32
        A consistently oriented manifold.
    crease_deg : float, optional
        Edges whose faces' normals differ by more are creases: normals are not averaged across
        them. None smooths every edge.
    alpha : float
        Strength of the Phong tessellation.
    """
    opposite = opposite_half_edges(faces)
    angle = np.rad2deg(edge_normals_angle(vertices, faces, opposite))
    crease = np.zeros(len(opposite), bool)
    if crease_deg is not None:
        crease = (opposite >= 0) & (angle > crease_deg)
    normals = _corner_normals(vertices, faces, opposite, crease)
    sharpest = np.zeros(len(vertices))
    start, end = half_edges(faces)
    np.maximum.at(sharpest, np.r_[start, end], np.r_[angle, angle])
    sharpest[start[crease]] = sharpest[end[crease]] = 180
    return SmoothInput(vertices, faces, normals, opposite, crease, sharpest, alpha)


def _corner_normals(vertices, faces, opposite, crease):
    """Angle-weighted normals per corner, averaged over the corners not parted by creases."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = 3 * len(faces)
    h = np.arange(n)
    after = h - h % 3 + (h + 1) % 3
    joined = (opposite >= 0) & ~crease
    # across half-edge h (a to b): the corner of a here is the corner after the opposite half-edge there
    here = np.concatenate([h[joined], after[joined]])
    there = np.concatenate([after[opposite[joined]], opposite[joined]])
    graph = coo_matrix((np.ones(len(here), bool), (here, there)), shape=(n, n))
    count, group = connected_components(graph, directed=False)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
    u = np.roll(corners, -1, axis=1) - corners
    w = np.roll(corners, 1, axis=1) - corners
    angle = np.arctan2(np.linalg.norm(np.cross(u, w), axis=2), np.einsum("mkx,mkx->mk", u, w))
    weighted = (angle[..., None] * normal[:, None]).reshape(n, 3)
    summed = np.stack([np.bincount(group, weighted[:, x], count) for x in range(3)], axis=1)
    size = np.linalg.norm(summed, axis=1, keepdims=True)
    fallback = np.zeros_like(summed)
    fallback[group] = np.repeat(normal, 3, axis=0)
    fallback[np.linalg.norm(fallback, axis=1) == 0] = (0, 0, 1)
    mean = np.where(size > 1e-9, summed / np.maximum(size, 1e-9), fallback)
    return mean[group].reshape(len(faces), 3, 3)
