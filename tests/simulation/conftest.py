"""Small scenes for the simulator."""

from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from btfpipe.simulation.materials import build_patch
from btfpipe.simulation.spec import read_spec


@pytest.fixture
def write_spec(tmp_path):
    """Write a specification; keys of `changes` replace those of a small bumpy one."""

    def write(name="spec.yaml", **changes):
        spec = {
            "texels": 12,
            "texels_per_mm": 4,
            "vertices_per_texel": 2,
            "inter_reflection": {"rays": 8},
            "directions": {"views": [[0, 0], [40, 20]], "lights": [[0, 0], [30, 90], [60, 200]]},
            "structure": {"bumps": {"count": [2, 2], "height_mm": 0.5}},
            "parts": {"ground": {"albedo": "#806040"}, "bump": {"albedo": [0.5, 0.2, 0.1]}},
        }
        path = tmp_path / name
        path.write_text(yaml.safe_dump(spec | changes))
        return path

    return write


@pytest.fixture
def make_patch(write_spec):
    """Patch of a specification, with a mesh (vertices in mm, faces, part, names) where it asks for one."""

    def make(mesh=None, **changes):
        files = SimpleNamespace(mesh=lambda name: mesh)
        return build_patch(read_spec(write_spec(**changes)), files)

    return make


@pytest.fixture
def make_scene(make_patch):
    """Patch of 32 x 32 texels, a millimetre each, with a black floor at 0 and things above it.

    Things are rectangles ((s0, s1), (t0, t1), height) of part ``thing``, or boxes if `boxes`.
    """

    def make(things, boxes=False, floor=(0, 0, 0), thing=(1, 1, 1), **floor_coat):
        def rectangle(s, t, z):
            return [[s[0], t[0], z], [s[1], t[0], z], [s[1], t[1], z], [s[0], t[1], z]]

        vertices, faces = list(rectangle((0, 32), (0, 32), 0)), [[0, 1, 2], [0, 2, 3]]
        part = [0, 0]
        for s, t, z in things:
            k = len(vertices)
            vertices += rectangle(s, t, z)
            quads = [[0, 1, 2, 3]]
            if boxes:
                vertices += rectangle(s, t, 0)
                quads += [[4 + i, 4 + (i + 1) % 4, (i + 1) % 4, i] for i in range(4)]
            for a, b, c, d in quads:
                faces += [[k + a, k + b, k + c], [k + a, k + c, k + d]]
                part += [1, 1]
        mesh = np.array(vertices, float), np.array(faces), np.array(part), ("floor", "thing")
        return make_patch(
            mesh=mesh,
            texels=32,
            texels_per_mm=1,
            structure={"obj": {"file": "scene.obj"}},
            parts={"floor": {"albedo": list(floor)} | floor_coat, "thing": {"albedo": list(thing)}},
        )

    return make
