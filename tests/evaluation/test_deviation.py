"""Deviation from a reference: a known dent is found wherever, and in whatever unit, the part is."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from polmvs.errors import OptionError
from polmvs.evaluation.deviation import MeasuredPart, infer_unit, measure_deviation
from polmvs.evaluation.registration import CloudReference, MeshReference, register
from polmvs.surface.mesh_geometry import TriangleMesh

NOISE_M = 5e-5
DENT_M = 5e-4


def part() -> trimesh.Trimesh:
    """A block with a rib to one side: no turn lays it onto itself. Metres."""
    block = trimesh.creation.box((0.12, 0.08, 0.03))
    rib = trimesh.creation.box((0.02, 0.05, 0.02))
    rib.apply_translation([0.03, 0.01, 0.025])
    knob = trimesh.creation.icosphere(subdivisions=3, radius=0.01)
    knob.apply_translation([-0.04, -0.02, 0.015])
    return trimesh.util.concatenate([block, rib, knob])


def scanned(dent: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of all of it but the lower side, with noise, and which of them lie in the dent."""
    points, face = trimesh.sample.sample_surface(part(), 30_000, seed=seed)
    points, normals = np.asarray(points), part().face_normals[face]
    hidden = (normals[:, 2] < -0.5) | _inside(points)
    points, normals = points[~hidden], normals[~hidden]
    top = (normals[:, 2] > 0.9) & (np.abs(points[:, 2] - 0.015) < 1e-9)
    in_dent = top & (np.hypot(points[:, 0] + 0.005, points[:, 1] + 0.02) < 0.012)
    rng = np.random.default_rng(seed)
    points = points + rng.normal(0, NOISE_M, (len(points), 1)) * normals
    points[in_dent] -= dent * normals[in_dent]
    return points, normals, in_dent


def _inside(points: np.ndarray) -> np.ndarray:
    """Faces of the parts that lie in each other."""
    x, y, z = points.T
    rib = (np.abs(x - 0.03) < 0.01) & (np.abs(y - 0.01) < 0.025) & (z < 0.0151)
    knob = (np.hypot(x + 0.04, y + 0.02) < 0.01) & (z < 0.0151)
    return rib | knob


def moved(
    points: np.ndarray, normals: np.ndarray, scale: float = 1.0, sigma: np.ndarray | None = None
) -> MeasuredPart:
    turn = Rotation.from_euler("xyz", [100, -35, 200], degrees=True).as_matrix()
    return MeasuredPart(
        points=scale * (points @ turn.T) + [0.4, -1.2, 3.0],
        normals=normals @ turn.T,
        sigma=sigma,
        is_metric=scale == 1,
    )


def reference(scale: float = 1e3) -> MeshReference:
    mesh = part()
    # Of the outside alone: a drawing has no faces within.
    return MeshReference(
        TriangleMesh(scale * np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64))
    )


def test_a_dent_is_found_within_its_stated_deviation() -> None:
    points, normals, in_dent = scanned(DENT_M)
    sigma = np.full(len(points), NOISE_M)
    found = measure_deviation(
        moved(points, normals, sigma=sigma),
        reference(),
        unit=None,
        tolerance_mm=0.25,
        least_share=0.99,
    )
    figures = found.figures
    assert (figures.unit, figures.unit_inferred, figures.scale) == ("mm", True, 1)
    assert not figures.ambiguous
    assert figures.num_far < 1e-3 * len(points)  # at edges the other face may be nearer
    in_dent = in_dent[found.index]
    dent = found.distance[in_dent].mean()
    # The mean of some hundred points; the fit is pulled by none of them.
    assert dent == pytest.approx(-1e3 * DENT_M, abs=0.02)
    flat = ~in_dent & (np.abs(found.distance) < 0.4)
    assert np.std(found.distance[flat]) == pytest.approx(1e3 * NOISE_M, rel=0.1)
    assert abs(found.distance[flat].mean()) < 0.01
    np.testing.assert_allclose(found.sigma, 1e3 * NOISE_M, rtol=0.05)
    assert np.mean(np.abs(found.distance[in_dent] + 1e3 * DENT_M) < 3 * found.sigma[in_dent]) > 0.98
    share = in_dent.mean()
    assert figures.share_within == pytest.approx(1 - share, abs=0.005)
    assert figures.passed is (figures.share_within >= 0.99)
    assert figures.significant_share == pytest.approx(share, abs=0.006)
    points, normals, _ = scanned(0.0)
    sound = measure_deviation(
        MeasuredPart(points=points, normals=normals),
        reference(),
        unit="mm",
        tolerance_mm=0.25,
        least_share=0.999,
    )
    assert sound.figures.passed is True
    assert np.isnan(sound.figures.median_sigma)


def test_a_result_of_any_scale() -> None:
    points, normals, in_dent = scanned(DENT_M)
    found = measure_deviation(moved(points, normals, scale=7.3), reference(), unit="mm")
    assert found.figures.scale == pytest.approx(1e3 / 7.3, rel=5e-4)
    assert found.distance[in_dent[found.index]].mean() == pytest.approx(-1e3 * DENT_M, abs=0.03)
    with pytest.raises(OptionError, match="has no metric scale"):
        measure_deviation(moved(points, normals, scale=7.3), reference(), unit=None)


def test_a_wrong_size_is_told_and_not_fitted_away() -> None:
    points, normals, _ = scanned(0.0)
    found = measure_deviation(moved(1.02 * points, normals), reference(), unit=None)
    assert found.figures.scale == 1
    assert found.figures.percentiles["99"] > 0.5  # 2 % of half of 120 mm is 1.2 mm


def test_an_aligned_result_stays_where_it_is() -> None:
    points, normals, _ = scanned(0.0)
    found = measure_deviation(
        MeasuredPart(points=points + np.array([0, 0, 1e-3]), normals=normals),
        reference(),
        unit="mm",
        aligned=True,
    )
    up = found.normals[:, 2] > 0.9
    assert found.distance[up].mean() == pytest.approx(1.0, abs=0.01)


def test_two_scans_of_one_part() -> None:
    points, normals, _ = scanned(0.0)
    other = CloudReference(*scanned(0.0, seed=1)[:2])
    found = measure_deviation(moved(points, normals), other, unit="m")
    # Noise of both; points at edges have no tangent plane.
    assert np.median(np.abs(found.distance)) < 2 * 1e3 * NOISE_M


def test_a_part_that_looks_alike_when_turned_is_called_ambiguous() -> None:
    box = trimesh.creation.box((0.12, 0.08, 0.03))
    points, face = trimesh.sample.sample_surface(box, 5000, seed=0)
    target = MeshReference(TriangleMesh(np.asarray(box.vertices), np.asarray(box.faces, np.int64)))
    found = register(np.asarray(points), box.face_normals[face], target)
    assert found.runner_up < 1.1
    assert found.rms < 1e-6


@pytest.mark.parametrize(
    ("factor", "unit"), [(1e3, "mm"), (1e2, "cm"), (1.0, "m"), (1 / 0.0254, "inch")]
)
def test_units_are_inferred(factor: float, unit: str) -> None:
    points = scanned(0.0)[0]
    assert infer_unit(points, 1.1 * factor * points) == unit


def test_a_size_of_no_unit() -> None:
    points = scanned(0.0)[0]
    with pytest.raises(OptionError, match="follows from no size"):
        infer_unit(points, 30_000 * points)
