"""What makes two texels alike: filter banks, textons, neighbour lists."""

from btfpipe.analysis.features import FeatureLevel, Features

__all__ = ["FeatureLevel", "Features"]
