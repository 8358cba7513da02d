"""Rows of points with known normals, seen from all around, and how far estimates are off."""

import numpy as np


def unit(vectors, axis=0):
    return vectors / np.linalg.norm(vectors, axis=axis, keepdims=True)


def simulate(num_rows, num_points, sigma_deg, rng, outliers=0.0):
    """Rows, rays, sigmas and normals of points seen from all around, the rows turned by noise.

    ``sigma_deg`` (low, high): the deviations are spread evenly in logarithm.
    """
    shape = (num_rows, num_points)
    normals = unit(rng.standard_normal((3, num_points)))
    zenith = np.radians(rng.uniform(20, 70, shape))
    # Two views never look along the same plane of incidence.
    azimuth = 2.4 * np.arange(num_rows)[:, None] + rng.uniform(-0.3, 0.3, shape)
    first, second = tangents_of(normals)
    across = np.cos(azimuth) * first[:, None] + np.sin(azimuth) * second[:, None]
    rays = -np.cos(zenith) * normals[:, None] - np.sin(zenith) * across
    rows = unit(np.cross(rays, normals[:, None], axis=0))
    sigma = np.radians(np.exp(rng.uniform(*np.log(sigma_deg), shape)))
    turn = sigma * rng.standard_normal(shape)
    wrong = rng.random(shape) < outliers
    turn = np.where(wrong, rng.uniform(-np.pi / 2, np.pi / 2, shape), turn)
    rows = np.cos(turn) * rows + np.sin(turn) * np.cross(rays, rows, axis=0)
    return rows * rng.choice([-1, 1], shape), rays, sigma, normals


def tangents_of(normals):
    least = np.eye(3)[np.abs(normals).argmin(axis=0)].T
    first = unit(np.cross(normals, least, axis=0))
    return first, np.cross(normals, first, axis=0)


def errors_deg(estimate, normals):
    return np.degrees(np.arccos(np.clip((estimate.normals.T * normals).sum(axis=0), -1, 1)))
