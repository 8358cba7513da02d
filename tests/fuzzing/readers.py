"""Every reader, with sound files for it: what the fuzz test damages.

A kind writes its files into a folder and reads them again as the program does. The files are as
small as they can be, so that a mutation hits what matters.
"""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import capture_writer
import cv2
import data_set_writer
import numpy as np
import pycolmap
from dense_scenes import OPENCV, PINHOLE, board_scene
from scenes import phase_map_of

from polmvs.camera import PinholeCamera
from polmvs.cli.call import read_config
from polmvs.colmap.database import check_database, copy_database, opened, read_descriptors, sound
from polmvs.colmap.dense_workspace import open_dense_workspace
from polmvs.colmap.models import match_model_to_capture, read_model, write_model
from polmvs.colmap.pairs import read_pairs
from polmvs.config import (
    CaptureOptions,
    Options,
    groups_of,
    options_from_plain,
    to_plain,
)
from polmvs.evaluation.comparison import Comparison, SparseFigures, read_comparison
from polmvs.experiments.contours import open_surface
from polmvs.io.arrays import map_array
from polmvs.io.clouds import (
    Cloud,
    Mesh,
    has_triangles,
    read_cloud,
    read_mesh,
    write_cloud,
    write_mesh,
)
from polmvs.io.data_sets import load_converted, read_data_set, read_set_mask
from polmvs.io.ground_truth import open_ground_truth
from polmvs.io.images import read_gray, read_mask
from polmvs.io.intrinsics import read_intrinsics
from polmvs.io.layouts import read_author_truth
from polmvs.io.raw_formats import probe_raw, read_raw
from polmvs.neighbors import nearest_points, voxel_representatives
from polmvs.pipeline.batch import read_batch
from polmvs.pipeline.record import Record, read_image_names, read_options
from polmvs.pipeline.run_folder import RunFolder, mark_own_workspace, require_own
from polmvs.pipeline.run_lock import locked
from polmvs.pipeline.runner import load_record
from polmvs.pipeline.stages.normals import NORMALS_TYPE
from polmvs.pipeline.stages.seeds import SEEDS_TYPE, load_seeds, seed_tracks
from polmvs.polarization.capture import open_capture
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import open_phase_map, store_phase_map
from polmvs.poses.known_poses import retriangulate
from polmvs.poses.metric_frame import read_centers
from polmvs.scene import View, point_sigmas
from polmvs.surface.dense_view import DenseView, find_dense_view, store_dense_view
from polmvs.synthetic.captures import render_view, ring_of_views
from polmvs.synthetic.surfaces import Plane


class Kind(NamedTuple):
    """Files of one kind.

    Attributes
    ----------
    write : into an empty folder.
    read : as the program does; returns anything, or fails with a ``PolmvsError``.
    """

    write: Callable[[Path], object]
    read: Callable[[Path], object]


RNG = np.random.default_rng(0)
SHARE = np.clip(RNG.normal(0.5, 0.2, (16, 24)), 0, 0.95)


def capture(name: str) -> Kind:
    """A capture of two views in one of the formats of the capture writer."""
    options = []

    def write(folder: Path) -> None:
        (folder / "c").mkdir()
        mosaics = {"a": SHARE, "b": SHARE[::-1]}
        options.append(capture_writer.FORMATS[name](folder / "c", mosaics).options)

    def read(folder: Path) -> object:
        opened = open_capture(folder / "c", options[-1])
        return [opened.load(name) for name in opened.names]

    return Kind(write, read)


def image(name: str, read: Callable[[Path], object], pixels=None) -> Kind:
    """One image in the container of its suffix."""
    pixels = np.rint(255 * SHARE).astype(np.uint8) if pixels is None else pixels
    return Kind(
        lambda folder: cv2.imwrite(str(folder / name), pixels), lambda folder: read(folder / name)
    )


def data_set(writer: Callable) -> Kind:
    def write(folder: Path) -> None:
        views = some_views()
        source = {str(k): (SHARE, view, SHARE[::2, ::2] > 0.4) for k, view in enumerate(views)}
        writer(folder / "set", source)

    def read(folder: Path) -> None:
        found = read_data_set(folder / "set")
        if found.capture is None:
            for stem in found.names:
                load_converted(found, stem)
        else:
            opened = open_capture(found.capture, found.options)
            opened.load(opened.names[0])
        for path in found.masks.values():
            read_set_mask(path)
        if found.sparse is not None:
            read_model(found.sparse)

    return Kind(write, read)


def text(name: str, content: str, read: Callable[[Path], object]) -> Kind:
    return Kind(
        lambda folder: (folder / name).write_text(content), lambda folder: read(folder / name)
    )


def small_camera() -> PinholeCamera:
    return PinholeCamera(width=12, height=8, fx=10.0, fy=10.0, cx=6.0, cy=4.0)


def some_views(num: int = 3) -> list[View]:
    return ring_of_views(num, small_camera(), distance=0.5, elevation_deg=50)


# Clouds and meshes


def write_some_cloud(folder: Path) -> None:
    normals = np.tile([0, 0, 1.0], (20, 1))
    colors = np.full((20, 3), 9, np.uint8)
    cloud = Cloud(RNG.normal(size=(20, 3)), normals, colors, {"sigma_deg": np.ones(20)})
    write_cloud(folder / "a.ply", cloud)


def write_ascii_cloud(folder: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 6\n" + "".join(
        f"property float {name}\n" for name in ("x", "y", "z", "quality")
    )
    header += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    rows = "".join(f"{i} {i % 3}.5 -1e-3 7\n" for i in range(6)) + "3 0 1 2\n4 0 1 2 5\n"
    (folder / "a.ply").write_text(header + rows)


def write_some_mesh(folder: Path) -> None:
    points = RNG.normal(size=(9, 3))
    triangles = np.array([[0, 1, 2], [2, 3, 4], [5, 6, 7], [6, 7, 8]], np.int32)
    write_mesh(folder / "a.ply", Mesh(points, np.tile([0, 0, 1.0], (9, 1)), triangles))


def write_polygons(folder: Path) -> None:
    write_some_mesh(folder)
    data = (folder / "a.ply").read_bytes()
    (folder / "a.ply").write_bytes(
        data.replace(b"element face 4", b"element face 5") + struct.pack("<B4i", 4, 0, 1, 2, 3)
    )


def read_any_ply(folder: Path) -> None:
    path = folder / "a.ply"
    cloud = read_cloud(path)
    if len(cloud.points):
        voxel_representatives(cloud.points, 0.001)
        nearest_points(cloud.points, np.zeros((2, 3)), far=0.1)
    if has_triangles(path):
        read_mesh(path)


# COLMAP's models and workspaces


def use_model(path: Path) -> None:
    """What a run does with a model: cameras' rays, tracks, triangulation."""
    model = read_model(path)
    names = [view.name for view in model.views]
    width, height = model.views[0].camera.width, model.views[0].camera.height
    model = match_model_to_capture(model, names, width, height)
    if len(model.tracks.point3D_ids):
        point_sigmas(model.tracks, model.views)
    tracks = retriangulate(model.views, model.tracks)
    if len(tracks.point3D_ids):
        point_sigmas(tracks, model.views)
    write_model(model, path.parent / "again")


def model(camera, *, five: bool, as_text: bool = False) -> Kind:
    def write(folder: Path) -> None:
        write_model(board_scene(camera, 3).model, folder / "sparse")
        if as_text:
            reconstruction = pycolmap.Reconstruction(str(folder / "sparse"))
            for path in (folder / "sparse").iterdir():
                path.unlink()
            reconstruction.write_text(str(folder / "sparse"))
        for name in () if five else ("rigs", "frames"):
            for suffix in (".bin", ".txt"):
                (folder / "sparse" / f"{name}{suffix}").unlink(missing_ok=True)

    return Kind(write, lambda folder: use_model(folder / "sparse"))


def write_database(folder: Path) -> None:
    """Two views with features, matches and a verified pair."""
    pycolmap.Database.open(folder / "a.db").close()
    with opened(folder / "a.db") as content:
        camera = pycolmap.Camera(model="PINHOLE", width=24, height=16, params=[18, 18, 12, 8])
        number = content.write_camera(camera)
        same = np.tile(np.arange(20, dtype=np.uint32)[:, None], (1, 2))
        for name in ("a.png", "b.png"):
            image = content.write_image(pycolmap.Image(name=name, camera_id=number))
            content.write_keypoints(image, RNG.uniform(0, 16, (20, 4)).astype(np.float32))
            descriptors = pycolmap.FeatureDescriptors(
                pycolmap.FeatureExtractorType.SIFT, RNG.integers(0, 255, (20, 128), np.uint8)
            )
            content.write_descriptors(image, descriptors)
        content.write_matches(1, 2, same)
        geometry = pycolmap.TwoViewGeometry()
        geometry.inlier_matches = same
        content.write_two_view_geometry(1, 2, geometry)


def use_database(folder: Path) -> None:
    """What SfM does with a given database; COLMAP's mapper reads it into its cache."""
    given = check_database(folder / "a.db", ["a.png", "b.png"], 24, 16)
    copy = folder / "copy.db"
    copy_database(given, copy)
    with sound(folder / "a.db"), opened(copy) as content:
        for number in given.ids.values():
            read_descriptors(content, number)
        options = pycolmap.DatabaseCacheOptions()
        options.image_names = set(given.ids)
        pycolmap.DatabaseCache.create(content, options)


def use_workspace(path: Path) -> None:
    for item in open_dense_workspace(path).views:
        item.load_maps()
        item.load_image()


SMALL = PinholeCamera(width=24, height=16, fx=18.0, fy=18.0, cx=12.0, cy=8.0)


# Ground truth


def cameras_json() -> str:
    images = {}
    for view in some_views():
        pose = view.cam_from_world
        matrix = np.column_stack([pose.rotation, pose.translation])
        images[view.name] = {"K": view.camera.K.tolist(), "cam_from_world": matrix.tolist()}
    return json.dumps({"width": 12, "height": 8, "images": images})


def write_truth(folder: Path) -> None:
    (folder / "cameras.json").write_text(cameras_json())
    surface = {"type": "plane", "normal": [0, 0, 1], "offset": 0.25}
    (folder / "scene.json").write_text(json.dumps({"surface": surface}))
    for view in some_views():
        stem = Path(view.name).stem
        depth = np.full((8, 12), 25000, np.uint16)
        normal = np.zeros((8, 12, 3), np.uint16)
        cv2.imwrite(str(folder / f"{stem}_depth.png"), depth)
        cv2.imwrite(str(folder / f"{stem}_normal.png"), normal)
        cv2.imwrite(str(folder / f"{stem}_mask.png"), (depth > 0).astype(np.uint8))


def use_truth(folder: Path) -> None:
    truth = open_ground_truth(folder)
    for name in truth.names:
        truth.normals(name)
    truth.surface_points()
    open_surface(truth)


def write_author_truth(folder: Path) -> None:
    (folder / "cams").mkdir()
    for k, view in enumerate(some_views()):
        pose = np.eye(4)
        pose[:3] = np.column_stack([view.cam_from_world.rotation, view.cam_from_world.translation])
        lines = ["extrinsic", *(" ".join(map(str, row)) for row in pose)]
        lines += ["intrinsic", *(" ".join(map(str, row)) for row in view.camera.K)]
        (folder / "cams" / f"{k:08d}_cam.txt").write_text("\n".join(lines))
    np.save(folder / "normal_w.npy", np.array([[0], [0], [1.0]]))
    np.save(
        folder / "pts_3d_corners_w.npy",
        0.1 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]]),
    )


def use_author_truth(folder: Path) -> None:
    names = [view.name for view in some_views()]
    truth = read_author_truth(folder, names, 12, 8)
    for name in names:
        truth.normals(name)


# Runs


def write_run(folder: Path) -> None:
    stage = {
        "name": "images", "angle_model": None, "reads": [], "wrote": {"images": 1},
        "options": {"capture.gamma": 1.0}, "inputs": {"region.mask": "0123"}, "is_lost": False,
        "seconds": 1.0, "cpu_s": 1.5,
        "peak_rss_mb": 2.0, "warnings": [], "result": {"num_images": 1},
    }  # fmt: skip
    record = to_plain(Record(images=("a.png",), options=to_plain(Options())))
    (folder / "run.json").write_text(json.dumps({**record, "stages": [stage]}))


def use_run(folder: Path) -> None:
    run_folder = RunFolder(folder)
    record = load_record(run_folder)
    read_image_names(run_folder)
    options_from_plain(read_options(run_folder), str(run_folder.run_file))
    if record.options:
        options_from_plain(record.options, str(run_folder.run_file))


def write_stage_files(folder: Path) -> None:
    """What the stages hand to each other in files: phase maps, normals, seeds, dense views."""
    view = some_views(1)[0]
    flat = np.full((8, 12), 0.5, np.float32)
    store_phase_map(
        phase_map_of(render_view(view, Plane(np.zeros(3), np.array([0, 0, 1.0])))), folder
    )
    store_dense_view(
        DenseView(2, flat, np.dstack([flat] * 3), flat, flat, flat), folder / view.name
    )
    run = RunFolder(folder)
    run.seeds.parent.mkdir()
    np.save(run.track_normals(AngleModel.PPA), np.zeros(4, NORMALS_TYPE))
    seeds = np.zeros(3, SEEDS_TYPE)
    seeds["track"] = (1, 0, 3)
    np.save(run.seeds, seeds)


def use_stage_files(folder: Path) -> None:
    view = some_views(1)[0]
    np.asarray(open_phase_map(view, folder).samples)
    found = find_dense_view(folder / view.name)
    assert found is not None
    found.known.sum()
    load_seeds(RunFolder(folder), AngleModel.PPA)
    seed_tracks(RunFolder(folder).seeds, 4)


def write_marked(folder: Path) -> None:
    (folder / "dense" / "stereo").mkdir(parents=True)
    (folder / "dense" / "stereo" / "fusion.cfg").write_text("a.png\n")
    mark_own_workspace(folder / "dense")


def write_lock(folder: Path) -> None:
    (folder / ".polmvs-lock").write_text("0123456789abcdef 12\nfedcba9876543210 13\n")


def use_lock(folder: Path) -> None:
    with locked(folder):
        pass


def write_calibration_file(folder: Path) -> None:
    np.save(folder / "flat.npy", np.ones((16, 24), np.float32))
    (folder / "c.toml").write_text(
        "version = 1\npattern = [90, 45, 135, 0]\ngains = [1.0, 1.01, 0.99, 1.0]\n"
        'angles_deg = [0.1, 45, 90, 135]\ndiattenuations = [0.99, 1, 1, 1]\nflat = "flat.npy"\n'
    )


def use_calibration(folder: Path) -> None:
    capture_folder = folder / "c"
    if not capture_folder.exists():
        capture_folder.mkdir()
        cv2.imwrite(str(capture_folder / "a.png"), np.rint(255 * SHARE).astype(np.uint8))
    opened = open_capture(capture_folder, CaptureOptions(calibration=folder / "c.toml"))
    opened.load("a.png")


OPENCV_YAML = """%YAML:1.0
---
image_width: 24
image_height: 16
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 20., 0., 12., 0., 20., 8., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0.1, 0.01, 0., 0., 0. ]
"""
OPENCV_JSON = json.dumps(
    {
        "image_size": [24, 16],
        "K": [[20, 0, 12], [0, 20, 8], [0, 0, 1]],
        "dist": [0.1, 0, 0, 0, 0],
    }
)
KALIBR = """cam0:
  camera_model: pinhole
  intrinsics: [20.0, 20.0, 12.0, 8.0]
  distortion_model: equidistant
  distortion_coeffs: [0.1, 0.0, 0.0, 0.0]
  resolution: [24, 16]
"""
COLMAP_LINE = "# cameras\n1 OPENCV 24 16 20 20 12 8 0.1 0 0 0\n"
CENTERS = '{"images": {"a.png": {"center": [0, 1, 2]}, "b.png": {"center": [1, 1, 2]}}}'
CONFIG = "[capture]\ngamma = 1.5\npattern = [90, 45, 135, 0]\n[sfm]\nintrinsics = [1, 1, 5, 5.0]\n"


def comparison_json() -> str:
    sparse = SparseFigures(num_views=3, unregistered=("a.png",), num_tracks=9, num_seeds=4)
    figures = Comparison(capture="c", sparse=sparse, models={}, phase=None, best_fit=None)
    return json.dumps(to_plain(figures))


SET_WRITERS = (
    data_set_writer.ppa4p3d,
    data_set_writer.pisr,
    data_set_writer.pisr_maps,
    data_set_writer.pandora,
    data_set_writer.nersp,
    data_set_writer.mvas,
)
PAIRS = '# pairs\na.png d.png\n"b c.png" a.png\n'


def batch(name: str, content: str) -> Kind:
    def write(folder: Path) -> None:
        (folder / "c").mkdir()
        (folder / name).write_text(content)

    return Kind(write, lambda folder: read_batch(folder / name, Options()))


GROUPS = tuple(groups_of(Options).values())
KINDS: dict[str, Kind] = {
    **{f"capture, {n}": capture(n) for n in capture_writer.FORMATS if "turned" not in n},
    "jpeg": image("a.jpg", read_raw),
    "hdr": image("a.hdr", read_raw, np.dstack([SHARE] * 3).astype(np.float32)),
    "probe": image("a.png", probe_raw),
    "mask": image("a.png", lambda path: read_mask(path, SHARE.shape)),
    "mask in tiff": image("a.tif", lambda path: read_mask(path, SHARE.shape)),
    "gray": image("a.png", read_gray),
    "set mask": image("a.png", read_set_mask, np.full((8, 12, 4), 7, np.uint8)),
    **{f"set, {writer.__name__}": data_set(writer) for writer in SET_WRITERS},
    "cloud": Kind(write_some_cloud, read_any_ply),
    "ascii cloud": Kind(write_ascii_cloud, read_any_ply),
    "mesh": Kind(write_some_mesh, read_any_ply),
    "polygons": Kind(write_polygons, read_any_ply),
    "model": model(PINHOLE, five=True),
    "old model": model(OPENCV, five=False),
    "text model": model(OPENCV, five=True, as_text=True),
    "old text model": model(PINHOLE, five=False, as_text=True),
    "database": Kind(write_database, use_database),
    "workspace": Kind(
        lambda folder: board_scene(SMALL, 3).write(folder / "w"),
        lambda folder: use_workspace(folder / "w"),
    ),
    "truth": Kind(write_truth, use_truth),
    "author truth": Kind(write_author_truth, use_author_truth),
    "array": Kind(
        lambda folder: np.save(folder / "a.npy", SHARE), lambda folder: map_array(folder / "a.npy")
    ),
    "run": Kind(write_run, use_run),
    "stage files": Kind(write_stage_files, use_stage_files),
    "marker": Kind(write_marked, lambda folder: require_own(folder / "dense")),
    "lock": Kind(write_lock, use_lock),
    "calibration": Kind(write_calibration_file, use_calibration),
    "opencv yaml": text("a.yaml", OPENCV_YAML, read_intrinsics),
    "opencv json": text("a.json", OPENCV_JSON, read_intrinsics),
    "kalibr": text("a.yaml", KALIBR, read_intrinsics),
    "camera line": text("cameras.txt", COLMAP_LINE, read_intrinsics),
    "centers": text("a.json", CENTERS, read_centers),
    "center lines": text("a.txt", "a.png 0 1 2\nb c.png 1 2 3\n", read_centers),
    "pairs": text("p.txt", PAIRS, lambda path: read_pairs(path, ["a.png", "b c.png", "d.png"])),
    "batch in toml": batch("b.toml", '[[captures]]\ncapture = "c"\n[captures.sfm]\nseed = 3\n'),
    "batch in csv": batch("b.csv", "capture,name,sfm.seed\nc,one,3\nc,two,\n"),
    "config": text("a.toml", CONFIG, lambda path: read_config(path, GROUPS)),
    "metrics": text("metrics.json", comparison_json(), read_comparison),
}  # fmt: skip
