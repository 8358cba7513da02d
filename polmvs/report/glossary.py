"""Meaning of the page's numbers, one line each, for readers who are new to the field."""

from __future__ import annotations

# By the beginning of a number's name; the longest match is used.
_MEANINGS = {
    # models
    "OPA": "Orthographic phase angle: the older model, which takes all rays of the camera as "
    "parallel.",
    "PPA": "Perspective phase angle: each pixel has its own ray.",
    "TILTED": "PPA, with polarizers that oblique rays meet at a tilt.",
    "tilted": "PPA, with polarizers that oblique rays meet at a tilt.",
    "textbook OPA": "Orthographic phase angle as published, with nothing added.",
    "textbook PPA": "Perspective phase angle as published, with nothing added.",
    "polmvs OPA": "Orthographic phase angle, with the additions of polmvs.",
    "polmvs PPA": "Perspective phase angle, with the additions of polmvs.",
    "polmvs tilted": "PPA, with polarizers that oblique rays meet at a tilt.",
    # facts
    "views with a pose": "Images whose position and direction SfM found, of all.",
    "sparse points": "Points that SfM triangulated from features; the surface starts from those on "
    "the part.",
    "seeds": "Sparse points on the polarized surface, which give its distance.",
    "points": "Of the dense cloud, on the polarized surface.",
    "region covered": "Share of the polarized pixels, over all views, in which the cloud has a "
    "point.",
    "time": "Wall time of all stages together.",
    "scale": "Whether lengths are metric, from known cameras, markers or a distance.",
    "size": "Of the part, along its three main directions, without the outermost half per cent.",
    # the comparison
    "coverage": "Share of the polarized pixels, over all views, in which the cloud has a point.",
    "agreement of the views": "Of all views that see a point, the share that agree with its "
    "position and normal.",
    "phase residual over all views": "Angle between the measured phase and the one that the "
    "surface predicts. Needs no ground truth.",
    "phase residual of the seeds": "The same at the sparse points from which the surface starts.",
    "phase error on the part": "Angle between the measured phase and the one that the model "
    "predicts from the true surface.",
    "error of the sparse normals": "Angle between the normals of the sparse points and the true "
    "ones.",
    "depth maps, RMSE": "Root mean square error of the depth maps; large errors dominate.",
    "depth maps within": "Share of the depths with an error below that distance.",
    "depths within one / two": "Share of the depths with an error below one and two of their "
    "stated standard deviations; 68 and 95 % are ideal.",
    "normals within one / two": "Share of the normals with an angular error below one and two of "
    "their stated standard deviations; 68 and 95 % are ideal.",
    "normal maps": "Angle between the normals of the depth maps and the true ones.",
    "F-score": "Harmonic mean of accuracy and completeness.",
    "accuracy": "Share of the cloud's points within this distance of the true surface.",
    "completeness": "Share of the true surface with a point of the cloud within this distance.",
    "Chamfer distance": "Mean distance from the cloud to the true surface and back.",
    "normal error": "Angle between the cloud's normals and the true ones.",
    "outliers": "Share of the points far from every surface of the scene.",
    # trust
    "phase residual beyond noise, median, deg": "Angle between measured phases and those that the "
    "surface predicts, without the part that noise explains.",
    "phase residual, median, sigma": "The whole angle in stated standard deviations of the phases.",
    "views that agree": "Of all views that see a point, the share that agree with its position "
    "and normal.",
    "points within the silhouettes": "Share of the points that are inside the outline of the part "
    "in the views that see them.",
    "coverage of the polarized regions": "Share of the polarized pixels that the surface explains.",
    "position uncertainty (1 sigma)": "Stated standard deviation of a point along its normal, as a "
    "share of its distance.",
    # deviation
    "compared points": "Points of the part that were compared with the reference.",
    "mean": "Of the signed distances: positive is outside the reference.",
    "standard deviation": "Of the signed distances about their mean.",
    "RMS": "Root mean square of the signed distances.",
    "percentile": "That share of the points has a smaller signed distance.",
    "uncertainty (1 sigma) of a distance": "Median over the points.",
    "farther off than three": "Share of the points whose distance is significant, by their stated "
    "deviations.",
    "within the tolerance": "Share of the points whose distance is at most the tolerance.",
    "repeatability": "Standard deviation of one run of two: that of their differences over the "
    "square root of two.",
    "scale that was fitted": "The result has no metric scale; it was fitted to the reference.",
    # stages
    "stage": "Stages of the run, in their order.",
    "seconds": "Wall time.",
    "peak memory": "Largest memory of all processes together.",
    "value": "What was measured.",
    "normal": "Range of right results.",
}


def meaning(name: str) -> str:
    """The meaning of a number, one line; "" if unknown."""
    fitting = [known for known in _MEANINGS if name.startswith(known)]
    return _MEANINGS[max(fitting, key=len)] if fitting else ""
