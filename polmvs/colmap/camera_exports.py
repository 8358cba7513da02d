"""Posed images for other programs: nerfstudio, gsplat, NeuS, IDR, Metashape, RealityScan, Bundler.

All formats use the undistorted images of a dense workspace, so every camera is a pinhole without
distortion. Each function fills an empty folder. The pixel origin is the corner of the first pixel
(COLMAP, nerfstudio, Metashape) or its centre (NeuS). Axes are x right, y down, z forward unless a
format has others.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Mask
from polmvs.camera import PinholeCamera
from polmvs.colmap.dense_workspace import DenseWorkspace, WorkspaceView
from polmvs.io.arrays import save_array
from polmvs.io.clouds import Cloud, write_cloud
from polmvs.io.images import write_bytes, write_mask, write_png
from polmvs.io.typed_json import write_json
from polmvs.scene import View, stem_of

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # camera axes x right, y up, z backwards
# nerfstudio multiplies depths by 0.001 by default, so they are written in thousandths of the
# model's unit.
DEPTH_FACTOR = 1000.0
FULL_FRAME_MM = 36.0  # film width of RealityScan's focal lengths
SPHERE_MARGIN = 1.1  # radius of the sphere of NeuS over the part's radius


@dataclass(frozen=True, kw_only=True)
class CameraExport:
    """Data for an export of posed images.

    Attributes
    ----------
    workspace : images, cameras, depth and normals, sparse points.
    cloud : dense cloud, the start of splatting.
    mask : gives the mask (H, W) of the part in a view.
    part : (N, 3) points of the part, for its position and size.
    """

    workspace: DenseWorkspace
    cloud: Cloud
    mask: Callable[[View], Mask]
    part: Array


def write_nerfstudio(export: CameraExport, folder: Path) -> None:
    """``transforms.json`` of nerfstudio and gsplat, with depth, normals, masks and the cloud.

    ``depths/NAME.npy`` hold z in thousandths of the model's unit (0: unknown), which nerfstudio's
    default factor makes units again; ``normals/NAME.png`` the camera frame as ``n / 2 + 0.5``.
    """
    for name in ("images", "masks", "depths", "normals"):
        (folder / name).mkdir()
    write_cloud(folder / "points3D.ply", export.cloud)
    frames = []
    for number, item in enumerate(export.workspace.views):
        name = f"{number:05d}_{_flat(item.view.name)}"
        shutil.copyfile(item.image, folder / "images" / f"{name}{item.image.suffix}")
        write_mask(folder / "masks" / f"{name}.png", export.mask(item.view))
        frame: dict[str, Any] = {
            "file_path": f"images/{name}{item.image.suffix}",
            "mask_path": f"masks/{name}.png",
            **_nerfstudio_camera(item.camera),
            "transform_matrix": (_world_from_cam(item.view) @ OPENGL).tolist(),
        }
        maps = item.load_maps()
        if maps is not None:
            save_array(folder / "depths" / f"{name}.npy", maps.depth * np.float32(DEPTH_FACTOR))
            known = maps.depth > 0
            normals = np.where(known[..., None], 0.5 * maps.normals + 0.5, 0)
            picture = np.rint(255 * normals[..., ::-1]).astype(np.uint8)
            write_png(folder / "normals" / f"{name}.png", picture)
            frame["depth_file_path"] = f"depths/{name}.npy"
            frame["normal_file_path"] = f"normals/{name}.png"
        frames.append(frame)
    content = {"camera_model": "PINHOLE", "ply_file_path": "points3D.ply", "frames": frames}
    write_json(folder / "transforms.json", content)


def _nerfstudio_camera(camera: PinholeCamera) -> dict[str, Any]:
    return {
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
    }


def write_neus(export: CameraExport, folder: Path) -> None:
    """``image/ mask/`` and ``cameras_sphere.npz``, also as ``cameras.npz``, of NeuS and IDR.

    ``scale_mat`` transforms the unit sphere about the part to the model's world.
    """
    (folder / "image").mkdir()
    (folder / "mask").mkdir()
    center = 0.5 * (export.part.min(axis=0) + export.part.max(axis=0))
    radius = SPHERE_MARGIN * float(np.linalg.norm(export.part - center, axis=1).max())
    scale = np.diag([radius, radius, radius, 1.0])
    scale[:3, 3] = center
    content: dict[str, Array] = {}
    for number, item in enumerate(export.workspace.views):
        shutil.copyfile(item.image, folder / "image" / f"{number:03d}{item.image.suffix}")
        write_mask(folder / "mask" / f"{number:03d}.png", export.mask(item.view))
        matrix = np.eye(4)
        matrix[:3, :3] = item.camera.K
        matrix[:2, 2] -= 0.5
        content[f"world_mat_{number}"] = matrix @ np.linalg.inv(_world_from_cam(item.view))
        content[f"scale_mat_{number}"] = scale
    for name in ("cameras_sphere.npz", "cameras.npz"):
        with (folder / name).open("wb") as file:
            np.savez(file, **content)  # type: ignore[arg-type]


def write_metashape(export: CameraExport, folder: Path) -> None:
    """``cameras.xml`` as Agisoft Metashape imports it (Agisoft XML), and the images."""
    _copy_images(export.workspace.views, folder)
    document = ElementTree.Element("document", version="1.5.0")
    chunk = ElementTree.SubElement(document, "chunk", label="polmvs", enabled="true")
    cameras = list(dict.fromkeys(item.camera for item in export.workspace.views))
    sensors = ElementTree.SubElement(chunk, "sensors", next_id=str(len(cameras)))
    for number, camera in enumerate(cameras):
        sensor = ElementTree.SubElement(
            sensors, "sensor", id=str(number), label=f"camera {number}", type="frame"
        )
        size = {"width": str(camera.width), "height": str(camera.height)}
        ElementTree.SubElement(sensor, "resolution", size)
        found = ElementTree.SubElement(
            sensor, "calibration", {"type": "frame", "class": "adjusted"}
        )
        ElementTree.SubElement(found, "resolution", size)
        # u = w / 2 + cx + x f + x b1, v = h / 2 + cy + y f
        values = {
            "f": camera.fy,
            "cx": camera.cx - 0.5 * camera.width,
            "cy": camera.cy - 0.5 * camera.height,
            "b1": camera.fx - camera.fy,
        }
        for name, value in values.items():
            ElementTree.SubElement(found, name).text = repr(float(value))
    placed = ElementTree.SubElement(chunk, "cameras")
    for number, item in enumerate(export.workspace.views):
        sensor_id = str(cameras.index(item.camera))
        label = Path(item.view.name).stem
        camera_of = ElementTree.SubElement(
            placed, "camera", id=str(number), sensor_id=sensor_id, label=label, enabled="true"
        )
        ElementTree.SubElement(camera_of, "transform").text = _row(_world_from_cam(item.view))
    _write_xml(folder / "cameras.xml", document)


def write_realityscan(export: CameraExport, folder: Path) -> None:
    """The images with an XMP file each, as RealityScan (RealityCapture) reads them."""
    _copy_images(export.workspace.views, folder)
    space = "http://www.capturingreality.com/ns/xcr/1.1#"
    rdf = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
    ElementTree.register_namespace("x", "adobe:ns:meta/")
    ElementTree.register_namespace("rdf", rdf)
    ElementTree.register_namespace("xcr", space)
    for item in export.workspace.views:
        camera, view = item.camera, item.view
        longest = max(camera.width, camera.height)
        values = {
            "Version": "3",
            "PosePrior": "locked",
            "Coordinates": "absolute",
            "DistortionModel": "perspective",
            "FocalLength35mm": repr(float(camera.fx * FULL_FRAME_MM / longest)),
            "Skew": "0",
            "AspectRatio": repr(float(camera.fy / camera.fx)),
            "PrincipalPointU": repr(float((camera.cx - 0.5 * camera.width) / longest)),
            "PrincipalPointV": repr(float((camera.cy - 0.5 * camera.height) / longest)),
            "CalibrationPrior": "exact",
            "CalibrationGroup": "-1",
            "DistortionGroup": "-1",
            "InTexturing": "1",
            "InMeshing": "1",
        }
        root = ElementTree.Element("{adobe:ns:meta/}xmpmeta")
        about = ElementTree.SubElement(root, f"{{{rdf}}}RDF")
        fields = {f"{{{space}}}{name}": value for name, value in values.items()}
        told = ElementTree.SubElement(about, f"{{{rdf}}}Description", fields)
        rotation = np.asarray(view.cam_from_world.rotation)
        ElementTree.SubElement(told, f"{{{space}}}Rotation").text = _row(rotation)
        ElementTree.SubElement(told, f"{{{space}}}Position").text = _row(view.center_in_world)
        ElementTree.SubElement(told, f"{{{space}}}DistortionCoeficients").text = "0 0 0 0 0 0"
        place = folder / "images" / _image_name(item)
        _write_xml(place.with_suffix(".xmp"), root)


def write_bundler(export: CameraExport, folder: Path) -> None:
    """``bundle.out`` and ``list.txt`` (Bundler v0.3) with the sparse points, and the images.

    The format has one focal length a camera, and its axes at the image's centre: cameras of which
    that is not so are approximated, the mean of the two focal lengths, and keypoints moved along.
    """
    _copy_images(export.workspace.views, folder)
    views, tracks = export.workspace.views, export.workspace.tracks
    turn = OPENGL[:3, :3]
    lines = ["# Bundle file v0.3", f"{len(views)} {len(tracks.point3D_ids)}"]
    for item in views:
        pose = item.view.cam_from_world
        lines.append(f"{item.camera.mean_focal_px!r} 0 0")
        lines += [_row(row) for row in turn @ np.asarray(pose.rotation)]
        lines.append(_row(turn @ np.asarray(pose.translation)))
    count = np.zeros(len(views), np.int64)
    for track, own in enumerate(tracks.of_tracks()):
        lines.append(_row(tracks.points_in_world[track]))
        lines.append(" ".join(map(str, tracks.colors[track].tolist())))
        words = [str(len(own))]
        for index in own:
            number = int(tracks.obs_view[index])
            camera, focal = views[number].camera, views[number].camera.mean_focal_px
            x, y = tracks.obs_xy[index]
            words += [str(number), str(count[number])]
            words.append(repr(float((x - camera.cx) / camera.fx * focal)))
            words.append(repr(float(-(y - camera.cy) / camera.fy * focal)))
            count[number] += 1
        lines.append(" ".join(words))
    write_bytes(folder / "bundle.out", ("\n".join(lines) + "\n").encode())
    names = [f"images/{_image_name(item)}" for item in views]
    write_bytes(folder / "list.txt", ("\n".join(names) + "\n").encode())


def _copy_images(views: Sequence[WorkspaceView], folder: Path) -> None:
    (folder / "images").mkdir()
    for item in views:
        shutil.copyfile(item.image, folder / "images" / _image_name(item))


def _image_name(item: WorkspaceView) -> str:
    return f"{_flat(item.view.name)}{item.image.suffix}"


def _flat(name: str) -> str:
    """The stem of an image's name as that of a file in one folder."""
    return stem_of(name).replace("/", "_")


def _world_from_cam(view: View) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3] = np.asarray(view.cam_from_world.rotation).T
    matrix[:3, 3] = view.center_in_world
    return matrix


def _row(values: NDArray[np.floating]) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def _write_xml(path: Path, root: ElementTree.Element) -> None:
    ElementTree.indent(root)
    write_bytes(path, ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))


CAMERA_FORMATS: Mapping[str, Callable[[CameraExport, Path], None]] = {
    "nerfstudio": write_nerfstudio,
    "neus": write_neus,
    "metashape": write_metashape,
    "realityscan": write_realityscan,
    "bundler": write_bundler,
}
