"""The Sample: a measured or simulated BTF."""

from btfpipe.sample.appearance import Appearance, light_cosines
from btfpipe.sample.sample import Sample
from btfpipe.sample.transfer import TRANSFERS, decode_table, encode

__all__ = ["TRANSFERS", "Appearance", "Sample", "decode_table", "encode", "light_cosines"]
