from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from polmvs.camera import PinholeCamera
from polmvs.errors import DataError
from polmvs.evaluation.map_errors import lattice_errors, map_errors
from polmvs.geometry import RigidTransform, SimilarityTransform
from polmvs.io.ground_truth import GroundTruth
from polmvs.scene import View
from polmvs.surface.dense_view import DenseView, lattice_xy
from polmvs.synthetic.captures import render_view, ring_of_views
from polmvs.synthetic.surfaces import Group, Plane, Sphere, Surface

CAMERA = PinholeCamera(width=160, height=128, fx=150.0, fy=150.0, cx=80.0, cy=64.0)
VIEWS = ring_of_views(6, CAMERA, target=np.zeros(3), distance=0.5, elevation_deg=45, roll_deg=20)
PLANE = Plane(point=np.zeros(3), normal=np.array([0.1, -0.05, 1.0]), extent=(0.12, 0.15))
ROTATION = Rotation.from_rotvec([0.3, -2.0, 0.7]).as_matrix()
SHIFT = np.array([5.0, -3.0, 11.0])
STRIDES = (1, 2, 3)


class ExactTruth(GroundTruth):
    """Maps of an analytic surface, not rounded as files are."""

    def __init__(self, surface: Surface, views: list[View] = VIEWS) -> None:
        super().__init__(folder=Path("gt"), views={view.name: view for view in views})
        object.__setattr__(self, "_maps", {v.name: render_view(v, surface) for v in views})

    def mask(self, name: str) -> NDArray[np.bool_]:
        return self._maps[name].mask

    def depth(self, name: str) -> NDArray[np.float32]:
        return self._maps[name].depth.astype(np.float32)

    def normals(self, name: str) -> NDArray[np.float32]:
        return self._maps[name].normals_in_cam.astype(np.float32)


def scrambled(scale: float) -> list[View]:
    """The true views in a world of another scale, orientation and origin."""
    views = []
    for view in VIEWS:
        rotation = view.cam_from_world.rotation @ ROTATION.T
        center = scale * ROTATION @ view.center_in_world + SHIFT
        views.append(replace(view, cam_from_world=RigidTransform(rotation, -rotation @ center)))
    return views


def dense_of(surface: Surface, view: View, scale: float = 1.0, stride_px: int = 2) -> DenseView:
    """What a perfect reconstruction in the scrambled world stores."""
    xy = lattice_xy(CAMERA.height // stride_px, CAMERA.width // stride_px, stride_px)
    rays = CAMERA.rays(xy) @ view.cam_from_world.rotation
    distance, normals = surface.intersect(view.center_in_world, rays)
    known = np.isfinite(distance)
    return DenseView(
        stride_px=stride_px,
        range_map=np.where(known, scale * distance, 0).astype(np.float32),
        normals_in_world=np.where(known[..., None], normals @ ROTATION.T, np.nan).astype(
            np.float32
        ),
        sigma_deg=np.where(known, 1, np.nan).astype(np.float32),
        sigma=np.where(known, scale * 1e-3, np.nan).astype(np.float32),
        confidence=known.astype(np.float32),
    )


@pytest.fixture(scope="module")
def plane() -> ExactTruth:
    return ExactTruth(PLANE)


@pytest.mark.parametrize("scale", [1.0, 7.0])
@pytest.mark.parametrize("stride_px", STRIDES)
def test_truth_in_another_world_is_perfect(plane: ExactTruth, scale: float, stride_px: int) -> None:
    dense = [dense_of(PLANE, view, scale, stride_px) for view in VIEWS]
    errors = map_errors(scrambled(scale), dense, plane)
    assert errors.num_pixels > 6 * 2000 / stride_px**2
    assert errors.coverage == 1
    assert errors.outside < 1e-3
    # Maps of float32 hold half a metre to 30 nm and inverse metres as well.
    assert errors.depth_rmse_m < 2e-7
    assert errors.depth_p95_m < 5e-7
    assert errors.depth_within_1mm == errors.within_two_sigma == 1
    assert errors.sigma_ratio_median < 1e-3
    assert errors.normals.mean_deg < 1e-4
    assert errors.normals.count == errors.num_pixels


def changed(scale: float, change: Callable[[DenseView], DenseView]) -> list[DenseView]:
    return [change(dense_of(PLANE, view, scale)) for view in VIEWS]


@pytest.mark.parametrize("turn_deg", [0.6, 1.5, 4.0])
def test_a_turn_of_the_normals_in_units_of_its_sigma(plane: ExactTruth, turn_deg: float) -> None:
    def change(one: DenseView) -> DenseView:
        normal = one.normals_in_world
        across = np.cross(normal, np.roll(normal, 1, axis=-1))
        across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
        turned = np.cos(np.radians(turn_deg)) * normal + np.sin(np.radians(turn_deg)) * across
        sigma = np.full_like(one.sigma_deg, 1.0)
        sigma[::2] = np.inf  # unknown: no part of the shares
        return replace(one, normals_in_world=turned.astype(np.float32), sigma_deg=sigma)

    errors = map_errors(scrambled(1.0), changed(1.0, change), plane)
    assert errors.normals.median_deg == pytest.approx(turn_deg, rel=1e-3)
    assert errors.normals_within_one_sigma == (1 if turn_deg < 1 else 0)
    assert errors.normals_within_two_sigma == (1 if turn_deg < 2 else 0)


@pytest.mark.parametrize("offset_m", [0.0005, -0.002])
def test_an_offset_of_the_range_in_units_of_its_sigma(plane: ExactTruth, offset_m: float) -> None:
    scale, sigma_m = 7.0, 0.0008

    def change(one: DenseView) -> DenseView:
        moved = np.where(one.range_map > 0, one.range_map + scale * offset_m, 0)
        sigma = np.full_like(one.sigma, scale * sigma_m)
        return replace(one, range_map=moved.astype(np.float32), sigma=sigma)

    errors = map_errors(scrambled(scale), changed(scale, change), plane)
    assert errors.sigma_ratio_median == pytest.approx(abs(offset_m) / sigma_m, rel=1e-3)
    assert errors.within_one_sigma == (1 if abs(offset_m) < sigma_m else 0)
    assert errors.within_two_sigma == (1 if abs(offset_m) < 2 * sigma_m else 0)
    # Depth errs by z / range of it: 0.78 at the corners of the image.
    assert 0.78 * abs(offset_m) < abs(errors.depth_bias_m) < abs(offset_m)
    assert np.sign(errors.depth_bias_m) == np.sign(offset_m)
    assert errors.depth_rmse_m == pytest.approx(abs(errors.depth_bias_m), rel=0.05)
    assert errors.depth_median_m < errors.depth_p95_m < abs(offset_m)
    assert errors.depth_within_1mm == (abs(offset_m) < 1e-3)
    assert errors.normals.mean_deg < 1e-4
    assert errors.coverage == 1


def test_errors_of_one_view_lie_where_they_arise(plane: ExactTruth) -> None:
    view, same = VIEWS[0], SimilarityTransform(1.0, np.eye(3), np.zeros(3))
    dense = dense_of(PLANE, view)
    dense = replace(dense, normals_in_world=(dense.normals_in_world @ ROTATION).astype(np.float32))
    moved = dense.range_map.copy()
    moved[20:24, 30:40] += np.float32(0.003)
    moved[26:30, 30:40] = 0
    errors = lattice_errors(view, replace(dense, range_map=moved), plane, same)
    z = CAMERA.rays(dense.lattice_xy())[..., 2]
    np.testing.assert_allclose(errors.depth_m[20:24, 30:40], 0.003 * z[20:24, 30:40], atol=1e-6)
    assert np.isnan(errors.depth_m[26:30, 30:40]).all()
    assert not errors.known[26:30, 30:40].any()
    elsewhere = errors.on_part & errors.known
    elsewhere[20:24, 30:40] = False
    assert np.abs(errors.depth_m[elsewhere]).max() < 1e-6
    assert errors.normal_deg[elsewhere].max() < 0.01
    np.testing.assert_allclose(errors.sigma_m[elsewhere], 1e-3 * z[elsewhere], rtol=1e-5)
    assert np.isnan(errors.depth_m[~errors.on_part]).all()
    assert not (errors.on_part & errors.off_part).any()
    nothing = lattice_errors(view, None, plane, same, stride_px=2)
    np.testing.assert_array_equal(nothing.on_part, errors.on_part)
    assert not nothing.known.any()
    assert np.isnan(nothing.depth_m).all()


def test_turned_normals(plane: ExactTruth) -> None:
    normal = ROTATION @ PLANE.normal / np.linalg.norm(PLANE.normal)
    turn = Rotation.from_rotvec(np.radians(5) * np.linalg.svd(normal[None])[2][1]).as_matrix()

    def change(one: DenseView) -> DenseView:
        return replace(one, normals_in_world=(one.normals_in_world @ turn.T).astype(np.float32))

    errors = map_errors(scrambled(7.0), changed(7.0, change), plane)
    assert errors.normals.mean_deg == pytest.approx(5, abs=1e-4)
    assert errors.normals.median_deg == pytest.approx(5, abs=1e-4)
    assert errors.depth_rmse_m < 2e-7


def test_holes_count_against_coverage_only(plane: ExactTruth) -> None:
    def change(one: DenseView) -> DenseView:
        holes = one.range_map.copy()
        holes[::2] = 0
        return replace(one, range_map=holes)

    errors = map_errors(scrambled(1.0), changed(1.0, change), plane)
    assert errors.coverage == pytest.approx(0.5, abs=0.02)
    assert errors.depth_rmse_m < 2e-7


def test_views_without_a_map_count_against_coverage(plane: ExactTruth) -> None:
    dense: list[DenseView | None] = [dense_of(PLANE, view) for view in VIEWS]
    whole = map_errors(scrambled(1.0), dense, plane)
    for k in (0, 3):  # each other's mirror image in the ring, not alone in its size
        dense[k] = None
    part = map_errors(scrambled(1.0), dense, plane)
    assert part.num_pixels < whole.num_pixels
    assert part.coverage == pytest.approx(part.num_pixels / whole.num_pixels)
    none = map_errors(scrambled(1.0), [None] * 6, plane)
    assert (none.coverage, none.num_pixels, none.normals.count) == (0, 0, 0)
    figures = (none.outside, none.depth_rmse_m, none.depth_median_m, none.depth_within_1mm)
    assert np.isnan([*figures, none.sigma_ratio_median, none.within_one_sigma]).all()


def test_values_beside_the_part(plane: ExactTruth) -> None:
    def change(one: DenseView) -> DenseView:
        return replace(one, range_map=np.where(one.range_map > 0, one.range_map, np.float32(1)))

    errors = map_errors(scrambled(1.0), changed(1.0, change), plane)
    beside = 1 - np.mean([plane.mask(view.name) for view in VIEWS])
    assert errors.outside == pytest.approx(beside, abs=0.03)
    assert errors.depth_rmse_m < 2e-7


def test_between_two_surfaces_there_is_no_truth() -> None:
    """One part before another: interpolated across the step the truth is 50 mm wrong."""
    high = Plane(point=np.array([0, 0, 0.1]), normal=np.array([0, 0, 1.0]), extent=(0.04, 0.04))
    surface = Group((PLANE, high))
    dense = [dense_of(surface, view) for view in VIEWS]
    errors = map_errors(scrambled(1.0), dense, ExactTruth(surface))
    alone = map_errors(scrambled(1.0), [dense_of(PLANE, v) for v in VIEWS], ExactTruth(PLANE))
    assert errors.depth_rmse_m < 2e-7
    assert errors.coverage == 1
    # About 4 sides of 25 px in each of 6 views, every second pixel, are left out.
    assert errors.num_pixels / alone.num_pixels > 0.9


def test_curved_surface_up_to_its_outline() -> None:
    """Inverse depth of a sphere is interpolated to a share of the sagitta of half a pixel."""
    sphere = Sphere(center=np.zeros(3), radius=0.1)
    errors = map_errors(scrambled(1.0), [dense_of(sphere, v) for v in VIEWS], ExactTruth(sphere))
    gsd_m = 0.5 / CAMERA.fx
    assert errors.depth_median_m < gsd_m**2 / 0.1
    assert errors.normals.median_deg < 0.1
    assert errors.coverage == 1


def test_names_and_sizes(plane: ExactTruth) -> None:
    views, dense = scrambled(1.0), [dense_of(PLANE, view) for view in VIEWS]
    whole = map_errors(views, dense, plane)
    renamed = [*views[:4], replace(views[4], name="x.png"), replace(views[5], name="y.png")]
    assert map_errors(renamed, dense, plane).num_pixels < whole.num_pixels
    with pytest.raises(DataError, match="needs 3"):
        map_errors([*views[:2], *renamed[4:]], dense[:4], plane)
    with pytest.raises(ValueError, match="zip"):
        map_errors(views, dense[:5], plane)
    wide = [replace(view, camera=replace(CAMERA, width=320)) for view in views]
    with pytest.raises(DataError, match=r"160x128 px but the capture's are 320x128"):
        map_errors(wide, dense, plane)


def test_comparison_tells_of_the_maps(demo_run: Path) -> None:
    metrics = json.loads((demo_run / "metrics.json").read_text())
    maps = {name: model["truth"]["maps"] for name, model in metrics["models"].items()}
    assert maps["ppa"]["depth_rmse_m"] < 0.001
    assert maps["opa"]["depth_rmse_m"] > 2 * maps["ppa"]["depth_rmse_m"]
    assert maps["ppa"]["normals"]["median_deg"] < 1 < maps["opa"]["normals"]["median_deg"]
    assert maps["ppa"]["coverage"] > 0.9
    summary = (demo_run / "summary.md").read_text()
    rows = {line.split("|")[1].strip(): line for line in summary.splitlines() if "|" in line}
    for name in (
        "depth maps, RMSE, mm",
        "depth maps within 1 mm, %",
        "depths within one / two sigma, %",
        "normal maps, mean / median error, deg",
        "normals within one / two sigma, %",
    ):
        assert any(digit in rows[name] for digit in "0123456789")
