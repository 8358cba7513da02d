"""Lengths on the page are in the unit that stands beside them."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from polmvs.geometry import SimilarityTransform
from polmvs.io.clouds import Cloud
from polmvs.polarization.kinds import AngleModel
from polmvs.report import report
from polmvs.report.report import ReportInput, scene_layers
from polmvs.scene import PointKind


@pytest.mark.parametrize(
    ("is_metric", "scale", "factor", "unit"),
    [
        (True, None, 1000.0, "mm"),
        (False, None, 1.0, "model units"),
        (False, 0.25, 250.0, "mm"),  # by the truth, of which one model unitss is 0.25 m
    ],
)
def test_deviations_of_a_metric_cloud_are_millimetres(
    is_metric, scale, factor, unit, monkeypatch
) -> None:
    sigma = np.full(50, 0.002)
    cloud = Cloud(
        points=np.random.default_rng(0).normal(size=(50, 3)),
        normals=np.tile([0, 0, 1.0], (50, 1)),
        scalars={"sigma": sigma, "kind": np.full(50, PointKind.SURFACE)},
    )
    nothing = SimpleNamespace(is_file=lambda: False)
    given = SimpleNamespace(
        clouds={AngleModel.PPA: cloud},
        record=SimpleNamespace(result=lambda kind: SimpleNamespace(is_metric=is_metric)),
        truth=None,
        models=(AngleModel.PPA,),
        folder=SimpleNamespace(mesh=lambda model: nothing, views=lambda model: Path("nowhere")),
        is_metric=is_metric,
        deviation=None,
        sparse=SimpleNamespace(views=range(6)),
    )
    if scale is not None:
        similarity = SimilarityTransform(scale, np.eye(3), np.zeros(3))
        places = scale * cloud.points + [0, 0, 0.001]
        true = SimpleNamespace(points=places, normals=np.asarray(cloud.normals))
        given.truth = (SimpleNamespace(surface_points=lambda: true), similarity)
    given.length = ReportInput.length.fget(given)
    monkeypatch.setattr(report, "_residuals", lambda *_: np.full(50, 1.0))
    layers, channels = scene_layers(given)
    assert channels["sigma"].unit == unit
    assert channels["sigma"].high == pytest.approx(0.002 * factor)
    np.testing.assert_allclose(layers[0].values["sigma"], 0.002 * factor)
    if scale is not None:
        assert channels["error"].unit == "mm"
        np.testing.assert_allclose(layers[0].values["error"], 1.0, atol=1e-6)
