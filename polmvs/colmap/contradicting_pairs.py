"""Pairs of images whose matches contradict a known camera.

COLMAP verifies the matches of a pair by the epipolar geometry of calibrated cameras, of
uncalibrated cameras, and of a plane. Matches that fit uncalibrated cameras clearly better than the
given ones are mostly between two things that look alike, such as parts of a textured table. The
mapper would use them and give a view a wrong pose.
"""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import pycolmap

from polmvs.colmap.database import opened

# Largest share of the verified pairs. If more contradict the camera, the camera is wrong: then the
# pairs are kept, and the trial adjustment names the camera.
MAX_SHARE = 0.5
# Largest number of images for which pairs are dropped. A guess: among many images the right pairs
# outvote a wrong one, and contradicting pairs hold good matches too. Measured: with all pairs, two
# choices of six images of a mug had a view turned by 83 degrees, without these pairs none; among 16
# small images, one choice got worse without them.
MAX_IMAGES = 8


def drop_contradicting(database: Path) -> int:
    """Remove pairs that fit no geometry of their known cameras from a database.

    Returns
    -------
    Their number; 0 if so many contradict the cameras that the cameras are wrong, and if there are
    many images.
    """
    with opened(database) as content:
        numbers = sorted(image.image_id for image in content.read_all_images())
        if len(numbers) > MAX_IMAGES:
            return 0
        verified, contradicting = 0, []
        for pair in combinations(numbers, 2):
            if not content.exists_two_view_geometry(*pair):
                continue
            found = content.read_two_view_geometry(*pair)
            if not len(found.inlier_matches):
                continue
            verified += 1
            if found.config == pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED:
                contradicting.append(pair)
        if len(contradicting) > MAX_SHARE * verified:
            return 0
        for pair in contradicting:
            content.delete_two_view_geometry(*pair)
    return len(contradicting)
