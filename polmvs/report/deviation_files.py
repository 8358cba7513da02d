"""Files of a deviation: a coloured cloud, a picture with its scale, a histogram, statistics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polmvs.evaluation.deviation import Deviation, DeviationFigures
from polmvs.io.clouds import Cloud, write_cloud
from polmvs.io.images import write_bytes, write_png
from polmvs.io.typed_json import write_json
from polmvs.report.pictures import palette
from polmvs.report.plots import deviation_histogram
from polmvs.report.rendering import Viewpoint, contact_sheet

COLORS = "coolwarm"  # blue: inside, grey: on it, red: outside
VIEWPOINTS = tuple(Viewpoint(elevation_deg=35.0, azimuth_deg=turn) for turn in (40.0, 220.0))
BAR_PX = 18


def write_deviation(folder: Path, found: Deviation) -> None:
    """Write ``deviation.ply``, ``.png``, ``.svg`` and ``.json`` into an existing folder."""
    limit_mm = color_limit(found.figures, found.distance)
    colors = deviation_colors(found.distance, limit_mm)
    cloud = Cloud(
        points=found.points,
        normals=found.normals,
        colors=colors,
        scalars={"distance_mm": found.distance, "sigma_mm": found.sigma},
    )
    names = [folder / f"deviation.{suffix}" for suffix in ("ply", "png", "svg", "json")]
    write_cloud(names[0], cloud)
    sheet = contact_sheet([cloud], VIEWPOINTS)
    write_png(names[1], np.vstack([sheet, _bar(sheet.shape[1], limit_mm)])[..., ::-1])
    svg = deviation_histogram(found.distance, found.figures.tolerance, limit_mm)
    write_bytes(names[2], svg.encode())
    write_json(names[3], found.figures)


def color_limit(figures: DeviationFigures, distance: NDArray[np.floating]) -> float:
    """The distance of the strongest colours, mm: the tolerance, else the 99th percentile."""
    if figures.tolerance is not None:
        return figures.tolerance
    return max(float(np.percentile(np.abs(distance), 99)), 1e-9)


def deviation_colors(distance: NDArray[np.floating], limit_mm: float) -> NDArray[np.uint8]:
    """Colours (N, 3) of distances: blue inside, red outside, grey on the reference."""
    share = np.clip(0.5 + 0.5 * distance / limit_mm, 0, 1)
    return np.asarray(palette(COLORS)[np.rint(255 * share).astype(np.intp)], np.uint8)


def _bar(width: int, limit_mm: float) -> NDArray[np.uint8]:
    """The scale under the picture."""
    import cv2

    bar = np.full((3 * BAR_PX, width, 3), 255, np.uint8)
    across = np.linspace(-limit_mm, limit_mm, width - 2 * BAR_PX)
    bar[:BAR_PX, BAR_PX:-BAR_PX] = deviation_colors(across, limit_mm)
    for text, share in ((f"-{limit_mm:.3g} mm", 0.0), ("0", 0.5), (f"+{limit_mm:.3g} mm", 1.0)):
        (size, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)
        left = int(np.clip(share * width - size / 2, 2, width - size - 2))
        cv2.putText(
            bar, text, (left, 2 * BAR_PX), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA
        )
    return bar
