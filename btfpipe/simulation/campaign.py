"""A whole measurement: every picture of a list of pairs, in order, on several threads."""

from dataclasses import dataclass

import numpy as np

from btfpipe import parallel
from btfpipe.errors import InputError, too_little
from btfpipe.sample.transfer import encode
from btfpipe.simulation.tracing import copies


@dataclass
class Display:
    """How values become codes.

    Attributes
    ----------
    largest_value : float or None
        Value of code 255; None for half floats, which hold the values themselves.
    """

    largest_value: float | None

    @property
    def settings(self):
        """What a reader must know: white and transfer."""
        if self.largest_value is None:
            return {"white": 1.0, "transfer": "linear"}
        return {"white": 1 / self.largest_value, "transfer": "srgb"}

    def encode(self, picture):
        """Codes of linear values (rows, cols, 3), and how many were clipped."""
        if self.largest_value is None:
            return picture.astype(np.float16), 0
        codes = encode(picture / self.largest_value, "srgb") * 255 + 0.5
        return np.clip(codes, 0, 255).astype(np.uint8), int((codes >= 256).sum())


def display(file_format, largest_value):
    """The Display of a file format: ``jpeg``, ``png`` or ``exr``."""
    return Display(None if file_format == "exr" else largest_value)


def require_memory(patch, rays, memory):
    """Refuse, before work starts, a patch whose geometry and light paths exceed `memory` bytes.

    Rough: about 150 bytes for a triangle in Embree, 28 for a ray that is kept (half of them), 100
    for a vertex.
    """
    needed = int(len(patch.faces) * copies(patch) * 150 + len(patch.normals) * (14 * rays + 100))
    if needed > memory:
        raise InputError(
            f"{len(patch.normals)} vertices with {rays} rays each need about"
            f" {too_little(needed, memory)}, or lower vertices_per_texel or inter_reflection.rays."
        )
    return needed


def capture(goniometer, lights, views, pairs, finish, threads=1, memory=2 << 30):
    """Yield (view index, light index, finished picture) for each pair.

    Parameters
    ----------
    goniometer : Goniometer
    lights, views : (n, 3) arrays
        Unit vectors.
    pairs : (n, 2) int array
        (view, light) of each picture. The pictures do not depend on their order, nor on `memory`; a memory too
        small for all lights at once makes pictures come in several rounds over the views.
    finish : callable
        What to do with each picture (rows, cols, 3) on the thread that made it.
    threads : int
    memory : int
        Bytes for the lights' tables.

    Yields
    ------
    view, light : int
    finished
        What `finish` returned.
    """
    pairs = np.asarray(pairs)
    per_light = goniometer.bytes_per_light
    if per_light > memory:
        raise InputError(
            f"the tables of one light need {too_little(per_light, memory)}, or lower vertices_per_texel."
        )
    used = np.unique(pairs[:, 1])
    for block in parallel.blocks(len(used), max(int(memory // per_light), 1)):
        chosen = used[block]
        lit = goniometer.light(lights[chosen])
        here = pairs[np.isin(pairs[:, 1], chosen)]
        jobs = []
        for view in dict.fromkeys(here[:, 0].tolist()):
            of_view = here[here[:, 0] == view, 1]
            jobs.append((view, of_view, np.searchsorted(chosen, of_view)))

        def one(job, lit=lit):
            view, of_view, rows = job
            pictures = goniometer.pictures(views[view], lit, rows)
            return view, of_view, [finish(picture) for picture in pictures]

        for view, of_view, finished in parallel.ordered_map(one, jobs, threads):
            for light, thing in zip(of_view.tolist(), finished, strict=True):
                yield view, light, thing
