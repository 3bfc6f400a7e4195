"""The measurement itself: pictures of a patch for pairs of light and view.

Rectified as Bonn does: the ray of texel (i, j) goes through that texel's point of the reference plane along the view
direction, whatever it meets there. Parallax and masking are in the pictures.
"""

import numpy as np

from btfpipe import hashing
from btfpipe.compiled import njit
from btfpipe.simulation.patch import texel_positions
from btfpipe.simulation.reflectance import (
    average_fresnel,
    frame,
    lobes,
    masking_ratio,
    reflect,
    schlick,
    visible_normal,
)
from btfpipe.simulation.tracing import Tracer
from btfpipe.simulation.transport import OFFSET, ROUGHNESS_SEEN, Gatherer, interpolate

_RAYS = 1 << 16  # camera rays traced at a time: bounds the memory
_EYE_DRAWS = 1 << 32  # keeps the draws of the eye's rays apart from those of the vertices


class Goniometer:
    """Measures a patch: a light and an eye, each in any direction.

    Parameters
    ----------
    patch : Patch
    samples : int
        Rays a texel, in a fixed pattern: the box filter of a texel.
    bounces : int
        Inter-reflections beyond direct light; 0 for none.
    rays : int
        Gathering rays a vertex.
    seed, threads : int
        Threads serve the set-up and `light`; `picture` may be called from several threads.
    """

    def __init__(self, patch, samples=4, bounces=2, rays=64, seed=0, threads=1):
        self.patch, self.samples, self.bounces, self.seed = patch, samples, bounces, seed
        self.tracer = Tracer(patch)
        self._gatherer = Gatherer(patch, self.tracer, rays if bounces else 0, seed, threads)
        self._table_faces = patch.table_faces

    @property
    def bytes_per_light(self):
        """Memory that `light` takes for each light."""
        return len(self.patch.normals) * 13

    def light(self, lights):
        """Prepare lights (n, 3); the result is handed to `pictures`."""
        lights = np.ascontiguousarray(lights, np.float64)
        visibility = self._gatherer.visibility(lights)
        return lights, visibility, self._gatherer.indirect(lights, visibility, self.bounces)

    def pictures(self, view, lit, which):
        """Pictures of one view under several of the prepared lights.

        Parameters
        ----------
        view : (3,)
            Unit vector towards the eye.
        lit : tuple
            Of `light`.
        which : sequence of int
            Rows of the prepared lights.

        Returns
        -------
        (n, rows, cols, 3) float32
            Reflected radiance relative to a perfect white diffuser lit at normal incidence.
        """
        rows, cols = self.patch.shape
        out = np.zeros((len(which), rows * cols, 3), np.float32)
        view = np.asarray(view, np.float64)
        block = max(_RAYS // self.samples, 1)
        for start in range(0, rows * cols, block):
            texels = np.arange(start, min(start + block, rows * cols))
            self._block(view, lit, which, texels, out[:, texels[0] : texels[-1] + 1])
        return out.reshape(len(which), rows, cols, 3)

    def _block(self, view, lit, which, texels, out):
        lights, visibility, indirect = lit
        patch, faces = self.patch, self._table_faces
        hits = self.tracer.meet(*self._eye_rays(view, texels))
        face = np.where(hits.front, hits.face, -1).astype(np.int32)
        n = len(face)
        points = np.zeros((n, 10), np.float32)
        origins = np.zeros((n, 3), np.float32)
        second = np.zeros((n, 3), np.float32)  # directions of mirrored rays
        gloss = np.zeros((n, 3), np.float32)  # and what they weigh
        _surface(
            face, hits.u, hits.v, faces, patch.faces, patch.vertices, patch.normals, patch.albedo,
            patch.roughness, patch.f0, view, self.seed + _EYE_DRAWS, texels[0] * self.samples,
            points, origins, second, gloss,
        )  # fmt: skip
        self.tracer.wrap(origins)
        mirrored = np.flatnonzero(gloss.any(axis=1)) if self.bounces else np.zeros(0, int)
        glimpse = self._glimpses(origins, second, mirrored)
        for k, index in enumerate(which):
            free = self.tracer.free(origins, lights[index][None])
            _shade(
                face, hits.u, hits.v, faces, points, view, lights[index], free, indirect[index],
                1.0 / self.samples, self.samples, out[k],
            )  # fmt: skip
            if glimpse is not None:
                _mirror(*glimpse, lights[index], visibility[index], indirect[index], gloss,
                        1.0 / self.samples, self.samples, out[k])  # fmt: skip

    def _eye_rays(self, view, texels):
        """Origins above the structure, in the central tile, and the one direction."""
        rows, cols = self.patch.shape
        row, col = np.divmod(np.repeat(texels, self.samples), cols)
        dr, dc = _pattern(self.samples)
        s, t = texel_positions(
            rows, cols, row + np.tile(dr, len(texels)), col + np.tile(dc, len(texels))
        )
        rise = max(self.tracer.top, 0) + 1
        points = np.stack([s, t, np.zeros_like(s)], axis=1) + view * (rise / view[2])
        # float64 until wrapped: grazing views start far away
        points[:, :2] %= self.tracer.period
        return points.astype(np.float32), -view[None].astype(np.float32)

    def _glimpses(self, origins, directions, rays):
        """What the mirrored rays meet, ready for `_mirror`; None if nothing."""
        if len(rays) == 0:
            return None
        hits = self.tracer.meet(origins[rays], directions[rays])
        seen = np.flatnonzero((hits.face >= 0) & hits.front)
        if len(seen) == 0:
            return None
        patch, faces = self.patch, self._table_faces
        face, u, v = (a[seen] for a in hits[:3])
        points = np.zeros((len(seen), 10), np.float32)
        _seen(faces, patch.normals, patch.albedo, patch.roughness, patch.f0, face, u, v, points)
        rays = rays[seen]
        return rays, face, u, v, faces, points, directions[rays]


def _pattern(samples):
    """Offsets (row, col) of the rays in a texel, in (-0.5, 0.5): a Hammersley set."""
    k = np.arange(samples)
    bits = max(int(samples - 1).bit_length(), 0)
    radical = sum(((k >> b) & 1) * 0.5 ** (b + 1) for b in range(bits)) + 0.5 ** (bits + 1)
    return radical - 0.5 + np.zeros(samples), (k + 0.5) / samples - 0.5


@njit(cache=True, nogil=True)
def _seen(faces, normals, albedo, roughness, f0, face, u, v, points):
    """What mirrored rays meet, no smoother than ROUGHNESS_SEEN."""
    for k in range(face.shape[0]):
        interpolate(faces, normals, albedo, roughness, f0, face[k], u[k], v[k], points[k])
        points[k, 6] = max(points[k, 6], ROUGHNESS_SEEN)


@njit(cache=True, nogil=True)
def _surface(
    face, u, v, table_faces, faces, vertices, normals, albedo, roughness, f0, view, seed, first,
    points, origins, second, gloss,
):  # fmt: skip
    """For each camera ray: its point's tables, where shadow rays start, one mirrored ray and its weight."""
    for k in range(face.shape[0]):
        if face[k] < 0:
            origins[k, 2] = 1e6
            continue
        w = 1.0 - u[k] - v[k]
        interpolate(table_faces, normals, albedo, roughness, f0, face[k], u[k], v[k], points[k])
        weights = (w, np.float64(u[k]), np.float64(v[k]))
        x = 0.0
        y = 0.0
        z = 0.0
        for c in range(3):
            a = faces[face[k], c]
            x += weights[c] * vertices[a, 0]
            y += weights[c] * vertices[a, 1]
            z += weights[c] * vertices[a, 2]
        # start where the smooth surface would be: no facets at the shadow's terminator (Hanika 2021)
        ox = 0.0
        oy = 0.0
        oz = 0.0
        for c in range(3):
            a = faces[face[k], c]
            r = table_faces[face[k], c]
            below = (
                (x - vertices[a, 0]) * normals[r, 0]
                + (y - vertices[a, 1]) * normals[r, 1]
                + (z - vertices[a, 2]) * normals[r, 2]
            )
            below = min(below, 0.0) * weights[c]
            ox -= below * normals[r, 0]
            oy -= below * normals[r, 1]
            oz -= below * normals[r, 2]
        nx, ny, nz = points[k, 0], points[k, 1], points[k, 2]
        origins[k, 0] = x + ox + OFFSET * nx
        origins[k, 1] = y + oy + OFFSET * ny
        origins[k, 2] = z + oz + OFFSET * nz
        if points[k, 7] + points[k, 8] + points[k, 9] <= 0.0:
            continue
        sx, sy, sz, tx, ty, tz = frame(nx, ny, nz)
        n_v = max(nx * view[0] + ny * view[1] + nz * view[2], 1e-3)
        local = (
            sx * view[0] + sy * view[1] + sz * view[2],
            tx * view[0] + ty * view[1] + tz * view[2],
            n_v,
        )
        u1 = hashing.uniform(seed, first + k, 0)
        u2 = hashing.uniform(seed, first + k, 1)
        hx, hy, hz = visible_normal(local, points[k, 6], u1, u2)
        v_h = local[0] * hx + local[1] * hy + local[2] * hz
        lx = 2.0 * v_h * hx - local[0]
        ly = 2.0 * v_h * hy - local[1]
        n_l = 2.0 * v_h * hz - local[2]
        if n_l <= 1e-4:
            continue
        second[k, 0] = lx * sx + ly * tx + n_l * nx
        second[k, 1] = lx * sy + ly * ty + n_l * ny
        second[k, 2] = lx * sz + ly * tz + n_l * nz
        weight = masking_ratio(points[k, 6], n_l, n_v)
        for c in range(3):
            gloss[k, c] = weight * schlick(points[k, 7 + c], v_h)


@njit(cache=True, nogil=True)
def _shade(
    face, u, v, table_faces, points, view, light, free, indirect, weight, samples, out,
):  # fmt: skip
    """Add direct light and diffusely reflected indirect light of every camera ray to its texel."""
    for k in range(face.shape[0]):
        if face[k] < 0:
            continue
        point = points[k]
        pixel = out[k // samples]
        n_l = 0.0
        if free[k]:
            n_l, n_v, l_h, coat = lobes(point[0:3], point[7:10], point[6], light, view)
            if n_l > 0.0:
                for c in range(3):
                    pixel[c] += weight * reflect(point[3 + c], point[7 + c], n_l, n_v, l_h, coat)
        n_v = point[0] * view[0] + point[1] * view[1] + point[2] * view[2]
        n_v = max(n_v, 1e-3)
        a = table_faces[face[k], 0]
        b = table_faces[face[k], 1]
        d = table_faces[face[k], 2]
        w = 1.0 - u[k] - v[k]
        for c in range(3):
            around = w * indirect[a, c] + u[k] * indirect[b, c] + v[k] * indirect[d, c]
            f0 = point[7 + c]
            through = (1.0 - schlick(f0, n_v)) * (1.0 - average_fresnel(f0))
            pixel[c] += weight * point[3 + c] * through * around


@njit(cache=True, nogil=True)
def _mirror(
    rays, face, u, v, table_faces, points, directions, light, visibility, indirect, gloss, weight,
    samples, out,
):  # fmt: skip
    """Add what the mirrored rays see: direct light there, and the indirect light it reflects diffusely."""
    for k in range(rays.shape[0]):
        point = points[k]
        a = table_faces[face[k], 0]
        b = table_faces[face[k], 1]
        d = table_faces[face[k], 2]
        w = 1.0 - u[k] - v[k]
        share = w * visibility[a] + u[k] * visibility[b] + v[k] * visibility[d]
        view = (-directions[k, 0], -directions[k, 1], -directions[k, 2])
        n_l = 0.0
        n_v = 1.0
        l_h = 1.0
        coat = 0.0
        if share > 0.0:
            n_l, n_v, l_h, coat = lobes(point[0:3], point[7:10], point[6], light, view)
        pixel = out[rays[k] // samples]
        for c in range(3):
            f0 = point[7 + c]
            seen = 0.0
            if n_l > 0.0:
                seen = share * reflect(point[3 + c], f0, n_l, n_v, l_h, coat)
            around = w * indirect[a, c] + u[k] * indirect[b, c] + v[k] * indirect[d, c]
            seen += point[3 + c] * (1.0 - average_fresnel(f0)) ** 2 * around
            pixel[c] += weight * gloss[rays[k], c] * seen
