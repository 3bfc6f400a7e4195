"""What a render takes of private memory, counted from shapes before the work.

Mapped files are not private: the system takes their pages back when it wants to. The constants were measured (RssAnon)
and err on the safe side. Compiling, which only the first render of an installation does, takes some 50 MB more.
"""

import math
from dataclasses import dataclass

from btfpipe.compression import shading_needs
from btfpipe.errors import InputError, amount
from btfpipe.rendering import objects
from btfpipe.rendering.description import naming_entry
from btfpipe.rendering.environment import KEPT_PIXEL_BYTES, PIXEL_BYTES
from btfpipe.rendering.footprint import PROBES
from btfpipe.rendering.footprint_kernels import MOST_TEXTURE_RAYS
from btfpipe.rendering.renderer import LAYERS, tile_side

PROCESS_BYTES = 120 << 20  # Python, its libraries and compiled kernels
_RAY_BYTES = 530  # origin, direction, hit, point, light
_LOOKUP_BYTES = 80  # coordinates, directions and values
_FOOTPRINT_BYTES = 130  # of a look-up that is filtered: its strata's parts
_PROBE_BYTES = 150  # of those evaluated at a time
_SLICED_BYTES = 200  # of a look-up with a slice, beside the slice
_OCCLUSION_BYTES = 48  # a ray of those that see how much of the sky is open
_TILE_PIXEL_BYTES = 200  # sums and layers of a tile, and of finished tiles that wait for their turn
_FILM_BYTES = 4 * len(LAYERS)  # a pixel


@dataclass
class Part:
    """What takes memory.

    Attributes
    ----------
    name : str
    kept : int
        Bytes from loading to the end.
    loading : int
        Further bytes while it is loaded; parts are loaded one after the other.
    rendering : int
        Further bytes from then on.
    instead : str
        What would take less.
    """

    name: str
    kept: int = 0
    loading: int = 0
    rendering: int = 0
    instead: str = ""


def plan_threads(parts, tile, threads, memory):
    """How many threads render within the memory.

    Parameters
    ----------
    parts : list of Part
    tile : int
        Bytes that each thread takes.
    threads : int
        At most.
    memory : int
        Bytes.

    Raises
    ------
    InputError
        If the memory is not enough for one; it says what takes how much.
    """
    parts = [Part("the program itself", PROCESS_BYTES), *parts]
    fixed = sum(part.kept + part.rendering for part in parts)
    largest = max(parts, key=lambda part: part.loading)
    loading = sum(part.kept for part in parts) + largest.loading
    if max(loading, fixed + tile) <= memory:
        return min(threads, (memory - fixed) // tile)
    if loading > fixed + tile:
        shares = [(part, part.kept + part.loading * (part is largest)) for part in parts]
    else:
        shares = [(part, part.kept + part.rendering) for part in parts]
        shares.append((Part("a tile of pixels in work", instead="fewer samples a pixel"), tile))
    shares.sort(key=lambda share: -share[1])
    listed = ", ".join(f"{part.name} {amount(size)}" for part, size in shares if size >= 1 << 20)
    need = sum(size for _, size in shares)
    instead = next(part.instead for part, _ in shares if part is not parts[0])
    raise InputError(
        f"rendering takes {amount(need)} of memory and --memory allows {amount(memory, math.floor)}: {listed}. Pass --memory"
        f" {math.ceil(need / 2**20)}M{instead and ', or take ' + instead}."
    )


def parts_of_scene(description, film, once, read_mesh=None, read_picture=None):
    """What a scene takes, and what each thread that renders it.

    Parameters
    ----------
    description : dict
    film : Film
    once : callable
        ``once(opener, *arguments)`` opens a file, or gives what it gave before.
    read_mesh, read_picture : callable, optional
        See `load_scene`.

    Returns
    -------
    parts : list of Part
    tile : int
        Bytes.
    """
    parts = [
        Part(
            f"the film of {film.width} x {film.height} pixels",
            rendering=_FILM_BYTES * film.width * film.height,
            instead="a smaller film",
        )
    ]
    lights = description["lights"]
    for number, light in enumerate(lights):
        if light["type"] == "environment" and read_picture is not None:
            with naming_entry("lights", number):
                parts.append(_map_part(light["map"], once(read_picture, light["map"])))
    looks, shaders, levels, making = [], {}, set(), 0
    for number, entry in enumerate(description["objects"]):
        if "ground" in entry:
            continue
        with naming_entry("objects", number):
            mesh, layers = _mesh_part(entry, once, read_mesh)
            parts.append(mesh)
            if "model" in entry:
                needs = once(shading_needs, entry["model"])
                # a patch that shows the sample itself is one piece; over a map each of three vertices may look up its own
                looks.append((3 * layers if "map" in entry else 1, needs, "map" in entry))
                shader = tuple(str(entry.get(k)) for k in ("model", "material", "interpolation"))
                if shader not in shaders:
                    instead = needs.instead
                    if film.texture_filter and not instead:
                        instead = "--no-texture-filter"
                    shaders[shader] = Part(entry["model"], needs.kept, needs.loading, 0, instead)
                    parts.append(shaders[shader])
                # levels of detail are made one after the other, once for all that shows a sample itself and once a map
                worn = shader, *(str(entry[k]) for k in ("map", "surface", "plane") if "map" in entry and k in entry)  # fmt: skip
                if film.texture_filter and worn not in levels:
                    levels.add(worn)
                    shaders[shader].rendering += needs.levels
                    making = max(making, needs.making_levels)
    if making:
        parts.append(Part("making levels of detail", 0, 0, making, "--no-texture-filter"))
    return parts, _tile_bytes(film, lights, looks)


def _map_part(name, picture):
    rows, cols = picture.shape[:2]
    kept = KEPT_PIXEL_BYTES * rows * cols
    loading = PIXEL_BYTES * rows * cols - kept
    return Part(f"{name} of {cols} x {rows} pixels", kept, loading, 0, "a smaller map")


def _mesh_part(entry, once, read_mesh):
    """The Part of an object's triangles and of the coordinates that they wear, and the layers of these."""
    from btfpipe.surface import Surface
    from btfpipe.synthesis import CoordinateMap

    layers, own = 0, 0
    if "surface" in entry:
        name, level = entry["surface"], once(Surface.open, entry["surface"]).levels[0]
        vertices, faces = len(level.vertices), len(level.faces)
        layers = len(once(CoordinateMap.open, entry["map"]).row)
    elif "mesh" in entry:
        name, mesh = entry["mesh"], once(objects.open_mesh, entry["mesh"], read_mesh)
        vertices, faces = len(mesh[0]), len(mesh[1])
        own = 36 * vertices + 12 * faces
    elif "map" in entry:
        name, coordinates = f"the plane of {entry['map']}", once(CoordinateMap.open, entry["map"])
        layers, (_, cols) = len(coordinates.row), coordinates.domain.get("plane", (0, 0))
        vertices = objects.patch_vertices(entry, cols)
        faces = 2 * vertices
        own = (36 + 12 * layers) * vertices + 12 * faces
    else:
        name, vertices, faces, layers = "a plane", 4, 2, int("model" in entry)
    part = Part(
        name,
        # axes, and in which faces coordinates may be interpolated
        kept=own
        + layers * (12 * vertices + faces)
        + (36 * vertices if "transform" in entry else 0),
        loading=(50 + 65 * layers) * vertices,
        # all meshes as one, and the ray tree
        rendering=60 * vertices + 124 * faces,
        instead="a coarser mesh",
    )
    return part, layers


def _tile_bytes(film, lights, looks):
    """Most bytes that a thread holds for the rays of a tile, of objects with so many look-ups a ray and such needs."""
    count = sum(
        light.get("lights", 64) if light["type"] == "environment" else 1 for light in lights
    )
    skies = [
        light.get("occlusion_rays", 16) for light in lights if light.get("method") == "harmonics"
    ]
    # each ray of a map's may become so many more; fewer of them share a tile
    mapped = film.texture_filter and any(m for _, _, m in looks)
    more = MOST_TEXTURE_RAYS**2 if mapped else 1
    looks = [(n * (more if m else 1), needs) for n, needs, m in looks]
    sliced = [
        (n, needs.slice_bytes)
        for n, needs in looks
        if needs.slice_bytes and count >= needs.many_lights
    ]
    most = max((size for _, size in sliced), default=0)
    ray = _RAY_BYTES * (1 + (more > 1) * more // 2) + _OCCLUSION_BYTES * max(skies, default=0)
    lookup, fixed = _LOOKUP_BYTES, 0
    if film.texture_filter and looks:
        lookup, fixed = _LOOKUP_BYTES + _FOOTPRINT_BYTES, _PROBE_BYTES * PROBES
        fixed += 2 * most * PROBES  # slices of roots, and of values
    plain = ray + lookup * max((n for n, _ in looks), default=1)
    shared = ray + max((n * (lookup + _SLICED_BYTES + size) for n, size in sliced), default=0)
    # slices make tiles smaller, if there are any in the end
    return fixed + max(
        _tile_of(film, 0, plain, mapped), _tile_of(film, most, max(plain, shared), mapped)
    )


def _tile_of(film, slice_bytes, ray_bytes, mapped):
    side = tile_side(film.samples, slice_bytes, mapped)
    pixels = min(side, film.width) * min(side, film.height)
    return pixels * (film.samples * ray_bytes + _TILE_PIXEL_BYTES)
