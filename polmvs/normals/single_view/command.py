"""The command ``polmvs plane``: normals of planes in one raw image, and which model fits it."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.camera import PinholeCamera
from polmvs.config import AngleModel, CaptureOptions, Estimator, Light, SfmOptions
from polmvs.errors import DataError, OptionError
from polmvs.io.images import read_mask
from polmvs.normals.single_view.focal import FocalEstimate
from polmvs.normals.single_view.pixels import PlaneView, load_stokes, polygon_mask
from polmvs.normals.single_view.plane import PlaneEstimate
from polmvs.option_values import parse_text, to_plain
from polmvs.polarization.stokes import Stokes

Mask = NDArray[np.bool_]

MIN_PIXELS = 50


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add ``plane`` to the commands; its ``run`` is :func:`run`."""
    description = "normals of planes in one raw image, and which camera model fits it"
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "plane", help=description, description=description[0].upper() + description[1:] + "."
    )
    parser.add_argument("image", type=Path, metavar="IMAGE", help="raw polarizer mosaic")
    parser.add_argument("-v", "--verbose", action="store_true", help="show every step")
    _add_pixel_flags(parser)
    parser.add_argument(
        "--model",
        type=AngleModel,
        choices=list(AngleModel),
        default=AngleModel.PPA,
        help="angle and normal; 'tilted' presumes a lens not telecentric on the image side "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--light",
        type=Light,
        choices=list(Light),
        default=Light.SPECULAR,
        help="reflection that dominates the polarisation (default: %(default)s)",
    )
    parser.add_argument(
        "--estimator",
        type=Estimator,
        choices=list(Estimator),
        default=Estimator.ROBUST,
        help="weighted robust, or the paper's eigenvector (default: %(default)s)",
    )
    parser.add_argument(
        "--estimate-focal",
        action="store_true",
        help="estimate the focal length from the plane (tilted model); used where --intrinsics "
        "are not given",
    )
    parser.add_argument("--find-planes", action="store_true", help="find all planes in view")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(run=run)
    return parser


def _add_pixel_flags(parser: argparse.ArgumentParser) -> None:
    """Flags that say how the image is read and which of its pixels count."""
    parser.add_argument(
        "--intrinsics",
        metavar="FX,FY,CX,CY",
        help="of the half-size polarization image, px, COLMAP's convention (default: centred, "
        "focal length of the image's width, which the output says)",
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--mask", type=Path, metavar="FILE", help="half-size image, not 0 on the plane"
    )
    where.add_argument(
        "--polygon",
        nargs="+",
        metavar="X,Y",
        help="corners about the plane, half-size px (default: all valid pixels)",
    )
    parser.add_argument(
        "--min-dolp",
        type=float,
        default=0.1,
        help="degree of polarisation from which a pixel counts (default: %(default)s)",
    )
    parser.add_argument(
        "--min-intensity",
        type=float,
        default=0.5,
        help="share of the pixels' median intensity from which one counts: where something dark "
        "is reflected, other light shows; 0: all (default: %(default)s)",
    )
    parser.add_argument(
        "--drop-clipped",
        action="store_true",
        help="leave saturated pixels out; a plane at one exposure loses its brightest part",
    )
    parser.add_argument(
        "--pattern",
        default="90,45,135,0",
        metavar="A,B,C,D",
        help="polarizer angles of a 2x2 cell in degrees, row by row (default: %(default)s)",
    )
    parser.add_argument(
        "--gamma",
        type=float,
        default=1.0,
        help="encoding gamma: linear = (raw / full scale) ** (1 / gamma) (default: %(default)s)",
    )


def run(args: argparse.Namespace, terminal: object = None) -> int:
    """Run ``polmvs plane`` and print what came of it.

    Parameters
    ----------
    args : of the parser made by :func:`add_parser`.
    terminal : not used; commands are called with one.

    Raises
    ------
    OptionError, DataError
        An option is unusable or does not fit the image, a file is, or no pixel counts.
    """
    if args.find_planes and args.model is AngleModel.OPA:
        raise OptionError("--find-planes needs --model ppa or tilted: under OPA planes are lines.")
    stokes = load_stokes(args.image, _capture_options(args))
    view = PlaneView(stokes=stokes, mask=_select(args, stokes), light=args.light)
    camera = _camera(args.intrinsics, stokes)
    result = _measure(args, view, camera)
    print(json.dumps(to_plain(result), indent=1) if args.json else _text(result))
    return 0


def _measure(args: argparse.Namespace, view: PlaneView, camera: PinholeCamera) -> dict[str, Any]:
    """All figures, as printed in JSON."""
    result: dict[str, Any] = {
        "image": str(args.image),
        "width": camera.width,
        "height": camera.height,
        "intrinsics_from": "options" if args.intrinsics else "assumed",
        "model": args.model,
        "light": args.light,
        "estimator": args.estimator,
        "min_dolp": args.min_dolp,
    }
    if args.estimate_focal:
        focal = view.focal(camera)
        result["focal"] = _focal_figures(focal)
        if focal.observable and not args.intrinsics:
            scale = focal.focal_px / camera.fx
            camera = replace(camera, fx=camera.fx * scale, fy=camera.fy * scale)
            result["intrinsics_from"] = "estimated"
    result["intrinsics"] = [camera.fx, camera.fy, camera.cx, camera.cy]
    robust = args.estimator is Estimator.ROBUST
    planes = {model: view.plane(model, camera, robust=robust) for model in AngleModel}
    result["plane"] = _figures(planes[args.model])
    result["residuals"] = {
        str(model): {"rmse_deg": plane.rmse_deg, "median_deg": plane.median_deg}
        for model, plane in planes.items()
    }
    if args.find_planes:
        result["planes"] = [
            {**_figures(plane.estimate), "center_xy": _center(plane.mask)}
            for plane in view.planes(args.model, camera)
        ]
    return result


def _capture_options(args: argparse.Namespace) -> CaptureOptions:
    """How the mosaic is read."""
    try:
        pattern = parse_text(tuple[int, int, int, int], args.pattern)
    except ValueError as error:
        raise OptionError(f"--pattern needs four angles, not {args.pattern!r}.") from error
    return CaptureOptions(pattern=pattern, gamma=args.gamma)


def _select(args: argparse.Namespace, stokes: Stokes) -> Mask:
    """Pixels that count."""
    if not 0 < args.min_dolp < 1:
        raise OptionError(f"--min-dolp must lie in 0 to 1, not {args.min_dolp}.")
    if not 0 <= args.min_intensity < 1:
        raise OptionError(f"--min-intensity must lie in 0 to 1, not {args.min_intensity}.")
    inside = np.ones(stokes.shape, np.bool_)
    if args.mask is not None:
        inside = read_mask(args.mask, stokes.shape)
    elif args.polygon is not None:
        corners = [_numbers(text, 2, "--polygon") for text in args.polygon]
        if len(corners) < 3:
            raise OptionError(f"--polygon needs three corners or more, not {len(corners)}.")
        inside = polygon_mask(corners, stokes.shape)
    valid = stokes.valid if args.drop_clipped else stokes.s0 > 0
    mask = inside & valid & (stokes.dolp > args.min_dolp)
    if mask.any():
        mask &= stokes.s0 >= args.min_intensity * np.median(stokes.s0[mask])
    if np.count_nonzero(mask) < MIN_PIXELS:
        raise DataError(
            args.image,
            f"only {np.count_nonzero(mask)} pixels have a DoLP above {args.min_dolp} there; "
            "lower --min-dolp or choose a polarised area.",
        )
    return np.asarray(mask)


def _camera(text: str | None, stokes: Stokes) -> PinholeCamera:
    """The given camera, or a centred one with a focal length of the image's width."""
    height, width = stokes.shape
    if text is None:
        return PinholeCamera(
            width=width, height=height, fx=width, fy=width, cx=width / 2, cy=height / 2
        )
    values = SfmOptions(intrinsics=_numbers(text, 4, "--intrinsics")).intrinsics
    assert values is not None
    fx, fy, cx, cy = values
    if not (cx < width and cy < height):
        raise OptionError(
            f"--intrinsics have the principal point {cx:g},{cy:g} outside the polarization image "
            f"of {width}x{height} px; give those of the half-size image."
        )
    return PinholeCamera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def _numbers(text: str, count: int, flag: str) -> tuple[float, ...]:
    """Numbers from a list with commas."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not np.isfinite(values).all():
        raise OptionError(f"{flag} needs {count} numbers with commas between, not {text!r}.")
    return values


def _figures(plane: PlaneEstimate) -> dict[str, Any]:
    return {**asdict(plane), "normal": plane.normal.tolist()}


def _focal_figures(focal: FocalEstimate) -> dict[str, Any]:
    return {
        "focal_px": focal.focal_px if focal.observable else None,
        "sigma_px": focal.sigma_px,
        "observable": focal.observable,
        "scan_focal_px": focal.scan_focal_px.tolist(),
        "scan_rmse_deg": focal.scan_rmse_deg.tolist(),
        "scan_median_deg": focal.scan_median_deg.tolist(),
    }


def _center(mask: Mask) -> list[float]:
    row, col = np.argwhere(mask).mean(axis=0)
    return [float(col + 0.5), float(row + 0.5)]


def _text(result: dict[str, Any]) -> str:
    """The figures for people."""
    fx, fy, cx, cy = result["intrinsics"]
    source = {"assumed": " (assumed: give --intrinsics)", "estimated": " (estimated)"}
    lines = [
        f"{result['image']}: {result['width']}x{result['height']} px, "
        f"{result['plane']['num_pixels']:,} pixels with a DoLP above {result['min_dolp']:g}",
        f"intrinsics    {fx:.6g},{fy:.6g},{cx:.6g},{cy:.6g}"
        + source.get(result["intrinsics_from"], ""),
    ]
    if "focal" in result:
        lines.append(_focal_line(result["focal"]))
    lines.append(
        f"normal        {_plane_line(result['plane'])}, {result['model']}, {result['estimator']}"
    )
    for index, found in enumerate(result.get("planes", [])):
        x, y = found["center_xy"]
        place = f"{found['num_pixels']:,} px about {x:.0f},{y:.0f}"
        lines.append(f"plane {index + 1:<8}{_plane_line(found)}, {place}")
    lines.append("phase residual of the best single normal, deg: RMSE, median")
    for model, residual in result["residuals"].items():
        lines.append(f"  {model:<12}{residual['rmse_deg']:6.2f} {residual['median_deg']:6.2f}")
    return "\n".join(lines)


def _plane_line(plane: dict[str, Any]) -> str:
    x, y, z = plane["normal"]
    if not plane["valid"]:
        return f"not determined (rows of rank 1), within the plane of incidence of {x:.3f} {y:.3f}"
    return (
        f"{x:.4f} {y:.4f} {z:.4f}, sigma {plane['sigma_deg']:.2f} deg, conditioning "
        f"{plane['conditioning']:.3f}, outliers {100 * plane['outlier_share']:.1f} %"
    )


def _focal_line(focal: dict[str, Any]) -> str:
    if not focal["observable"]:
        return "focal length  not observable here: all fit alike"
    return f"focal length  {focal['focal_px']:.0f} +- {focal['sigma_px']:.0f} px (tilted model)"
