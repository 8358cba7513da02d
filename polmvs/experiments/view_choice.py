"""Which K views give the normal of a point."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from polmvs.errors import OptionError

Floats = NDArray[np.floating]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

DEFAULT_K = tuple(range(2, 21))


def check_k(k: Sequence[int] | None, num_views: int) -> tuple[int, ...]:
    """Numbers of views in ascending order; those of the default that the capture has.

    Raises
    ------
    OptionError
        One is under 2 or over ``num_views``, or the capture has fewer than two views.
    """
    if num_views < 2:
        raise OptionError(f"normals from tracks need 2 views or more, this capture has {num_views}")
    if k is None:
        return tuple(value for value in DEFAULT_K if value <= num_views)
    if not k or min(k) < 2 or max(k) > num_views:
        raise OptionError(
            f"must lie in 2 to {num_views}, the views of this capture with truth and pose, "
            f"not {','.join(map(str, k))}.",
            field="experiment.k",
        )
    return tuple(sorted(set(k)))


def order_at_random(usable: Mask, rng: np.random.Generator) -> Indices:
    """Views of each point (V, N) in random order, those that do not count last."""
    keys = np.where(usable, rng.random(usable.shape), 2.0)
    return np.argsort(keys, axis=0, kind="stable")


def order_by_angle(rays: Floats, usable: Mask, num: int, rng: np.random.Generator) -> Indices:
    """Views of each point (num, N): a random one, then each the farthest in angle from the others.

    Parameters
    ----------
    rays : (3, V, N), unit, world, from the views to the points.
    usable : (V, N) bool; views that do not count come last.
    num : views to choose.
    """
    points = np.arange(usable.shape[1])
    order = order_at_random(usable, rng)[:num]
    # Largest cosine to a chosen view; 3: not usable, 2: chosen already.
    closest = np.where(usable, -1.0, 3.0)
    for step in range(1, num):
        chosen = order[step - 1]
        cosine = np.einsum("ivn,in->vn", rays, rays[:, chosen, points])
        closest = np.where(usable, np.maximum(closest, cosine), 3.0)
        for earlier in order[:step]:
            closest[earlier, points] = np.maximum(closest[earlier, points], 2.0)
        order[step] = closest.argmin(axis=0)
    return order
