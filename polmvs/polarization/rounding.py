"""Rounding error of Stokes images where noise is too small to dither it.

Rounding adds a variance of a twelfth of a squared step. If the noise of a sample is half a step or
more, this error is white: neighbours are rounded independently. With less noise, as in the dark
parts of 8-bit images, neighbours of one intensity have the same rounding error, which no smoothing
reduces. For a value ``x`` with noise of deviation ``w``, in steps, the mean of the rounded values
has the error

    sum over k > 0 of  (-1)^k / (pi k)  exp(-2 pi^2 k^2 w^2)  sin(2 pi k x)

(Widrow & Kollar, Quantization Noise, 2008, chapter 4). Its variance over ``x`` is the sum of
``exp(-4 pi^2 k^2 w^2) / (2 pi^2 k^2)``: a twelfth without noise, 0.001 at a third of a step. Where
the intensity changes by ``g`` steps a pixel, a Gaussian window of width ``s`` leaves ``exp(-4 pi^2
k^2 s^2 g^2)`` of each term.
"""

from __future__ import annotations

import cv2
import numpy as np

from polmvs.arrays import Image, Mask

NUM_TERMS = 4
BLURRED = 0.12  # squared steps of noise above which less than 0.0005 squared steps are shared
GRADIENT_WINDOW_PX = 9  # over which slopes of rounded samples are known


def shared_rounding(
    intensities: Image,
    valid: Mask,
    *,
    constant: float,
    slope: float,
    quantum: float,
    window_px: float = 1.0,
) -> Image | None:
    """Variance that neighbouring pixels share by the rounding of samples, mean over the images.

    Parameters
    ----------
    intensities : (n, H, W) float32, linear, units of full scale.
    valid : (H, W), pixels to use.
    constant, slope : of the variance of a sample before rounding, by its intensity; a lower bound
        makes the result too large.
    quantum : step of a sample, units of full scale.
    window_px : width of the smoothing that follows.

    Returns
    -------
    (H, W) float32, squared units of full scale; None if noise dithers all valid pixels.
    """
    if quantum <= 0:
        return None
    step = quantum**2
    lowest = intensities.min(axis=0)
    dark = valid & (constant + slope * lowest < BLURRED * step)
    if not dark.any():
        return None
    size = (GRADIENT_WINDOW_PX, GRADIENT_WINDOW_PX)
    shared = np.zeros(np.count_nonzero(dark), np.float32)
    for image in intensities:
        smooth = cv2.blur(image, size)
        across = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)[dark]
        down = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=1, scale=0.5)[dark]
        noise = np.maximum(constant + slope * smooth[dark], 0)
        blur = (noise + window_px**2 * (across**2 + down**2)) / step
        for k in range(1, NUM_TERMS + 1):
            shared += np.exp(-4 * np.pi**2 * k**2 * blur) / (2 * np.pi**2 * k**2)
    found = np.zeros(valid.shape, np.float32)
    found[dark] = shared * np.float32(step / len(intensities))
    return found
