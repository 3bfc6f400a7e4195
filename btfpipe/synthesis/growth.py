"""Growing a sample over a surface: the two-pass multi-resolution synthesis of Tong et al. 2002, section 5.

Where this departs from the paper: the coarsest level is walked as a front, in its first sweep places not yet synthesised do not count (instead of
counting as the random texels that they carry), every level is swept more than once, the coordinate of a vertex is the mean of
the runs that lead to its texel, which keeps coherent patches rigid, and below the coarsest level a texel that continues no run of its
surroundings must be clearly nearer (as kappa of Hertzmann et al. 2001), or the blending of textons
between vertices, which favours smooth texels everywhere, would break patches up and lose their grain.
"""

import time
from collections import namedtuple

import numpy as np

from btfpipe.compiled import njit
from btfpipe.errors import InputError
from btfpipe.parallel import blocks, ordered_map
from btfpipe.sample.orientation import step_to_texels
from btfpipe.surface.flatten import PATCH, Flattener, frame_angle
from btfpipe.synthesis import search
from btfpipe.synthesis.coordinate_map import CoordinateMap
from btfpipe.synthesis.exemplar import cut, exemplar, random_texel

_BLOCK = 4096  # vertices flattened at once: about 8 MB
SWEEPS = (16, 3)  # on the coarsest level, on the others
COHERENCE = 0.4

Grown = namedtuple("Grown", "row col label")


def grow_over_surface(
    features, surface, texels_per_unit=None, *, full=False, k=11, levels=3, sweeps=SWEEPS, turn=0.0, seed=0,
    threads=1, coherence=COHERENCE, distance=None, memory=2 << 30,
    on_progress=None,
):  # fmt: skip
    """Grow a sample over a surface.

    Parameters
    ----------
    features : Features
    surface : Surface
    texels_per_unit : float, optional
        Texels of level 0 per unit of the surface's length; the same scale holds on every level. By default one texel per mean
        edge of the surface's level 0.
    full : bool
        Full search instead of the k-coherent one.
    k : int
        Entries of each neighbour list that are tried; 1 is Ashikhmin's search for natural textures.
    levels : int
    sweeps : (int, int)
        Times that the coarsest level and every other level are walked.
    coherence : float
        By how much the distance of a texel counts more if no run of the patch leads to it: on level 0, half as much a level
        from there on, and not at all on the coarsest, which finds the structure. 0 is the paper's choice: the nearest
        candidate, whatever it breaks.
    turn : float
        Angle of the sample's s axis against the vector field, counter-clockwise, radians.
    seed, threads : int
    memory : int
        Bytes to stay within; where they allow it, flattened patches are kept for the next sweep.
    distance : str, optional
        ``gram`` or ``vectors``; see `exemplar`.
    on_progress : callable, optional
        Gets vertices done and in all.

    Returns
    -------
    CoordinateMap
        With ``about["synthesis"]``: per level candidates, distances, fallbacks, seconds.

    Raises
    ------
    InputError
    """
    features = cut(features, levels)
    if len(surface.levels) < levels:
        raise InputError(
            f"the surface has {len(surface.levels)} levels, fewer than --levels {levels}; lower it, or make more"
            " with `btfpipe surface`."
        )
    for i in range(levels - 1):
        _require_places(surface, i)
    spacing = mean_edge(surface.levels[0])
    scale = scale_for(surface, features.levels[0].shape, texels_per_unit)
    if not 0.25 <= scale * spacing <= 4.0:
        raise InputError(
            f"{scale:.4g} texels per unit are {scale * spacing:.3g} texels per edge of the surface; expected"
            " 0.25 to 4 (1 is best). Resample the surface, or choose another scale."
        )
    total = sum(
        len(surface.levels[i].vertices) * (sweeps[0] if i == levels - 1 else sweeps[1])
        for i in range(levels)
    )
    finished, report = 0, []
    below = coarse_mesh = coarse_sample = None
    for i in reversed(range(levels)):
        level = surface.levels[i]
        sample = exemplar(features, i, None if full else k, distance)
        mesh = Flattener(level, scale / 2**i, turn)
        n = len(mesh.vertices)
        state = Grown(np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.int32))
        if below is None:
            _scatter(sample, np.flatnonzero(sample.usable), np.uint64(seed), *state)
            coarse_label = np.zeros(0, np.int32)
        else:
            _inherit(level, mesh, coarse_mesh, below, coarse_sample, sample, state)
            coarse_label = below.label
        done = np.full(n, below is not None)
        times = np.zeros(n, np.int64), np.ones(n, np.int64), np.zeros(n, np.float32)
        tally = np.ones(5, np.int64)
        room = search.scratch(sample, PATCH)
        jobs = _Jobs(
            _Flatten(level, mesh, coarse_mesh, sample, breadth_first(mesh, int(seed) % n)), memory
        )
        for sweep in range(sweeps[0] if below is None else sweeps[1]):
            tally[1:] = 0
            start, searching = time.perf_counter(), 0.0
            for job in jobs.run(threads):
                tick = time.perf_counter()
                search.grow(
                    *job, sample, full, below is None and sweep == 0,
                    np.float32(0.0 if below is None else coherence * 2.0**-i), *state, done, *times, coarse_label, room, tally,
                )  # fmt: skip
                searching += time.perf_counter() - tick
                finished += len(job[0])
                if on_progress is not None:
                    on_progress(finished, total)
            report.append(
                summary(i, sweep, tally, times[2], searching, time.perf_counter() - start)
            )
        below, coarse_mesh, coarse_sample = state, mesh, sample
    return CoordinateMap(
        state.row,
        state.col,
        np.full(len(state.row), turn, np.float32),
        scale,
        {"surface": surface.digest},
        about={"synthesis": report},
    )


def _require_places(surface, i):
    """Refuse a surface without usable places on the next coarser level."""
    face, below = surface.levels[i].parent_face, len(surface.levels[i + 1].faces)
    if face is None:
        raise InputError(
            f"the surface does not say where the vertices of level {i} lie on level {i + 1}; make it anew with"
            " `btfpipe surface`, or pass --levels 1."
        )
    if face.min() < 0 or face.max() >= below:
        raise InputError(
            f"level {i} of the surface names face {face.min() if face.min() < 0 else face.max()} of level"
            f" {i + 1}, which has {below}; make it anew with `btfpipe surface`."
        )


class _Flatten:
    """What the search needs of a block of vertices: their numbers, patches, and squares on the coarser level."""

    def __init__(self, level, mesh, coarse_mesh, sample, order):
        self.level, self.mesh, self.coarse_mesh = level, mesh, coarse_mesh
        self.sample, self.order = sample, order

    def __call__(self, block):
        vertices = self.order[block]
        patches = self.mesh.squares(vertices, self.sample.fine.side)
        if self.coarse_mesh is None:
            return vertices, patches, np.zeros((0, 0, 3), np.int32), np.zeros((0, 0, 3), np.float32)
        coarse = self.coarse_mesh.squares_at(
            self.level.parent_face[vertices], self.level.parent_weights[vertices],
            self.mesh.normals[vertices], self.mesh.tangents[vertices], self.sample.coarse.side,
        )  # fmt: skip
        return vertices, patches, *coarse


class _Jobs:
    """Flattened blocks in order, kept from one sweep to the next if they fit into the memory."""

    def __init__(self, flatten, memory):
        self.flatten = flatten
        self.kept = []
        n = len(flatten.order)
        side, coarse_side = flatten.sample.fine.side, flatten.sample.coarse.side
        self.keeps = n * (24 * (side**2 + coarse_side**2) + 12 * PATCH) < memory // 2

    def run(self, threads):
        if self.kept:
            yield from self.kept
            return
        for job in ordered_map(self.flatten, blocks(len(self.flatten.order), _BLOCK), threads):
            yield job
            if self.keeps:
                self.kept.append(job)


def summary(level, sweep, tally, distances, searching, seconds):
    """What one sweep over a level did; `tally` and `distances` as in `search.grow`."""
    n = distances.size
    return {
        "level": level,
        "sweep": sweep,
        "elements": n,
        "candidates": float(tally[search.CANDIDATES] / n),
        "mean_distance": float(distances.mean(dtype=np.float64)),
        "fallbacks": int(tally[search.FALLBACKS]),
        "starts": int(tally[search.STARTS]),
        "changed": float(tally[search.MOVED] / n),
        "search_seconds": searching,
        "seconds": seconds,
    }


def scale_for(surface, shape, texels_per_unit=None, repeats=None):
    """Texels per unit of length: as given, or `repeats` widths of the sample along the longest side, or one a mean edge."""
    if texels_per_unit is not None:
        return float(texels_per_unit)
    if repeats is not None:
        vertices = np.asarray(surface.levels[0].vertices)
        return float(repeats * shape[1] / (vertices.max(axis=0) - vertices.min(axis=0)).max())
    return 1.0 / mean_edge(surface.levels[0])


def mean_edge(level):
    """Mean length of the edges of a mesh level."""
    corners = np.asarray(level.vertices)[np.asarray(level.faces)]
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())


@njit(cache=True, nogil=True)
def _scatter(sample, usable, seed, row, col, label):
    """A random texel for every vertex."""
    half = sample.fine.side // 2
    for v in range(row.shape[0]):
        texel = random_texel(sample, usable, seed, v)
        r = texel // sample.cols
        c = texel - r * sample.cols
        row[v] = r
        col[v] = c
        label[v] = sample.fine.labels[r + half, c + half]


def _inherit(level, mesh, coarse_mesh, below, coarse_sample, sample, state):
    step = np.empty((len(mesh.vertices), 3, 2), np.float32)
    face = np.ascontiguousarray(level.parent_face, np.int32)
    weight = np.ascontiguousarray(level.parent_weights, np.float32)
    _parent_steps(
        mesh.normals, mesh.tangents, face, weight, coarse_mesh.vertices, coarse_mesh.faces,
        coarse_mesh.normals, coarse_mesh.tangents, coarse_mesh.texels_per_unit, step,
    )  # fmt: skip
    search.inherit(
        face, weight, coarse_mesh.faces, step, below.row, below.col, sample, coarse_sample.rows,
        coarse_sample.cols, *state,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _parent_steps(
    normals, tangents, face, weight, vertices, faces, coarse_normals, coarse_tangents, scale, step
):  # fmt: skip
    """Change of (row, col) from the corners of each vertex's coarse face to its place in it."""
    place = np.empty(3)
    for v in range(face.shape[0]):
        for d in range(3):
            place[d] = 0.0
            for j in range(3):
                place[d] += weight[v, j] * vertices[faces[face[v], j], d]
        for j in range(3):
            u = faces[face[v], j]
            nx, ny, nz = coarse_normals[u, 0], coarse_normals[u, 1], coarse_normals[u, 2]
            sx, sy, sz = coarse_tangents[u, 0], coarse_tangents[u, 1], coarse_tangents[u, 2]
            tx, ty, tz = ny * sz - nz * sy, nz * sx - nx * sz, nx * sy - ny * sx
            x, y, z = (
                place[0] - vertices[u, 0],
                place[1] - vertices[u, 1],
                place[2] - vertices[u, 2],
            )
            ds, dt = x * sx + y * sy + z * sz, x * tx + y * ty + z * tz
            length = np.sqrt(x * x + y * y + z * z)
            stretch = scale * length / max(np.sqrt(ds * ds + dt * dt), 1e-12)
            # In the frame half-way from the corner's to the vertex's, as in `flatten`.
            angle = 0.5 * frame_angle(
                coarse_normals[u], coarse_tangents[u], normals[v], tangents[v]
            )
            cosine = np.cos(angle)
            sine = np.sin(angle)
            drow, dcol = step_to_texels(
                stretch * (ds * cosine + dt * sine), stretch * (dt * cosine - ds * sine), 0.0
            )
            step[v, j, 0] = drow
            step[v, j, 1] = dcol


def breadth_first(mesh, start=0):
    """Order in which a front that starts at a vertex, then in every part not yet reached, walks the mesh; (n,) int32."""
    order = np.empty(len(mesh.vertices), np.int32)
    _breadth_first(mesh.faces, mesh.twin, mesh.start, start, order)
    return order


@njit(cache=True, nogil=True)
def _breadth_first(faces, twin, fan, start, order):
    corner = faces.ravel()
    n = order.shape[0]
    reached = np.zeros(n, np.bool_)
    count = 0
    head = 0
    for offset in range(n):
        first = (start + offset) % n
        if reached[first]:
            continue
        reached[first] = True
        order[count] = first
        count += 1
        while head < count:
            h = fan[order[head]]
            head += 1
            begin = h
            while h >= 0:
                f = 3 * (h // 3)
                a = corner[f + (h + 1) % 3]
                b = corner[f + (h + 2) % 3]
                for u in (a, b):
                    if not reached[u]:
                        reached[u] = True
                        order[count] = u
                        count += 1
                h = twin[f + (h + 2) % 3]
                if h == begin:
                    break


__all__ = [
    "COHERENCE",
    "SWEEPS",
    "breadth_first",
    "grow_over_surface",
    "mean_edge",
    "scale_for",
    "summary",
]
