"""What writers of pictures share: a folder or zip that appears whole, and pictures encoded from an appearance."""

import contextlib
import json
import zipfile
from pathlib import Path

import numpy as np

from btfpipe import files, store
from btfpipe.directions import to_angles
from btfpipe.errors import InputError
from btfpipe.formats.images import encode_picture
from btfpipe.formats.picture_sets import SETTINGS
from btfpipe.parallel import blocks, ordered_map
from btfpipe.sample import Sample
from btfpipe.sample.transfer import encode

_BLOCK_BYTES = 4 << 20  # linear pictures at a time
_HALF = float(np.finfo(np.float16).max)
_MUCH = 2.0  # largest value that eight bits take without a word
CURVES = {".jpg": "gamma2.2", ".png": "srgb"}  # what readers of these sets take without being told


@contextlib.contextmanager
def create_set(path, settings):
    """Open a set of files for writing; it appears at `path` only if the block succeeds.

    Parameters
    ----------
    path : path-like
        A zip if it ends in ``.zip`` (members stored, dated with the zip's epoch), else a folder.
    settings : dict
        For ``btfpipe.json``.

    Yields
    ------
    function
        ``add(name, data)`` adds one file; names have forward slashes.

    Raises
    ------
    InputError
        If it cannot be written, a name comes twice, or a folder of that name is there that is no such set.
    """
    path = Path(path)
    about = (json.dumps(settings, indent=2, default=store._plain) + "\n").encode()
    names = set()

    def once(name):
        if name in names:
            raise InputError(f"{path}: two pictures would be called {name!r}.")
        names.add(name)

    if path.suffix.lower() == ".zip":
        with files.whole(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:

            def pack(name, data):
                once(name)
                info = zipfile.ZipInfo(name)
                info.external_attr = 0o644 << 16
                archive.writestr(info, data)

            pack(SETTINGS, about)
            yield pack
        return
    if path.exists() and not (path / SETTINGS).is_file():
        raise InputError(
            f"{path}: is there and was not written by btfpipe (no {SETTINGS} in it); choose another --out."
        )
    with files.whole_folder(path) as part:

        def put(name, data):
            once(name)
            target = part / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(data)

        put(SETTINGS, about)
        yield put


class Pictures:
    """The pictures of an appearance, encoded for a set.

    Floating-point pictures (``.exr``) hold linear values as they are. Eight-bit ones (``.png``, ``.jpg``) hold ``value *
    white`` through the transfer curve, with a `white` at which nothing is clipped: the reciprocal of the largest value, or of
    the scale of a Sample that has eight bits itself, whose codes then come out as they went in.

    Parameters
    ----------
    appearance : Appearance
        Sample or Model, a product or a list of pairs.
    suffix : str
        ``.exr``, ``.png`` or ``.jpg``.
    transfer : str, optional
        Curve of eight-bit pictures; by default the Sample's own if it has eight bits, else that of `CURVES`.
    precision : str
        Of ``.exr``: ``half`` or ``single``.
    quality : int
        Of ``.jpg``.
    convert : function, optional
        Applied to linear pictures (n, rows, cols, 3) before they are encoded as floats.
    pairs : (n,) int, optional
        Which pairs; all by default.
    threads : int
        Never changes the result.

    Raises
    ------
    InputError
        For another suffix or precision, or values that are not finite.

    Attributes
    ----------
    settings : dict
        For ``btfpipe.json``: white (where the scale is known) or scale (where only values relative to each other are), transfer,
        toroidal, texels_per_mm.
    facts : dict
        For a summary: pictures, white, largest (known for eight-bit pictures that needed a look), warnings (sentences).
    """

    def __init__(
        self,
        appearance,
        suffix,
        *,
        transfer=None,
        precision="half",
        quality=95,
        convert=None,
        pairs=None,
        threads=1,
    ):
        if suffix not in (".exr", *CURVES):
            raise InputError(f"pictures ending in {suffix!r}; expected .exr, .png or .jpg.")
        if precision not in ("half", "single"):
            raise InputError(f"precision {precision!r}; expected half or single.")
        self.appearance, self.suffix, self.quality = appearance, suffix, quality
        self.convert, self.threads, self.precision = convert, threads, precision
        rows, cols = appearance.shape
        self.pairs = np.arange(appearance.n_pairs) if pairs is None else np.asarray(pairs)
        self._blocks = blocks(len(self.pairs), max(1, _BLOCK_BYTES // (12 * rows * cols)))
        self.white, largest = 1.0, None
        self.transfer = "linear"
        if suffix != ".exr":
            eight = isinstance(appearance, Sample) and appearance.codes.dtype == np.uint8
            self.transfer = transfer or (appearance.transfer if eight else CURVES[suffix])
            if eight and appearance.gain is None:
                self.white = 1 / appearance.scale
            else:
                largest = self._largest()
                self.white = 1 / max(largest, 1.0)
        absolute = getattr(appearance, "absolute", False)
        self.settings = {
            "white": self.white if absolute else None,
            "scale": None if absolute else 1 / self.white,
            "transfer": self.transfer,
            "toroidal": bool(appearance.toroidal),
            "texels_per_mm": appearance.texels_per_mm,
        }
        self.facts = {"pictures": len(self.pairs), "white": self.white, "largest": largest}
        if largest is not None and largest > _MUCH:
            self.facts["warnings"] = [
                f"values up to {largest:.3g} are divided by that to fit 8 bits, and dark ones lose steps; --suffix .exr keeps them"
                " as they are"
            ]

    def _largest(self):
        def work(block):
            return self.appearance.pictures(self.pairs[block]).max()

        largest = float(np.max(list(ordered_map(work, self._blocks, self.threads))))
        if not np.isfinite(largest):
            raise InputError("the sample holds non-finite values; `btfpipe info` counts them.")
        return largest

    def encoded(self, on_progress=None):
        """Yield (pair, bytes of its picture) in order."""

        def work(block):
            values = self.appearance.pictures(self.pairs[block])
            codes = self._codes(values)
            return block, [encode_picture(picture, self.suffix, self.quality) for picture in codes]

        for block, pictures in ordered_map(work, self._blocks, self.threads):
            yield from zip(self.pairs[block].tolist(), pictures, strict=True)
            if on_progress is not None:
                on_progress(block.stop, len(self.pairs))

    def _codes(self, values):
        if self.suffix != ".exr":
            display = encode(np.clip(values * np.float32(self.white), 0, 1), self.transfer)
            return (display * 255 + 0.5).astype(np.uint8)
        if self.convert is not None:
            values = self.convert(values)
        if self.precision == "single":
            return np.asarray(values, np.float32)
        largest = float(np.abs(values).max())
        if not largest <= _HALF:
            raise InputError(
                f"values reach {largest:.3g}, beyond half precision ({_HALF:.0f}), in which .exr is written; write .png,"
                " whose values are scaled to fit."
            )
        return values.astype(np.float16)


def angles_deg(directions):
    """Polar angle and azimuth (n, 2) in degrees, rounded as names of pictures have them."""
    theta, phi = np.degrees(to_angles(directions))
    theta, phi = np.round(theta, 6), np.round(phi, 6) % 360
    phi[theta == 0] = 0
    return np.stack([theta, phi], axis=1).tolist()
