"""Learned features, ALIKED matched by LightGlue, where pycolmap was built with ONNX.

The user gives the files of the weights; nothing is downloaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pycolmap

from polmvs.config import SfmOptions
from polmvs.errors import DataError, OptionError


@dataclass(frozen=True, kw_only=True)
class LearnedFeatures:
    """Files of weights, ONNX.

    Attributes
    ----------
    aliked : of the extractor (ALIKED-N16ROT, which takes turned images).
    lightglue : of the matcher for its features.
    """

    aliked: Path
    lightglue: Path

    def extraction(self) -> pycolmap.FeatureExtractionOptions:
        """COLMAP's options of the extraction."""
        options = pycolmap.FeatureExtractionOptions()
        options.type = pycolmap.FeatureExtractorType.ALIKED_N16ROT
        options.aliked.n16rot_model_path = str(self.aliked)  # type: ignore[attr-defined]
        return options

    def matching(self) -> pycolmap.FeatureMatchingOptions:
        """COLMAP's options of the matching."""
        options = pycolmap.FeatureMatchingOptions()
        options.type = pycolmap.FeatureMatcherType.ALIKED_LIGHTGLUE
        options.aliked.lightglue.model_path = str(self.lightglue)  # type: ignore[attr-defined]
        return options


def learned_features(options: SfmOptions) -> LearnedFeatures | None:
    """The learned features of the options; None: SIFT.

    Raises
    ------
    OptionError
        This pycolmap does not support them.
    DataError
        A file of weights is missing.
    """
    if options.aliked is None or options.lightglue is None:
        return None
    if not hasattr(pycolmap.FeatureExtractionOptions(), "aliked"):
        raise OptionError(
            f"needs a pycolmap that was built with ONNX; this one, {pycolmap.__version__}, was "
            "not, nor are the wheels that pip installs. Build COLMAP and pycolmap with "
            "-DONNX_ENABLED=ON, give matches as `sfm.database`, or leave it out.",
            field="sfm.aliked",
        )
    for field, path in (("sfm.aliked", options.aliked), ("sfm.lightglue", options.lightglue)):
        if not path.is_file():
            raise DataError(path, f"no such file. `{field}` takes a file of weights, ONNX.")
    return LearnedFeatures(aliked=options.aliked, lightglue=options.lightglue)
