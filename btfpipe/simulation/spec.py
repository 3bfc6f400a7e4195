"""Reads the specification of a simulation; its format is `simulation.schema.yaml`, beside this module."""

from functools import cache
from pathlib import Path

import numpy as np

from btfpipe.description import read_description, validator
from btfpipe.directions import bonn81, from_angles, ubo2014
from btfpipe.errors import InputError

# 25 of Bonn's 81: the steps of azimuth, in degrees, that are kept on each ring
_BONN25_STEPS_DEG = {0: 360, 30: 60, 60: 36, 75: 45}


@cache
def schema():
    """The closed JSON schema of a specification."""
    import yaml

    return yaml.safe_load(Path(__file__).with_name("simulation.schema.yaml").read_text("utf-8"))


def read_spec(path):
    """Read and check a specification; missing keys get their defaults.

    Raises
    ------
    InputError
        Names the key, what was found and what was expected.
    """
    from jsonschema.exceptions import best_match

    path = Path(path)
    spec = read_description(path, "a specification of a simulation")
    problem = best_match(validator(schema()).iter_errors(spec))
    if problem is not None:
        key = ".".join(str(k) for k in problem.absolute_path) or "the specification"
        raise InputError(f"{path}: {key}: {problem.message}. See simulation.schema.yaml.")
    spec = _filled(schema(), spec)
    if isinstance(spec["texels"], int):
        spec["texels"] = [spec["texels"]] * 2
    return spec


def _filled(part, value):
    """`value` with the defaults of the schema `part`, all the way down."""
    if "$ref" in part:
        name = part["$ref"].rsplit("/", 1)[1]
        part = schema()["$defs"][name] | {k: v for k, v in part.items() if k != "$ref"}
    if not isinstance(value, dict):
        return value
    properties = part.get("properties", {})
    value = dict(value)
    for name, below in properties.items():
        if "$ref" in below:
            below = schema()["$defs"][below["$ref"].rsplit("/", 1)[1]] | below
        if name not in value and "default" in below:
            value[name] = below["default"]
    others = part.get("additionalProperties") or {}
    return {name: _filled(properties.get(name, others), below) for name, below in value.items()}


def plan(spec, table=None):
    """What to measure.

    Parameters
    ----------
    spec : dict
    table : path-like, optional
        Pairs in place of the specification's directions; see `read_pairs`.

    Returns
    -------
    lights_deg, views_deg : (n, 2) arrays
        Distinct directions (theta, phi).
    pairs : (n, 2) int array
        (view, light) of each picture.
    """
    if table is None:
        views, lights = directions(spec)
        pair = np.arange(len(views) * len(lights))
        return lights, views, np.stack([pair // len(lights), pair % len(lights)], axis=1)
    lights, views = read_pairs(table)
    lights, light = np.unique(lights, axis=0, return_inverse=True)
    views, view = np.unique(views, axis=0, return_inverse=True)
    return lights, views, np.stack([view.ravel(), light.ravel()], axis=1)


def directions(spec):
    """Views and lights of a product, each (n, 2) in degrees (theta, phi)."""
    chosen = spec["directions"]
    if isinstance(chosen, str):
        angles = {"bonn81": bonn81, "ubo2014": ubo2014, "bonn25": _bonn25}[chosen](degrees=True)
        return angles, angles
    return tuple(_checked(np.array(chosen[side], float), side) for side in ("views", "lights"))


def _bonn25(degrees):
    del degrees
    return np.array(
        [(theta, phi) for theta, step in _BONN25_STEPS_DEG.items() for phi in range(0, 360, step)]
    )


def _checked(angles_deg, what):
    """Refuse angles that repeat or do not lie on the hemisphere."""
    theta = angles_deg[:, 0]
    if not ((theta >= 0) & (theta < 90)).all():
        bad = int(np.flatnonzero(~((theta >= 0) & (theta < 90)))[0])
        raise InputError(
            f"{what}: direction {bad} has theta {theta[bad]:g}; expected 0 to below 90 degrees."
        )
    vectors = vectors_of(angles_deg)
    near = vectors @ vectors.T - 2 * np.eye(len(vectors)) > 1 - 1e-9
    if near.any():
        a, b = np.argwhere(near)[0]
        raise InputError(f"{what}: directions {a} and {b} are the same; expected distinct ones.")
    return angles_deg


def vectors_of(angles_deg):
    """Unit vectors (n, 3) of (theta, phi) in degrees (n, 2)."""
    return from_angles(*np.radians(np.asarray(angles_deg, float).T))


def read_pairs(path):
    """Read a table of pairs: columns theta_i_deg, phi_i_deg, theta_v_deg, phi_v_deg, in any order.

    Returns
    -------
    lights_deg, views_deg : (n, 2) arrays
    """
    import csv

    path = Path(path)
    columns = ("theta_i_deg", "phi_i_deg", "theta_v_deg", "phi_v_deg")
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(line for line in file if not line.startswith("#"))
            found = tuple(name.strip() for name in reader.fieldnames or ())
            if sorted(found) != sorted(columns):
                raise InputError(
                    f"{path}: has the columns {', '.join(found) or 'none'}; expected {', '.join(columns)}."
                )
            reader.fieldnames = list(found)
            rows = [[row[name] for name in columns] for row in reader]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}).") from error
    try:
        table = np.array([[float(cell) for cell in row] for row in rows]).reshape(-1, 4)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: holds something that is not a number ({error}).") from error
    if len(table) == 0:
        raise InputError(f"{path}: holds no pairs; expected at least one line of angles.")
    for start, what in ((0, "theta_i_deg"), (2, "theta_v_deg")):
        theta = table[:, start]
        bad = np.flatnonzero(~((theta >= 0) & (theta < 90)))
        if len(bad):
            raise InputError(
                f"{path}: pair {bad[0]} has {what} {theta[bad[0]]:g}; expected 0 to below 90 degrees."
            )
    if len(np.unique(table.round(6) % [90, 360, 90, 360], axis=0)) < len(table):
        raise InputError(f"{path}: a pair occurs twice; expected distinct pairs.")
    return table[:, :2], table[:, 2:]
