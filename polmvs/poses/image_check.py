"""Check of given cameras against the images by epipolar distances of matches.

Features of the images are matched without cameras. Matches that an epipolar geometry of a pair
explains are mostly correct. If the given poses belong to the images, these matches lie on each
other's epipolar lines.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from os import PathLike

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array
from polmvs.colmap.dense_workspace import MatchTolerances
from polmvs.errors import DataError
from polmvs.geometry import lengths
from polmvs.polarization.capture import WHITE_PERCENTILE, Capture, intensity_image_8bit
from polmvs.scene import View, evenly_spread

ImageLoader = Callable[[str], NDArray[np.uint8]]


@dataclass(frozen=True, kw_only=True)
class ImageCheckTolerances:
    """Tolerances of the comparison of images and cameras.

    Attributes
    ----------
    max_views : number of compared views, evenly spread; costs time only. Derived: as for a dense
        workspace.
    max_features : of an image, the strongest; costs time only.
    max_ratio : of the distances of the best and the next descriptor. As Lowe advises.
    epipolar_px : of a match from the geometry of its pair's matches. Guess; features are exact to
        about a pixel.
    min_matches : of a pair that one geometry explains. Derived: eight determine a geometry, and of
        the 20 to 100 false matches of unrelated images 8 to 15 fit the best one (simulated).
    min_share : of a pair's matches that one geometry explains. Guess.
    max_distance : of a match from the given cameras' epipolar line, as a share of the image's
        diagonal: the error of poses that still belong to the images. Guess. By chance 2 to 4 % of
        the matches are so near.
    min_fitting : share of matches within this distance below which the cameras are of other images.
        Measured: cameras of five captures on the images of each have 0.71 to 0.99 on their own
        images (least with a repeating pattern), 0.00 to 0.16 on others; a guess between.
    """

    max_views: int = MatchTolerances.max_compared_views
    max_features: int = 1500
    max_ratio: float = 0.75
    epipolar_px: float = 2.0
    min_matches: int = 20
    min_share: float = 0.5
    max_distance: float = 0.01
    min_fitting: float = 0.3


@dataclass(frozen=True, kw_only=True)
class ImageFit:
    """Fit of cameras to images.

    Attributes
    ----------
    num_matches : matches that the images' own geometry explains.
    fitting : share of them that the cameras also explain; NaN if there are too few.
    fits : None if there are too few.
    """

    num_matches: int
    fitting: float
    fits: bool | None


def require_cameras_of_images(
    views: Sequence[View], matches: ImageMatches, source: str | PathLike[str], remedy: str
) -> ImageFit:
    """Refuse cameras that cannot belong to the images of their names.

    Parameters
    ----------
    views : given cameras, named as the images.
    matches : between the images.
    source : of the cameras, for messages.
    remedy : what to give instead.

    Raises
    ------
    DataError
        The images contradict the cameras. Images with too few matches pass.
    """
    fit = fit_to_images(views, matches)
    if fit.fits is False:
        raise DataError(
            source,
            f"its cameras do not fit the images: of {fit.num_matches} features that the images "
            f"share {100 * fit.fitting:.0f} % lie where these cameras put them, of right ones "
            f"nearly all. {remedy}",
        )
    return fit


def fit_to_images(views: Sequence[View], matches: ImageMatches) -> ImageFit:
    """Compare cameras with the matches of the images of their names."""
    t = matches.tolerances
    distances = [np.zeros(0)]
    chosen = [views[k] for k in evenly_spread(len(views), t.max_views)]
    for first, second in combinations(chosen, 2):
        found = matches.between(first.name, second.name)
        if found is not None:
            distances.append(epipolar_distances(first, second, *found))
    shares = np.concatenate(distances)
    if len(shares) < 2 * t.min_matches:  # one pair alone is not reliable
        return ImageFit(num_matches=len(shares), fitting=float("nan"), fits=None)
    fitting = float(np.mean(shares < t.max_distance))
    return ImageFit(num_matches=len(shares), fitting=fitting, fits=fitting >= t.min_fitting)


class ImageMatches:
    """Matches between images, each found once however many cameras are compared with them.

    Parameters
    ----------
    load_image : gives an image (H, W) by its name.
    tolerances : of the comparison.
    """

    def __init__(
        self, load_image: ImageLoader, *, tolerances: ImageCheckTolerances = ImageCheckTolerances()
    ) -> None:
        self.tolerances = tolerances
        sift = feature_detector(tolerances)
        self._features = lru_cache(None)(lambda name: find_features(sift, load_image(name)))
        self._between = lru_cache(None)(
            lambda a, b: _consistent_matches(self._features(a), self._features(b), tolerances)
        )

    def between(self, first: str, second: str) -> tuple[Array, Array] | None:
        """Places (N, 2) of the matches in two images that one epipolar geometry explains.

        None if too few do.
        """
        return self._between(first, second)


def matches_of(capture: Capture, names: Mapping[str, str]) -> ImageMatches:
    """Matches between the intensity images of a capture, each with an exposure of its own.

    Parameters
    ----------
    names : of the capture's views by the names of their images.
    """

    def load(name: str) -> NDArray[np.uint8]:
        stokes = capture.load(names[name])
        white = float(np.percentile(stokes.s0, WHITE_PERCENTILE))
        return intensity_image_8bit(stokes, white if white > 0 else 1.0)

    return ImageMatches(load)


def feature_detector(t: ImageCheckTolerances) -> cv2.SIFT:
    """SIFT without the shift by a quarter of a pixel of OpenCV's enlarged image."""
    return cv2.SIFT.create(nfeatures=t.max_features, enable_precise_upscale=True)


def find_features(
    sift: cv2.SIFT, image: NDArray[np.uint8]
) -> tuple[Array, NDArray[np.float32], tuple[int, int]]:
    """Positions (N, 2), COLMAP's pixels, descriptors (N, 128), and the image's shape."""
    keypoints, descriptors = sift.detectAndCompute(image, None)
    xy = np.array([keypoint.pt for keypoint in keypoints], np.float64).reshape(-1, 2) + 0.5
    if not keypoints:  # then OpenCV gives None for the descriptors
        descriptors = np.zeros((0, 128), np.float32)
    return xy, np.asarray(descriptors, np.float32), (image.shape[0], image.shape[1])


def _consistent_matches(
    first: tuple[Array, NDArray[np.float32], tuple[int, int]],
    second: tuple[Array, NDArray[np.float32], tuple[int, int]],
    t: ImageCheckTolerances,
) -> tuple[Array, Array] | None:
    """Places of the matches that one epipolar geometry explains; None where too few do."""
    if min(len(first[0]), len(second[0])) < t.min_matches:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first[1], second[1], k=2)
    good = [m for m, other in pairs if m.distance < t.max_ratio * other.distance]
    # One partner each.
    best = {m.trainIdx: m for m in sorted(good, key=lambda m: -m.distance)}
    if len(best) < t.min_matches:
        return None
    a = first[0][[m.queryIdx for m in best.values()]]
    b = second[0][[m.trainIdx for m in best.values()]]
    # Before a turntable the background stays in place: it tells nothing about the cameras.
    moved = lengths(a - b) > t.epipolar_px
    a, b = a[moved], b[moved]
    if len(a) < t.min_matches:
        return None
    cv2.setRNGSeed(0)
    _, inside = cv2.findFundamentalMat(a, b, cv2.FM_RANSAC, t.epipolar_px, 0.999, 2000)
    kept = np.ravel(inside) == 1  # None where no geometry fits
    if kept.size != len(a) or kept.sum() < max(t.min_matches, t.min_share * len(a)):
        return None
    return a[kept], b[kept]


def epipolar_distances(first: View, second: View, a: Array, b: Array) -> Array:
    """Distances (N,) of matches from each other's epipolar plane, shares of the diagonal.

    It is the larger of the angles at the two cameras, times the focal length. A match behind a
    camera has no finite distance.
    """
    rays, others = first.rays_in_world(a), second.rays_in_world(b)
    base = second.center_in_world - first.center_in_world
    length = np.linalg.norm(base)
    largest = np.zeros(len(a))
    for view, own, other in ((first, rays, others), (second, others, rays)):
        camera = view.camera
        normal = np.cross(other, base)
        sine = np.abs((own * normal).sum(axis=1)) / np.maximum(
            np.linalg.norm(normal, axis=1), 1e-12
        )
        scale = camera.mean_focal_px / float(np.hypot(camera.width, camera.height))
        largest = np.maximum(largest, scale * np.arcsin(np.minimum(sine, 1.0)))
    # Lines a + s r and b + t q meet nearest at s, t; of true matches both are positive.
    cosine = (rays * others).sum(axis=1)
    along, across = rays @ base, others @ base
    s, t = along - cosine * across, cosine * along - across
    behind = (s < 0) & (1 - cosine**2 > 1e-6) | (t < 0) & (1 - cosine**2 > 1e-6)
    return np.where((length > 0) & ~behind & np.isfinite(largest), largest, np.inf)
