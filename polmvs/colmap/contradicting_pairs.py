"""Pairs of images whose matches a known camera rules out.

COLMAP verifies the matches of a pair by the epipolar geometry of its calibrated cameras, of any
cameras, and of a plane. Matches that fit any cameras clearly better than the given ones are mostly
those of two things that look alike: of a textured table after a turn, say. The mapper takes them as
they are, and places a view wrongly by them.
"""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import pycolmap

from polmvs.colmap.database import opened

# Of the verified pairs. If more contradict the camera, it is the camera that is wrong: then the
# pairs stay, and the trial adjustment names the camera.
MAX_SHARE = 0.5
# Of images that this is done for. A guess: where each has many pairs, the others outvote a wrong
# one, and contradicting pairs hold good matches too. Measured: of six images of a mug two choices
# had a view turned by 83 degrees, and have none now; of 16 small images one got worse by this.
MAX_IMAGES = 8


def drop_contradicting(database: Path) -> int:
    """Take pairs that fit no geometry of their known cameras out of a database.

    Returns
    -------
    Their number; 0 where so many contradict the cameras that these are wrong, and where images
    are many.
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
