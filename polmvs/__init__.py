"""polmvs: multi-view reconstruction of glossy, textureless surfaces from polarization cameras.

Conventions (``tests/test_conventions.py`` tests each of them)
--------------------------------------------------------------
Camera
    x right, y down, z forward (OpenCV and COLMAP). ``p_in_cam = cam_from_world * p_in_world``.
    A ray ``v`` is unit and leaves the camera, ``v_z > 0``; a visible surface normal has
    ``n . v < 0``. Points and vectors are rows of ``(..., 3)`` arrays.
Pixels
    COLMAP's: the origin is the corner of the image, so pixel ``(row, col)`` has its centre at
    ``xy = (col + 0.5, row + 0.5)``. OpenCV counts from pixel centres; only
    :mod:`polmvs.camera` converts between the two. A 2x2 polarizer cell of the raw mosaic is one
    pixel of the polarization image: ``K_half[:2] = K_raw[:2] / 2``.
Polarization
    ``aolp``: direction of greatest transmitted intensity, anticlockwise from +x as displayed,
    modulo pi. ``phase``: direction in which the plane of incidence cuts the image plane, same
    sense, modulo pi. ``phase = aolp`` for diffuse-dominant light, ``aolp + pi/2`` for
    specular-dominant light. Both are axial: they are averaged and interpolated through
    ``(cos 2x, sin 2x)`` only.
Rows
    ``m``: the unit normal of the plane of incidence. ``m . n = 0`` for the surface normal ``n``;
    the residual is the sine of the angle between the normal and the plane of incidence.
World
    COLMAP's. Its scale is arbitrary unless the poses were given in metres.

Use
---
The import is quick and has no side effects; a function imports what it needs when it is called::

    stokes = polmvs.read_stokes("frame.png")              # .aolp, .dolp, .phase(), .sigma_aolp
    picture = polmvs.aolp_colors(polmvs.read_stokes(array))  # of a frame that a camera's SDK gives
    normal = polmvs.plane_normal(stokes, (fx, fy, cx, cy))
    result = polmvs.reconstruct("capture", "out", model="ppa")
    result.point_cloud(), result.mesh(), result.depth_map("003.png"), result.metrics
    print(polmvs.compare("capture", "out2", gt="capture/gt").table())
    polmvs.simulate("part.stl", "capture", material="black-plastic", light="overcast", views=16)
"""

# pycolmap >= 4.1 exports its own deflate symbols: imported before zlib it makes PNG and npz
# writing abort. Loading zlib before anything else of this package prevents that.
import zlib  # noqa: F401
from importlib import import_module
from typing import TYPE_CHECKING, Any

from polmvs._version import __version__

if TYPE_CHECKING:
    from polmvs.api import (
        Reconstruction,
        RunResult,
        TrackNormals,
        aolp_colors,
        compare,
        dolp_colors,
        open_run,
        plane_normal,
        read_stokes,
        reconstruct,
        simulate,
        track_normals,
    )
    from polmvs.camera import PinholeCamera
    from polmvs.config import Options
    from polmvs.errors import DataError, OptionError, PolmvsError
    from polmvs.polarization.kinds import AngleModel

__all__ = [
    "AngleModel",
    "DataError",
    "OptionError",
    "Options",
    "PinholeCamera",
    "PolmvsError",
    "Reconstruction",
    "RunResult",
    "TrackNormals",
    "__version__",
    "aolp_colors",
    "compare",
    "dolp_colors",
    "open_run",
    "plane_normal",
    "read_stokes",
    "reconstruct",
    "simulate",
    "track_normals",
]

# Modules of the public names that are not in polmvs.api; each is imported at its first use.
_ELSEWHERE = {
    "AngleModel": "polmvs.polarization.kinds",
    "DataError": "polmvs.errors",
    "OptionError": "polmvs.errors",
    "Options": "polmvs.config",
    "PinholeCamera": "polmvs.camera",
    "PolmvsError": "polmvs.errors",
}


def __getattr__(name: str) -> Any:
    """A name of the public API."""
    if name not in __all__:
        raise AttributeError(f"module 'polmvs' has no attribute {name!r}")
    value = getattr(import_module(_ELSEWHERE.get(name, "polmvs.api")), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public API."""
    return sorted(__all__)
