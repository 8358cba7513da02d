"""Phase maps: the phase of one view, with its precision."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Floats, Image, Mask
from polmvs.camera import pixel_centers, sample_image
from polmvs.errors import DataError
from polmvs.io.arrays import map_array, save_array
from polmvs.polarization.angle_models import correct_stokes, phase_sign
from polmvs.polarization.kinds import Light
from polmvs.polarization.region import Region, smooth
from polmvs.polarization.stokes import Stokes
from polmvs.scene import View

MIN_SHARE = 0.02  # of a window that must count
TINY = 1e-12  # variance of a polarization without noise
# Least median of an object's DoLP over its standard deviation: the median of Rice's distribution
# whose true DoLP equals the deviation. Unpolarized light has 1.18, white plastic in a studio 12.
MIN_DOLP_SIGMAS = 1.48
STRENGTH_WINDOW_PX = 3.0  # of the averages whose DoLP is compared with it


@dataclass(frozen=True, kw_only=True)
class PhaseTolerances:
    """Tolerances of smoothing, and errors of the phase other than noise.

    Attributes
    ----------
    sharp_smoothing_px : of the lowest DoLP of single pixels. Guess.
    fine_smoothing_px : of the phase. Measured, F at 1 mm with 1.5 px, 1 px and 0.7 px: of `step`
        97.6, 98.0 and 97.8 %, of `mug` 97.6, 98.2 and 98.0 %.
    coarse_smoothing_px : of the phase where few pixels are usable: it bridges clipped spots. Guess.
    model_sigma : rad; error of the phase of strongly polarized light that noise does not
        explain. Measured on the shared captures.
    ridge : of the local linear fits, as a share of the window's variance: bounds their slopes
        where few pixels count. Guess.
    mixture_sigma : rad times DoLP; light of the other kind, mixed in, turns the phase by this over
        the DoLP. Measured on the shared captures.
    """

    sharp_smoothing_px: float = 0.7
    fine_smoothing_px: float = 1.0
    coarse_smoothing_px: float = 5.0
    ridge: float = 0.02
    model_sigma: float = 0.014
    mixture_sigma: float = 0.006


@dataclass(frozen=True)
class PhaseMap:
    """Phase of one view, smoothed over the valid pixels of its region.

    Attributes
    ----------
    view : camera, pose and name.
    region : where the view shows a polarized surface.
    samples : (H, W, 3) float32: ``dolp cos 2 phase``, ``dolp sin 2 phase`` and the phase's inverse
        variance (1 / rad^2; 0: no phase here): noise and mixed light, whatever the angle model.
    intensity : (H, W) float32, s0 in units of full scale.
    diffuse : (H, W) bool, pixels with mainly diffuse light; the others have specular light.
    lowest_dolp : (H, W) uint8, lowest DoLP of single pixels next to each pixel, in 1/255: a print
        on a surface is less polarized than the surface, a mirror image in it is not.
    polarization : (H, W, 4) float32: ``s1 / s0`` and ``s2 / s0`` of each pixel as measured, inside
        and outside of the region, and the variance of either: that of a mean of n pixels is the
        third channel over n (noise, which neighbours share in part, and lossy compression) plus the
        fourth, which all pixels share (gains, and rounding without dithering noise). Both are inf
        where a pixel is clipped or dark.
    outline_shift : (H, W) float32 px, distance by which the outline of the region lies outside of
        its border, at each pixel that of the nearest border pixel; None if not measured.
    folder : folder of the arrays, if they are stored.
    tilted : the samples are corrected for tilted polarizers (:func:`as_tilted`).
    """

    view: View
    region: Region
    samples: Image
    intensity: Image
    diffuse: Mask
    lowest_dolp: NDArray[np.uint8]
    polarization: Image
    outline_shift: Image | None = None
    folder: Path | None = None
    tilted: bool = False

    def shows_surface(self, xy: Floats) -> Mask:
        """Whether the pixels at image coordinates ``(..., 2)`` belong to the region."""
        return sample_image(self.region.inside.astype(np.float32), xy, nearest=True) > 0

    def changed(self, **changes: Any) -> PhaseMap:
        """The map with other arrays, not stored."""
        now = {field.name: getattr(self, field.name) for field in fields(PhaseMap)}
        return PhaseMap(**{**now, "folder": None, **changes})


class StoredPhaseMap(PhaseMap):
    """A phase map on disk; its arrays are mapped into memory when they are used, not held.

    So only the maps in use take memory. It is pickled as its path.
    """

    def __init__(self, view: View, folder: Path, tilted: bool) -> None:
        for name, value in (("view", view), ("folder", folder), ("tilted", tilted)):
            object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[Any, ...]:
        assert self.folder is not None
        return StoredPhaseMap, (self.view, self.folder, self.tilted)

    def _array(self, name: str, kind: type[np.generic]) -> NDArray[Any]:
        assert self.folder is not None
        return map_array(self.folder / name, kind)

    @property
    def flags(self) -> NDArray[np.uint8]:
        """Region and light of each pixel (H, W), one bit each."""
        return self._array(f"{self.view.name}.region.npy", np.unsignedinteger)

    @property
    def samples(self) -> Image:
        """See :class:`PhaseMap`."""
        return self._array(_samples_name(self.view.name, self.tilted), np.floating)

    @property
    def intensity(self) -> Image:
        """See :class:`PhaseMap`."""
        return self._array(f"{self.view.name}.intensity.npy", np.floating)

    @property
    def lowest_dolp(self) -> NDArray[np.uint8]:
        """See :class:`PhaseMap`."""
        return self._array(f"{self.view.name}.dolp.npy", np.unsignedinteger)

    @property
    def polarization(self) -> Image:
        """See :class:`PhaseMap`."""
        return self._array(f"{self.view.name}.polarization.npy", np.floating)

    @property
    def outline_shift(self) -> Image | None:
        """See :class:`PhaseMap`."""
        name = f"{self.view.name}.outline.npy"
        assert self.folder is not None
        return self._array(name, np.floating) if (self.folder / name).is_file() else None

    @property
    def region(self) -> Region:
        """See :class:`PhaseMap`."""
        return _StoredRegion(self.flags)

    @property
    def diffuse(self) -> Mask:
        """See :class:`PhaseMap`."""
        return np.asarray((self.flags & 8) > 0)


class _StoredRegion(Region):
    """A region as its flags on disk, of which one mask at a time is made."""

    def __init__(self, flags: NDArray[np.uint8]) -> None:
        object.__setattr__(self, "flags", flags)

    def __reduce__(self) -> tuple[Any, ...]:
        return Region, (self.inside, self.reliable, self.edges, self.unbounded)

    def _mask(self, bit: int) -> Mask:
        return np.asarray((vars(self)["flags"] & bit) > 0)

    @property
    def inside(self) -> Mask:
        return self._mask(1)

    @property
    def reliable(self) -> Mask:
        return self._mask(2)

    @property
    def edges(self) -> Mask:
        return self._mask(4)

    @property
    def unbounded(self) -> Mask:
        return self._mask(16)


def build_phase_map(
    view: View,
    stokes: Stokes,
    region: Region,
    light: Light,
    *,
    tolerances: PhaseTolerances = PhaseTolerances(),
) -> PhaseMap:
    """Smooth the polarization of a region's valid pixels and convert it to phase and precision.

    ``s1 / s0`` and ``s2 / s0`` are smoothed: smoothing the Stokes images would spread the phase of
    a bright patch into the dark one beside it. For the same reason printed marks keep their own
    weak phase: in one view a mark looks like a wall that turns away from the light. All usable
    pixels have the same weight. Less weight where the four samples disagree raises phase errors by
    2 to 13 %, and would depend on the format of the capture.

    Parameters
    ----------
    stokes : of this view. Smoothing does not reduce errors that neighbours share: those of
        compression within a block, of gains over all pixels, and of rounding without dithering.
    region : of this view.
    light : dominant kind of light; specular light turns the phase by pi/2 from the AoLP.
    tolerances : of this step.
    """
    t = tolerances
    counted = region.inside & stokes.valid & (stokes.s0 > 0)
    s0 = np.where(counted, stokes.s0, np.float32(1))
    axial = np.dstack([np.where(counted, channel / s0, 0) for channel in (stokes.s1, stokes.s2)])
    axial = np.asarray(phase_sign(light) * axial, np.float32)
    whole, lossy = np.square(stokes.sigma / s0), np.square(stokes.lossy_sigma / s0)
    variances = np.maximum(whole - lossy, 0)
    widths_px = t.fine_smoothing_px, t.coarse_smoothing_px
    fine, coarse = (_smoothed(axial, variances, counted, width, t.ridge) for width in widths_px)
    use_fine = fine.share > 0.25
    axial = np.where(use_fine[..., None], fine.values, coarse.values)
    share = np.where(use_fine, fine.share, coarse.share)
    width_px = np.where(use_fine, *widths_px)
    dolp = np.linalg.norm(axial, axis=-1)
    axial = axial / np.maximum(dolp, 1)[..., None]  # beside an outline a fit may go beyond
    dolp = np.minimum(dolp, 1)
    # A Gaussian of width w averages 4 pi w^2 independent pixels.
    blocks = 4 * np.pi * width_px**2 * share / stokes.lossy_block_px**2
    noise = np.where(use_fine, fine.variance, coarse.variance)
    # Neighbours were interpolated from the same samples: they err together.
    area = stokes.noise_area_px
    noise = noise * np.maximum(area / (1 + area / (4 * np.pi * width_px**2)), 1)
    noise = noise + lossy / np.maximum(blocks, 1) + _shared_by_all(stokes, s0)
    with np.errstate(divide="ignore"):
        variance = t.model_sigma**2 + (t.mixture_sigma**2 + noise / 4) / dolp**2
        precision = np.where(region.inside & (share > MIN_SHARE), 1 / variance, 0)
    samples = np.dstack([axial, precision]).astype(np.float32)
    diffuse = np.full(region.inside.shape, light is Light.DIFFUSE)
    intensity = np.asarray(stokes.s0, np.float32)
    lowest = _lowest_dolp(np.dstack([stokes.s0, stokes.s1, stokes.s2]), tolerances=t)
    polarization = measured_polarization(stokes)
    return PhaseMap(view, region, samples, intensity, diffuse, lowest, polarization)


def measured_polarization(stokes: Stokes) -> Image:
    """Normalised Stokes parameters of all pixels (H, W, 4) with their variances.

    It does not depend on the kind of light. See ``polarization`` of :class:`PhaseMap`.
    """
    known = stokes.valid & (stokes.s0 > 0)
    s0 = np.where(known, stokes.s0, np.float32(1))
    whole, lossy = np.square(stokes.sigma / s0), np.square(stokes.lossy_sigma / s0)
    own = stokes.noise_area_px * np.maximum(whole - lossy, 0) + stokes.lossy_block_px**2 * lossy
    shared = np.broadcast_to(_shared_by_all(stokes, s0), own.shape)
    channels = np.dstack([stokes.s1 / s0, stokes.s2 / s0, own, shared])
    nothing = np.array([0, 0, np.inf, np.inf], np.float32)
    return np.where(known[..., None], channels, nothing).astype(np.float32)


def _shared_by_all(stokes: Stokes, s0: Image) -> Image:
    """Variance of s1 / s0 and of s2 / s0 that no smoothing reduces, (H, W) or of any shape."""
    gains = np.asarray(stokes.gain_sigma**2, np.float32)
    if stokes.rounding is None:
        return gains
    return np.asarray(gains + stokes.rounding / np.square(s0), np.float32)


def smoothed_polarization(
    polarization: Image, width_px: float, counted: Mask | None = None
) -> Image:
    """Polarization (H, W, 3) averaged over a Gaussian window: s1 / s0, s2 / s0, their variance.

    Parameters
    ----------
    polarization : as of :class:`PhaseMap`.
    width_px : of the window.
    counted : (H, W), pixels to use; None: all.

    Returns
    -------
    The variance is 0 where the window has no usable pixel.
    """
    known = np.isfinite(polarization[..., 2])
    if counted is not None:
        known &= counted
    whole = np.zeros((*known.shape, 3), np.float32)
    # The window reaches no farther about the usable pixels.
    reach = len(_window(width_px)[0]) // 2
    part = box_about(known, reach)
    whole[part] = _smoothed_part(polarization[part], known[part], width_px)
    return whole


def dolp_in_sigmas(phase_map: PhaseMap) -> Image:
    """Smoothed DoLP of all pixels (H, W) over its standard deviation; NaN where it is unknown."""
    smoothed = smoothed_polarization(np.asarray(phase_map.polarization), STRENGTH_WINDOW_PX)
    dolp, variance = np.hypot(smoothed[..., 0], smoothed[..., 1]), smoothed[..., 2]
    known = variance > 0
    return np.where(known, dolp / np.sqrt(np.where(known, variance, 1)), np.nan).astype(np.float32)


def median_strength(sigmas: Image, where: Mask) -> float:
    """Median of what :func:`dolp_in_sigmas` gives for some pixels; 0 where none is known."""
    known = sigmas[where & np.isfinite(sigmas)]
    return float(np.median(known)) if known.size else 0.0


def box_about(known: Mask, margin: int) -> tuple[slice, slice]:
    """Smallest part of an image that holds its marked pixels with a margin."""
    ends = []
    for axis in (1, 0):
        marked = np.flatnonzero(known.any(axis=axis))
        first, last = (marked[0], marked[-1]) if len(marked) else (0, -1)
        ends.append(slice(max(int(first) - margin, 0), int(last) + 1 + margin))
    return ends[0], ends[1]


def _smoothed_part(polarization: Image, known: Mask, width_px: float) -> Image:
    """As :func:`smoothed_polarization`, with the usable pixels."""
    axial = np.where(known[..., None], polarization[..., :2], 0).astype(np.float32)
    own, shared = (np.where(known, polarization[..., c], 0).astype(np.float32) for c in (2, 3))
    found = _smoothed(axial, own, known, width_px, PhaseTolerances.ridge)
    variance = found.variance + smooth(shared, width_px) / np.maximum(found.share, 1e-6)
    variance = np.where(found.share > MIN_SHARE, np.maximum(variance, TINY), 0)
    return np.dstack([found.values, variance]).astype(np.float32)


def _lowest_dolp(stokes: Image, *, tolerances: PhaseTolerances) -> NDArray[np.uint8]:
    """Lowest DoLP in the 3x3 px about each pixel, in 1/255."""
    sharp = smooth(stokes[..., :3], tolerances.sharp_smoothing_px)
    dolp = np.hypot(sharp[..., 1], sharp[..., 2]) / np.maximum(sharp[..., 0], 1e-6)
    quantised = (255 * np.clip(dolp, 0, 1)).astype(np.uint8)
    lowest = cv2.erode(quantised, np.ones((3, 3), np.uint8))
    return np.asarray(lowest, np.uint8)


def as_tilted(phase_map: PhaseMap) -> PhaseMap:
    """The phase map that a sensor obeying PPA would have given, not stored.

    This assumes that the polarizers are tilted for oblique rays
    (:mod:`polmvs.polarization.angle_models`). The correction is linear in the Stokes parameters
    and varies slowly over the image, so it may follow the smoothing.
    """
    sign = np.where(phase_map.diffuse, phase_sign(Light.DIFFUSE), phase_sign(Light.SPECULAR))
    cos, sin, precision = np.moveaxis(phase_map.samples, -1, 0)
    measured = Stokes(
        s0=np.ones_like(sign),
        s1=sign * cos,
        s2=sign * sin,
        sigma=np.ones_like(sign),
        valid=precision > 0,
    )
    corrected = correct_stokes(measured, view_rays(phase_map.view), diffuse=phase_map.diffuse)
    scale = sign / np.maximum(corrected.s0, 1e-6)
    # The variance of a row's rotation about its ray stays; that of the phase changes.
    precision = precision / np.square(corrected.sigma)
    samples = np.dstack([scale * corrected.s1, scale * corrected.s2, precision])
    clean = np.nan_to_num(samples, nan=0.0, posinf=0.0, neginf=0.0).astype(np.float32)
    return phase_map.changed(samples=clean, tilted=True)


def turned(phase_map: PhaseMap, where: Mask) -> PhaseMap:
    """The map with the other kind of light at some pixels, whose phase is turned; not stored."""
    sign = np.where(where, -1, 1).astype(np.float32)[..., None]
    axial, precision = phase_map.samples[..., :2], phase_map.samples[..., 2:]
    samples = np.concatenate([sign * axial, precision], axis=-1)
    return phase_map.changed(samples=samples, diffuse=phase_map.diffuse ^ where)


def store_phase_map(phase_map: PhaseMap, folder: Path) -> PhaseMap:
    """Write a phase map as ``.npy`` files named after the view; return the stored map.

    A tilted map shares all files except the samples with the map from which it was made.
    """
    region, name = phase_map.region, phase_map.view.name
    flags = region.inside * 1 | region.reliable * 2 | region.edges * 4 | phase_map.diffuse * 8
    if region.unbounded is not None:
        flags |= region.unbounded * 16
    save_array(folder / _samples_name(name, phase_map.tilted), phase_map.samples)
    save_array(folder / f"{name}.intensity.npy", phase_map.intensity)
    save_array(folder / f"{name}.region.npy", flags.astype(np.uint8))
    save_array(folder / f"{name}.dolp.npy", phase_map.lowest_dolp)
    save_array(folder / f"{name}.polarization.npy", phase_map.polarization)
    if phase_map.outline_shift is not None:
        save_array(folder / f"{name}.outline.npy", phase_map.outline_shift)
    return open_phase_map(phase_map.view, folder, tilted=phase_map.tilted)


def _samples_name(name: str, tilted: bool) -> str:
    return f"{name}.tilted.npy" if tilted else f"{name}.samples.npy"


def open_phase_map(view: View, folder: Path, *, tilted: bool = False) -> PhaseMap:
    """Open a stored phase map; its images stay on disk until they are used.

    Raises
    ------
    DataError
        A file is missing, damaged, or has another size than the view's camera.
    """
    stored = StoredPhaseMap(view, folder, tilted)
    samples = stored.samples
    size = (view.camera.height, view.camera.width)
    shapes = (samples.shape[:2], stored.intensity.shape, stored.flags.shape)
    fits = all(shape == size for shape in (*shapes, stored.lowest_dolp.shape))
    fits &= stored.polarization.shape == (*size, 4)
    if not fits or samples.shape[2:] != (3,):
        reason = "has another size than its camera; give `run.overwrite`."
        raise DataError(folder / view.name, reason)
    return stored


@dataclass(frozen=True)
class _Smoothed:
    """Images smoothed over the pixels that count.

    ``values`` (H, W, C); ``variance`` (H, W) of each channel from the pixels' noise; ``share``
    (H, W) of the window that counts.
    """

    values: Image
    variance: Image
    share: Image


def _window(sigma_px: float) -> tuple[Image, Image]:
    """Places (px) of a Gaussian window along an axis, and its values, which sum to one."""
    reach = int(np.ceil(4 * sigma_px))
    place = np.arange(-reach, reach + 1, dtype=np.float32)
    window = np.exp(-0.5 * (place / sigma_px) ** 2)
    return place, np.asarray(window / window.sum(), np.float32)


def _smoothed(
    images: Image, variances: Image, counted: Mask, sigma_px: float, ridge: float
) -> _Smoothed:
    """Local linear fits under a Gaussian window (first-order normalized convolution).

    Next to an outline, all usable pixels lie on one side. Their mean is that of a point further
    inside, where a curved surface is less oblique: a bias of 2 to 7 deg at the outline of `dome`.
    A linear fit, evaluated at the window's centre, has no such bias.

    Knutsson & Westin, CVPR 1993.

    Parameters
    ----------
    images : (H, W, C), 0 where a pixel does not count.
    variances : (H, W), of their noise.
    counted : (H, W), pixels that count.
    sigma_px : of the window.
    ridge : as in `PhaseTolerances`.
    """
    place, window = _window(sigma_px)

    def moment(image: Image, power_x: int, power_y: int, kernel: Image = window) -> Image:
        along_x, along_y = (np.asarray(kernel * place**i, np.float32) for i in (power_x, power_y))
        return np.asarray(
            cv2.sepFilter2D(image, -1, along_x, along_y, borderType=cv2.BORDER_REPLICATE)
        )

    weight = counted.astype(np.float32)
    share = moment(weight, 0, 0)
    total = np.maximum(share, 1e-6)
    x, y = moment(weight, 1, 0) / total, moment(weight, 0, 1) / total
    xx = moment(weight, 2, 0) / total - x * x + ridge * sigma_px**2
    yy = moment(weight, 0, 2) / total - y * y + ridge * sigma_px**2
    xy = moment(weight, 1, 1) / total - x * y
    # Values at the centre: the mean less the slope times the centroid (x, y) of what counts.
    scale = 1 / np.maximum(xx * yy - xy * xy, 1e-9)
    lever_x, lever_y = scale * (yy * x - xy * y), scale * (xx * y - xy * x)
    constant = (1 + lever_x * x + lever_y * y) / total
    by_x, by_y = lever_x / total, lever_y / total
    values = np.asarray(constant[..., None] * moment(images, 0, 0), np.float32)
    values -= by_x[..., None] * moment(images, 1, 0)
    values -= by_y[..., None] * moment(images, 0, 1)
    # The same weights squared give the noise.
    noisy, squared = weight * variances, np.asarray(window**2, np.float32)
    second = {(i, j): moment(noisy, i, j, squared) for i in range(3) for j in range(3 - i)}
    variance = (
        constant**2 * second[0, 0]
        + by_x**2 * second[2, 0]
        + by_y**2 * second[0, 2]
        + 2 * by_x * by_y * second[1, 1]
        - 2 * constant * (by_x * second[1, 0] + by_y * second[0, 1])
    )
    return _Smoothed(values, np.maximum(variance, 0).astype(np.float32), share)


def view_rays(view: View) -> NDArray[np.float32]:
    """Unit rays ``(H, W, 3)`` of all pixels, camera frame."""
    camera = view.camera
    return camera.rays(pixel_centers(camera.width, camera.height)).astype(np.float32)
