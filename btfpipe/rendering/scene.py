"""The Scene: camera, film, lights and objects, loaded and checked against each other."""

from dataclasses import dataclass, field

import numpy as np

from btfpipe.compression import choose_material, open_appearance
from btfpipe.errors import InputError
from btfpipe.rendering import objects
from btfpipe.rendering.camera import FILTER_RADIUS, Camera, make_camera
from btfpipe.rendering.description import naming_entry, read_description
from btfpipe.rendering.environment import Environment
from btfpipe.rendering.memory import parts_of_scene, plan_threads


@dataclass
class Film:
    """Pixels across and down, rays a pixel, the filter that gathers them (radius in pixels), and whether textures are filtered."""

    width: int = 512
    height: int = 512
    samples: int = 16
    filter: str = "gaussian"
    radius: float = 1.5
    texture_filter: bool = True


@dataclass
class Light:
    """A directional or a point light.

    `place` is the unit vector towards it, or its position; `power` the irradiance of a surface that faces it, or its
    intensity in W/sr; `environment` the number of the environment map that it stands for, with others.
    """

    directional: bool
    place: np.ndarray
    power: np.ndarray
    environment: int | None = None


@dataclass
class Scene:
    """All that a picture is made of.

    Attributes
    ----------
    camera : Camera
    film : Film
    lights : list of Light
        Those that stand for environment maps among them.
    objects : list of Thing
    background : (3,) float64 or None
        Radiance where nothing is hit; None is transparent black.
    files : list of Path
        What the scene was loaded from, without the description itself.
    environments : list of Environment
        Those that are visible are seen where nothing is hit.
    threads : int
        That may render it within the memory.
    """

    camera: Camera
    film: Film
    lights: list
    objects: list
    background: np.ndarray | None = None
    files: list | None = None
    environments: list = field(default_factory=list)
    threads: int = 1


def load_scene(
    path,
    bindings=None,
    *,
    film=None,
    read_mesh=None,
    read_picture=None,
    memory=None,
    threads=1,
    seed=0,
):
    """Load a scene's description and all files that it names.

    Parameters
    ----------
    path : path-like
        YAML; see `read_description`.
    bindings : dict, optional
        Files for its placeholders.
    film : dict, optional
        Replaces entries of its film.
    read_mesh : callable, optional
        Path to (vertices, faces) of a foreign mesh file.
    read_picture : callable, optional
        Path to (rows, cols, 3) colours of a picture file, for environment maps.
    memory : int, optional
        Bytes of private memory to stay within; by default nothing is counted.
    threads : int
        That will render, unless the memory is for fewer; each works on a tile.
    seed : int
        Of environment maps sampled at random.

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        As `read_description`; if files do not belong together; if rendering takes more than `memory`; if the
        camera is inside an object.
    """
    description = read_description(path, bindings)
    settings = description.get("film", {}) | {
        k: v for k, v in (film or {}).items() if v is not None
    }
    settings.setdefault("filter", "gaussian")
    settings.setdefault("radius", FILTER_RADIUS[settings["filter"]])
    film = Film(**settings)
    opened = {}

    def once(opener, *arguments):
        key = (opener, *arguments)
        if key not in opened:
            opened[key] = opener(*arguments)
        return opened[key]

    try:
        if memory is not None:
            parts = parts_of_scene(description, film, once, read_mesh, read_picture)
            threads = plan_threads(*parts, threads, memory)
        lights, environments, skies = [], [], {}
        things, grounds, files, pyramids = [], [], [], {}
        for number, light in enumerate(description["lights"]):
            if light["type"] == "environment":
                files.append(light["map"])
                with naming_entry("lights", number):
                    environment = _environment(light, read_picture, opened)
                    lights += _stand_for(environment, len(environments), light, seed)
                    if light.get("method") == "harmonics":
                        skies[number] = len(environments), environment, light
                environments.append(environment)
                if environment.visible and "background" in description:
                    raise InputError(
                        f"background: lights[{number}] shows its map there; leave out background, or give"
                        " visible: false with the light."
                    )
            else:
                lights.append(_light(number, light))
        for number, entry in enumerate(description["objects"]):
            files += [entry[key] for key in ("surface", "map", "model", "mesh") if key in entry]
            if "ground" in entry:
                grounds.append(entry)
                continue
            with naming_entry("objects", number):
                thing = _thing(entry, once, read_mesh)
                things.append(objects.transformed(thing, entry.get("transform")))
                if thing.dressing is not None:
                    thing.dressing.mapped = "map" in entry
                if film.texture_filter and thing.dressing is not None:
                    thing.dressing.pyramid = _pyramid(pyramids, entry, thing, threads)
        for number, sky in skies.items():
            with naming_entry("lights", number):
                _add_sky(things, *sky)
        dressed = [t for t in things if t.dressing is not None] or things
        if not dressed:
            raise InputError("objects: a ground needs something to lie below; add an object.")
        points = np.concatenate([t.vertices for t in dressed])
        camera = make_camera(description["camera"], film.width / film.height, points)
        for number, thing in enumerate(things):
            if thing.solid and _inside(thing, camera.position):
                raise InputError(
                    f"camera: position {_numbers(camera.position)} is inside objects[{number}]; move it out, or"
                    " give direction instead of position for automatic framing."
                )
        up = np.array(description["camera"].get("up", [0, 1, 0]), float)
        things += [_ground(entry, points, up) for entry in grounds]
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    background = description.get("background")
    return Scene(
        camera, film, lights, things,
        None if background is None else np.array(background, float),
        list(dict.fromkeys(files)), environments, threads,
    )  # fmt: skip


def _light(number, light):
    if light["type"] == "point":
        return Light(False, np.array(light["position"], float), np.array(light["intensity"], float))
    direction = np.array(light["direction"], float)
    length = np.linalg.norm(direction)
    if length < 1e-12:
        raise InputError(f"lights[{number}]: direction is zero; it points towards the light.")
    return Light(True, direction / length, np.array(light["irradiance"], float))


def _environment(light, read_picture, opened):
    if read_picture is None:
        raise InputError(f"{light['map']}: no reader of pictures at hand; pass load_scene one.")
    # the Environment keeps one of its own
    picture = opened.pop((read_picture, light["map"]), None)
    if picture is None:
        picture = read_picture(light["map"])
    return Environment(
        picture,
        light.get("projection"),
        intensity=light.get("intensity", 1.0),
        turn=objects.rotation(light),
        visible=light.get("visible", True),
        name=light["map"],
    )


def _stand_for(environment, number, light, seed):
    """The directional lights of an environment."""
    method = light.get("method", "q2tree")
    if method == "harmonics":  # for objects of other Models
        method = "q2tree"
    elif strange := {"terms", "occlusion_rays"} & set(light):
        raise InputError(f"{min(strange)} is of method harmonics; the method is {method}.")
    directions, irradiances = environment.lights(light.get("lights", 64), method, seed)
    return [Light(True, *both, number) for both in zip(directions, irradiances, strict=True)]


def _add_sky(things, number, environment, light):
    """Light the objects whose Model is made of harmonics by an environment's own."""
    from btfpipe.compression.harmonics import HarmonicsModel
    from btfpipe.rendering.harmonic_light import HarmonicEnvironment, project_environment

    dressings = [t.dressing for t in things if t.dressing is not None]
    dressings = [d for d in dressings if isinstance(d.model, HarmonicsModel)]
    if not dressings:
        raise InputError(
            "method harmonics needs an object with a Model of that method (`btfpipe compress --method harmonics`);"
            " there is none. Take method q2tree."
        )
    terms, rays = light.get("terms", 169), light.get("occlusion_rays", 16)
    coefficients = project_environment(environment, terms)
    for dressing in dressings:
        dressing.skies[number] = HarmonicEnvironment(dressing.model, coefficients, terms, rays)


def _material(once, entry):
    appearance = once(open_appearance, entry["model"])
    return once(choose_material, appearance, entry.get("material"), entry["model"])


def _pyramid(pyramids, entry, thing, threads):
    """Levels of detail of what an object wears; objects of one Model share them, those with a map of their own do not."""
    from btfpipe.rendering.pyramid import Pyramid, usage

    dressing = thing.dressing
    key = (id(dressing.shader), entry.get("map"), entry.get("surface"), str(entry.get("plane")))
    if "map" not in entry:
        key = id(dressing.shader)
    if key not in pyramids:
        weight = usage(thing) if "map" in entry else None
        interpolation = entry.get("interpolation", "barycentric")
        pyramids[key] = Pyramid(
            dressing.model, dressing.shader, interpolation, weight=weight, name=entry["model"], threads=threads
        )  # fmt: skip
    return pyramids[key]


def pyramids(scene):
    """The levels of detail of a Scene's objects, each once."""
    found = {id(t.dressing.pyramid): t.dressing.pyramid for t in scene.objects if t.dressing}
    return [pyramid for pyramid in found.values() if pyramid is not None]


def texture_filter_facts(scene):
    """What the levels of detail of a rendered Scene took: bytes, seconds, errors of those that are an SVD; warnings as sentences."""
    from btfpipe.rendering.pyramid import ERROR_BOUND

    made = [pyramid for pyramid in pyramids(scene) if pyramid.made]
    facts = {
        "levels_bytes": sum(pyramid.nbytes for pyramid in made),
        "levels_seconds": round(sum(pyramid.seconds for pyramid in made), 3),
        "levels_of": [{"model": str(p.name), "levels": p.top, "bytes": p.nbytes, **p.facts} for p in made],
        "warnings": [
            f"{p.name}: its levels of detail are off by {100 * p.facts['relative_error']:.2g} % of the averaged texels with"
            f" {p.facts['terms']} terms; expected at most {100 * ERROR_BOUND:g} %. --no-texture-filter does without them"
            for p in made
            if p.facts.get("relative_error", 0) > ERROR_BOUND
        ],
    }  # fmt: skip
    return facts


def _thing(entry, once, read_mesh):
    """Load one object; Models, Surfaces and their shaders are opened once."""
    from btfpipe.surface import Surface
    from btfpipe.synthesis import CoordinateMap

    interpolation = entry.get("interpolation", "barycentric")
    if "surface" in entry:
        surface = once(Surface.open, entry["surface"])
        coordinates = once(CoordinateMap.open, entry["map"])
        belongs = coordinates.domain.get("surface")
        if belongs is None:
            raise InputError(f"{entry['map']}: a map over a plane; this object is a surface.")
        if belongs != surface.digest:
            raise InputError(
                f"{entry['map']}: made for surface {belongs}; {entry['surface']} is {surface.digest}. Run"
                " `btfpipe synthesize` on this surface, or name the other."
            )
        appearance = _material(once, entry)
        return objects.dressed_surface(
            surface.levels[0], coordinates, appearance, interpolation, entry["map"]
        )
    if "plane" in entry and "model" in entry:
        coordinates = None
        if "map" in entry:
            coordinates = once(CoordinateMap.open, entry["map"])
            if "plane" not in coordinates.domain:
                raise InputError(f"{entry['map']}: a map over a surface; this object is a plane.")
        return objects.patch(
            entry["plane"],
            _material(once, entry),
            interpolation,
            coordinates=coordinates,
            texels_per_unit=entry.get("texels_per_unit"),
            repeats=entry.get("repeats"),
            name=entry.get("map", ""),
        )
    if "plane" in entry:
        return objects.flat(entry["plane"], entry["albedo"])
    mesh = once(objects.open_mesh, entry["mesh"], read_mesh)
    return objects.diffuse_mesh(*mesh, entry["albedo"])


def _ground(entry, points, up):
    """A diffuse square below all points, across `up`."""
    up = up / np.linalg.norm(up)
    low, high = points.min(axis=0), points.max(axis=0)
    middle, diagonal = (low + high) / 2, np.linalg.norm(high - low)
    settings = entry["ground"] or {}
    bottom = (points @ up).min() - settings.get("gap", 0)
    side = np.cross(up, [1, 0, 0] if abs(up[0]) < 0.9 else [0, 1, 0])
    size = settings.get("size", 40) * diagonal
    plane = {
        "center": middle + (bottom - middle @ up) * up,
        "s": side,
        "t": np.cross(up, side),
        "size": [size, size],
    }
    return objects.flat(plane, entry["albedo"])


def _inside(thing, position):
    if not (
        (position > thing.vertices.min(axis=0)) & (position < thing.vertices.max(axis=0))
    ).all():
        return False
    return abs(objects.winding_number(thing.vertices, thing.faces, *position)) > 0.5


def _numbers(vector):
    return "[" + ", ".join(f"{x:.4g}" for x in vector) + "]"
