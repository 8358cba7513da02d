"""Meaning of the page's numbers, one line each, for readers who are new to the field."""

from __future__ import annotations

# By the beginning of a number's name; the longest match is used.
_MEANINGS = {
    # models
    "OPA": "Orthographic phase angle: the older model, which takes all rays of the camera as "
    "parallel.",
    "PPA": "Perspective phase angle: each pixel has a ray of its own.",
    "TILTED": "PPA, with polarizers that oblique rays meet at a tilt.",
    "tilted": "PPA, with polarizers that oblique rays meet at a tilt.",
    "textbook OPA": "Orthographic phase angle as published, with nothing added.",
    "textbook PPA": "Perspective phase angle as published, with nothing added.",
    "polmvs OPA": "Orthographic phase angle, with what polmvs makes up for.",
    "polmvs PPA": "Perspective phase angle, with what polmvs makes up for.",
    "polmvs tilted": "PPA, with polarizers that oblique rays meet at a tilt.",
    # facts
    "views with a pose": "Photographs whose place and direction SfM found, of all.",
    "sparse points": "Points that SfM triangulated from features; the surface starts from those on "
    "the part.",
    "seeds": "Sparse points on the polarized surface, which say how far away it is.",
    "points": "Of the dense cloud, on the polarized surface.",
    "region covered": "Share of the polarized pixels, over all views, in which the cloud has a "
    "point.",
    "time": "By the clock, all stages together.",
    "scale": "Whether lengths are true: by known cameras, markers or a distance.",
    "size": "Of the part, along its three main directions, without the outermost half per cent.",
    # the comparison
    "coverage": "Share of the polarized pixels, over all views, in which the cloud has a point.",
    "agreement of the views": "Of all views that see a point, the share that agree with its place "
    "and normal.",
    "phase residual over all views": "Angle between the measured phase and the one that the "
    "surface predicts. Needs no ground truth.",
    "phase residual of the seeds": "The same at the sparse points that the surface starts from.",
    "phase error on the part": "Angle between the measured phase and the one that the true "
    "surface has under the model.",
    "error of the sparse normals": "Angle between the normals of the sparse points and the true "
    "ones.",
    "depth maps, RMSE": "Root mean square of the depth maps' errors: few large errors count much.",
    "depth maps within": "Share of the depths that are right to that distance.",
    "depths within one / two": "Share of the depths that err by less than one and two of their "
    "stated standard deviations; 68 and 95 % are right.",
    "normal maps": "Angle between the normals of the depth maps and the true ones.",
    "F-score": "Accuracy and completeness in one figure, their harmonic mean.",
    "accuracy": "Share of the cloud's points that lie so near to the true surface.",
    "completeness": "Share of the true surface that has a point of the cloud so near to it.",
    "Chamfer distance": "Mean distance from the cloud to the true surface and back.",
    "normal error": "Angle between the cloud's normals and the true ones.",
    "outliers": "Share of the points that lie near no surface of the scene.",
    # trust
    "phase residual, median, deg": "Angle between measured phases and those that the surface "
    "predicts.",
    "phase residual, median, sigma": "The same in the standard deviations that the phases are "
    "stated with.",
    "views that agree": "Of all views that see a point, the share that agree with its place and "
    "normal.",
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
    "farther off than three": "Share of the points whose distance is no chance, by their stated "
    "deviations.",
    "within the tolerance": "Share of the points whose distance is at most the tolerance.",
    "repeatability": "Standard deviation of one run of two: that of their differences over the "
    "square root of two.",
    "scale that was fitted": "The result has no scale of its own; the reference's was taken.",
    # stages
    "stage": "Steps of the program, in their order.",
    "seconds": "By the clock.",
    "peak memory": "Most memory that all processes of the program held together until then.",
    "value": "What was measured.",
    "normal": "What right results have.",
}


def meaning(name: str) -> str:
    """The meaning of a number, one line; "" if unknown."""
    fitting = [known for known in _MEANINGS if name.startswith(known)]
    return _MEANINGS[max(fitting, key=len)] if fitting else ""
