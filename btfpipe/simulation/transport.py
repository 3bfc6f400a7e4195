"""Light between the points of a patch: direct visibility and inter-reflection, cached per vertex.

The diffuse light that other parts of the structure throw onto a point does not depend on the eye and varies slowly, so it
is gathered once a vertex by Monte Carlo, for all lights along the same rays, and interpolated: the first bounce with the
full reflectance of the point that is seen, further ones diffusely, through a sparse matrix.
"""

import numpy as np

from btfpipe import hashing, parallel
from btfpipe.compiled import njit
from btfpipe.simulation.reflectance import frame, lobes, reflect

OFFSET = 2e-3  # texels by which rays start above the surface
_BLOCK = 1024  # vertices gathered at a time

# A point that is seen by way of another one reflects at least this roughly: narrow lobes there are found by so few paths
# that they would show as sparks, not as caustics (path space regularisation, Kaplanyan and Dachsbacher 2013).
ROUGHNESS_SEEN = 0.4


class Gatherer:
    """Rays from every vertex into its hemisphere, traced once, used for any light.

    Parameters
    ----------
    patch : Patch
    tracer : Tracer
    rays : int
        Per vertex, cosine-distributed and stratified.
    seed : int
    threads : int
    """

    def __init__(self, patch, tracer, rays, seed, threads):
        self.patch, self.tracer, self.rays, self.threads = patch, tracer, rays, threads
        self._origins = tracer.wrap(patch.table_vertices + OFFSET * patch.normals)
        self._table_faces = patch.table_faces
        blocks = parallel.blocks(len(patch.normals), _BLOCK)
        self._gathered = list(parallel.ordered_map(lambda b: self._trace(b, seed), blocks, threads))
        self._bounce = None

    def _trace(self, block, seed):
        """Hits of the rays of a block of vertices: (vertex, direction, face, u, v), misses left out."""
        normals = self.patch.normals[block]
        directions = np.empty((len(normals) * self.rays, 3), np.float32)
        _cosine_directions(normals, self.rays, seed, block.start, directions)
        hits = self.tracer.meet(np.repeat(self._origins[block], self.rays, axis=0), directions)
        seen = np.flatnonzero((hits.face >= 0) & hits.front)
        vertex = (seen // self.rays + block.start).astype(np.int32)
        return vertex, directions[seen], hits.face[seen], hits.u[seen], hits.v[seen]

    def visibility(self, lights):
        """Whether each vertex sees each light (lights, k) uint8; the vertex's own side is not asked."""

        def one(light):
            return self.tracer.free(self._origins, light[None])

        lights = np.asarray(lights, np.float32)
        return np.array(list(parallel.ordered_map(one, lights, self.threads)), np.uint8)

    def indirect(self, lights, visibility, bounces):
        """Indirect irradiance (lights, k, 3) float32 relative to that of the light at normal incidence."""
        patch = self.patch
        lights = np.ascontiguousarray(lights, np.float64)
        total = np.zeros((len(lights), len(patch.normals), 3), np.float32)
        if bounces == 0:
            return total

        def first(gathered):
            vertex, directions, face, u, v = gathered
            _first_bounce(
                vertex, directions, face, u, v, self._table_faces, patch.normals, patch.albedo,
                patch.roughness, patch.f0, lights, visibility, 1.0 / self.rays, total,
            )  # fmt: skip

        for _ in parallel.ordered_map(first, self._gathered, self.threads):
            pass  # blocks own disjoint vertices
        if bounces > 1:
            self._further(total, bounces - 1)
        return total

    def _further(self, total, bounces):
        matrix = self._matrix()
        diffuse = self.patch.albedo * (1 - average_fresnel_of(self.patch.f0)) ** 2

        def one(index):
            part = total[index].copy()
            for _ in range(bounces):
                part = matrix @ (diffuse * part)
                total[index] += part

        for _ in parallel.ordered_map(one, range(len(total)), self.threads):
            pass

    def _matrix(self):
        """Sparse (k, k): mean over the rays of a vertex of the interpolated value they see."""
        if self._bounce is None:
            from scipy.sparse import csr_array

            vertex, _, face, u, v = (
                np.concatenate(part) for part in zip(*self._gathered, strict=True)
            )
            weights = np.stack([1 - u - v, u, v], axis=1) / np.float32(self.rays)
            k = len(self.patch.normals)
            self._bounce = csr_array(
                (weights.ravel(), (np.repeat(vertex, 3), self._table_faces[face].ravel())), (k, k)
            )
        return self._bounce


def average_fresnel_of(f0):
    """`average_fresnel` of an array."""
    return f0 + (np.minimum(1, 50 * f0) - f0) / 21


@njit(cache=True, nogil=True)
def _cosine_directions(normals, rays, seed, start, out):
    """Cosine-distributed directions about each normal; strata turned and shifted by a hash of the vertex."""
    for k in range(normals.shape[0]):
        shift_u = hashing.uniform(seed, start + k, 0)
        shift_v = hashing.uniform(seed, start + k, 1)
        nx, ny, nz = normals[k, 0], normals[k, 1], normals[k, 2]
        sx, sy, sz, tx, ty, tz = frame(nx, ny, nz)
        for r in range(rays):
            # a rank-1 lattice of the golden ratio, shifted
            radius2 = ((r + shift_u) / rays) % 1.0
            phi = 2.0 * np.pi * ((r * 0.6180339887498949 + shift_v) % 1.0)
            radius = np.sqrt(radius2)
            x = radius * np.cos(phi)
            y = radius * np.sin(phi)
            z = np.sqrt(max(1.0 - radius2, 1e-8))
            row = k * rays + r
            out[row, 0] = x * sx + y * tx + z * nx
            out[row, 1] = x * sy + y * ty + z * ny
            out[row, 2] = x * sz + y * tz + z * nz


@njit(cache=True, nogil=True)
def _first_bounce(
    vertex, directions, face, u, v, table_faces, normals, albedo, roughness, f0, lights, visibility,
    weight, total,
):  # fmt: skip
    """Add to `total` what each ray sees of the directly lit structure."""
    n = vertex.shape[0]
    points = np.empty((n, 10), np.float32)
    corner = np.empty((n, 3), np.int32)
    for k in range(n):
        interpolate(table_faces, normals, albedo, roughness, f0, face[k], u[k], v[k], points[k])
        points[k, 6] = max(points[k, 6], ROUGHNESS_SEEN)
        for c in range(3):
            corner[k, c] = table_faces[face[k], c]
    for light in range(lights.shape[0]):
        w_i = lights[light]
        sees = visibility[light]
        out = total[light]
        for k in range(n):
            share = (
                (1.0 - u[k] - v[k]) * sees[corner[k, 0]]
                + u[k] * sees[corner[k, 1]]
                + v[k] * sees[corner[k, 2]]
            )
            if share <= 0.0:
                continue
            point = points[k]
            view = (-directions[k, 0], -directions[k, 1], -directions[k, 2])
            n_l, n_v, l_h, coat = lobes(point[0:3], point[7:10], point[6], w_i, view)
            if n_l <= 0.0:
                continue
            for c in range(3):
                value = reflect(point[3 + c], point[7 + c], n_l, n_v, l_h, coat)
                out[vertex[k], c] += weight * share * value


@njit(cache=True, nogil=True)
def interpolate(table_faces, normals, albedo, roughness, f0, face, u, v, out):
    """Fill `out` (10): unit normal, albedo, roughness, f0 at a point of a triangle."""
    a = table_faces[face, 0]
    b = table_faces[face, 1]
    c = table_faces[face, 2]
    w = 1.0 - u - v
    length = 0.0
    for k in range(3):
        out[k] = w * normals[a, k] + u * normals[b, k] + v * normals[c, k]
        length += out[k] * out[k]
        out[3 + k] = w * albedo[a, k] + u * albedo[b, k] + v * albedo[c, k]
        out[7 + k] = w * f0[a, k] + u * f0[b, k] + v * f0[c, k]
    length = np.sqrt(length) + 1e-20
    for k in range(3):
        out[k] /= length
    out[6] = w * roughness[a] + u * roughness[b] + v * roughness[c]
