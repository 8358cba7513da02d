"""Names and colours that figures and tables share."""

from __future__ import annotations

from polmvs.config import AngleModel

MODEL_LABELS = {AngleModel.OPA: "OPA", AngleModel.PPA: "PPA", AngleModel.TILTED: "tilted"}

# Okabe and Ito's palette, which people with any kind of colour blindness tell apart.
VERMILLION, ORANGE, SKY, BLUE, GREEN, GREY = (
    "#D55E00", "#E69F00", "#56B4E9", "#0072B2", "#009E73", "#666666",
)  # fmt: skip

PLANE_LABELS = {
    "algebraic": "PPA, eigenvector (paper)",
    "weighted_noise": "PPA, robust, noise weights",
    "weighted": "PPA, robust, tilt-aware weights",
    "tilted_algebraic": "tilted, eigenvector",
    "tilted": "tilted, robust",
}
PLANE_COLORS = {
    "algebraic": SKY,
    "weighted_noise": GREY,
    "weighted": BLUE,
    "tilted_algebraic": ORANGE,
    "tilted": GREEN,
}
PLANE_MARKERS = {
    "algebraic": "o", "weighted_noise": "x", "weighted": "s", "tilted_algebraic": "v",
    "tilted": "D",
}  # fmt: skip

TRACK_LABELS = {
    "opa": "OPA, eigenvector",
    "opa_weighted": "OPA, weighted robust",
    "ppa_algebraic": "PPA, eigenvector (paper)",
    "ppa_weighted": "PPA, weighted robust",
    "tilted_weighted": "tilted, weighted robust",
}
TRACK_COLORS = {
    "opa": VERMILLION,
    "opa_weighted": ORANGE,
    "ppa_algebraic": SKY,
    "ppa_weighted": BLUE,
    "tilted_weighted": GREEN,
}
TRACK_STYLES = {
    "opa": "-", "opa_weighted": "--", "ppa_algebraic": "--", "ppa_weighted": "-",
    "tilted_weighted": "-",
}  # fmt: skip

CONTOUR_LABELS = {
    "opa": "OPA, iso-depth",
    "ppa_normals": "PPA, two-view normals, same 2D paths",
    "ppa_tangent": "PPA, iso-range, one view",
    "tilted_tangent": "tilted, iso-range, one view",
}
CONTOUR_COLORS = {
    "opa": VERMILLION,
    "ppa_normals": SKY,
    "ppa_tangent": BLUE,
    "tilted_tangent": GREEN,
}
