"""Writes UBO2003's layout, as a zip or a folder; `ubo` reads it."""

import contextlib

from btfpipe.formats.ubo import pair_name
from btfpipe.formats.writing import Pictures, angles_deg, create_set


@contextlib.contextmanager
def create_measurement(path, settings):
    """Open a set of pictures for writing; it appears at `path` only if the block succeeds.

    Parameters
    ----------
    path : path-like
        A zip if it ends in ``.zip``, else a folder; see `writing.create_set`.
    settings : dict
        For ``btfpipe.json``: white (linear value, 1 for the largest code, of a perfect white diffuser lit along the
        normal), transfer, toroidal, texels_per_mm; others are for people.

    Yields
    ------
    function
        ``put(number, light_deg, view_deg, suffix, data)`` adds one picture.

    Raises
    ------
    InputError
        If it cannot be written, or a folder of that name is there that is no such set.
    """
    with create_set(path, settings) as add:
        yield lambda number, light, view, suffix, data: add(
            pair_name(number, light, view, suffix), data
        )


def write_ubo(path, appearance, suffix=".jpg", *, on_progress=None, **options):
    """Write a Sample or Model in UBO2003's layout.

    Parameters
    ----------
    path : path-like
        A zip if it ends in ``.zip``, else a folder.
    appearance : Appearance
        A product or a list of pairs.
    suffix : str
        ``.jpg``, ``.png`` or ``.exr``.
    on_progress : callable, optional
        Called with (pictures done, pictures in all).
    **options
        transfer, precision, quality, threads; see `writing.Pictures`.

    Returns
    -------
    dict
        Facts for a summary.

    Raises
    ------
    InputError
        If it cannot be written; see `writing.Pictures`.
    """
    pictures = Pictures(appearance, suffix, **options)
    lights = angles_deg(appearance.light_directions)
    views = angles_deg(appearance.view_directions)
    with create_measurement(path, pictures.settings) as put:
        for pair, data in pictures.encoded(on_progress):
            light, view = int(appearance.light_index[pair]), int(appearance.view_index[pair])
            put(light * len(views) + view, lights[light], views[view], suffix, data)
    return pictures.facts | {"format": "UBO2003"}
