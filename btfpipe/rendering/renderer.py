"""Rays through tiles: Embree finds what they hit, kernels shade it."""

import numpy as np

from btfpipe.parallel import ordered_map, single_threaded_blas
from btfpipe.rendering import kernels
from btfpipe.rendering.camera import filter_table, strata
from btfpipe.rendering.footprint import Footprints, filter_variance, strata_parts
from btfpipe.rendering.footprint_kernels import (
    LEAST_VARIANCE,
    count_texture_rays,
    film_offsets,
    film_steps,
    texture_rays,
    widest_square,
)

LAYERS = ("R", "G", "B", "A", "Z", "N.X", "N.Y", "N.Z", "texel.row", "texel.col")
TEXTURE_TILES = 8  # so many tiles in the place of one if objects wear maps that are filtered
# of a tile; fixed, so that memory is bounded and tiles are the same for any number of threads
_RAYS = 1 << 16
_RAY_BYTES = 600  # about what a ray takes, for tiles of like size in memory; fixed, too


def tile_side(samples, slice_bytes=0, texture_rays=False):
    """Pixels along a tile's side at this many rays a pixel; smaller for look-ups with so many bytes of a slice, or texture rays."""
    rays = _RAYS * _RAY_BYTES / (_RAY_BYTES + slice_bytes)
    if texture_rays:
        rays /= TEXTURE_TILES
    return min(max(int(np.sqrt(rays / samples)), 8), 256)


def _is_sliced(thing, lights):
    """Whether the lights of an object are many enough to share work."""
    if thing.dressing is None:
        return False
    many = getattr(thing.dressing.shader, "many_lights", None)
    lights = [light for light in lights if light.environment not in thing.dressing.skies]
    return many is not None and len(lights) >= many


def _of_points(target, chosen, n):
    """Which look-ups, by their points `target`, are of some of the n points."""
    wanted = np.zeros(n, bool)
    wanted[chosen] = True
    return np.flatnonzero(wanted[target])


class Renderer:
    """Holds what all tiles share: the ray tree, the merged mesh and the objects' places in it.

    Parameters
    ----------
    scene : Scene
    seed : int
        Of the rays' places inside their strata.
    """

    def __init__(self, scene, seed=0):
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.scene = scene
        self.seed = seed
        self.vertices = np.concatenate([t.vertices for t in scene.objects])
        self.normals = np.concatenate([t.normals for t in scene.objects])
        first_vertex = np.cumsum([0] + [len(t.vertices) for t in scene.objects])
        self.first_face = np.cumsum([0] + [len(t.faces) for t in scene.objects])
        self.faces = np.concatenate(
            [t.faces + n for t, n in zip(scene.objects, first_vertex, strict=False)]
        ).astype(np.int32)
        self.sliced = {
            number: thing.dressing.shader
            for number, thing in enumerate(scene.objects)
            if _is_sliced(thing, scene.lights)
        }
        self.table = filter_table(scene.film.filter, scene.film.radius)
        rows, cols = strata(scene.film.samples)
        self.parts = strata_parts(self.table, cols), strata_parts(self.table, rows)
        self.tree = EmbreeScene(robust=True)
        self._mesh = TriangleMesh(self.tree, self.vertices.astype(np.float32), self.faces)
        ray = np.zeros((1, 3), np.float32)
        self.tree.run(ray, ray + 1)  # builds the tree before threads ask for it

    def tiles(self):
        """Rectangles (x, y, width, height) that cover the film."""
        film = self.scene.film
        most = max((shader.slice_bytes for shader in self.sliced.values()), default=0)
        dressings = [thing.dressing for thing in self.scene.objects if thing.dressing is not None]
        mapped = any(d.mapped and d.pyramid is not None for d in dressings)
        side = tile_side(film.samples, most, mapped)
        return [
            (x, y, min(side, film.width - x), min(side, film.height - y))
            for y in range(0, film.height, side)
            for x in range(0, film.width, side)
        ]

    def tile(self, rectangle):
        """Layers (height, width, 10) float32 of a rectangle of pixels."""
        x, y, width, height = rectangle
        film, camera = self.scene.film, self.scene.camera
        n = width * height * film.samples
        origins, directions = np.empty((n, 3)), np.empty((n, 3))
        kernels.camera_rays(
            x, y, width, height, film.width, film.height, *strata(film.samples), self.table,
            self.seed, camera.position, camera.axes, np.array(camera.extent), camera.perspective,
            origins, directions,
        )  # fmt: skip
        found = self.tree.run(origins.astype(np.float32), directions.astype(np.float32), output=1)
        hits = np.flatnonzero(found["primID"] >= 0)
        points = Points(self, hits, found["primID"], origins, directions)
        # of the whole film, so that what is drawn at random does not hang on tiles
        pixel, sample = np.divmod(hits, film.samples)
        points.pixels = (
            (y + pixel // width) * film.width + x + pixel % width
        ) * film.samples + sample
        points.fine = self._texture_points(points, found["primID"], directions)
        points.footprints = self._footprints(points, found["primID"], directions)
        radiance = np.zeros((len(hits), 3))
        if len(hits):
            slices = {number: self._slice(number, points) for number in self.sliced}
            for light in self.scene.lights:
                self._add_light(light, points, slices, radiance)
            for number, thing in enumerate(self.scene.objects):
                if thing.dressing is not None and thing.dressing.skies:
                    self._add_skies(number, points, radiance)
        picture = np.empty((width * height, len(LAYERS)))
        # depth along the camera's axis, as compositing programs expect it
        depth = points.depth * (directions[hits] @ camera.axes[2])
        kernels.resolve(
            hits, film.samples, radiance, depth, points.normal, points.texels(), picture
        )
        self._add_environments(directions, found["primID"] < 0, picture)
        if self.scene.background is not None:
            picture[:, :3] += (1 - picture[:, 3:4]) * self.scene.background
            picture[:, 3] = 1
        with np.errstate(over="ignore"):  # infinite, and found by who takes the picture
            return picture.reshape(height, width, -1).astype(np.float32)

    def _add_environments(self, directions, missed, picture):
        """Show the visible environments where rays have hit nothing."""
        shown = [e for e in self.scene.environments if e.visible]
        if not shown:
            return
        missed = np.flatnonzero(missed)
        seen = sum(e.radiance(directions[missed]) for e in shown)
        pixel = missed // self.scene.film.samples
        for c in range(3):
            total = np.bincount(pixel, seen[:, c], len(picture))
            picture[:, c] += total / self.scene.film.samples
        picture[:, 3] = 1

    def _slice(self, number, points):
        """Slices of all look-ups of an object, and the point of each."""
        thing = self.scene.objects[number]
        mine = np.flatnonzero(points.thing == number)
        row, col, _, at_o, _, target, _ = self._look_up(thing, mine, points, points.toward_eye)
        filtered = points.footprints[number]
        if filtered is not None:
            return filtered.slices(at_o), target
        return self.sliced[number].slices(row, col, at_o), target

    def _add_light(self, light, points, slices, radiance):
        """Add one light's share to the radiance of all points."""
        n = len(points.hits)
        w_i, irradiance = np.empty((n, 3)), np.empty((n, 3))
        lit, far = np.empty(n, np.int64), np.empty(n, np.float32)
        origin, toward = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
        count = kernels.light_rays(
            light.directional, light.place, light.power, points.start, points.point,
            points.normal, w_i, irradiance, lit, origin, toward, far,
        )  # fmt: skip
        blocked = self.tree.run(origin[:count], toward[:count], dists=far[:count], query="OCCLUDED")
        lit = lit[:count][blocked < 0]
        owner = points.thing[lit]
        for number, thing in enumerate(self.scene.objects):
            mine = lit[owner == number]
            if thing.dressing is None:
                kernels.add_diffuse(mine, thing.albedo, points.normal, w_i, irradiance, radiance)
            elif len(mine) and light.environment not in thing.dressing.skies:
                lookups = self._look_up(thing, mine, points, w_i)
                row, col, at_i, at_o, blend, target, _ = lookups
                values = np.empty_like(at_i)
                filtered = points.footprints[number]
                if number in slices:
                    sliced, belongs = slices[number]
                    sliced.shade(_of_points(belongs, mine, n), at_i, values)
                elif filtered is not None:
                    filtered.shade(_of_points(filtered.target, mine, n), at_i, at_o, values)
                else:
                    thing.dressing.shader.shade(row, col, at_i, at_o, values)
                kernels.add_lookups(values, blend, target, irradiance, radiance)

    def _add_skies(self, number, points, radiance):
        """Add the light of environments that one object takes in the frequency domain."""
        thing, filtered = self.scene.objects[number], points.footprints[number]
        mine = np.flatnonzero(points.thing == number)
        if not len(mine):
            return
        n = len(points.hits)
        # the rows s, t, n of a look-up's frame are the scene's axes seen in it
        frames = []
        for axis in np.eye(3):
            along = np.ascontiguousarray(np.broadcast_to(axis, (n, 3)))
            row, col, at_i, at_o, blend, target, _ = self._look_up(thing, mine, points, along)
            frames.append(at_i)
        frames = np.ascontiguousarray(np.stack(frames, axis=2))
        values, full = np.empty_like(at_o), np.full((n, 3), np.pi)
        for sky in thing.dressing.skies.values():
            visibility = np.ones(n, np.float32)
            if sky.occlusion_rays:
                visibility[mine] = self._open_share(points, mine, sky.occlusion_rays)
            if filtered is not None:
                filtered.shade_sky(sky, frames, at_o, values, visibility[target])
            else:
                sky.shade(row, col, frames, at_o, values, visibility[target])
            kernels.add_lookups(values, blend, target, full, radiance)

    def _open_share(self, points, mine, rays):
        """Share (n,) float32 of rays spread by the cosine about the normals of some points that meet nothing."""
        origin, toward = (np.empty((len(mine) * rays, 3), np.float32) for _ in range(2))
        pixels = points.pixels[mine]
        kernels.cosine_rays(
            points.start, points.normal, mine, pixels, rays, self.seed, origin, toward
        )
        far = np.full(len(origin), 1e30, np.float32)
        blocked = self.tree.run(origin, toward, dists=far, query="OCCLUDED") >= 0
        return 1 - blocked.reshape(-1, rays).mean(axis=1, dtype=np.float32)

    def _look_up(self, thing, lit, points, w_i):
        """Coordinates, light and view in the sample's frame, share, point and corner of the look-ups that points of an object need."""
        dress = thing.dressing
        fine = points.fine.get(id(thing))
        seen = points
        if fine is not None:
            lit, seen, w_i = _of_points(fine.parent, lit, len(points.hits)), fine, w_i[fine.parent]
        n = kernels.count_lookups(lit, seen.face, dress.weight, dress.coherent)
        row, col, blend = (np.empty(n, np.float32) for _ in range(3))
        at_i, at_o = (np.empty((n, 3), np.float32) for _ in range(2))
        target, corner = np.empty(n, np.int64), np.empty(n, np.int8)
        n = kernels.gather_lookups(
            lit, seen.face, seen.share, seen.normal, seen.facing, seen.toward_eye, w_i,
            thing.faces, dress.row, dress.col, dress.weight, dress.axis, dress.coherent,
            dress.rows, dress.cols, dress.toroidal, row, col, at_i, at_o, blend, target, corner,
        )  # fmt: skip
        if fine is not None:
            blend[:n] *= fine.weight[target[:n]]
            target[:n] = fine.parent[target[:n]]
        return tuple(a[:n] for a in (row, col, at_i, at_o, blend, target, corner))

    def _steps(self, points, prim, directions):
        """Steps on the tangent planes of points; see `footprint_kernels.film_steps`."""
        film, camera = self.scene.film, self.scene.camera
        over = np.empty((len(points.hits), 3)), np.empty((len(points.hits), 3))
        film_steps(
            points.hits, prim, directions, points.depth, self.vertices, self.faces, camera.axes,
            2 * camera.extent[0] / film.width, -2 * camera.extent[1] / film.height, camera.perspective,
            *over,
        )  # fmt: skip
        return over

    def _film_offsets(self, points):
        """Offset (n, 2) of points' rays in their pixels, and its strata; see `footprint_kernels.film_offsets`."""
        n = len(points.hits)
        offset, stratum = np.empty((n, 2)), np.empty((n, 2), np.int64)
        film_offsets(
            points.pixels, *strata(self.scene.film.samples), self.table, self.seed, offset, stratum
        )
        return offset, stratum

    def _texture_points(self, points, prim, directions):
        """The `Points` at which mapped objects are looked up, by the identity of the object, where they are others than its own.

        A map's neighbouring texels are not the sample's: what a ray covers of it is found by further rays, without shadows of
        their own, until these are about half a texel apart.
        """
        n, found = len(points.hits), {}
        mapped = [
            number for number, thing in enumerate(self.scene.objects)
            if thing.dressing is not None and thing.dressing.pyramid is not None and thing.dressing.mapped
        ]  # fmt: skip
        if not mapped or not n:
            return found
        film, camera = self.scene.film, self.scene.camera
        rows, cols = strata(film.samples)
        over = self._steps(points, prim, directions)
        offset, _ = self._film_offsets(points)
        for number in mapped:
            thing = self.scene.objects[number]
            mine = np.flatnonzero(points.thing == number)
            across, down = np.empty(len(mine), np.int64), np.empty(len(mine), np.int64)
            count = count_texture_rays(
                mine, *over, float(thing.dressing.texels_per_unit), rows, cols, across, down
            )
            if count == len(mine):
                continue
            parent = np.empty(count, np.int64)
            origins, toward = np.empty((count, 3)), np.empty((count, 3))
            texture_rays(
                points.pixels, mine, across, down, rows, cols, film.width, film.height, self.table,
                camera.position, camera.axes, np.array(camera.extent), camera.perspective, offset, parent,
                origins, toward,
            )  # fmt: skip
            hit = self.tree.run(origins.astype(np.float32), toward.astype(np.float32), output=1)[
                "primID"
            ]
            first, last = self.first_face[number], self.first_face[number + 1]
            good = (hit >= first) & (hit < last)
            # where none meets the object, the point's own ray does
            lost = np.flatnonzero(np.bincount(parent[good], minlength=n)[mine] == 0)
            if len(lost):
                starts = np.cumsum(across * down) - across * down
                at = starts[lost]
                own = points.hits[mine[lost]]
                toward[at], hit[at], good[at] = directions[own], prim[own], True
                origins[at] = points.point[mine[lost]] - toward[at]
            fine = Points(self, np.flatnonzero(good), hit, origins, toward)
            fine.parent = parent[good]
            fine.weight = (1 / np.bincount(fine.parent, minlength=n)[fine.parent]).astype(
                np.float32
            )
            fine.over = self._steps(fine, hit, toward)
            place = np.searchsorted(mine, fine.parent)
            fine.over = fine.over[0] / across[place, None], fine.over[1] / down[place, None]
            found[id(thing)] = fine
        return found

    def _footprints(self, points, prim, directions):
        """The `Footprints` of each object's look-ups at all its points; None where nothing is filtered."""
        found = [None] * len(self.scene.objects)
        filtered = [
            number
            for number, thing in enumerate(self.scene.objects)
            if thing.dressing is not None and thing.dressing.pyramid is not None
        ]
        if not filtered or not len(points.hits):
            return found
        n = len(points.hits)
        over, on_film = self._steps(points, prim, directions), None
        variance = filter_variance(self.table)
        for number in filtered:
            thing = self.scene.objects[number]
            mine = np.flatnonzero(points.thing == number)
            fine = points.fine.get(id(thing))
            steps = over if fine is None else self._of_parents(fine, n)
            widest = widest_square(mine, *steps) * thing.dressing.texels_per_unit**2
            if widest * variance <= LEAST_VARIANCE:
                continue  # all are points: nothing is spent on them
            if on_film is None:
                on_film = self._film_offsets(points)
            row, col, at_x, _, _, target, corner = self._look_up(thing, mine, points, steps[0])
            at_y = self._look_up(thing, mine, points, steps[1])[2]
            if fine is not None:
                corner[:] = np.maximum(corner, 0)  # texture rays are where they should be
            made = Footprints(
                thing.dressing.pyramid, row, col, target, corner, at_x, at_y,
                thing.dressing.texels_per_unit, *on_film, self.parts, variance,
            )  # fmt: skip
            if not made.points:
                found[number] = made
        return found

    @staticmethod
    def _of_parents(fine, n):
        """The steps of texture rays, of one of each point's."""
        steps = np.zeros((n, 3)), np.zeros((n, 3))
        for out, over in zip(steps, fine.over, strict=True):
            out[fine.parent] = over
        return steps


class Points:
    """The hits of a tile's rays; see `kernels.surface_points` for the arrays."""

    def __init__(self, renderer, hits, prim, origins, directions):
        n = len(hits)
        self.renderer = renderer
        self.hits = hits
        self.share, self.point, self.start, self.normal = (np.empty((n, 3)) for _ in range(4))
        self.facing, self.depth = np.empty(n), np.empty(n)
        kernels.surface_points(
            hits, prim, origins, directions,
            renderer.vertices, renderer.faces, renderer.normals,
            self.share, self.point, self.start, self.normal, self.facing, self.depth,
        )  # fmt: skip
        self.toward_eye = -directions[hits]
        self.thing = np.searchsorted(renderer.first_face, prim[hits], side="right") - 1
        self.face = prim[hits] - renderer.first_face[self.thing]

    def texels(self):
        """Sample coordinates (n, 2) of all points, -1 where there are none."""
        texel = np.full((len(self.hits), 2), -1.0)
        for number, thing in enumerate(self.renderer.scene.objects):
            d = thing.dressing
            if d is not None:
                kernels.texel_coordinates(
                    np.flatnonzero(self.thing == number), self.face, self.share, thing.faces, d.row,
                    d.col, d.weight, d.coherent, d.rows, d.cols, d.toroidal, texel,
                )  # fmt: skip
        return texel


def render(scene, *, seed=0, threads=1, on_progress=None):
    """Render a Scene.

    Parameters
    ----------
    scene : Scene
    seed : int
    threads : int
        Never changes the result.
    on_progress : callable, optional
        Called with (tiles done, tiles).

    Returns
    -------
    (height, width, 10) float32
        The layers named by `LAYERS`: linear radiance with alpha (coverage) multiplied in, depth along the camera's
        axis (0 where nothing is hit), unit shading normal, and sample coordinates (-1 where there are none).
    """
    renderer = Renderer(scene, seed)
    tiles = renderer.tiles()
    picture = np.empty((scene.film.height, scene.film.width, len(LAYERS)), np.float32)
    done = zip(tiles, ordered_map(renderer.tile, tiles, threads), strict=True)
    with single_threaded_blas():
        for number, ((x, y, width, height), pixels) in enumerate(done):
            picture[y : y + height, x : x + width] = pixels
            if on_progress:
                on_progress(number + 1, len(tiles))
    return picture
