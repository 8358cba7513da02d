"""Clouds and meshes in the format of the report's 3D view: quantized, a few bytes per point.

A scene has one box for all its layers. Positions are 16-bit shares of its longest edge (0.004 mm
for a part of a quarter of a metre), normals have 8 bits per axis, and each further channel has one
byte per point with its range. ``viewer/viewer.js`` reads this format.
"""

from __future__ import annotations

import base64
import gzip
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.arrays import Array, Floats
from polmvs.geometry import RigidTransform
from polmvs.report.pictures import hex_palette
from polmvs.scene import PointKind, View

FULL = np.iinfo(np.uint16).max  # of a place, as the page holds it
FRUSTUM_SHARE = 0.08  # depth of a drawn camera, of the distance from the target
EYE_DISTANCE = 3.2  # from the target, in radii of the part: all of it in a field of view of 40 deg
EYE_ELEVATION_DEG = 35.0
SPACING_SAMPLES = 2000  # points whose nearest neighbour is looked up; their median errs by 1 %
UNKNOWN = "#999999"  # of points without a value
KIND_COLORS = ("#0072b2", "#999999", "#e69f00", "#009e73", "#cc79a7")  # by PointKind


@dataclass(frozen=True, kw_only=True)
class PointColoring:
    """A quantity for the colours of points.

    Attributes
    ----------
    label : its name on the page.
    unit : of its values; "" without one.
    low, high : the range of the colours; all layers share it.
    colors : name of the colour map; None for grey.
    classes : names of the values 0, 1, ... of a kind.
    note : its meaning, in a sentence.
    may_lack : points without a value (NaN) are grey; otherwise NaN counts as the worst value.
    """

    label: str
    unit: str = ""
    low: float = 0.0
    high: float = 1.0
    colors: str | None = None
    classes: tuple[str, ...] = ()
    note: str = ""
    may_lack: bool = False


@dataclass(frozen=True)
class BoxFrame:
    """A frame of a crop box.

    Attributes
    ----------
    label : its name on the page.
    option : its flag on the command line; "" for the model's frame.
    frame_from_world : its pose.
    """

    label: str
    option: str
    frame_from_world: RigidTransform


WORLD = BoxFrame("the model", "", RigidTransform(np.eye(3), np.zeros(3)))

KIND = PointColoring(
    label="kind of point",
    low=0,
    high=len(PointKind),
    classes=("polarized surface", "sparse point", "stereo", "given workspace", "inferred"),
    note="Origin of a point; inferred is surface that no phase shows, behind an opening.",
)


@dataclass(frozen=True, kw_only=True)
class Layer:
    """A cloud, or with ``triangles`` a mesh.

    Attributes
    ----------
    label : its name on the page.
    points : (N, 3), world.
    normals : (N, 3), unit; NaN or 0 if there is none.
    values : (N,) by name of the channel.
    triangles : (F, 3) or None.
    """

    label: str
    points: Floats
    normals: Floats
    values: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    triangles: NDArray[np.integer] | None = None


def thinned(layer: Layer, max_points: int) -> Layer:
    """At most this many points, spread evenly over their order; meshes are kept."""
    num = len(layer.points)
    if num <= max_points or layer.triangles is not None:
        return layer
    # A fixed permutation: points come in the order of views or voxels, which a stride would alias.
    index = np.sort(np.random.default_rng(0).permutation(num)[:max_points])
    return replace(
        layer,
        points=layer.points[index],
        normals=layer.normals[index],
        values={name: values[index] for name, values in layer.values.items()},
    )


@dataclass(frozen=True, kw_only=True)
class Scene3D:
    """Data of the page's 3D view.

    Attributes
    ----------
    description : JSON for the viewer.
    blocks : base64 text of each layer's bytes, by the id that the description names.
    """

    description: dict[str, Any]
    blocks: dict[str, str]


def pack_scene(
    layers: Sequence[Layer],
    channels: Mapping[str, PointColoring],
    views: Sequence[View],
    start: tuple[int, int | None],
    *,
    color: str = "normal",
    unit: tuple[str, float] = ("model units", 1.0),
    frames: Sequence[BoxFrame] = (),
) -> Scene3D:
    """Pack layers that share one world.

    Parameters
    ----------
    layers : at least one with a point.
    channels : by the names of the layers' values.
    views : views whose frusta can be shown.
    start : layers shown first in the left and the right pane; None: one pane.
    color : channel, or ``normal``, that is shown first.
    unit : name of the unit of lengths, and units for each of the world's.
    frames : of a crop box, in addition to the world.
    """
    everything = np.concatenate([layer.points for layer in layers if len(layer.points)])
    origin, top = everything.min(axis=0), everything.max(axis=0)
    extent = float(max((top - origin).max(), 1e-12))
    blocks, described = {}, []
    for number, layer in enumerate(layers):
        data, parts = _bytes_of(layer, channels, origin, extent)
        name = f"layer-{number}"
        # mtime 0: the same result is the same file.
        blocks[name] = base64.b64encode(gzip.compress(data, 6, mtime=0)).decode("ascii")
        described.append(
            {
                "label": layer.label,
                "data": name,
                "count": len(layer.points),
                "spacing": _spacing(layer),
                **parts,
            }
        )
    main = layers[start[0]]
    target, up, radius = _pose_of_part(main, views)
    side = _any_across(up)
    lift = np.radians(EYE_ELEVATION_DEG)
    eye = target + EYE_DISTANCE * radius * (np.cos(lift) * side + np.sin(lift) * up)
    description = {
        "origin": origin.tolist(),
        "extent": extent,
        "layers": described,
        "channels": {
            "normal": {
                "label": "normal",
                "note": "Direction of the surface. Red and green: sideways, blue: up; grey: no "
                "normal.",
            },
            **{name: _channel_json(channel) for name, channel in channels.items()},
        },
        "target": target.tolist(),
        "up": up.tolist(),
        "basis": np.concatenate([side, np.cross(up, side), up]).tolist(),
        "eye": eye.tolist(),
        "radius": radius,
        "cameras": _cameras(views, target),
        "start": list(start),
        "color": color,
        "unit": {"name": unit[0], "factor": unit[1]},
        "frames": [_frame_json(frame) for frame in (WORLD, *frames)],
    }
    return Scene3D(description=description, blocks=blocks)


def _bytes_of(
    layer: Layer, channels: Mapping[str, PointColoring], origin: Array, extent: float
) -> tuple[bytes, dict[str, Any]]:
    """One buffer and the offsets of its parts, which begin at multiples of four bytes."""
    pieces: list[bytes] = []
    used = 0

    def add(array: NDArray[Any]) -> dict[str, Any]:
        nonlocal used
        content = np.ascontiguousarray(array).tobytes()
        place = {"offset": used, "type": str(array.dtype), "length": int(array.size)}
        pieces.append(content + b"\0" * (-len(content) % 4))
        used += len(pieces[-1])
        return place

    position = np.round((layer.points - origin) / extent * FULL).astype(np.uint16)
    normals = np.round(127 * np.nan_to_num(layer.normals)).astype(np.int8)
    parts: dict[str, Any] = {"position": add(position), "normal": add(normals)}
    if layer.triangles is not None:
        parts["triangles"] = add(layer.triangles.astype(np.uint32))
    parts["channels"] = {
        name: add(_quantised(values, channels[name])) for name, values in layer.values.items()
    }
    return b"".join(pieces), parts


def _quantised(values: NDArray[Any], channel: PointColoring) -> NDArray[np.uint8]:
    """One byte a value; values that are not finite count as the highest, which is the worst.

    Of a channel that some points lack, 255 stands for no value.
    """
    if channel.classes:
        share = (np.asarray(values, np.float64) + 0.5) / len(channel.classes)
    else:
        share = (np.asarray(values, np.float64) - channel.low) / max(
            channel.high - channel.low, 1e-300
        )
    clean = np.clip(np.nan_to_num(share, nan=1.0, posinf=1.0, neginf=0.0), 0, 1)
    if channel.may_lack:
        return np.where(np.isnan(share), 255, np.round(254 * clean)).astype(np.uint8)
    return np.asarray(np.round(255 * clean), np.uint8)


def _channel_json(channel: PointColoring) -> dict[str, Any]:
    if channel.classes:
        colors = [KIND_COLORS[i % len(KIND_COLORS)] for i in range(len(channel.classes))]
        return {
            "label": channel.label,
            "classes": list(channel.classes),
            "colors": colors,
            "note": channel.note,
        }
    result: dict[str, Any] = {
        "label": channel.label,
        "unit": channel.unit,
        "range": [channel.low, channel.high],
        "note": channel.note,
    }
    if channel.colors is not None:
        result["colors"] = hex_palette(channel.colors)
    if channel.may_lack:
        result["unknown"] = UNKNOWN
    return result


def _spacing(layer: Layer) -> float:
    """Typical distance of neighbouring points; of a mesh it is not used."""
    points = layer.points
    if layer.triangles is not None or len(points) < 2:
        return 1.0
    chosen = points[:: max(1, len(points) // SPACING_SAMPLES)]
    distance, _ = cKDTree(points).query(chosen, k=2)
    return float(np.median(distance[:, 1]))


def _pose_of_part(layer: Layer, views: Sequence[View]) -> tuple[Array, Array, float]:
    """Middle, upward direction and radius of the part.

    Up is where the cameras are, seen from the middle: captures look down on a table.
    """
    surface = np.asarray(layer.points, np.float64)
    kind = layer.values.get("kind")
    if kind is not None and (kind == PointKind.SURFACE).any():
        surface = surface[np.asarray(kind) == PointKind.SURFACE]
    target = np.median(surface, axis=0)
    radius = float(np.percentile(np.linalg.norm(surface - target, axis=1), 98)) or 1.0
    up = np.array([0.0, 0.0, 1.0])
    if views:
        towards = np.mean([view.center_in_world for view in views], axis=0) - target
        if np.linalg.norm(towards) > 0:
            up = towards / np.linalg.norm(towards)
    return target, up, radius


def _any_across(up: Array) -> Array:
    """A unit vector perpendicular to another."""
    side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    return np.asarray(side / np.linalg.norm(side))


def _frame_json(frame: BoxFrame) -> dict[str, Any]:
    matrix = np.eye(4)
    matrix[:3, :3] = frame.frame_from_world.rotation
    matrix[:3, 3] = frame.frame_from_world.translation
    return {"label": frame.label, "option": frame.option, "matrix": matrix.ravel().tolist()}


def _cameras(views: Sequence[View], target: Array) -> list[dict[str, Any]]:
    """Drawn position and field of view of each camera; ``index`` is that of its view.

    ``corners`` are the ends of its frustum, from the image's upper left corner clockwise;
    ``half_field`` tangents from its axis to the image's side and top.
    """
    cameras = []
    for index, view in enumerate(views):
        camera, center = view.camera, view.center_in_world
        size = np.array([camera.width, camera.height], np.float64)
        corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float64) * size
        in_cam = camera.rays(corners)
        if not np.isfinite(in_cam).all():  # a lens that does not reach its image's corners
            continue
        depth = FRUSTUM_SHARE * float(np.linalg.norm(center - target))
        ends = center + depth * in_cam @ view.cam_from_world.rotation
        slopes = np.abs(in_cam[:, :2] / np.maximum(in_cam[:, 2:], 1e-3))
        cameras.append(
            {
                "name": view.name,
                "index": index,
                "center": _rounded(center),
                "corners": [_rounded(end) for end in ends],
                "forward": _rounded(view.cam_from_world.rotation[2]),
                "half_field": _rounded(slopes.max(axis=0)),
            }
        )
    return cameras


def _rounded(values: Array) -> list[float]:
    return [round(float(value), 6) for value in values]
