"""What a foreign file is, and what is wrong with it, in plain values.

A description names everything that is wrong, where `ingest` stops at the first thing.
"""

import json
from pathlib import Path

import numpy as np

from btfpipe.compression.model import Model
from btfpipe.description import read_description
from btfpipe.directions import from_angles
from btfpipe.errors import InputError
from btfpipe.formats import sources
from btfpipe.formats.archive import is_zip, open_archive
from btfpipe.formats.images import Decoder, is_mislabelled, open_picture
from btfpipe.formats.meshes import ENDINGS, read_mesh
from btfpipe.formats.picture_sets import unknown_settings
from btfpipe.formats.ubo import Listing, tables
from btfpipe.parallel import ordered_map
from btfpipe.sample.describe import describe_directions, describe_pairs

_LISTED = 20
# What a file of keys and values is, by one of its keys.
_DESCRIPTIONS = {
    "objects": "a scene, which `btfpipe render` reads",
    "structure": "a specification, which `btfpipe simulate` reads",
    "strokes": "strokes, which `btfpipe surface --field` reads",
    "comparisons": "a report of `btfpipe compare`",
    "sweep": "a report of `btfpipe compare --sweep`",
    "results": "a configuration of the workflow, for `snakemake --configfile`",
}


def describe_foreign(path, threads=1, report=lambda done, total: None):
    """Describe a folder, zip, picture or mesh, or say that it is unknown.

    Returns
    -------
    dict
        ``kind``, facts, and ``problems``: a list of sentences.
    """
    path = Path(path)
    description = _describe_description(path)
    if description is not None:
        return description
    name, reason = sources.recognise(path)
    if name not in ("ubo", "picture"):
        return _describe_source(path, name, reason, threads, report)
    if path.is_dir() or is_zip(path):
        try:
            return _describe_set(path, threads, report)
        except InputError as error:
            return {"kind": "folder" if path.is_dir() else "zip", "problems": [str(error)]}
    if path.suffix.lower() in ENDINGS:
        return describe_mesh(path)
    try:
        picture = open_picture(path)
    except InputError as error:
        try:
            with path.open("rb") as file:
                head = file.read(16)
        except OSError as unreadable:
            raise InputError(f"{path}: cannot be read ({unreadable.strerror}).") from unreadable
        return {
            "kind": "unknown",
            "bytes": path.stat().st_size,
            "first_bytes": repr(head)[2:-1],
            "problems": [str(error)],
        }
    return describe_picture(picture, path)


def _describe_description(path):
    """Describe a file of keys and values that this project reads or writes; None of what may be something else."""
    ending = path.suffix.lower()
    if ending not in (".yaml", ".yml", ".json") or not path.is_file():
        return None
    try:
        if ending == ".json":
            thing = json.loads(path.read_bytes())
        else:
            thing = read_description(path, "a description")
    except InputError as error:
        return {"kind": "description", "problems": [str(error)]}
    except (OSError, ValueError, RecursionError):
        return None  # a list of directions, perhaps, whose reader says what is wrong
    keys = [str(key) for key in thing] if isinstance(thing, dict) else []
    what = next((what for key, what in _DESCRIPTIONS.items() if key in keys), None)
    if what is None and ending == ".json":
        return None
    what = what or f"nothing that btfpipe reads; none of its keys is {', '.join(_DESCRIPTIONS)}"
    return {"kind": "description", "what": what, "keys": keys, "problems": []}


def _describe_source(path, name, reason, threads, report):
    """Describe a set or a factorisation by what its reader gives, every picture looked at."""
    facts = {"kind": f"{name} source", "because": reason}
    options = {"utia": {"pairs": True}, "curet": {"rectify": False}}.get(name, {})
    try:
        opened = sources.open_source(path, name, **options)
        if isinstance(opened, Model):
            return facts | _describe_model(opened)
        with opened as measurement:
            return facts | _describe_measurement(measurement, threads, report)
    except InputError as error:
        return facts | {"problems": [str(error)]}


def _describe_model(model):
    return {
        "method": model.method,
        "rows": model.shape[0],
        "cols": model.shape[1],
        "pairs": model.n_pairs,
        "views": describe_directions(model.view_directions),
        "lights": describe_directions(model.light_directions),
        "toroidal": model.toroidal,
        "texels_per_mm": model.texels_per_mm,
        "source": model.about.get("source"),
        "problems": [],
    }


def _describe_measurement(measurement, threads, report):
    def look(pair):
        try:
            values = measurement.read(pair)
        except InputError as error:
            return None, str(error)
        return (values.shape[:2], str(values.dtype)), _range(values)

    kinds, unreadable, not_finite = {}, [], []
    clipped = clipped_pictures = 0
    looks = ordered_map(look, range(measurement.n_pairs), threads, ahead=8 * threads)
    for pair, (kind, found) in enumerate(looks):
        if kind is None:
            unreadable.append(found)
            continue
        kinds.setdefault(kind, []).append(measurement.names[pair])
        clipped += found.get("clipped", 0)
        clipped_pictures += found.get("clipped", 0) > 0
        if found["not_finite"]:
            not_finite.append(f"{measurement.names[pair]}: {found['not_finite']} values")
        report(pair + 1, measurement.n_pairs)
    problems = [
        *_listed("pictures cannot be read", unreadable),
        *_listed("pictures hold values that are not finite", not_finite),
        *_listed("pictures are mislabelled", sorted(measurement.facts.get("mislabelled", ()))),
    ]
    if len(kinds) > 1:
        sizes = [
            f"{len(names)} of {shape[0]} x {shape[1]} {dtype} (first {names[0]!r})"
            for (shape, dtype), names in kinds.items()
        ]
        problems.append("pictures differ: " + "; ".join(sizes) + ".")
    (shape, dtype) = max(kinds, key=lambda kind: len(kinds[kind]), default=((None, None), ""))
    views, lights = measurement.view_directions, measurement.light_directions
    arranged, gaps = describe_pairs(
        measurement.view_index, measurement.light_index, len(views), len(lights)
    )
    return {
        "rows": shape[0],
        "cols": shape[1],
        "stored_as": dtype,
        "pairs": measurement.n_pairs,
        "views": describe_directions(views),
        "lights": describe_directions(lights),
        **arranged,
        **_invalid(measurement),
        "clipped_values": clipped,
        "clipped_pictures": clipped_pictures,
        "facts": {key: _cut(value) for key, value in measurement.facts.items()},
        "problems": [*gaps, *problems, *measurement.facts.get("warnings", [])],
    }


def _invalid(measurement):
    mask = measurement.mask
    return {} if mask is None else {"invalid_texels": int(mask.size - mask.sum())}


def describe_picture(picture, path):
    """Describe a decoded `Picture`: size, type, and per layer its channels, range and bad values."""
    values, problems = picture.values, []
    if is_mislabelled(str(path), picture.suffix):
        problems.append(f"the name says otherwise, but this is a {picture.suffix[1:]} file.")
    layers = {}
    for index, channel in enumerate(picture.channels):
        layers.setdefault(channel.rpartition(".")[0], []).append(index)
    described = {}
    for layer, index in layers.items():
        part = values[..., index]
        facts = {"channels": [picture.channels[i].rpartition(".")[2] for i in index]}
        facts |= _range(part)
        described[layer or "colour"] = facts
        if facts["not_finite"]:
            where = f"layer {layer}: " if layer else ""
            problems.append(f"{where}{facts['not_finite']} NaN or infinite values.")
    return {
        "kind": "picture",
        "format": picture.suffix[1:],
        "rows": values.shape[0],
        "cols": values.shape[1],
        "stored_as": str(values.dtype),
        "layers": described,
        "problems": problems,
    }


def describe_mesh(path):
    """Describe a mesh file: size, extent, topology, repairs that `surface` would make, and why it could not."""
    from btfpipe.surface.cleaning import clean
    from btfpipe.surface.topology import describe

    description = {"kind": "mesh", "format": Path(path).suffix[1:].lower()}
    try:
        vertices, faces = read_mesh(path)
    except InputError as error:
        return description | {"problems": [str(error)]}
    finite = np.isfinite(vertices).all(axis=1)
    description |= {
        "vertices": len(vertices),
        "faces": len(faces),
        "least": vertices[finite].min(axis=0).tolist() if finite.any() else None,
        "greatest": vertices[finite].max(axis=0).tolist() if finite.any() else None,
        "not_finite": int((~finite).sum()),
    }
    try:
        vertices, faces, repairs = clean(vertices, faces, str(path))
    except InputError as error:
        return description | {"problems": [str(error)]}
    euler, loops, _ = describe(faces, len(vertices))
    return description | {
        "components": len(euler),
        "boundary_loops": int(loops.sum()),
        "genus": int(((2 - loops - euler) // 2).sum()),
        "repairs": repairs,
        "problems": [],
    }


def _range(part):
    """Least, greatest and mean finite value, and counts of clipped and bad values."""
    if part.dtype.kind != "f":
        full = np.iinfo(part.dtype).max
        return {
            "least": int(part.min()),
            "greatest": int(part.max()),
            "mean": float(part.mean()),
            "clipped": int(np.count_nonzero(part == full)),
            "not_finite": 0,
        }
    good = part[np.isfinite(part)].astype(np.float64)
    return {
        "least": float(good.min()) if good.size else None,
        "greatest": float(good.max()) if good.size else None,
        "mean": float(good.mean()) if good.size else None,
        "clipped": 0,
        "not_finite": int(part.size - good.size),
    }


def _describe_set(path, threads, report):
    """Describe a folder or zip; decodes every picture of a UBO2003 set."""
    with open_archive(path) as archive, Decoder() as decoder:
        listing = Listing(archive)
        where = "folder" if path.is_dir() else "zip"
        if not listing.pairs:
            return {
                "kind": where,
                "files": len(archive.names),
                "problems": [
                    "holds no pictures with light and view angles in their names, such as"
                    " '00008 tl000 pl000 tv030 pv030.jpg'."
                ],
            }

        def look(name):
            try:
                picture = decoder.decode(archive.read(name), name)
            except InputError as error:
                return None, str(error), {"not_finite": 0, "clipped": 0}, False
            key = (picture.values.shape, str(picture.values.dtype), picture.suffix)
            return key, None, _range(picture.values), is_mislabelled(name, picture.suffix)

        names = list(listing.pairs.values())
        kinds, unreadable, mislabelled, not_finite = {}, [], [], []
        clipped = clipped_pictures = 0
        looks = ordered_map(look, names, threads, ahead=8 * threads)
        for done, (name, found) in enumerate(zip(names, looks, strict=True), 1):
            key, error, facts, wrong = found
            if error:
                unreadable.append(error)
                continue
            kinds.setdefault(key, []).append(name)
            clipped += facts["clipped"]
            clipped_pictures += facts["clipped"] > 0
            if facts["not_finite"]:
                not_finite.append(f"{name}: {facts['not_finite']} NaN or infinite values.")
            if wrong:
                mislabelled.append(name)
            report(done, len(names))
        lights, views, light_index, view_index = tables(listing.pairs)
        arranged, gaps = describe_pairs(
            view_index,
            light_index,
            len(views),
            len(lights),
            lambda view, light: _pair(views[view], lights[light]),
        )
        problems = [
            *_listed("pictures cannot be read", unreadable),
            *gaps,
            *_listed("pairs are there twice", [f"{a!r} and {b!r}" for a, b in listing.duplicates]),
            *_listed("pictures hold values that are not finite", not_finite),
            *_listed("pictures are mislabelled", mislabelled),
            *unknown_settings(listing.settings),
        ]
        if len(kinds) > 1:
            sizes = [
                f"{len(names)} of {shape[0]} x {shape[1]} {dtype} {suffix[1:]} (first {names[0]!r})"
                for (shape, dtype, suffix), names in kinds.items()
            ]
            problems.append("pictures differ: " + "; ".join(sizes) + ".")
        (shape, dtype, suffix) = max(kinds, key=lambda key: len(kinds[key]), default=((), "", ""))
        return {
            "kind": "UBO2003 set",
            "packed_as": where,
            "rows": shape[0] if shape else None,
            "cols": shape[1] if shape else None,
            "stored_as": dtype,
            "format": suffix[1:],
            "pairs": len(names),
            "views": describe_directions(from_angles(*np.radians(np.array(views).T))),
            "lights": describe_directions(from_angles(*np.radians(np.array(lights).T))),
            **arranged,
            "duplicate_pairs": len(listing.duplicates),
            "clipped_values": clipped,
            "clipped_pictures": clipped_pictures,
            "other_files": len(listing.strays),
            "ignored": listing.strays[:_LISTED],
            "settings": listing.settings,
            "problems": problems,
        }


def _pair(view, light):
    return f"tl{light[0]:g} pl{light[1]:g} tv{view[0]:g} pv{view[1]:g}"


def _cut(value):
    """A fact, its first few things if it is a list or a set."""
    if isinstance(value, set):
        value = sorted(value)  # threads fill sets in any order
    return value[:_LISTED] if isinstance(value, list) else value


def _listed(what, things):
    """One problem that lists the first few things, or none."""
    if not things:
        return []
    more = ", ..." if len(things) > _LISTED else ""
    return [f"{len(things)} {what}: {', '.join(things[:_LISTED])}{more}"]
