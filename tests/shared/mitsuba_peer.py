"""Scenes of diffuse objects rendered by Mitsuba 3, for tests and for the numbers in docs/results.md."""

import numpy as np


def mitsuba():
    """The Mitsuba module with the variant `scalar_rgb`, which needs no LLVM."""
    import mitsuba

    mitsuba.set_variant("scalar_rgb")
    return mitsuba


def peer_pictures(scene, samples=64):
    """Render a loaded Scene in Mitsuba, once for each light: linear colour (lights, height, width, 3) float32.

    Mitsuba draws one light at random for each path; pictures of single lights have no such noise.

    Parameters
    ----------
    scene : btfpipe.rendering.scene.Scene
        Of objects with an albedo, directional and point lights. The film's filter is taken for a box.
    samples : int
        Rays a pixel, stratified: a square number.
    """
    mi = mitsuba()
    parts = {"type": "scene", "sensor": _sensor(mi, scene, samples)}
    # what is seen directly and lit directly
    parts["integrator"] = {"type": "path", "max_depth": 2}
    for number, thing in enumerate(scene.objects):
        parts[f"object{number}"] = peer_mesh(mi, thing, f"object{number}")
    pictures = [
        np.array(mi.render(mi.load_dict(parts | {"light": _emitter(light)})))[..., :3]
        for light in scene.lights
    ]
    return np.stack(pictures)


def peer_picture_under_map(scene, values, rotate_deg=0.0, samples=64):
    """Render a Scene's objects under a latitude-longitude map alone: linear colour (height, width, 3) float32.

    The map is sampled at random there, and its first row lies on the pole instead of half a pixel from it.
    """
    mi = mitsuba()
    parts = {"type": "scene", "sensor": _sensor(mi, scene, samples)}
    parts["integrator"] = {"type": "path", "max_depth": 2, "hide_emitters": True}
    for number, thing in enumerate(scene.objects):
        parts[f"object{number}"] = peer_mesh(mi, thing, f"object{number}")
    parts["light"] = {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.asarray(values, np.float32)),
        "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 180 + rotate_deg),
    }
    return np.array(mi.render(mi.load_dict(parts)))[..., :3]


def peer_mesh(mi, thing, name):
    """A mesh of the same vertices, faces and shading normals, lit on both sides."""
    reflectance = {"type": "rgb", "value": [float(a) for a in thing.albedo]}
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(
        name, len(thing.vertices), len(thing.faces), has_vertex_normals=True, props=properties
    )
    arrays = mi.traverse(mesh)
    arrays["vertex_positions"] = np.asarray(thing.vertices, np.float32).ravel()
    arrays["vertex_normals"] = np.asarray(thing.normals, np.float32).ravel()
    arrays["faces"] = np.asarray(thing.faces, np.uint32).ravel()
    arrays.update()
    return mesh


def _sensor(mi, scene, samples):
    camera, film = scene.camera, scene.film
    _, up, forward = camera.axes
    place = [camera.position.tolist(), (camera.position + forward).tolist(), up.tolist()]
    world = mi.ScalarTransform4f().look_at(*place)
    if camera.perspective:
        sensor = {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(camera.extent[1]))),
            "fov_axis": "y",
        }
    else:
        half = float(camera.extent[0])
        sensor = {"type": "orthographic"}
        world = world @ mi.ScalarTransform4f().scale([half, half, 1.0])
    return sensor | {
        "to_world": world,
        "film": {
            "type": "hdrfilm",
            "width": film.width,
            "height": film.height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgba",
        },
        "sampler": {"type": "stratified", "sample_count": samples},
    }


def _emitter(light):
    power = {"type": "rgb", "value": [float(p) for p in light.power]}
    if light.directional:
        # there the direction in which light travels, here the one it comes from
        direction = [float(-x) for x in light.place]
        return {"type": "directional", "direction": direction, "irradiance": power}
    position = [float(x) for x in light.place]
    return {"type": "point", "position": position, "intensity": power}
