"""Rays against a patch that repeats for ever."""

from collections import namedtuple

import numpy as np

from btfpipe.errors import InputError

# Which triangle of the tile was met (-1: none), its barycentric coordinates, and whether from outside.
Hits = namedtuple("Hits", "face u v front")

_STEEPEST_DEG = 76  # directions up to here need no second trace, unless the structure is very deep
_MAX_COPIES = 3


class Tracer:
    """Embree over one tile and enough of its neighbours; results are those of the infinite tiling.

    A ray that leaves the copies before it leaves the slab of the structure is put back into the central tile and
    traced on, so even grazing rays are exact.

    Parameters
    ----------
    patch : Patch
    """

    def __init__(self, patch):
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        rows, cols = patch.shape
        self.period = np.array([cols, rows], np.float32)
        low, high = patch.vertices.min(axis=0), patch.vertices.max(axis=0)
        self.bottom, self.top = float(low[2]), float(high[2])
        depth = self.top - self.bottom
        # how far the tile's triangles stick out, in periods
        out = np.maximum(np.maximum(-low[:2], high[:2] - self.period), 0) / self.period
        out = np.ceil(out - 1e-6).astype(int)
        if out.max() > 2:
            raise InputError(
                f"the meso-structure sticks out {out.max()} periods beyond its tile; expected 2 at most."
            )
        run = np.minimum(depth * np.tan(np.radians(_STEEPEST_DEG)), _MAX_COPIES * self.period)
        self.margin = np.maximum(run, 1).astype(np.float32)  # a ray from the tile may run so far
        vertices, faces, self._face = _surroundings(patch, self.margin, out)
        self._scene = EmbreeScene(robust=True)
        self._mesh = TriangleMesh(self._scene, vertices, faces)
        # the first query builds the tree; two threads must not do that at once
        self._scene.run(np.array([[0, 0, self.top + 1]], np.float32),
                        np.array([[0, 0, 1]], np.float32), query="OCCLUDED")  # fmt: skip

    def wrap(self, points):
        """Bring points (n, 3) into the central tile, in place."""
        points[:, :2] -= np.floor(points[:, :2] / self.period) * self.period
        return points

    def meet(self, origins, directions):
        """First triangle along each ray; origins (n, 3) float32 lie in the central tile."""
        n = len(origins)
        face = np.full(n, -1, np.int32)
        u, v, front = np.zeros(n, np.float32), np.zeros(n, np.float32), np.zeros(n, bool)
        for rays, o, d, limit in self._legs(origins, directions):
            found = self._scene.run(o, d, output=1)
            hit = (found["primID"] >= 0) & (found["tfar"] <= limit)
            at = rays[hit]
            face[at] = self._face[found["primID"][hit]]
            u[at], v[at] = found["u"][hit], found["v"][hit]
            front[at] = (
                np.einsum(
                    "ij,ij->i",
                    found["Ng"][hit],
                    d[hit] if len(d) > 1 else np.broadcast_to(d, (hit.sum(), 3)),
                )
                < 0
            )
            rays[hit] = -1
        return Hits(face, u, v, front)

    def free(self, origins, directions):
        """Whether each ray leaves the structure unhindered (n,) bool; as `meet`."""
        free = np.ones(len(origins), bool)
        for rays, o, d, _limit in self._legs(origins, directions):
            hit = self._scene.run(o, d, query="OCCLUDED") != -1
            free[rays[hit]] = False
            rays[hit] = -1
        return free

    def _legs(self, origins, directions):
        """Cut rays into legs that stay inside the copies; the caller sets `rays` to -1 where one has ended."""
        directions = np.ascontiguousarray(np.atleast_2d(directions), np.float32)
        origins = np.ascontiguousarray(origins, np.float32)
        rays = np.arange(len(origins))
        while len(rays):
            with np.errstate(divide="ignore"):
                limit = (self.margin / np.abs(directions[:, :2])).min(axis=1)
                up = directions[:, 2] > 0
                end = np.where(up, self.top, self.bottom)
                leave = (end - origins[:, 2]) / directions[:, 2]
            leave = np.where(np.isnan(leave), np.inf, leave)
            yield rays, origins, directions, np.broadcast_to(limit, len(rays))
            on = (rays >= 0) & (leave > limit)
            if not on.any():
                return
            if len(directions) > 1:
                directions, limit = directions[on], limit[on]
            origins = self.wrap(origins[on] + directions * limit[:, None])
            rays = rays[on]
            # a ray along the plane never leaves the slab: give it up within a twentieth of a degree of it
            if len(directions) == 1 and abs(directions[0, 2]) < 1e-3:
                return
            keep = np.abs(directions[:, 2]) >= 1e-3
            if len(directions) > 1 and not keep.all():
                rays, origins, directions = rays[keep], origins[keep], directions[keep]


def _surroundings(patch, margin, out):
    """The triangles within `margin` of the tile.

    Returns
    -------
    vertices : (n, 3) float32
    faces : (m, 3) int32
    face : (m,) int32
        The patch's triangle that each is a copy of.
    """
    rows, cols = patch.shape
    period = np.array([cols, rows])
    corners = patch.vertices[patch.faces][..., :2]
    low, high = corners.min(axis=1), corners.max(axis=1)
    span_s, span_t = (range(-n, n + 1) for n in np.ceil(margin / period).astype(int) + out)
    vertices, faces, face, start = [], [], [], 0
    for shift in [(s * cols, t * rows) for t in span_t for s in span_s]:
        near = ((high + shift >= -margin) & (low + shift <= period + margin)).all(axis=1)
        kept = np.flatnonzero(near).astype(np.int32)
        used, index = np.unique(patch.faces[kept], return_inverse=True)
        vertices.append(patch.vertices[used] + np.array([*shift, 0], np.float32))
        faces.append((index.reshape(-1, 3) + start).astype(np.int32))
        face.append(kept)
        start += len(used)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(face)


def copies(patch):
    """About how many copies of the tile's triangles a Tracer holds."""
    depth = float(np.ptp(patch.vertices[:, 2]))
    run = np.minimum(depth * np.tan(np.radians(_STEEPEST_DEG)), _MAX_COPIES * max(patch.shape))
    return float(np.prod(1 + 2 * run / np.array(patch.shape)))
