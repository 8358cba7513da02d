"""Scene of the experiments: a capture, its ground truth, and poses in the true world."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from polmvs.arrays import Image, Mask
from polmvs.colmap.models import match_model_to_capture, read_model
from polmvs.config import (
    CaptureOptions,
    ExperimentOptions,
    RegionOptions,
)
from polmvs.errors import DataError, OptionError
from polmvs.io.folders import resolved
from polmvs.io.ground_truth import open_ground_truth
from polmvs.io.images import read_mask
from polmvs.io.layouts import AUTHOR_OPTIONS, BoardTruth, is_author_layout, read_author_truth
from polmvs.pipeline.stages.maps import find_mask
from polmvs.polarization.angle_models import correct_stokes, phase_sign
from polmvs.polarization.capture import Capture, open_capture
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.polarization.phase_map import PhaseMap, as_tilted, build_phase_map, view_rays
from polmvs.polarization.region import Region, find_region, grow_mask, smooth
from polmvs.polarization.stokes import Stokes
from polmvs.poses.alignment import Alignment, align_views
from polmvs.poses.image_check import matches_of, require_cameras_of_images
from polmvs.scene import View, find_name, match_names, short_list

EXACT_SIGMA = 1e-3  # rad; represents no noise, far below that of any phase
BLUR_REACH = 2.0  # deviations of the blur within which a mark affects a pixel


class Truth(Protocol):
    """Interface of a ground truth; maps are ``(H, W)`` of the half-size images."""

    @property
    def folder(self) -> Path:
        """Its folder, for messages."""

    @property
    def views(self) -> Mapping[str, View]:
        """True views by image name, metres."""

    def mask(self, name: str) -> Mask:
        """Whether each pixel shows the part."""

    def depth(self, name: str) -> Image:
        """True z, m; NaN without a surface."""

    def normals(self, name: str) -> Image:
        """True normals (H, W, 3), unit, camera frame; NaN off the part."""


MODEL_LABELS = {AngleModel.OPA: "OPA", AngleModel.PPA: "PPA", AngleModel.TILTED: "tilted"}


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A capture with poses in the world of its ground truth.

    Attributes
    ----------
    capture, truth : sources of pixels and true maps.
    views : posed views with the image names of the ground truth, true world, metres.
    raw_names : file name of each view's mosaic, in the order of ``views``.
    region : light, DoLP threshold, and a folder of masks that restrict the true ones.
    blur_px : deviation of the Gaussian blur of the images, px; 0: none.
    alignment : of estimated poses to the true world; None for true poses.
    """

    capture: Capture
    truth: Truth
    views: tuple[View, ...]
    raw_names: tuple[str, ...]
    region: RegionOptions
    blur_px: float = ExperimentOptions.blur_px
    alignment: Alignment | None = None

    def settings(self) -> dict[str, Any]:
        """Settings of the results, for their record."""
        return {
            "capture": str(self.capture.folder),
            "truth": str(self.truth.folder),
            "num_views": len(self.views),
            "poses": "true" if self.alignment is None else "sfm",
            "alignment": self.alignment,
            "light": self.region.light,
            "min_dolp": self.region.min_dolp,
            "blur_px": self.blur_px,
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewData:
    """Measured and true maps of one view.

    Attributes
    ----------
    view : posed camera.
    light : dominant kind of light.
    rays : (H, W, 3) float32, unit, camera frame.
    sharp, blurred : Stokes images as captured, and blurred as in the paper.
    part : (H, W) bool, the part by the true mask.
    counted : (H, W) bool, pixels of the part neither clipped nor dark, with a DoLP above the
        threshold in the blurred images.
    normals_in_cam : (H, W, 3) float32, true normals in the frame of the (estimated) camera.
    range_map : (H, W) float32, true distance from the camera centre, m; 0 where nothing is.
    """

    view: View
    light: Light
    rays: Image
    sharp: Stokes
    blurred: Stokes
    part: Mask
    counted: Mask
    normals_in_cam: Image
    range_map: Image

    def blurred_for(self, angle_model: AngleModel) -> Stokes:
        """Blurred Stokes images for the model: corrected under ``tilted``."""
        if angle_model is not AngleModel.TILTED:
            return self.blurred
        return correct_stokes(self.blurred, self.rays, diffuse=self.light is Light.DIFFUSE)

    def axial(self, angle_model: AngleModel) -> Image:
        """``(s0 cos 2 phase, s0 sin 2 phase)`` times the DoLP of the blurred images, (H, W, 2)."""
        stokes = self.blurred_for(angle_model)
        return phase_sign(self.light) * np.dstack([stokes.s1, stokes.s2])

    def find_region(self, min_dolp: float) -> Region:
        """The part with its reliable pixels (no printed marks) and edges."""
        s = self.sharp
        return find_region(s.s0, s.s1, s.s2, s.valid, min_dolp=min_dolp, mask=self.part)

    def beside_marks(self, region: Region, blur_px: float) -> Mask:
        """Pixels within the blur of printed marks or other unreliable pixels."""
        return grow_mask(self.part & ~region.reliable, math.ceil(BLUR_REACH * blur_px))

    def phase_map(self, angle_model: AngleModel, region: Region) -> PhaseMap:
        """The phase map of polmvs, with precisions."""
        measured = build_phase_map(self.view, self.sharp, region, self.light)
        return as_tilted(measured) if angle_model is AngleModel.TILTED else measured

    def plain_map(self, angle_model: AngleModel) -> PhaseMap:
        """A phase map as in the paper: blurred pixels above the threshold, with equal weights.

        The paper has no noise model: its rows count as exact, so only their geometry decides
        whether they give a normal.
        """
        axial = self.axial(angle_model) / np.maximum(self.blurred.s0, 1e-6)[..., None]
        precision = np.where(self.counted, EXACT_SIGMA**-2, 0)
        samples = np.dstack([axial, precision])
        region = Region(self.part, self.counted, np.zeros_like(self.part))
        base = self.phase_map(AngleModel.PPA, region)
        return replace(base, samples=samples.astype(np.float32))


def open_scene(
    capture: Capture,
    truth: Truth,
    region: RegionOptions,
    *,
    blur_px: float = ExperimentOptions.blur_px,
    sparse: Path | None = None,
) -> Scene:
    """Match a capture with its ground truth, and with estimated poses if given.

    Parameters
    ----------
    sparse : COLMAP model whose poses replace the true ones, aligned by the camera centres.

    Raises
    ------
    DataError
        No image has ground truth, sizes differ, or the poses are of other images.
    """
    raw_of = _raw_names(capture, truth)
    views = [view for name, view in truth.views.items() if name in raw_of]
    for view in views:
        if (view.camera.width, view.camera.height) != (capture.width, capture.height):
            raise DataError(
                truth.folder,
                f"its cameras are {view.camera.width}x{view.camera.height} px, the polarization "
                f"images {capture.width}x{capture.height} px; give the truth of this capture.",
            )
    require_cameras_of_images(
        views,
        matches_of(capture, raw_of),
        truth.folder,
        "Give the ground truth of this capture.",
    )
    alignment = None
    if sparse is not None:
        views, alignment = _estimated_views(sparse, capture, truth, list(raw_of))
    return Scene(
        capture=capture,
        truth=truth,
        views=tuple(views),
        raw_names=tuple(raw_of[view.name] for view in views),
        region=region,
        blur_px=blur_px,
        alignment=alignment,
    )


def _estimated_views(
    sparse: Path, capture: Capture, truth: Truth, names: Sequence[str]
) -> tuple[list[View], Alignment]:
    """Views of a COLMAP model in the world of the truth, aligned by the camera centres.

    ``names`` are those of the truth's images that the capture has; views come in their order.
    """
    sparse_model = match_model_to_capture(
        read_model(sparse), names, capture.width, capture.height, source=sparse
    )
    truth_from_world, alignment = align_views(sparse_model.views, truth.views, source=truth.folder)
    if alignment.dropped:
        raise DataError(
            sparse,
            f"poses of {short_list(alignment.dropped)} do not match the true ones; give a model "
            "of this capture without wrongly registered images.",
        )
    views = [
        replace(view, cam_from_world=truth_from_world.pose(view.cam_from_world))
        for view in sparse_model.views
    ]
    return sorted(views, key=lambda view: names.index(view.name)), alignment


def _raw_names(capture: Capture, truth: Truth) -> dict[str, str]:
    """Mosaic of each image of the truth, by name without suffix; images without one left out."""
    found = match_names(list(truth.views), capture.names)
    if not found:
        raise DataError(
            truth.folder,
            f"its images are named like {next(iter(truth.views))!r}, the capture's like "
            f"{capture.names[0]!r}; none match. Give the truth of this capture.",
        )
    return found


def load_view(scene: Scene, index: int) -> ViewData:
    """Read the mosaic and true maps of one view.

    Raises
    ------
    DataError
        A file is missing, damaged or of another size.
    """
    view, name = scene.views[index], scene.views[index].name
    truth, true_view = scene.truth, scene.truth.views[scene.views[index].name]
    sharp = scene.capture.load(scene.raw_names[index])
    blurred = _blur(sharp, scene.blur_px)
    part = truth.mask(name)
    if scene.region.mask is not None:
        part = part & read_mask(find_mask(scene.region.mask, name), part.shape)
    # The surface that a pixel shows is true whatever the pose; only its frame is the camera's.
    turn = view.cam_from_world.rotation @ true_view.cam_from_world.rotation.T
    depth = truth.depth(name)
    range_map = np.nan_to_num(depth / view_rays(true_view)[..., 2], nan=0.0)
    normals = truth.normals(name) @ turn.T.astype(np.float32)
    known = np.isfinite(normals).all(axis=-1)
    return ViewData(
        view=view,
        light=scene.region.light or Light.SPECULAR,
        rays=view_rays(view),
        sharp=sharp,
        blurred=blurred,
        part=part,
        counted=part & known & blurred.valid & (blurred.dolp > scene.region.min_dolp),
        normals_in_cam=normals,
        range_map=range_map.astype(np.float32),
    )


def _blur(stokes: Stokes, blur_px: float) -> Stokes:
    """Stokes images of Gaussian-blurred intensities; validity stays that of the pixel itself."""
    if blur_px <= 0:
        return stokes
    images = smooth(np.dstack([stokes.s0, stokes.s1, stokes.s2]), blur_px)
    s0, s1, s2 = (np.ascontiguousarray(images[..., i]) for i in range(3))
    return replace(stokes, s0=s0, s1=s1, s2=s2)


def require_counted(scene: Scene, num_counted: Sequence[int] | int) -> None:
    """Raise an error if no pixel is usable.

    Raises
    ------
    DataError
        All counts are 0.
    """
    if int(np.sum(num_counted)) == 0:
        raise DataError(
            scene.capture.folder,
            f"no pixel of the part has a DoLP above {scene.region.min_dolp}; "
            "give a lower `region.min_dolp`, or the mask of a polarized surface.",
        )


def open_experiment(
    folder: Path,
    options: ExperimentOptions,
    capture: CaptureOptions,
    region: RegionOptions,
) -> Scene:
    """The scene of a capture with ground truth, of either layout.

    Parameters
    ----------
    folder : of the capture.
    options : ground truth, poses and blur.
    capture : how to read the mosaics; for the layout of the authors' demo, which has its own
        defaults, only values other than the usual defaults.
    region : light, DoLP threshold and masks.

    Raises
    ------
    PolmvsError
        Something is missing, damaged or contradictory.
    """
    opened, truth = _open_data(folder, options.gt, capture)
    return open_scene(opened, truth, region, blur_px=options.blur_px, sparse=options.sparse)


def _open_data(folder: Path, gt: Path | None, options: CaptureOptions) -> tuple[Capture, Truth]:
    if is_author_layout(folder):
        if gt is not None and resolved(gt) != resolved(folder):
            raise OptionError(
                f"is {gt}, but {folder} brings its own truth. Leave it out.", field="experiment.gt"
            )
        given = None if options == CaptureOptions() else options
        return open_author_capture(folder, given)
    return open_capture(folder, options), open_ground_truth(folder if gt is None else gt)


def open_author_capture(
    folder: Path, options: CaptureOptions | None = None
) -> tuple[Capture, BoardTruth]:
    """Open a capture in the layout of the authors' demo, with its ground truth.

    Parameters
    ----------
    options : how to read the mosaics; None: the authors' options.

    Raises
    ------
    DataError
        A file is missing, damaged, or of another size, or the number of files is wrong.
    """
    capture = open_capture(folder / "images", AUTHOR_OPTIONS if options is None else options)
    return capture, read_author_truth(folder, capture.names, capture.width, capture.height)


def view_indices(names: Sequence[str] | None, scene: Scene) -> tuple[int, ...] | None:
    """Indices of views by their images' names, with or without suffix; None for None.

    Raises
    ------
    OptionError
        There is no such view.
    """
    if names is None:
        return None
    known = [view.name for view in scene.views]
    indices = []
    for name in names:
        found = find_name(name, known)
        if found is None:
            raise OptionError(
                f"names {name!r}, and there is no such image with truth and pose.",
                field="experiment.views",
            )
        indices.append(known.index(found))
    return tuple(dict.fromkeys(indices))


def require_apart(out: Path, capture: Path) -> None:
    """Refuse an output folder in which results would mix with the input.

    Raises
    ------
    OptionError
        It is a folder of the capture.
    DataError
        It is a file.
    """
    places = [capture, *(capture / name for name in ("raw", "images", "cams", "gt"))]
    if resolved(out) in [resolved(place) for place in places if place.exists()]:
        raise OptionError(f"{out}: OUT is a folder of the capture. Give another OUT.")
    if out.exists() and not out.is_dir():
        raise DataError(out, "is a file; OUT must be a folder.")
