"""Bonn's ``.btf`` files (UBO2014 and before): factorisations and plain values of a BTF, in one binary file.

====  =========================================================  =================
kind  holds                                                      read as
====  =========================================================  =================
DFMF  a factorisation of each channel of a colour space          `FactoredModel`
FMF   one factorisation of all channels together                 `FactoredModel`
PVF   a principal component analysis of each view                `Measurement`
BDI   half floats, one texel's lights and views after the other  `Measurement`
====  =========================================================  =================

Nothing is expanded: factors stay mapped from the file. All sizes that a file declares are held against its own length
before anything is read, and a file must end exactly where they say. `btf_header` reads what all kinds begin with,
`btf_bodies` the rest of factorisations, `btf_pictures` of the others; `btf_writing` writes a DFMF.

Any kind may hold spectra: more or fewer channels than three, whose names are wavelengths. They become linear Rec. 709 values as seen
under D65, taking 1 for white at any wavelength. A DFMF of spectra, and an FMF of them in logarithms, is read as a `Measurement`.

What no measured file has confirmed yet:

- The first stored row is taken as the top of the picture, as the library of the data's makers shows it; another
  reader turns the rows over. Azimuth 0 is taken along the columns, turning towards the picture's top, as in UBO2003.
- A cosine flag of 1 means that the light's cosine is inside the values, which is this project's convention; otherwise
  (and in files older than the flag, as in the makers' library) values are taken as divided by it, and each pair gets its
  light's cosine as a factor. `cosine` overrides that.
- Lab is taken under D50 to linear Rec. 709, as the other colour models are linear; the makers' library gives display values
  there. The RGB scale factors of the header are reported, not applied.
- Spectra in colour model 6 are decoded as the makers' library does, whose first channel is not what is left of the mean.
- Chunks of a BDI that are packed by bzip2 are taken for one stream each, of the same bytes as other chunks; the makers' library does
  not read them.
- The mask of a BDI is taken with columns fastest, as the makers' library writes it (it reads it the other way). Texels where it
  is 0 are invalid, whether values of them are stored or not; a mask that is 0 everywhere beside all texels says nothing.
"""

from btfpipe.errors import InputError
from btfpipe.formats.btf_bodies import read_dfmf, read_fmf
from btfpipe.formats.btf_header import MappedFile, read_header
from btfpipe.formats.btf_pictures import read_bdi, read_pvf

# By signature, longest first: kind, whether the header is extended, whether rotations follow.
SIGNATURES = {
    b"!DFMF08FCR": ("DFMF", False, True),
    b"!FMF12FCER": ("FMF", True, True),
    b"!BDIF06R2!": ("BDI", False, True),
    b"!FMF06FCR": ("FMF", False, True),
    b"!PVF06FCR": ("PVF", False, True),
    b"!FMF06FC": ("FMF", False, False),
    b"!PVF06FC": ("PVF", False, False),
}
_KINDS = {
    "DFMF": "a factorisation channel by channel",
    "FMF": "a factorisation of all channels together",
    "PVF": "a principal component analysis of each view",
    "BDI": "plain values, texel by texel",
}


def recognise(path):
    """Say why a file is one of Bonn's ``.btf``, or None if it is not (BigTIFF and others use the ending too)."""
    try:
        with open(path, "rb") as file:
            found = _signature(file.read(16))
    except OSError:
        return None
    if found is None:
        return None
    return f"its first bytes are {found.decode()}: {_KINDS[SIGNATURES[found][0]]} in Bonn's .btf format"


def _signature(head):
    return next((known for known in SIGNATURES if head.startswith(known)), None)


def read_btf(path, *, cosine=None, memory=1 << 30):
    """Read one of Bonn's ``.btf`` files.

    Parameters
    ----------
    path : path-like
        Must stay in place while the result is in use: it is mapped.
    cosine : str, optional
        ``inside`` or ``divided``: what was done with the light's cosine, whatever the file's flag says.
    memory : int
        Bytes in which to turn a BDI's values, or a DFMF's spectra, into pictures; each filling reads the file once.

    Returns
    -------
    FactoredModel or Measurement
        Of a product of views and lights; see the module for which. Values are linear and may exceed 1.

    Raises
    ------
    InputError
        Naming the section: another format, a size that the file's length does not bear, trailing bytes, counts that
        contradict each other, values that are not finite, or channels that are neither colours nor wavelengths.
    """
    if cosine not in (None, "inside", "divided"):
        raise InputError(f"cosine {cosine!r}; expected inside or divided.")
    file = MappedFile(path)
    head = file.bytes[:16].tobytes()
    signature = _signature(head)
    if signature is None:
        raise InputError(
            f"{path}: not one of Bonn's .btf files: it starts with {head[:10]!r}; expected one of"
            f" {', '.join(known.decode() for known in SIGNATURES)}."
        )
    kind, extended, rotations = SIGNATURES[signature]
    file.take(len(signature), "signature")
    header = read_header(file, kind, signature, cosine)
    bodies = {
        "DFMF": lambda: read_dfmf(file, header, memory),
        "FMF": lambda: read_fmf(file, header, memory, extended),
        "PVF": lambda: read_pvf(file, header),
        "BDI": lambda: read_bdi(file, header, memory),
    }
    return _with_rotations(file, header, rotations and not header.legacy, bodies[kind])


def _with_rotations(file, header, rotations, body):
    """Read the body behind the rotations, whose numbers some writers take for 9 and some for 3 a frame."""
    (count,) = file.unpack("I", "rotations") if rotations else (0,)
    if count == 0:
        return body()
    header.facts["rotations"] = count
    start, first = file.at, None
    for each in (9, 3):
        try:
            file.at = start
            file.need(4 * each * count, f"rotations ({each} numbers a frame)")
            file.at += 4 * each * count
            return body()
        except InputError as error:
            if file.at == file.size:  # the sizes fit, so something else is wrong
                raise
            first = first or error
    raise first
