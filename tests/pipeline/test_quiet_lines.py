"""Lines that alarm only where there is something to do, and once."""

import logging
from types import SimpleNamespace

import pytest

from polmvs.colmap import sfm
from polmvs.config import AngleModel
from polmvs.evaluation.tables import best_fit_lines
from polmvs.pipeline.stages.seeds import _warn_of_doubts
from polmvs.surface.parts import PartReport


def part(name: str, num_px: int) -> PartReport:
    return PartReport(
        view=name,
        num_px=num_px,
        num_views=3,
        num_agreeing=0,
        doubt="no outline",
        range=1.0,
        sigma=0.1,
        outline_px=1.0,
        phase_deg=1.0,
    )


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ([], []),
        (
            [part("a.png", 777)],
            ["a.png: a part of 777 px without a sparse point stays undetermined: no outline."],
        ),
        (
            [part("a.png", 777), part("b.png", 9000), part("c.png", 60)],
            [
                "b.png: a part of 9000 px without a sparse point stays undetermined: no outline "
                "(and 2 smaller parts; see the log)."
            ],
        ),
    ],
)
def test_parts_without_a_place_are_one_warning(caplog, parts, expected) -> None:
    with caplog.at_level(logging.INFO, logger="polmvs"):
        _warn_of_doubts(parts)
    by_level = {logging.WARNING: [], logging.INFO: []}
    for record in caplog.records:
        by_level[record.levelno].append(record.getMessage())
    assert by_level[logging.WARNING] == expected
    assert len(by_level[logging.INFO]) == max(0, len(parts) - 1)


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
        largest = sfm._map(
            tmp_path / "db",
            tmp_path,
            tmp_path / "models",
            names,
            sfm.SfmOptions(),
            sfm.SfmTolerances(),
        )
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
    assert best_fit_lines(two)[-1] == "The phases fit PPA best: 0.50 deg at the seeds."
