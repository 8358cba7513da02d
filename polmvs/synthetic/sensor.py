"""A polarization sensor with errors: gains, angles and extinction of its polarizers, dark level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from polmvs.arrays import Array
from polmvs.config import CaptureOptions
from polmvs.synthetic.captures import add_noise


@dataclass(frozen=True, kw_only=True, eq=False)
class FaultySensor:
    """Response of each sample of a mosaic: ``g / 2 (s0 + d (cos 2a s1 + sin 2a s2)) + b``.

    Attributes
    ----------
    gain, angle_deg, diattenuation, dark : (H, W), of each sample; ``dark`` in full scales.
    """

    gain: Array
    angle_deg: Array
    diattenuation: Array
    dark: Array

    def expose(self, stokes: Array, rng: np.random.Generator | None = None) -> Array:
        """Samples (H, W) of light ``(3, H, W)``, full scales; with noise if ``rng`` is given."""
        twice = 2.0 * np.radians(self.angle_deg)
        polarized = np.cos(twice) * stokes[1] + np.sin(twice) * stokes[2]
        light = 0.5 * self.gain * (stokes[0] + self.diattenuation * polarized)
        if rng is not None:
            light = add_noise(np.maximum(light, 0), rng=rng)
        return np.asarray(light + self.dark)


def faulty_sensor(
    shape: tuple[int, int],
    rng: np.random.Generator,
    *,
    gain_sigma: float = 0.02,
    angle_sigma_deg: float = 1.0,
    extinction_ratio: float = 50.0,
    sample_share: float = 0.0,
    dark: float = 0.01,
) -> FaultySensor:
    """Draw a sensor's errors, one of each kind per channel plus a share of it per sample.

    Parameters
    ----------
    shape : (H, W), even.
    gain_sigma, angle_sigma_deg : deviations over the four channels.
    extinction_ratio : mean; channels differ by a quarter of it.
    sample_share : deviation of single samples from their channel, as a share of these.
    dark : level without light, full scales.
    """
    gain, angle, strength = (np.empty(shape) for _ in range(3))
    for cell, nominal in enumerate(CaptureOptions.pattern):
        site = np.s_[cell // 2 :: 2, cell % 2 :: 2]
        ratio = extinction_ratio * (1 + 0.25 * rng.uniform(-1, 1))
        gain[site] = 1 + gain_sigma * rng.normal()
        angle[site] = nominal + angle_sigma_deg * rng.normal()
        strength[site] = (ratio - 1) / (ratio + 1)
    gain += sample_share * gain_sigma * rng.normal(size=shape)
    angle += sample_share * angle_sigma_deg * rng.normal(size=shape)
    return FaultySensor(
        gain=gain, angle_deg=angle, diattenuation=strength, dark=np.full(shape, dark)
    )
