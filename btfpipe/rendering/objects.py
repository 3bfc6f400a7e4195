"""Objects of a scene: triangles, frames, and either an albedo or a dressing of texel coordinates."""

from dataclasses import dataclass, field

import numpy as np

from btfpipe.compiled import njit
from btfpipe.errors import InputError
from btfpipe.synthesis.coherence import find_coherent

_MOST_VERTICES = 20_000_000
_MOST_ACROSS = 1 << 20  # texels; beyond, single precision leaves too little between them


@dataclass
class Dressing:
    """What a surface wears: texel coordinates at its vertices, and who evaluates them.

    Attributes
    ----------
    row, col, weight : (layers, n) float32
    axis : (layers, n, 3) float32
        The sample's s axis at the vertex, in the scene: the tangent turned by the map's angle.
    coherent : (layers, faces) bool
        Faces inside which the coordinate may be interpolated.
    shader : object
        See `Appearance.shader`.
    rows, cols : int
    toroidal : bool
    model : Appearance
        What the shader evaluates.
    texels_per_unit : float
        Texels per unit of length of the scene.
    mapped : bool
        Whether the coordinates are a map's, with borders between pieces of the sample.
    pyramid : Pyramid or None
        Levels of detail; None if look-ups are not filtered.
    skies : dict
        `HarmonicEnvironment` by the number of the environment, which then lights this surface instead of its directional lights.
    """

    row: np.ndarray
    col: np.ndarray
    weight: np.ndarray
    axis: np.ndarray
    coherent: np.ndarray
    shader: object
    rows: int
    cols: int
    toroidal: bool
    model: object = None
    texels_per_unit: float = 1.0
    mapped: bool = False
    pyramid: object = None
    skies: dict = field(default_factory=dict)


@dataclass
class Thing:
    """Triangles with shading normals, and what is on them.

    Attributes
    ----------
    vertices : (n, 3) float64
    faces : (m, 3) int32
    normals : (n, 3) float32
    dressing : Dressing or None
    albedo : (3,) float32
        Of a diffuse object.
    solid : bool
        Whether a camera could be inside.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    dressing: Dressing | None = None
    albedo: np.ndarray | None = None
    solid: bool = False


def dressed_surface(level, coordinates, appearance, interpolation, name=""):
    """Dress a Surface's finest level by a CoordinateMap.

    Parameters
    ----------
    level : Level
    coordinates : CoordinateMap
    appearance : Appearance
    interpolation : str
    name : str
        What messages call the map.

    Raises
    ------
    InputError
        If the map has another number of elements, was made for a sample of another size, or leaves the sample.
    """
    require_size(coordinates, appearance, name)
    vertices = np.ascontiguousarray(level.vertices, np.float64)
    if coordinates.row.shape[1] != len(vertices):
        raise InputError(
            f"{name}: {coordinates.row.shape[1]} coordinates for a surface of {len(vertices)} vertices; it"
            " was made for another surface."
        )
    faces = np.ascontiguousarray(level.faces, np.int32)
    normals = np.ascontiguousarray(level.normals, np.float32)
    tangents = np.ascontiguousarray(level.tangents, np.float32)
    dressing = dress(
        vertices, faces, normals, tangents, coordinates, appearance, interpolation, name
    )
    return Thing(vertices, faces, normals, dressing, solid=True)


def require_size(coordinates, appearance, name):
    """Refuse a map that was made for a sample of another size than this one's; of another material it may be."""
    size = coordinates.about.get("sample_shape")
    if size is not None and list(size) != list(appearance.shape):
        raise InputError(
            f"{name}: made for a sample of {' x '.join(map(str, size))} texels and the model has"
            f" {' x '.join(map(str, appearance.shape))}; name the model of that sample, or run `btfpipe synthesize`"
            " on this one."
        )


def dress(vertices, faces, normals, tangents, coordinates, appearance, interpolation, name=""):
    """Make the Dressing of any mesh; arguments as in `dressed_surface`."""
    if coordinates.sample_index.max(initial=0) > 0:
        raise InputError(
            f"{name}: it refers to {int(coordinates.sample_index.max()) + 1} samples and the object has one"
            " model."
        )
    rows, cols = appearance.shape
    if not appearance.toroidal:
        for what, values, size in (("row", coordinates.row, rows), ("col", coordinates.col, cols)):
            low, high = float(values.min()), float(values.max())
            if low < -1 or high > size:
                raise InputError(
                    f"{name}: {what} runs from {low:.1f} to {high:.1f} and the model has {size}; the map was"
                    " made for a sample of another size."
                )
    layers = len(coordinates.row)
    cosine, sine = np.cos(coordinates.angle)[..., None], np.sin(coordinates.angle)[..., None]
    bitangents = np.cross(normals, tangents)
    axis = np.ascontiguousarray(cosine * tangents + sine * bitangents, np.float32)
    coherent = np.zeros((layers, len(faces)), np.bool_)
    row, col, weight = (
        np.ascontiguousarray(a, np.float32)
        for a in (coordinates.row, coordinates.col, coordinates.weight)
    )
    for layer in range(layers):
        find_coherent(
            vertices, faces, normals, axis[layer], row[layer], col[layer],
            float(coordinates.texels_per_unit), rows, cols, appearance.toroidal, coherent[layer],
        )  # fmt: skip
    return Dressing(
        row, col, weight, axis, coherent, _shader(appearance, interpolation), rows, cols,
        bool(appearance.toroidal), appearance, float(coordinates.texels_per_unit),
    )  # fmt: skip


def _shader(appearance, interpolation):
    """An appearance's shader, kept with it: objects of one Model share what it holds."""
    made = vars(appearance).setdefault("_shaders", {})
    if interpolation not in made:
        made[interpolation] = appearance.shader(interpolation)
    return made[interpolation]


def plane_frame(plane):
    """Centre, s, t, n (float64) and size of a described plane."""
    center = np.array(plane["center"], float)
    s, t = np.array(plane["s"], float), np.array(plane["t"], float)
    n = np.cross(s, t)
    if np.linalg.norm(n) < 1e-9 * max(np.linalg.norm(s) * np.linalg.norm(t), 1e-30):
        raise InputError("plane: s and t point the same way; t is the picture's up, s its right.")
    n = n / np.linalg.norm(n)
    s = s / np.linalg.norm(s)
    return center, s, np.cross(n, s), n, plane["size"]


def flat(plane, albedo):
    """A diffuse rectangle."""
    center, s, t, n, (width, height) = plane_frame(plane)
    x, y = np.array([-1, 1, 1, -1]) * width / 2, np.array([-1, -1, 1, 1]) * height / 2
    vertices = center + x[:, None] * s + y[:, None] * t
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    normals = np.tile(n.astype(np.float32), (4, 1))
    return Thing(vertices, faces, normals, albedo=np.array(albedo, np.float32))


def patch(
    plane,
    appearance,
    interpolation,
    *,
    coordinates=None,
    texels_per_unit=None,
    repeats=None,
    name="",
):
    """A rectangle that shows the sample itself, or a map over a plane.

    The picture's upper left corner lies at the rectangle's. Texel (0, 0) is centred half a texel inside it.

    Raises
    ------
    InputError
        If more than the whole is asked of something that does not repeat, more texels than there is memory or
        precision for, or the map was made for a sample of another size.
    """
    from btfpipe.synthesis.coordinate_map import CoordinateMap

    center, s, t, n, (width, height) = plane_frame(plane)
    if coordinates is None:
        rows, cols = appearance.shape
        toroidal = appearance.toroidal
    else:
        require_size(coordinates, appearance, name)
        rows, cols = coordinates.domain["plane"]
        toroidal = coordinates.domain.get("toroidal", False)
    if texels_per_unit is None:
        texels_per_unit = cols * (repeats or 1) / width
    elif repeats is not None:
        raise InputError("plane: give texels_per_unit or repeats, not both.")
    across, down = width * texels_per_unit, height * texels_per_unit
    if not toroidal and (across > cols * (1 + 1e-6) or down > rows * (1 + 1e-6)):
        raise InputError(
            f"plane: {across:.1f} x {down:.1f} texels across and down, and there are {cols} x {rows} that do"
            " not repeat; lower texels_per_unit or repeats, or change the size."
        )
    if max(across, down) > _MOST_ACROSS:
        raise InputError(
            f"plane: {across:.4g} x {down:.4g} texels across and down; expected at most {_MOST_ACROSS}. Lower"
            " texels_per_unit or repeats, or the size."
        )
    if coordinates is not None and (across + 2) * (down + 2) > _MOST_VERTICES:
        raise InputError(
            f"plane: {across:.4g} x {down:.4g} texels of a map, which need {(across + 2) * (down + 2):.4g}"
            f" vertices; expected at most {_MOST_VERTICES // 10**6} million. Lower texels_per_unit or repeats,"
            " or the size."
        )
    if coordinates is None:
        x, y = np.array([0, across]), np.array([0, down])
        row, col = y[:, None] - 0.5 + 0 * x, x - 0.5 + 0 * y[:, None]
        angle, weight = np.zeros(4), None
    else:
        # vertices at the texels' centres and at the rectangle's border
        x = np.concatenate([[0], np.arange(0.5, across, 1), [across]])
        y = np.concatenate([[0], np.arange(0.5, down, 1), [down]])
        i, j = (np.clip(a - 0.5, 0, n).round().astype(int) for a, n in ((y, 1e9), (x, 1e9)))
        i, j = np.minimum(i, i[-2]), np.minimum(j, j[-2])
        texel = ((i % rows)[:, None] * cols + (j % cols)).ravel()
        angle = coordinates.angle[:, texel]
        dt = -(y - 0.5 - i)[:, None] + 0 * x
        ds = (x - 0.5 - j) + 0 * y[:, None]
        drow, dcol = (
            ds.ravel() * np.sin(angle) - dt.ravel() * np.cos(angle),
            ds.ravel() * np.cos(angle) + dt.ravel() * np.sin(angle),
        )
        row, col = coordinates.row[:, texel] + drow, coordinates.col[:, texel] + dcol
        weight = coordinates.weight[:, texel]
    corner = center - width / 2 * s + height / 2 * t
    vertices = (
        corner + (x / texels_per_unit)[None, :, None] * s - (y / texels_per_unit)[:, None, None] * t
    ).reshape(-1, 3)
    index = np.arange(len(x) * len(y)).reshape(len(y), len(x))
    a, b, c, d = index[1:, :-1], index[1:, 1:], index[:-1, 1:], index[:-1, :-1]
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3).astype(np.int32)
    normals = np.tile(n.astype(np.float32), (len(vertices), 1))
    tangents = np.tile(s.astype(np.float32), (len(vertices), 1))
    flat_map = CoordinateMap(
        np.reshape(row, (-1, len(vertices))), np.reshape(col, (-1, len(vertices))),
        np.reshape(angle, (-1, len(vertices))), texels_per_unit, {}, weight,
    )  # fmt: skip
    dressing = dress(
        vertices, faces, normals, tangents, flat_map, appearance, interpolation, "plane"
    )
    if coordinates is None:
        dressing.coherent[:] = True
        dressing.toroidal = False  # coordinates run on without a wrap
    return Thing(vertices, faces, normals, dressing)


def patch_vertices(entry, cols):
    """About how many vertices `patch` will have for an entry of a scene with a map of so many columns, at least 4."""
    width, height = entry["plane"]["size"]
    scale = entry.get("texels_per_unit") or cols * entry.get("repeats", 1) / width
    return int((width * scale + 2) * (height * scale + 2))


def transformed(thing, transform):
    """The same Thing scaled, turned and shifted; changes `thing` and returns it."""
    if not transform:
        return thing
    turn = rotation(transform, "transform: ")
    thing.vertices = thing.vertices * transform.get("scale", 1) @ turn.T
    thing.vertices += np.array(transform.get("translate", [0, 0, 0]), float)
    thing.normals = np.ascontiguousarray(thing.normals @ turn.T, np.float32)
    if thing.dressing is not None:
        thing.dressing.axis = np.ascontiguousarray(thing.dressing.axis @ turn.T, np.float32)
        thing.dressing.texels_per_unit /= transform.get("scale", 1)
    return thing


def rotation(settings, where=""):
    """Matrix (3, 3) that turns column vectors as ``rotate_deg`` about ``axis`` says; `where` starts its message."""
    axis = np.array(settings.get("axis", [0, 1, 0]), float)
    if np.linalg.norm(axis) < 1e-12:
        raise InputError(f"{where}axis is zero; give the direction to turn about.")
    axis = axis / np.linalg.norm(axis)
    angle = np.radians(settings.get("rotate_deg", 0))
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@njit(cache=True, nogil=True)
def winding_number(vertices, faces, x, y, z):
    """Solid angle of all faces from a point over 4 pi: 1 inside a closed mesh, 0 outside.

    The angle of a face by van Oosterom and Strackee (1983).
    """
    total = 0.0
    for f in range(len(faces)):
        ax, ay, az = (
            vertices[faces[f, 0], 0] - x,
            vertices[faces[f, 0], 1] - y,
            vertices[faces[f, 0], 2] - z,
        )
        bx, by, bz = (
            vertices[faces[f, 1], 0] - x,
            vertices[faces[f, 1], 1] - y,
            vertices[faces[f, 1], 2] - z,
        )
        cx, cy, cz = (
            vertices[faces[f, 2], 0] - x,
            vertices[faces[f, 2], 1] - y,
            vertices[faces[f, 2], 2] - z,
        )
        a = np.sqrt(ax * ax + ay * ay + az * az)
        b = np.sqrt(bx * bx + by * by + bz * bz)
        c = np.sqrt(cx * cx + cy * cy + cz * cz)
        volume = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
        rest = (
            a * b * c
            + (ax * bx + ay * by + az * bz) * c
            + (bx * cx + by * cy + bz * cz) * a
            + (cx * ax + cy * ay + cz * az) * b
        )
        total += np.arctan2(volume, rest)
    return total / (2 * np.pi)


def open_mesh(path, read_mesh):
    """Vertices, faces and normals of a Surface file or, through `read_mesh`, of a foreign mesh."""
    with open(path, "rb") as file:
        ours = file.read(2) == b"PK"
    if ours:
        from btfpipe.surface import Surface

        level = Surface.open(path).levels[0]
        vertices, faces = np.asarray(level.vertices, np.float64), np.asarray(level.faces, np.int32)
        normals = np.ascontiguousarray(level.normals, np.float32)
    else:
        if read_mesh is None:
            raise InputError(f"{path}: not a surface file; `btfpipe surface` makes one of a mesh.")
        vertices, faces = read_mesh(path)
        vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int32)
        # one vertex a corner, each with its face's normal: no smoothing that the file does not ask for
        vertices = np.ascontiguousarray(vertices[faces.ravel()])
        faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
        edges = vertices[faces]
        across = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
        normals = np.repeat(across, 3, axis=0).astype(np.float32)
    return vertices, faces, normals


def diffuse_mesh(vertices, faces, normals, albedo):
    """A diffuse object of what `open_mesh` gives."""
    return Thing(vertices, faces, normals, albedo=np.array(albedo, np.float32), solid=True)
