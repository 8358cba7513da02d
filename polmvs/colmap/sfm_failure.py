"""Diagnosis of a failed SfM from its database: no texture, no overlap, or a wrong camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from polmvs.colmap.database import opened
from polmvs.config import SfmOptions
from polmvs.scene import short_list


def why_no_model(database: Path, options: SfmOptions) -> str:
    """One or two sentences with the cause of the failure and the remedy.

    Parameters
    ----------
    database : COLMAP's, with features and matches.
    options : of the run that failed.

    Notes
    -----
    The initial pair of a model, and an image that is added, need a number of matches that COLMAP's
    mapper requires. An image with fewer features than that has too little texture; usual images
    have thousands.
    """
    asked = pycolmap.IncrementalMapperOptions()
    to_begin, to_add = asked.init_min_num_inliers, asked.abs_pose_min_num_inliers
    with opened(database) as content:
        images = {image.image_id: str(image.name) for image in content.read_all_images()}
        features = {i: int(content.num_keypoints_for_image(i)) for i in images}
        pairs, inliers = content.read_two_view_geometry_num_inliers()
        ids = [pycolmap.pair_id_to_image_pair(pair) for pair in pairs]
    if np.median(list(features.values())) < to_begin:
        poor = [images[i] for i, num in features.items() if num < to_begin]
        return (
            f"the images show too little texture: under {to_begin} features in "
            f"{len(poor)} of {len(images)} ({short_list(poor)}). SfM lives on the surroundings of "
            "the part: put a printed pattern about it, expose more, or give poses with "
            "`sfm.sparse`."
        )
    best = dict.fromkeys(images, 0)
    for (first, second), num in zip(ids, inliers, strict=True):
        best[first], best[second] = max(best[first], int(num)), max(best[second], int(num))
    if max(best.values(), default=0) < to_begin:
        lonely = [images[i] for i, num in best.items() if num < to_add]
        return (
            f"the images overlap too little: the two most alike share {max(best.values())} "
            f"features, and {len(lonely)} of {len(images)} share under {to_add} with any "
            "other. Record views in between, 20 degrees apart at most, of surroundings that stay "
            "in place, or give poses with `sfm.sparse`."
        )
    return (
        f"the images have texture and overlap (up to {max(best.values())} shared features), but "
        f"no camera explains them. {_camera_remedy(options)}"
    )


def _camera_remedy(options: SfmOptions) -> str:
    if options.known_camera is not None:
        return f"Check `{options.known_camera}`, or leave it out, so that the camera is estimated."
    if options.camera_model != SfmOptions().camera_model:
        return (
            f"Check `sfm.camera_model` {options.camera_model}; a normal lens has "
            f"{SfmOptions().camera_model}. Or give `sfm.intrinsics`."
        )
    return (
        "Give `sfm.intrinsics`, or for a very wide lens `sfm.camera_model` OPENCV_FISHEYE. Views "
        "that differ by a turn of the camera alone have no depth: move it."
    )
