"""What a ray covers of the sample, and the texels of a `Pyramid` that stand for it.

A pixel's rays follow its reconstruction filter, each in a stratum of it. Where several texels share a pixel a ray no longer shows the
point that it hits: its look-up moves to the mean of its stratum, by ray differentials (Igehy 1999) on the surface's tangent
plane and by the local frame, and to a level whose texels leave no gap between neighbouring strata. What such a probe
is wider than its stratum the means are drawn together, so that all rays of a pixel add up to the variance of its filter: the
picture is neither noisier nor more blurred than with any number of rays.

An elliptical footprint is read by several probes along its major axis (McCormack et al. 1999, *Feline*). All variances are in
texels squared: a probe of level l has 5 / 12 (4^l - 1) more than one of level 0, three fifths by the low-pass of
the levels and two by reading between their texels.

That lights and views differ within a footprint is neglected: they turn by about the angle of a pixel. Inside triangles whose
vertices are blended there is no coordinate to move; each vertex is read at its own, as widely.
"""

import copy
import math

import numpy as np

from btfpipe.rendering import footprint_kernels as kernels

PROBES = 1 << 14  # evaluated at a time
_MOST_PARTS = 3  # of a stratum along each axis
_WIDEST = 0.3  # standard deviation of a part over that of the filter
_STEPS = 256  # of a stratum's integrals


def strata_parts(table, count):
    """Means and weights (2, count, parts) float64 of the parts of a filter's strata, in pixels; see `camera.filter_table`.

    A ray stands for its stratum. Strata that are wide, as the outer ones of a filter with tails are, are divided at their mean, again
    and again, so that all parts are about as wide; a part that a stratum lacks has weight 0, the others of one stratum add up to 1.
    """
    steps = max(_STEPS, 8 * len(table) // count)
    at = (np.arange(count * steps) + 0.5) / (count * steps)
    offsets = np.interp(at * (len(table) - 1), np.arange(len(table)), table)
    widest = _WIDEST * offsets.std()
    out = np.zeros((2, count, _MOST_PARTS))
    for stratum, values in enumerate(offsets.reshape(count, steps)):
        parts = [values]
        while len(parts) < _MOST_PARTS:
            wide = max(range(len(parts)), key=lambda k: parts[k].std())
            if parts[wide].std() <= widest:
                break
            part = parts[wide]
            parts[wide : wide + 1] = [part[part < part.mean()], part[part >= part.mean()]]
        out[0, stratum, : len(parts)] = [part.mean() for part in parts]
        out[1, stratum, : len(parts)] = [len(part) / steps for part in parts]
    return out


def filter_variance(table):
    """Variance of a filter, in pixels squared."""
    at = (np.arange(8 * len(table)) + 0.5) / (8 * len(table)) * (len(table) - 1)
    return float(np.interp(at, np.arange(len(table)), table).var())


class Footprints:
    """Look-ups of an object, each with what it covers of the sample.

    Parameters
    ----------
    pyramid : Pyramid
    lookups : tuple
        row, col, at_i, at_o, blend, target, corner: what `kernels.gather_lookups` fills.
    at_x, at_y : (n, 3) float32
        The steps of `footprint_kernels.film_steps` in the look-ups' frames.
    texels_per_unit : float
    offset, stratum : (points, 2)
        See `footprint_kernels.film_offsets`.
    parts : tuple
        Of strata across and down; see `strata_parts`.
    variance : float
        See `filter_variance`.

    Attributes
    ----------
    target : (n,) int64
        The look-ups' points.
    spread : (n,) float32
        0 for a look-up that is a point, 1 for one that covers more than about a texel.
    points : bool
        Whether no look-up is more than a point: then nothing is filtered.
    """

    def __init__(
        self, pyramid, row, col, target, corner, at_x, at_y, texels_per_unit, offset, stratum, parts, variance
    ):  # fmt: skip
        self.pyramid, self.target = pyramid, target
        n = len(row) * math.prod(int((some[1] > 0).sum(axis=1).max()) for some in parts) + 1
        self.first = np.empty(len(row) + 1, np.int64)
        self.row, self.col, self.weight, self.share = (np.empty(n, np.float32) for _ in range(4))
        self.level, self.count = np.empty(n, np.int16), np.empty(n, np.int16)
        self.steps, self.spread = np.empty((n, 2), np.float32), np.empty(len(row), np.float32)
        whole = [(some[0] * some[1]).sum(axis=1) for some in parts]
        divided = [(some[0] ** 2 * some[1]).sum(axis=1).mean() for some in parts]
        film = np.concatenate([[variance], [means.var() for means in whole], divided, *whole])
        self.points = not kernels.fill_footprints(
            target, corner, at_x, at_y, float(texels_per_unit), offset, stratum, *parts, film, pyramid.top,
            np.empty((8, 6)), row, col, self.first, self.row, self.col, self.weight, self.level, self.share, self.count,
            self.steps, self.spread,
        )  # fmt: skip

    def average(self, chosen, add, out, shade_factors=None):
        """Average over the footprints of some look-ups.

        Parameters
        ----------
        chosen : (m,) int
            Look-ups.
        add : callable
            ``add(shader, which, row, col, weight, out)`` adds weighted values at coordinates (p,) of a level's shader to `out`;
            `which` (p,), ascending, numbers them along `chosen`.
        out : (m, ...) float32
            Filled in place.
        shade_factors : callable, optional
            ``shade_factors(shader, which, factors)`` gives values of factors that were averaged, of shaders that have some;
            those of one `Pyramid` have the same terms.
        """
        ends = np.empty(len(chosen), np.int64)
        kernels.count_probes(chosen, self.first, self.count, self.share, ends)
        out[:] = 0
        start = 0
        while start < len(chosen):
            before = ends[start - 1] if start else 0
            stop = max(int(np.searchsorted(ends, before + PROBES, "right")), start + 1)
            n = ends[stop - 1] - before
            owner, level = np.empty(n, np.int64), np.empty(n, np.int16)
            row, col, weight = (np.empty(n, np.float32) for _ in range(3))
            kernels.list_probes(
                chosen[start:stop], self.first, self.row, self.col, self.weight, self.level, self.share, self.count,
                self.steps, owner, row, col, level, weight,
            )  # fmt: skip
            owner += start
            factors, last, touched = None, None, np.zeros(stop - start, bool)
            for number in np.flatnonzero(np.bincount(level)):
                shader = self.pyramid.level(int(number))
                some = np.flatnonzero(level == number)
                which = owner[some]
                at = self._coordinates(shader, number, row[some], col[some])
                if shade_factors is not None and hasattr(shader, "add_factors"):
                    if factors is None:
                        factors = np.zeros((stop - start, shader.texture.shape[1]), np.float32)
                    shader.add_factors(*at, weight[some], which - start, factors)
                    touched[which - start] = True
                    last = shader
                else:
                    add(shader, which, *at, weight[some], out)
            if factors is not None:
                rows = np.flatnonzero(touched)
                values = shade_factors(last, start + rows, factors[rows])
                kernels.add(_flat(values), start + rows, np.ones(len(rows), np.float32), _flat(out))
            start = stop

    def _coordinates(self, shader, number, row, col):
        """Coordinates of level 0 on another level."""
        if not number:
            return row, col
        rows, cols = self.pyramid.appearance.shape
        return (
            ((row + 0.5) * (shader.rows / rows) - 0.5).astype(np.float32),
            ((col + 0.5) * (shader.cols / cols) - 0.5).astype(np.float32),
        )

    def shade(self, chosen, w_i, w_o, out):
        """Fill `out` (m, 3) float32 with what some look-ups show; see `Appearance.shader`."""

        def add(shader, which, row, col, weight, out):
            if hasattr(shader, "add_means"):
                shader.add_means(row, col, weight, which, w_i, w_o, out)
                return
            values = np.empty((len(which), 3), np.float32)
            shader.shade(row, col, w_i[which], w_o[which], values)
            kernels.add(values, which, weight, out)

        def shade_factors(shader, which, factors):
            values = np.empty((len(which), 3), np.float32)
            shader.shade_factors(factors, w_i[which], w_o[which], values)
            return values

        self.average(chosen, add, out, shade_factors)

    def slices(self, w_o):
        """What all look-ups show whatever the light; see `Appearance.shader`."""

        def add(shader, which, row, col, weight, out):
            values = shader.slices(row, col, w_o[which]).values
            kernels.add(_flat(values), which, weight, _flat(out))

        def shade_factors(shader, which, factors):
            return shader.slice_factors(factors, w_o[which])

        shader = self.pyramid.level(0)
        values = np.empty((len(self.target), *shader.slice_shape), np.float32)
        self.average(np.arange(len(self.target)), add, values, shade_factors)
        return shader.averaged_slices(values, w_o, self.spread)

    def shade_sky(self, sky, frames, w_o, out, visibility):
        """Fill `out` with the light of a `HarmonicEnvironment`; arguments as for its ``shade``."""

        def add(shader, which, row, col, weight, out):
            values = np.empty((len(which), 3), np.float32)
            level = copy.copy(sky)
            level.shader = shader
            level.shade(row, col, frames[which], w_o[which], values, visibility[which])
            kernels.add(values, which, weight, out)

        self.average(np.arange(len(self.target)), add, out)


def _flat(values):
    """Values (n, ...) as (n, k)."""
    return values.reshape(len(values), -1)
