"""Still pictures of clouds and meshes, made without a display or a graphics driver.

Points are splatted with a depth buffer and shaded by their normals. A mesh is drawn as points on
its triangles, dense enough to hide the background.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Floats
from polmvs.camera import PinholeCamera
from polmvs.geometry import RigidTransform
from polmvs.io.clouds import Cloud, Mesh

Rgb = NDArray[np.uint8]

PAPER, SURFACE = 255, (214, 219, 224)  # colours of the background, and of points without one
NORMAL_SHADING = 0.85  # share of the brightness that follows the angle of the normal
LIGHT_IN_CAM = np.array([-0.4, -0.5, -0.77])  # from the upper left, a little off the camera's axis
DISTANCE = 3.4  # of the eye from the middle, in radii: the part fills most of the picture
POINTS_A_PIXEL = 4.0  # of a mesh: of 1.8e5 pixels then one in 50 (exp -4) has no point of its own


@dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """Viewpoint of a picture, about the middle of the part.

    Attributes
    ----------
    elevation_deg : above the mean plane of the part.
    azimuth_deg : about the plane's normal, from the part's longest direction.
    """

    elevation_deg: float
    azimuth_deg: float


@dataclass(frozen=True, kw_only=True)
class Subject:
    """Middle, size and axes of the subject of a picture.

    Attributes
    ----------
    center : (3,).
    radius : world units.
    axes : (3, 3), rows: longest direction, across, up; right-handed.
    """

    center: Array
    radius: float
    axes: Array

    @staticmethod
    def of(points: Floats, normals: Floats | None) -> Subject:
        """The subject of points ``(N, 3)``; up is the main direction of their normals."""
        finite = np.isfinite(points).all(axis=1)
        center = np.median(points[finite], axis=0) if finite.any() else np.zeros(3)
        spread = points[finite] - center
        distance = np.linalg.norm(spread, axis=1)
        near = distance <= 3 * np.median(distance) if len(distance) else np.zeros(0, bool)
        # Fewer than three points have three axes as well.
        axes = np.linalg.svd(np.vstack([spread[near], np.zeros((3, 3))]), full_matrices=False)[2]
        up = axes[2]
        if normals is not None and float(np.nansum(normals[finite] @ up)) < 0:
            up = -up
        radius = float(np.percentile(distance[near], 99)) if near.any() else 1.0
        return Subject(
            center=np.asarray(center, np.float64),
            radius=max(radius, 1e-12),
            axes=np.array([axes[0], np.cross(up, axes[0]), up]),
        )

    def pose(self, viewpoint: Viewpoint) -> RigidTransform:
        """``cam_from_world`` of a camera that sees the whole subject."""
        turn, lift = np.radians([viewpoint.azimuth_deg, viewpoint.elevation_deg])
        along, across, up = self.axes
        side = np.cos(turn) * along + np.sin(turn) * across
        eye = self.center + DISTANCE * self.radius * (np.cos(lift) * side + np.sin(lift) * up)
        forward = (self.center - eye) / np.linalg.norm(self.center - eye)
        # Seen from straight above, "up" is where the side looks from.
        right = np.cross(forward, np.cos(lift) * up - np.sin(lift) * side)
        right /= np.linalg.norm(right)
        rotation = np.array([right, np.cross(forward, right), forward])
        return RigidTransform(rotation, -rotation @ eye)


def render_cloud(
    cloud: Cloud,
    camera: PinholeCamera,
    cam_from_world: RigidTransform,
    *,
    radius_px: int = 1,
    plain: bool = False,
) -> Rgb:
    """Picture ``(H, W, 3)`` of a cloud.

    Parameters
    ----------
    radius_px : half the side of a point's square, minus half a pixel.
    plain : ignore the points' colours.

    Notes
    -----
    Points that face away are left out; those without a normal are drawn half bright.
    """
    in_cam = cam_from_world * cloud.points
    shade = np.full(len(in_cam), 0.6)
    drawn = np.isfinite(in_cam).all(axis=1) & (in_cam[:, 2] > 0)
    if cloud.normals is not None:
        normals = np.nan_to_num(cloud.normals) @ cam_from_world.rotation.T
        has_normal = np.linalg.norm(normals, axis=1) > 0.5
        bright = 1 - NORMAL_SHADING * (1 - np.clip(normals @ LIGHT_IN_CAM, 0, 1))
        shade = np.where(has_normal, bright, shade)
        drawn &= ~has_normal | ((normals * in_cam).sum(axis=-1) < 0)
    uncoloured = plain or cloud.colors is None
    base = np.array(SURFACE, np.float64) if uncoloured else np.asarray(cloud.colors)
    colors = (base * shade[:, None]).astype(np.uint8)
    order = np.flatnonzero(drawn)
    order = order[np.argsort(-in_cam[order, 2], kind="stable")]  # far first, near ones over them
    pixels = np.floor(camera.project(in_cam[order])).astype(np.int64)
    picture = np.full((camera.height, camera.width, 3), PAPER, np.uint8)
    for dy in range(-radius_px, radius_px + 1):
        for dx in range(-radius_px, radius_px + 1):
            col, row = pixels[:, 0] + dx, pixels[:, 1] + dy
            ok = (col >= 0) & (row >= 0) & (col < camera.width) & (row < camera.height)
            picture[row[ok], col[ok]] = colors[order[ok]]
    return picture


def mesh_points(mesh: Mesh, num: int) -> Cloud:
    """Points spread evenly over the triangles of a mesh, with its normals and colours.

    For a mesh without area they are its vertices.
    """
    corners = mesh.vertices[mesh.triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    if not area.sum() > 0:
        return Cloud(points=mesh.vertices, normals=mesh.normals, colors=mesh.colors)
    rng = np.random.default_rng(0)
    face = np.sort(rng.choice(len(area), num, p=area / area.sum()))
    root, other = np.sqrt(rng.random(num)), rng.random(num)
    weight = np.stack([1 - root, root * (1 - other), root * other], axis=1)
    vertex = mesh.triangles[face]

    def mean(values: Floats) -> Array:
        return np.asarray((weight[..., None] * values[vertex]).sum(axis=1))

    normals = mean(mesh.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    colors = None if mesh.colors is None else mean(mesh.colors.astype(float)).astype(np.uint8)
    return Cloud(points=mean(mesh.vertices), normals=normals, colors=colors)


def contact_sheet(
    subjects: Sequence[Cloud | Mesh],
    viewpoints: Sequence[Viewpoint],
    *,
    labels: Sequence[str] = (),
    size_px: tuple[int, int] = (640, 400),
    plain: bool = False,
) -> Rgb:
    """One column for each cloud or mesh, one row for each viewpoint, all seen by one camera.

    The middle and the axes are those of the last subject.
    """
    width, height = size_px
    focal = float(min(width, height)) * 1.5  # the part's radius spans 0.44 of the shorter side
    camera = PinholeCamera(
        width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2
    )
    clouds = [
        one if isinstance(one, Cloud) else mesh_points(one, int(POINTS_A_PIXEL * width * height))
        for one in subjects
    ]
    middle = Subject.of(clouds[-1].points, clouds[-1].normals)
    rows = [
        np.hstack([render_cloud(c, camera, middle.pose(viewpoint), plain=plain) for c in clouds])
        for viewpoint in viewpoints
    ]
    sheet = np.ascontiguousarray(np.vstack(rows))
    for number, label in enumerate(labels):
        _write(sheet, label, (width * number + 14, 30))
    return sheet


def _write(picture: Rgb, text: str, place: tuple[int, int]) -> None:
    import cv2

    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.8, (40, 40, 40), 2, cv2.LINE_AA)
