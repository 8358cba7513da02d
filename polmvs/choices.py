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


class Packing(StrEnum):
    """How a dump without a header holds its samples."""

    MONO8 = "mono8"
    MONO16 = "mono16"
    MONO10P = "mono10p"
    MONO12P = "mono12p"
    MONO10PACKED = "mono10packed"
    MONO12PACKED = "mono12packed"


class CaptureKind(StrEnum):
    """What the files of a capture hold."""

    MOSAIC = "mosaic"
    ANGLES = "angles"
    STOKES = "stokes"
    AOLP = "aolp"


class BayerOrder(StrEnum):
    """Colours of the 2x2 blocks of polarizers of a colour sensor, row by row."""

    RGGB = "rggb"
    GRBG = "grbg"
    GBRG = "gbrg"
    BGGR = "bggr"


class Channel(StrEnum):
    """Which colour the Stokes images are made of."""

    COMBINED = "combined"
    RED = "red"
    GREEN = "green"
    BLUE = "blue"


class Resolution(StrEnum):
    """Size of the polarization images of a mosaic."""

    HALF = "half"
    FULL = "full"
