"""From a specification to a patch: the structure, and the material of each of its parts."""

import numpy as np

from btfpipe.errors import InputError
from btfpipe.sample.transfer import decode
from btfpipe.simulation.meshes import MESHES
from btfpipe.simulation.noise import fractal_noise
from btfpipe.simulation.patch import DEEPEST, Patch, height_field
from btfpipe.simulation.reliefs import RELIEFS, Relief
from btfpipe.simulation.tiles import TileMesh, smooth_corners, split

_GREY = np.array([0.2126, 0.7152, 0.0722])  # luminance of linear Rec. 709


def build_patch(spec, files):
    """Make the Patch of a specification.

    Parameters
    ----------
    spec : dict
        Of `read_spec`.
    files : object
        Reads what the specification names: ``picture(name)`` returns (rows, cols, channels), ``mesh(name)`` returns
        vertices (n, 3), faces (m, 3), part (m,) and the parts' names.

    Raises
    ------
    InputError
        If a part lacks a material or a file cannot be used.
    """
    ((kind, parameters),) = spec["structure"].items()
    rows, cols = spec["texels"]
    scale = spec["texels_per_mm"]
    size = (rows / scale, cols / scale)
    for name, value in parameters.items():
        if name.endswith("_mm") and value > DEEPEST * max(size):
            raise InputError(
                f"structure: {name} of {kind} is {value:g} over a tile of {size[0]:g} x {size[1]:g} mm; expected at most"
                f" {DEEPEST} times its side."
            )
    rng = np.random.default_rng([spec["seed"], 0])
    fine = spec["vertices_per_texel"]
    if kind == "obj":
        mesh = split(_read_mesh(files, parameters["file"]), 2 / (fine * scale))
        return _tiled(spec, files, mesh, parameters["crease_deg"], size)
    if kind in MESHES:
        return _tiled(
            spec, files, MESHES[kind](size, 2 / (fine * scale), rng, **parameters), 180, size
        )
    t, s = np.meshgrid(
        np.arange(rows * fine) / (rows * fine),
        np.arange(cols * fine) / (cols * fine),
        indexing="ij",
    )
    if kind == "picture":
        relief = _pictured(t, s, files, **parameters)
    else:
        relief = RELIEFS[kind](t, s, size, rng, **parameters)
    albedo, roughness, f0 = painted(spec, files, relief, t, s, size)
    return height_field(relief.height * scale, albedo, roughness, f0, (rows, cols))


def _read_mesh(files, file):
    vertices, faces, part, names = files.mesh(file)
    flat = np.zeros(len(vertices), int)
    return TileMesh(vertices, faces, part, flat, flat, names)


def _tiled(spec, files, mesh, crease_deg, size):
    """Patch of a TileMesh: corners with one normal and one material share a row of the tables."""
    group, normals = smooth_corners(mesh, size, crease_deg)
    # a vertex for each (vertex, group) pair that occurs
    pairs, corner = np.unique(
        np.stack([mesh.faces.ravel(), group.ravel()], axis=1), axis=0, return_inverse=True
    )
    faces = corner.reshape(-1, 3)
    part, first = np.zeros(len(normals), int), np.zeros(len(normals), int)
    part[group.ravel()] = np.repeat(mesh.part, 3)
    first[pairs[::-1, 1]] = pairs[::-1, 0]
    places = mesh.vertices[first]
    t, s = places[:, 1] / size[0] % 1, places[:, 0] / size[1] % 1
    relief = Relief(places[:, 2], part, mesh.element[first], mesh.fibre[first], mesh.parts)
    return Patch(
        tuple(spec["texels"]), mesh.vertices[pairs[:, 0]] * spec["texels_per_mm"], faces, pairs[:, 1],
        normals, *painted(spec, files, relief, t, s, size),
    )  # fmt: skip


def _pictured(t, s, files, *, file, height_mm):
    grey = _read(files, file)
    grey = grey[..., 0] if grey.shape[-1] < 3 else grey[..., :3] @ _GREY
    height = height_mm * _look_up(grey[..., None], t, s)[..., 0]
    flat = np.zeros(t.shape, int)
    return Relief(height, flat, flat, np.zeros(t.shape), ("surface",))


def _read(files, file):
    """A picture as floats, integers scaled to [0, 1]."""
    picture = files.picture(file)
    top = np.iinfo(picture.dtype).max if picture.dtype.kind == "u" else 1
    return picture / np.float64(top)


def _look_up(picture, t, s):
    """Linear interpolation of a periodic picture (rows, cols, channels) at fractions t (upwards), s."""
    from scipy.ndimage import map_coordinates

    rows, cols = picture.shape[:2]
    row, col = (1 - t) * rows - 0.5, s * cols - 0.5
    return np.stack(
        [
            map_coordinates(c, [row, col], order=1, mode="grid-wrap")
            for c in np.moveaxis(picture, -1, 0)
        ],
        axis=-1,
    )


def painted(spec, files, relief, t, s, size):
    """Albedo (..., 3), roughness (...) and f0 (..., 3) over places (t, s) with a Relief's parts."""
    parts = spec["parts"]
    ((kind, _),) = spec["structure"].items()
    _match(kind, relief.parts, parts)
    albedo = np.zeros((*t.shape, 3))
    roughness, f0 = np.zeros(t.shape), np.zeros((*t.shape, 3))
    for index, name in enumerate(relief.parts):
        material = parts[name]
        at = relief.part == index
        rng = np.random.default_rng([spec["seed"], 1, index])
        cells = tuple(max(round(length / material["mottle_mm"]), 2) for length in size)
        mottle = fractal_noise(rng, cells, t[at], s[at])
        colour = _colour(material["albedo"], files, relief.element[at], t[at], s[at], rng)
        change = (1 + material["mottle"] * mottle) * (1 + material["streaks"] * relief.fibre[at])
        albedo[at] = np.clip(colour * change[:, None], 0, 1)
        rough = _value(material["roughness"], files, t[at], s[at])
        roughness[at] = np.clip(rough.mean(axis=-1), 0.05, 1)
        f0[at] = np.clip(_value(material["f0"], files, t[at], s[at]), 0, 1)
    return albedo, roughness, f0


def _match(kind, expected, given):
    """Refuse a specification whose parts are not those of its structure."""
    for name in expected:
        if name not in given:
            raise InputError(
                f"parts: no material for {name!r}; {kind} has the parts {', '.join(expected)}."
            )
    for name in given:
        if name not in expected:
            raise InputError(
                f"parts: {name!r} is not a part of {kind}, which has {', '.join(expected)}."
            )


def _colour(albedo, files, element, t, s, rng):
    if isinstance(albedo, dict):
        picture = _read(files, albedo["picture"])[..., :3]
        return _look_up(decode(picture, "srgb"), t, s) + np.zeros(3)
    if isinstance(albedo, str) or not isinstance(albedo[0], str | list):
        return _linear(albedo) + np.zeros((len(t), 1))
    palette = np.array([_linear(colour) for colour in albedo])
    if len(element) == 0:
        return np.zeros((0, 3))
    # every colour in turn, shuffled: a small palette is never drawn lopsided
    count = element.max() + 1
    draw = rng.permutation(np.arange(count) % len(palette))
    return palette[draw[element]]


def _linear(colour):
    if isinstance(colour, str):
        return decode(np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255, "srgb")
    return np.array(colour, float)


def _value(thing, files, t, s):
    """A number, a triple or a picture as linear values (n, 3)."""
    if isinstance(thing, dict):
        picture = _read(files, thing["picture"])
        picture = picture[..., :3] if picture.shape[-1] >= 3 else picture[..., :1]
        return _look_up(picture, t, s) + np.zeros(3)
    return np.asarray(thing, float) + np.zeros((len(t), 3))
