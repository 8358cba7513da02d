"""Lines that alarm only where there is something to do, and once."""

import logging
from types import SimpleNamespace

import pytest

from polmvs.colmap import sfm
from polmvs.config import FusionOptions, Options, Surroundings
from polmvs.evaluation.comparison import best_fit_lines
from polmvs.parallel import Workers
from polmvs.pipeline.stages import densify
from polmvs.polarization.kinds import AngleModel


@pytest.mark.parametrize(("registered", "warns"), [(5, False), (4, True)])
def test_several_models_are_said_only_where_images_are_left_out(
    caplog, tmp_path, monkeypatch, registered: int, warns: bool
) -> None:
    found = {
        number: SimpleNamespace(num_reg_images=lambda n=n: n, num_points3D=lambda: 9)
        for number, n in enumerate((registered, 2))
    }
    monkeypatch.setattr(sfm.pycolmap, "incremental_mapping", lambda *arguments: found)
    names = [f"{number}.png" for number in range(5)]
    with caplog.at_level(logging.WARNING, logger="polmvs"):
        work = sfm.SfmWork(
            images=tmp_path,
            names=names,
            database=tmp_path / "db",
            reader=sfm.pycolmap.ImageReaderOptions(),
            options=sfm.SfmOptions(),
        )
        largest = work.map()
    assert largest.num_reg_images() == registered
    assert [record.getMessage() for record in caplog.records] == (
        ["SfM: the images fall into 2 models; the largest is used and has 4 of 5 images."] * warns
    )


def test_one_model_fits_best_of_none() -> None:
    figures = SimpleNamespace(consistency=SimpleNamespace(track_residual_median_deg=0.5))
    alone = SimpleNamespace(best_fit=AngleModel.PPA, models={AngleModel.PPA: figures})
    assert best_fit_lines(alone) == []
    two = SimpleNamespace(
        best_fit=AngleModel.PPA, models={AngleModel.OPA: figures, AngleModel.PPA: figures}
    )
    assert best_fit_lines(two)[-1] == "The phases fit polmvs PPA best: 0.50 deg at the seeds."


def test_stereo_that_finds_nothing_says_so_and_keeps_the_sparse_points(
    caplog, tmp_path, monkeypatch
) -> None:
    kept = object()
    nothing = SimpleNamespace(points=[])
    monkeypatch.setattr(densify, "stereo_surroundings", lambda *given, **others: nothing)
    monkeypatch.setattr(densify, "sparse_surroundings", lambda tracks, maps: kept)
    monkeypatch.setattr(densify, "sparse_part", lambda found: found)
    options = Options(fusion=FusionOptions(surroundings=Surroundings.STEREO))
    given = SimpleNamespace(maps=[], options=options, workers=Workers(1))
    cloud = densify.surroundings_cloud(None, None, given, None, tmp_path)
    assert cloud is kept
    assert "`fusion.surroundings` stereo finds no points: too few views" in caplog.text
    assert "record more views" in caplog.text
