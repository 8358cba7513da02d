"""Learned features: what is asked of a pycolmap that has them, and what one without says."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from helpers import refused

from polmvs.colmap import database as database_module
from polmvs.colmap import sfm as sfm_module
from polmvs.colmap.database import match_pairs
from polmvs.colmap.learned_features import LearnedFeatures, learned_features
from polmvs.config import SfmOptions
from polmvs.errors import DataError, OptionError
from polmvs.io.images import write_png

HAS_ONNX = hasattr(pycolmap.FeatureExtractionOptions(), "aliked")


@pytest.fixture
def weights(tmp_path: Path) -> SfmOptions:
    paths = tmp_path / "aliked.onnx", tmp_path / "lightglue.onnx"
    for path in paths:
        path.write_bytes(b"weights")
    return SfmOptions(aliked=paths[0], lightglue=paths[1])


@pytest.fixture
def with_onnx(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pycolmap with ONNX, as its source has it: options within options."""

    def extraction() -> SimpleNamespace:
        return SimpleNamespace(type=None, aliked=SimpleNamespace(n16rot_model_path=""))

    def matching() -> SimpleNamespace:
        lightglue = SimpleNamespace(model_path="")
        return SimpleNamespace(type=None, aliked=SimpleNamespace(lightglue=lightglue))

    monkeypatch.setattr(pycolmap, "FeatureExtractionOptions", extraction)
    monkeypatch.setattr(pycolmap, "FeatureMatchingOptions", matching)


def test_sift_is_the_default() -> None:
    assert learned_features(SfmOptions()) is None


@pytest.mark.skipif(HAS_ONNX, reason="this pycolmap has ONNX")
def test_a_pycolmap_without_onnx_says_so_at_once(demo_capture, tmp_path, weights, cli) -> None:
    with pytest.raises(OptionError, match="built with ONNX") as caught:
        learned_features(weights)
    assert caught.value.field == "sfm.aliked"
    flags = ("--aliked", weights.aliked, "--lightglue", weights.lightglue)
    err = refused(cli("sfm", demo_capture, tmp_path / "out", *flags), 2)
    assert "--aliked needs a pycolmap that was built with ONNX" in err
    assert "give matches as --database" in err
    assert not (tmp_path / "out").exists()


def test_weights_come_in_pairs_and_from_files(with_onnx, weights, tmp_path) -> None:
    with pytest.raises(OptionError, match=r"needs `sfm.lightglue` as well") as caught:
        SfmOptions(aliked=weights.aliked)
    assert caught.value.field == "sfm.aliked"
    with pytest.raises(OptionError, match=r"needs `sfm.aliked` as well"):
        SfmOptions(lightglue=weights.lightglue)
    with pytest.raises(OptionError, match="exclude each other"):
        SfmOptions(aliked=weights.aliked, lightglue=weights.lightglue, database=tmp_path / "d.db")
    with pytest.raises(OptionError, match="COLMAP model is given"):
        SfmOptions(aliked=weights.aliked, lightglue=weights.lightglue, sparse=tmp_path)
    gone = SfmOptions(aliked=weights.aliked, lightglue=tmp_path / "gone.onnx")
    with pytest.raises(DataError, match=r"gone.onnx: no such file. `sfm.lightglue` takes"):
        learned_features(gone)


def test_what_colmap_is_told(with_onnx, weights, tmp_path, monkeypatch) -> None:
    """Extraction and matching, of which this machine's pycolmap may have no more than the names."""
    told = []
    for module, name, key in (
        (sfm_module, "extract_features", 6 - 1),
        (database_module, "match_image_pairs", "matching_options"),
    ):

        def listen(*arguments, key=key, **named):
            told.append(arguments[key] if isinstance(key, int) else named[key])

        monkeypatch.setattr(module.pycolmap, name, listen)
    names = ["a.png", "b.png"]
    for name in names:
        write_png(tmp_path / name, np.zeros((24, 32), np.uint8))
    database = tmp_path / "database.db"
    sfm_module.SfmWork(
        images=tmp_path,
        names=names,
        database=database,
        reader=pycolmap.ImageReaderOptions(),
        options=weights,
    ).describe(database)
    match_pairs(database, (("a.png", "b.png"),), learned=learned_features(weights))
    extraction, matching = told
    assert extraction.type == pycolmap.FeatureExtractorType.ALIKED_N16ROT
    assert extraction.aliked.n16rot_model_path == str(weights.aliked)
    assert matching.type == pycolmap.FeatureMatcherType.ALIKED_LIGHTGLUE
    assert matching.aliked.lightglue.model_path == str(weights.lightglue)
    assert matching.num_threads == 1


@pytest.mark.skipif(not HAS_ONNX, reason="this pycolmap was built without ONNX")
def test_colmap_has_these_options(weights) -> None:
    assert weights.aliked is not None
    assert weights.lightglue is not None
    found = LearnedFeatures(aliked=weights.aliked, lightglue=weights.lightglue)
    assert found.extraction().check()
    assert found.matching().check()
