"""``polmvs plane``: normals of planes in one raw image, and which model fits it."""

from __future__ import annotations

from polmvs.cli.call import Call
from polmvs.cli.commands import PlaneArguments
from polmvs.cli.terminal import Terminal
from polmvs.config import CaptureOptions, PlaneOptions
from polmvs.normals.single_view.measurement import (
    IntrinsicsSource,
    PlaneFigures,
    PlaneMeasurement,
    measure_planes,
)

_SOURCES = {
    IntrinsicsSource.OPTIONS: "",
    IntrinsicsSource.ASSUMED: " (assumed: give --intrinsics)",
    IntrinsicsSource.ESTIMATED: " (estimated)",
}


def plane(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs plane``."""
    image = call.get(PlaneArguments).image
    options, capture = call.get(PlaneOptions), call.get(CaptureOptions)
    measured = measure_planes(image, options, capture)
    terminal.show(_text(measured), measured.content())
    return 0


def _text(measured: PlaneMeasurement) -> str:
    """The figures for people."""
    fx, fy, cx, cy = measured.intrinsics
    lines = [
        f"{measured.image}: {measured.width}x{measured.height} px, "
        f"{measured.plane.num_pixels:,} pixels with a DoLP above {measured.min_dolp:g}",
        f"intrinsics    {fx:.6g},{fy:.6g},{cx:.6g},{cy:.6g}{_SOURCES[measured.intrinsics_from]}",
    ]
    if measured.focal is not None:
        focal = measured.focal
        lines.append(
            f"focal length  {focal.focal_px:.0f} +- {focal.sigma_px:.0f} px (tilted model)"
            if focal.observable
            else "focal length  not observable here: all fit alike"
        )
    solved = f"{measured.angle_model}, {measured.estimator}"
    lines.append(f"normal        {_plane_line(measured.plane)}, {solved}")
    for index, found in enumerate(measured.planes or (), 1):
        assert found.center_xy is not None
        x, y = found.center_xy
        place = f"{found.num_pixels:,} px about {x:.0f},{y:.0f}"
        lines.append(f"plane {index:<8}{_plane_line(found)}, {place}")
    lines.append("phase residual of the best single normal, deg: RMSE, median")
    for model, residual in measured.residuals.items():
        lines.append(f"  {model:<12}{residual.rmse_deg:6.2f} {residual.median_deg:6.2f}")
    return "\n".join(lines)


def _plane_line(found: PlaneFigures) -> str:
    x, y, z = found.normal
    if not found.valid:
        return f"not determined (rows of rank 1), within the plane of incidence of {x:.3f} {y:.3f}"
    return (
        f"{x:.4f} {y:.4f} {z:.4f}, sigma {found.sigma_deg:.2f} deg, conditioning "
        f"{found.conditioning:.3f}, outliers {100 * found.outlier_share:.1f} %"
    )
