"""Maps as pictures in false colours, and their encoding for a page.

Every function takes arrays and gives RGB ``(H, W, 3)`` uint8. The colour maps are perceptually
uniform and suitable for all kinds of colour blindness; angles have a cyclic one.
"""

from __future__ import annotations

import base64
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Floats, Mask

Rgb = NDArray[np.uint8]

CYCLIC, SEQUENTIAL, ERROR = "twilight", "viridis", "plasma"
OUTLINE = (230, 159, 0)
NOTHING = 236  # grey of pixels without a value; reads on light and dark pages
QUALITY = 82  # of 100, of what compresses; 100 px of a thumbnail hardly show a difference above


@lru_cache(maxsize=8)
def palette(name: str, num: int = 256) -> Rgb:
    """``(num, 3)`` colours of one of matplotlib's maps."""
    from matplotlib import colormaps

    return np.asarray(255 * colormaps[name](np.linspace(0, 1, num))[:, :3] + 0.5, np.uint8)


def hex_palette(name: str, num: int = 256) -> list[str]:
    """The colours of :func:`palette` as ``#rrggbb``."""
    return ["#" + bytes(color).hex() for color in palette(name, num).tolist()]


def scalar_picture(values: Floats, low: float, high: float, *, colors: str = SEQUENTIAL) -> Rgb:
    """Values ``(H, W)`` from ``low`` to ``high`` in sequential colours; grey where not finite."""
    share = (np.asarray(values, np.float64) - low) / max(high - low, 1e-300)
    return _colored(share, palette(colors))


def angle_picture(angle: Floats, *, strength: Floats | None = None) -> Rgb:
    """Axial angles ``(H, W)``, rad modulo pi, in cyclic colours; grey where not finite.

    Parameters
    ----------
    strength : (H, W), 0 to 1, share of the colour over grey.
    """
    share = np.mod(np.asarray(angle, np.float64), np.pi) / np.pi
    picture = _colored(share, palette(CYCLIC))
    if strength is None:
        return picture
    weight = np.clip(np.nan_to_num(strength), 0, 1)[..., None]
    return np.asarray(weight * picture + (1 - weight) * NOTHING, np.uint8)


def angle_wheel(size_px: int = 96) -> NDArray[np.uint8]:
    """Legend of :func:`angle_picture`: RGBA ``(size, size, 4)``, the colour of each direction.

    Angles are axial, anticlockwise from +x as displayed.
    """
    axis = np.arange(size_px) + 0.5 - size_px / 2
    x, y = np.meshgrid(axis, -axis)  # y up, as displayed
    radius = np.hypot(x, y) / (size_px / 2)
    ring = (radius < 1) & (radius > 0.45)
    rgb = angle_picture(np.arctan2(y, x))
    return np.dstack([rgb, np.where(ring, 255, 0).astype(np.uint8)])


def normal_picture(normals_in_cam: Floats) -> Rgb:
    """Normals ``(H, W, 3)``, camera frame, in the usual colours; grey where not finite.

    Red is right, green is up, blue is towards the camera.
    """
    known = np.isfinite(normals_in_cam).all(axis=-1, keepdims=True)
    flipped = np.where(known, normals_in_cam, 0) * np.array([1.0, -1.0, -1.0])
    return np.where(known, 127.5 * (1 + flipped) + 0.5, NOTHING).astype(np.uint8)


def gray_picture(intensity: Floats, white: float) -> Rgb:
    """Linear intensities ``(H, W)`` encoded for display; ``white`` and above is white."""
    share = np.clip(np.nan_to_num(np.asarray(intensity, np.float64)) / white, 0, 1)
    gray = (255 * share ** (1 / 2.2) + 0.5).astype(np.uint8)
    return np.repeat(gray[..., None], 3, axis=-1)


def outline_picture(intensity: Floats, white: float, inside: Mask) -> Rgb:
    """The intensity, dimmed outside of a mask, with the mask's outline."""
    picture = gray_picture(intensity, white)
    picture[~inside] = (0.35 * picture[~inside]).astype(np.uint8)
    picture[_border(inside)] = OUTLINE
    return picture


def mesh_picture(intensity: Floats, white: float, normals_in_cam: Floats) -> Rgb:
    """The intensity with a mesh over it, blue and shaded by its normals, and its outline.

    Parameters
    ----------
    normals_in_cam : (H, W, 3), camera frame, NaN off the mesh.
    """
    picture = gray_picture(intensity, white).astype(np.float64)
    shown = np.asarray(np.isfinite(normals_in_cam).all(axis=-1))
    facing = np.clip(-np.where(shown, normals_in_cam[..., 2], -1.0), 0, 1)
    tint = (0.25 + 0.75 * facing)[..., None] * np.array([86.0, 180.0, 233.0])
    picture[shown] = 0.45 * picture[shown] + 0.55 * tint[shown]
    picture[_border(shown)] = OUTLINE
    return np.asarray(picture, np.uint8)


def _border(mask: Mask) -> Mask:
    """Pixels beside those of a mask."""
    flags = mask.astype(np.uint8)
    return np.asarray(cv2.dilate(flags, np.ones((3, 3), np.uint8)) > flags)


def _colored(share: Floats, colors: Rgb) -> Rgb:
    known = np.isfinite(share)
    index = np.clip(np.where(known, share, 0) * len(colors), 0, len(colors) - 1).astype(np.intp)
    return np.where(known[..., None], colors[index], np.uint8(NOTHING))


def data_uri(picture: NDArray[np.uint8]) -> str:
    """A picture, RGB or RGBA, as a data URI (WebP)."""
    order = cv2.COLOR_RGBA2BGRA if picture.shape[-1] == 4 else cv2.COLOR_RGB2BGR
    _, code = cv2.imencode(
        ".webp", cv2.cvtColor(picture, order), [cv2.IMWRITE_WEBP_QUALITY, QUALITY]
    )
    return "data:image/webp;base64," + base64.b64encode(code.tobytes()).decode("ascii")
