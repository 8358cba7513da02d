"""The paper's experiments: exact on analytic scenes, their statistics, output and bad input."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scenes import CAMERA

import polmvs
from polmvs.config import (
    CaptureOptions,
    ExperimentOptions,
    Poses,
    RegionOptions,
)
from polmvs.errors import OptionError
from polmvs.experiments import output
from polmvs.experiments.contours import (
    Lines,
    PlaneSurface,
    SampledSurface,
    edge_seeds,
    line_set_bytes,
    measure_contours,
    pool_lines,
)
from polmvs.experiments.data import Scene, load_view, open_experiment, open_scene
from polmvs.experiments.phase import ErrorTally, measure_phase, phase_images, ratio_to_opa
from polmvs.experiments.plane import measure_plane
from polmvs.experiments.tracks import check_k, measure_tracks, order_at_random, order_by_angle
from polmvs.io.images import write_png
from polmvs.io.open3d_import import import_open3d
from polmvs.parallel import Workers
from polmvs.polarization.capture import open_capture
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.synthetic.captures import quantize, render_mosaic, render_view, ring_of_views
from polmvs.synthetic.surfaces import Plane

DEMO = Path(polmvs.__file__).parent / "demo_capture"
SURFACE = Plane(point=np.zeros(3), normal=np.array([0.1, -0.05, 1.0]), extent=(0.12, 0.15))
UNIT_NORMAL = SURFACE.normal / np.linalg.norm(SURFACE.normal)


@dataclass(frozen=True)
class SyntheticTruth:
    """True maps by rendering."""

    folder: Path
    views: dict

    def _rendered(self, name):
        return render_view(self.views[name], SURFACE)

    def mask(self, name):
        return self._rendered(name).mask

    def depth(self, name):
        return self._rendered(name).depth.astype(np.float32)

    def normals(self, name):
        return self._rendered(name).normals_in_cam.astype(np.float32)


def synthetic_scene(folder: Path, sensor: str, light: str = "specular") -> Scene:
    """A board seen by an exact sensor; 16 bit, so that rounding does not matter."""
    views = ring_of_views(6, CAMERA, distance=0.5, elevation_deg=45, roll_deg=20)
    (folder / "raw").mkdir()
    for view in views:
        mosaic = render_mosaic(view, SURFACE, sensor=sensor, light=light, s0=0.4, background=0.6)
        write_png(folder / "raw" / view.name, quantize(mosaic, 16))
    truth = SyntheticTruth(folder, {view.name: view for view in views})
    region = RegionOptions(light=Light(light), min_dolp=0.05 if light == "diffuse" else 0.1)
    return open_scene(open_capture(folder), truth, region, blur_px=0.5)


@pytest.fixture(scope="module")
def tilted_scene(tmp_path_factory):
    return synthetic_scene(tmp_path_factory.mktemp("tilted"), "tilted")


@pytest.mark.parametrize("sensor", ["opa", "ppa", "tilted"])
def test_phase_of_the_sensors_own_model_is_exact(tmp_path, sensor):
    scene = synthetic_scene(tmp_path, sensor)
    with Workers(1) as workers:
        result = measure_phase(scene, workers)
    medians = {model: stats.median_deg for model, stats in result.all_pixels.items()}
    # Interpolating the mosaic of a curved phase field costs about 0.05 degrees.
    assert medians[AngleModel(sensor)] < 0.1
    assert min(m for model, m in medians.items() if model != sensor) > 0.2
    assert ratio_to_opa(result.all_pixels, AngleModel.OPA) == 1
    columns = result.densities[AngleModel.PPA].sum(axis=-1)
    np.testing.assert_allclose(columns[np.isfinite(columns)], 1)
    images = phase_images(scene, 0)
    assert np.isfinite(images.predicted[AngleModel.TILTED][images.part]).mean() > 0.95


def test_plane_estimates_on_a_tilted_sensor(tilted_scene):
    with Workers(1) as workers:
        result = measure_plane(tilted_scene, workers)
    means = {name: stats.mean_deg for name, stats in result.stats.items()}
    assert means["tilted"] < 0.1
    assert means["tilted"] < means["weighted"] < means["algebraic"]
    assert len(result.per_image) == 6
    assert result.is_planar
    opa, ppa = result.ambiguity[AngleModel.OPA], result.ambiguity[AngleModel.PPA]
    np.testing.assert_allclose(opa.rmse_deg, opa.rmse_turned_deg)
    assert (opa.determined_share, ppa.determined_share) == (0, 1)
    assert ppa.rmse_turned_deg > 5 * ppa.rmse_deg


def test_plane_of_diffuse_light(tmp_path):
    scene = synthetic_scene(tmp_path, "tilted", "diffuse")
    with Workers(1) as workers:
        result = measure_plane(scene, workers)
    assert result.stats["tilted"].mean_deg < 0.3


def test_tracks_on_a_tilted_sensor(tilted_scene):
    options = ExperimentOptions(num_points=300, k=(3, 2))
    with Workers(1) as workers:
        result = measure_tracks(tilted_scene, options, workers)
        again = measure_tracks(tilted_scene, options, workers)
    assert result.k == (2, 3)
    mean = {name: errors.over(np.mean)[1] for name, errors in result.estimators.items()}
    assert mean["tilted_weighted"] < 0.3
    assert mean["tilted_weighted"] < mean["ppa_weighted"] < 0.3 * mean["opa"]
    first, second = (r.estimators["opa"].errors_deg[0] for r in (result, again))
    np.testing.assert_array_equal(first, second)


def test_contours_on_a_tilted_sensor(tilted_scene):
    plane = PlaneSurface(UNIT_NORMAL, 0.0)
    with Workers(1) as workers:
        views = measure_contours(tilted_scene, plane, [0, 3], workers, num_seeds=6)
    stats = {name: pool_lines(views, name) for name in views[0].lines}
    assert [view.name for view in views] == ["000.png", "003.png"]
    assert stats["tilted_tangent"].rmse_mm < 0.15
    assert stats["ppa_tangent"].rmse_mm < 0.25 * stats["opa"].rmse_mm
    assert stats["ppa_normals"].rmse_mm < 0.25 * stats["opa"].rmse_mm
    seeds = edge_seeds(load_view(tilted_scene, 0).part, 6)
    assert seeds.shape == (6, 2)


def test_estimated_camera_turns_the_true_normals(tilted_scene):
    view = tilted_scene.views[1]
    turn = ring_of_views(7, CAMERA)[2].cam_from_world.rotation
    turned = replace(
        view,
        cam_from_world=replace(view.cam_from_world, rotation=turn @ view.cam_from_world.rotation),
    )
    views = (tilted_scene.views[0], turned, *tilted_scene.views[2:])
    data = load_view(replace(tilted_scene, views=views), 1)
    true = load_view(tilted_scene, 1)
    np.testing.assert_allclose(
        data.normals_in_cam[true.part], true.normals_in_cam[true.part] @ turn.T, atol=1e-6
    )


def test_tally_agrees_with_numpy():
    errors = np.random.default_rng(0).normal(1, 5, 5000)
    tally = ErrorTally.of(errors[:2000]) + ErrorTally.of(np.append(errors[2000:], np.nan))
    stats = tally.stats()
    assert stats.num_pixels == 5000
    np.testing.assert_allclose(stats.mean_deg, errors.mean())
    np.testing.assert_allclose(stats.rmse_deg, np.sqrt((errors**2).mean()))
    np.testing.assert_allclose(stats.median_deg, np.median(np.abs(errors)), atol=0.02)
    np.testing.assert_allclose(stats.p95_deg, np.percentile(np.abs(errors), 95), atol=0.02)
    assert np.isnan(ErrorTally.of(np.zeros(0)).stats().median_deg)


def test_orders_put_usable_views_first():
    rng = np.random.default_rng(0)
    usable = rng.random((8, 50)) < 0.6
    order = order_at_random(usable, rng)
    np.testing.assert_array_equal(np.sort(order, axis=0), np.tile(np.arange(8)[:, None], 50))
    counted = np.take_along_axis(usable, order, axis=0)
    assert (np.diff(counted.astype(int), axis=0) <= 0).all()


def test_order_by_angle_takes_the_farthest():
    angles = np.radians([0.0, 10.0, 90.0, 50.0])
    rays = np.stack([np.cos(angles), np.sin(angles), 0 * angles])[:, :, None].repeat(20, axis=2)
    usable = np.ones((4, 20), bool)
    usable[2, 10:] = False
    order = order_by_angle(rays, usable, 3, np.random.default_rng(0))
    assert all(len(set(column)) == 3 for column in order.T)
    starts_at_zero = order[0] == 0
    assert (order[1, starts_at_zero & usable[2]] == 2).all()
    assert (order[1, starts_at_zero & ~usable[2]] == 3).all()
    assert 2 not in order[:, 10:]


@pytest.mark.parametrize("k", [(1, 2), (3, 9), ()])
def test_k_beyond_the_views(k):
    with pytest.raises(OptionError, match=r"`experiment\.k` must lie in 2 to 8"):
        check_k(k, 8)
    assert check_k(None, 4) == (2, 3, 4)
    with pytest.raises(OptionError, match="2 views"):
        check_k(None, 1)


def test_sampled_surface_measures_to_its_tangent_planes():
    x, y = np.meshgrid(np.arange(20) * 1e-3, np.arange(20) * 1e-3)
    points = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    surface = SampledSurface(points, normals, 1e-3)
    queries = np.array([[0.0042, 0.0047, 0.002], [0.01, 0.01, -0.003], [-0.01, 0.005, 0.0]])
    np.testing.assert_allclose(surface.heights(queries), [0.002, -0.003, 0.01], atol=1e-9)


def test_line_sets_open_in_open3d(tmp_path):
    points = np.arange(30, dtype=float).reshape(10, 3)
    curve = np.array([0] * 6 + [1] * 4)
    lines = Lines(points=points, curve=curve, heights=np.zeros(10))
    path = tmp_path / "lines.ply"
    path.write_bytes(line_set_bytes([lines, lines], stride=1))
    loaded = import_open3d().io.read_line_set(str(path))
    np.testing.assert_allclose(np.asarray(loaded.points), np.concatenate([points, points]))
    edges = np.asarray(loaded.lines)
    assert len(edges) == 2 * (5 + 3)
    assert [5, 6] not in edges.tolist()
    empty = Lines(points=np.zeros((0, 3)), curve=np.zeros(0, np.int64), heights=np.zeros(0))
    assert b"element vertex 0" in line_set_bytes([empty])


def open_demo(options: ExperimentOptions = ExperimentOptions()) -> Scene:  # noqa: B008
    return open_experiment(DEMO, options, CaptureOptions(), RegionOptions())


def test_true_poses_as_a_model_give_the_same(tmp_path):
    """A model in another frame and scale, with the true cameras, changes nothing."""
    sparse = tmp_path / "sparse"
    sparse.mkdir()
    scene = open_demo()
    camera = scene.views[0].camera
    (sparse / "cameras.txt").write_text(
        f"1 PINHOLE {camera.width} {camera.height} "
        f"{camera.fx} {camera.fy} {camera.cx} {camera.cy}\n"
    )
    lines = []
    for i, view in enumerate(scene.views, 1):
        w, x, y, z = _quaternion(view.cam_from_world.rotation)
        t = 3.0 * view.cam_from_world.translation
        lines.append(f"{i} {w!r} {x!r} {y!r} {z!r} {t[0]!r} {t[1]!r} {t[2]!r} 1 {view.name}\n\n")
    (sparse / "images.txt").write_text("".join(lines).replace("np.float64(", "").replace(")", ""))
    (sparse / "points3D.txt").write_text("")
    aligned = open_demo(ExperimentOptions(poses=Poses.SFM, sparse=sparse))
    for one, other in zip(scene.views, aligned.views, strict=True):
        assert one.name == other.name
        np.testing.assert_allclose(one.center_in_world, other.center_in_world, atol=1e-9)
        np.testing.assert_allclose(
            one.cam_from_world.rotation, other.cam_from_world.rotation, atol=1e-9
        )
    assert aligned.settings()["poses"] == "sfm"


def _quaternion(rotation):
    w = 0.5 * np.sqrt(max(1 + np.trace(rotation), 0))
    if w > 1e-3:
        skew = rotation - rotation.T
        return w, skew[2, 1] / (4 * w), skew[0, 2] / (4 * w), skew[1, 0] / (4 * w)
    values, vectors = np.linalg.eigh(rotation + rotation.T)
    return 0.0, *vectors[:, values.argmax()]


def test_overwrite_replaces_own_results_only(tmp_path):
    report = output.Report(
        name="phase", title="t", content={"a": np.nan}, text="x", figures={}, lines={}
    )
    (tmp_path / "phase_old.png").write_bytes(b"old")
    (tmp_path / "plane.json").write_text("{}")
    output.check_output(tmp_path, "phase", overwrite=False)
    output.write_report(tmp_path, report)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["phase.json", "phase.md", "plane.json"]
    assert json.loads((tmp_path / "phase.json").read_text()) == {"a": None}
    with pytest.raises(OptionError):
        output.check_output(tmp_path, "phase", overwrite=False)
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(OptionError):
        output.check_output(tmp_path, "tracks", overwrite=False)
