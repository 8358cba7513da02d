"""The pictures of the README: what goes in, what comes out, and what OPA and PPA say of a phase.

python docs/pictures.py hero.png phases.png --captures FOLDER     # FOLDER/mug is the capture
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from polmvs.camera import pixel_centers
from polmvs.colmap.models import read_model
from polmvs.io.clouds import read_mesh
from polmvs.io.ground_truth import open_ground_truth
from polmvs.pipeline.run_folder import SURFACE_MESH, RunFolder
from polmvs.pipeline.stages.maps import open_maps
from polmvs.polarization.angle_models import phase_from_normal
from polmvs.polarization.capture import open_capture
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.stokes import axial_difference
from polmvs.report.pictures import ERROR, angle_picture, gray_picture, scalar_picture
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh

VIEW = "005.png"  # which shows handle, lip and foot
LIGHT = np.array([-0.45, -0.65, -0.61])  # of the shaded mesh, camera frame: from the upper left
LIT = np.array([0.83, 0.85, 0.88])
INK = "#222222"
MAX_ERROR_DEG = 30.0


def hero(capture: Path, run: RunFolder, path: Path) -> None:
    """One view of the mug: photo, AoLP, COLMAP's sparse points, the mesh."""
    view = next(v for v in read_model(run.sparse).views if v.name == VIEW)
    stokes = open_capture(capture).load(VIEW)
    mesh = read_mesh(run.views(AngleModel.PPA) / SURFACE_MESH)
    scene = RayScene(TriangleMesh(mesh.vertices, np.asarray(mesh.triangles, np.int64)))
    height, width = view.camera.height, view.camera.width
    xy = pixel_centers(width, height).reshape(-1, 2)
    hits = scene.cast(view.center_in_world, view.rays_in_world(xy))
    on_part = hits.face >= 0
    corners = mesh.triangles[hits.face[on_part]]
    normals = (mesh.normals[corners] * hits.barycentric[on_part][..., None]).sum(axis=1)
    normals = normals @ view.cam_from_world.rotation.T
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    shade = 0.35 + 0.75 * np.clip(normals @ LIGHT, 0, 1)
    shaded = np.ones((height * width, 3))
    shaded[on_part] = np.clip(shade[:, None] * LIT, 0, 1)
    points = read_model(run.sparse).tracks.points_in_world
    seen = view.cam_from_world * points
    at = view.project(points[seen[:, 2] > 0])
    intensity = stokes.s0 / 2
    white = float(np.nanpercentile(intensity, 97))
    aolp = np.where(stokes.valid, stokes.aolp, np.nan)

    figure, axes = plt.subplots(1, 4, figsize=(14, 3.9), layout="constrained")
    axes[0].imshow(gray_picture(intensity, white))
    axes[1].imshow(angle_picture(aolp, strength=stokes.dolp / 0.3))
    axes[2].scatter(at[:, 0], at[:, 1], s=7, color=INK, linewidths=0)
    axes[3].imshow(shaded.reshape(height, width, 3))
    titles = (
        "black and glossy: a photo",
        "the angle of its polarization (AoLP)",
        "COLMAP's points (SfM)",
        "polmvs' mesh",
    )
    rows, cols = np.nonzero(on_part.reshape(height, width))
    for axis, title in zip(axes, titles, strict=True):
        axis.set_title(title, fontsize=13, color=INK)
        _frame(axis, width, height)
        axis.set(xlim=(cols.min() - 60, cols.max() + 60), ylim=(rows.max() + 45, rows.min() - 45))
    _save(figure, path)


def phases(capture: Path, run: RunFolder, path: Path) -> None:
    """The measured phase, those that OPA and PPA predict of the true normals, and their errors."""
    truth = open_ground_truth(capture / "gt")
    phase_map = next(m for m in open_maps(run, AngleModel.PPA) if m.view.name == VIEW)
    camera = truth.views[VIEW].camera
    rays = camera.rays(pixel_centers(camera.width, camera.height))
    samples = np.asarray(phase_map.samples)
    inside = truth.mask(VIEW) & (samples[..., 2] > 0) & (np.hypot(*samples[..., :2].T).T > 0.1)
    measured = np.where(inside, 0.5 * np.arctan2(samples[..., 1], samples[..., 0]), np.nan)
    # A diffuse pixel's phase was turned to the specular one's; what is shown is the phase itself.
    normals = truth.normals(VIEW)
    shown, errors = [("measured", measured)], []
    for model in (AngleModel.OPA, AngleModel.PPA):
        predicted = np.where(inside, phase_from_normal(model, normals, rays), np.nan)
        shown.append((f"{model.value.upper()} predicts", predicted))
        off = np.abs(np.degrees(axial_difference(measured, predicted)))
        errors.append((f"{model.value.upper()} is off by {np.nanmedian(off):.1f}° (median)", off))
    figure, axes = plt.subplots(1, 5, figsize=(15, 3.1), layout="constrained")
    for axis, (title, phase) in zip(axes, shown, strict=False):
        axis.imshow(angle_picture(phase))
        axis.set_title(title, fontsize=12, color=INK)
    for axis, (title, off) in zip(axes[3:], errors, strict=True):
        axis.imshow(scalar_picture(off, 0, MAX_ERROR_DEG, colors=ERROR))
        axis.set_title(title, fontsize=12, color=INK)
    bar = plt.cm.ScalarMappable(plt.Normalize(0, MAX_ERROR_DEG), cmap=ERROR)
    figure.colorbar(bar, ax=axes[4], label="error of the phase, degrees", shrink=0.85)
    rows, cols = np.nonzero(inside)
    for axis in axes:
        _frame(axis, camera.width, camera.height)
        axis.set(xlim=(cols.min() - 15, cols.max() + 15), ylim=(rows.max() + 15, rows.min() - 15))
    _save(figure, path)


def _frame(axis: plt.Axes, width: int, height: int) -> None:
    axis.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xticks=[], yticks=[])
    for spine in axis.spines.values():
        spine.set(color="#bbbbbb")


def _save(figure: plt.Figure, path: Path) -> None:
    figure.savefig(path, bbox_inches="tight", dpi=90, facecolor="white")
    plt.close(figure)
