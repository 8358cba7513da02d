"""What options choose among."""

from __future__ import annotations

from enum import StrEnum


class AngleModel(StrEnum):
    """Relation between the measured angle and the surface normal."""

    OPA = "opa"
    PPA = "ppa"
    TILTED = "tilted"


class Light(StrEnum):
    """Which reflection dominates the polarisation of the part."""

    SPECULAR = "specular"
    DIFFUSE = "diffuse"


class Method(StrEnum):
    """How ranges spread over a view's region."""

    INTEGRATE = "integrate"
    CONTOUR = "contour"


class Contour(StrEnum):
    """How a PPA contour is traced."""

    TANGENT = "tangent"
    NORMALS = "normals"


class Surroundings(StrEnum):
    """What a cloud holds beside the polarised parts."""

    NONE = "none"
    SPARSE = "sparse"
    STEREO = "stereo"


class Estimator(StrEnum):
    """How a normal is solved from its rows."""

    ROBUST = "robust"
    ALGEBRAIC = "algebraic"
