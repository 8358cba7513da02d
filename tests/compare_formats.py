"""Compare one capture in every format: ``compare_formats.py CAPTURE WORK [FORMAT ...]``.

CAPTURE has ``gt/`` and mosaics of 8 bits, whose steps are filled with noise that finer formats
show. Each format is written to a folder of WORK, with the truth turned where the format turns the
images, and run as ``polmvs compare CAPTURE OUT --gt GT --method contour`` with the poses of the
first (``--sparse``): a grain of noise moves those of SfM by more than a format does. Formats that
give the same Stokes images to the last bit share a run. Figures stay in WORK, so that a later call
goes on where one ended. Prints a table, and which figures of a format differ by more than 5 % from
those of floats.
"""

import hashlib
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from capture_writer import FORMATS, Mosaics, Written, rounded, tolerance, turn

from polmvs.camera import PinholeCamera
from polmvs.colmap.models import read_model, write_model
from polmvs.config import (
    BayerOrder,
    CaptureOptions,
    EvaluationOptions,
    Method,
    Options,
    PropagationOptions,
    RunOptions,
    SfmOptions,
)
from polmvs.evaluation.tables import format_table
from polmvs.geometry import RigidTransform
from polmvs.io.ground_truth import open_ground_truth
from polmvs.io.raw_formats import read_raw
from polmvs.pipeline.jobs import AngleModel, compare
from polmvs.pipeline.runner import Job
from polmvs.polarization.capture import open_capture

REFERENCE = "npy, float64"
# The axes of a turned image in those of the image, by TIFF orientation.
AXES = {
    1: [[1, 0], [0, 1]],
    2: [[-1, 0], [0, 1]],
    3: [[-1, 0], [0, -1]],
    4: [[1, 0], [0, -1]],
    5: [[0, 1], [1, 0]],
    6: [[0, -1], [1, 0]],
    7: [[0, -1], [-1, 0]],
    8: [[0, 1], [-1, 0]],
}


def jpeg(folder: Path, mosaics: Mosaics) -> Written:
    for stem, share in mosaics.items():
        cv2.imwrite(str(folder / f"{stem}.jpg"), rounded(share, 8), [cv2.IMWRITE_JPEG_QUALITY, 98])
    return Written(CaptureOptions(), tolerance(6))


def exposures(folder: Path, mosaics: Mosaics) -> Written:
    for stem, share in mosaics.items():
        for time in (1, 4):
            samples = rounded(np.clip(share * time / 2, 0, 1), 12)
            cv2.imwrite(str(folder / f"{stem}_{time}ms.png"), samples)
    return Written(CaptureOptions(), tolerance(12))


def colour_mosaic(folder: Path, mosaics: Mosaics) -> Written:
    """A colour sensor (its sides are multiples of 4) before a grey scene, less light in red and
    blue."""
    brightness = np.kron([[0.6, 1.0], [1.0, 0.7]], np.ones((2, 2)))
    for stem, share in mosaics.items():
        height, width = share.shape
        cells = np.tile(brightness, (height // 4, width // 4))
        cv2.imwrite(str(folder / f"{stem}.png"), rounded(share * cells, 12))
    return Written(CaptureOptions(bayer=BayerOrder.RGGB), tolerance(12))


ALL = {
    **FORMATS,
    "colour mosaic": colour_mosaic,
    "jpeg, quality 98": jpeg,
    "two exposures": exposures,
}


def turned(pixels: np.ndarray, orientation: int) -> np.ndarray:
    return np.dstack([turn(plane, orientation) for plane in cv2.split(pixels)]).squeeze()


def turned_truth(source: Path, folder: Path, orientation: int) -> tuple[float, ...]:
    """Write the truth of the turned images; their intrinsics.

    A mirrored image is one of the world mirrored in x.
    """
    axes = np.eye(3)
    axes[:2, :2] = AXES[orientation]
    world = np.diag([np.linalg.det(axes), 1, 1])
    cameras = json.loads((source / "cameras.json").read_text())
    size = np.array([cameras["width"], cameras["height"]])
    turned_size = np.abs(axes[:2, :2]) @ size
    for image in cameras["images"].values():
        matrix, pose = np.array(image["K"]), np.array(image["cam_from_world"])
        center = axes[:2, :2] @ (matrix[:2, 2] - size / 2) + turned_size / 2
        focal = np.abs(axes[:2, :2]) @ np.diag(matrix)[:2]
        image["K"] = [[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]]
        pose = np.column_stack([axes @ pose[:, :3] @ world, axes @ pose[:, 3]])
        image["cam_from_world"] = pose.tolist()
    cameras["width"], cameras["height"] = map(int, turned_size)
    folder.mkdir(exist_ok=True)
    (folder / "cameras.json").write_text(json.dumps(cameras))
    for path in source.glob("*.png"):
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if path.stem.endswith("_normal"):
            normals = (pixels[..., ::-1] / 32767.5 - 1) @ axes.T
            pixels = np.rint((normals + 1) * 32767.5).astype(np.uint16)[..., ::-1]
        assert cv2.imwrite(str(folder / path.name), turned(pixels, orientation))
    return (*focal, *center)


def turned_model(source: Path, folder: Path, orientation: int, intrinsics: tuple[float, ...]):
    """Write a model's views and points as the turned images see them."""
    model = read_model(source)
    axes = np.eye(3)
    axes[:2, :2] = AXES[orientation]
    world = np.diag([np.linalg.det(axes), 1, 1])
    old = model.views[0].camera
    size = np.array([old.width, old.height])
    turned_size = np.abs(axes[:2, :2]) @ size
    numbers = (*map(int, turned_size), *intrinsics)
    names = ("width", "height", "fx", "fy", "cx", "cy")
    camera = PinholeCamera(**dict(zip(names, numbers, strict=True)))
    views = tuple(
        replace(
            view,
            camera=camera,
            cam_from_world=RigidTransform(
                axes @ view.cam_from_world.rotation @ world, axes @ view.cam_from_world.translation
            ),
        )
        for view in model.views
    )
    tracks = replace(
        model.tracks,
        points_in_world=model.tracks.points_in_world @ world,
        obs_xy=(model.tracks.obs_xy - size / 2) @ axes[:2, :2].T + turned_size / 2,
    )
    write_model(replace(model, views=views, tracks=tracks), folder)


def digest(capture: Path, written: Written) -> str:
    """Of all Stokes images."""
    opened = open_capture(capture, written.options)
    total = hashlib.sha256()
    for name in opened.names:
        stokes = opened.load(name)
        for image in (stokes.s0, stokes.s1, stokes.s2, stokes.sigma, stokes.valid):
            total.update(np.ascontiguousarray(image).tobytes())
    return total.hexdigest()[:12]


def run(capture: Path, truth: Path, written: Written, work: Path) -> dict:
    """Figures of one format."""
    work.mkdir(exist_ok=True)
    if not (work / "metrics.json").exists():
        intrinsics = turned_truth(truth, work / "gt", written.turn)
        model = work.parent / "sparse"
        sfm = SfmOptions(intrinsics=intrinsics)
        if model.exists():
            turned_model(model, work / "sparse", written.turn, intrinsics)
            sfm = SfmOptions(sparse=work / "sparse")
        options = Options(
            capture=written.options,
            sfm=sfm,
            propagation=PropagationOptions(method=Method.CONTOUR),
            evaluation=EvaluationOptions(gt=work / "gt"),
        )
        alone = RunOptions(workers=1, overwrite=True)
        job = Job(capture=capture, out=work / "out", options=options, run_options=alone)
        compare(job, (AngleModel.OPA, AngleModel.PPA))
        shutil.copy(work / "out" / "metrics.json", work / "metrics.json")
        if not model.exists():
            shutil.copytree(work / "out" / "sparse", model)
        shutil.rmtree(work / "out")
    return json.loads((work / "metrics.json").read_text())


def figures(metrics: dict) -> dict[str, float]:
    found = {}
    for name, model in metrics["models"].items():
        cloud, maps = model["truth"]["cloud"], model["truth"]["maps"]
        found |= {
            f"{name} F, %": 100 * cloud["f_score"][0],
            f"{name} completeness, %": 100 * cloud["completeness"][1],
            f"{name} Chamfer, mm": 1e3 * cloud["chamfer_m"],
            f"{name} depth, mm": 1e3 * maps["depth_rmse_m"],
            f"{name} normals, deg": maps["normals"]["mean_deg"],
            f"{name} phase, deg": metrics["phase"]["maps"][name]["rmse_deg"],
        }
    return found


def main(capture: Path, work: Path, names: list[str]) -> None:
    truth = capture / "gt"
    rng = np.random.default_rng(0)
    mosaics = {}
    for stem in (Path(name).stem for name in open_ground_truth(truth).names):
        raw = read_raw(capture / "raw" / f"{stem}.png").samples
        share = np.clip((raw + rng.uniform(-0.5, 0.5, raw.shape)) / 255, 0, 1)
        share[raw == 255] = 1.0
        mosaics[stem] = share
    rows, reference = [], {}
    chosen = list(names or ALL)
    if "colour mosaic" in chosen and any(
        side % 4 for share in mosaics.values() for side in share.shape
    ):
        print("colour mosaic: left out, sides of the mosaics are no multiples of 4.", flush=True)
        chosen.remove("colour mosaic")
    for name in dict.fromkeys([REFERENCE, *chosen]):
        folder = work / "capture"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        written = ALL[name](folder, mosaics)
        key = digest(folder, written)
        found = figures(run(folder, truth, written, work / key))
        shutil.rmtree(folder)
        reference = reference or found
        rows.append([name, key[:6], *(f"{value:.3g}" for value in found.values())])
        for figure, value in found.items():
            change = value / reference[figure] - 1
            if abs(change) > 0.05:
                print(f"{name}: {figure} differs by {100 * change:.1f} %", flush=True)
        print(rows[-1], flush=True)
    print(format_table(["format", "Stokes", *reference], rows))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:])
