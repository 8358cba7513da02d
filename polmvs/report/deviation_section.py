"""The report's comparison of the part with its reference."""

from __future__ import annotations

import base64
import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from polmvs.errors import PolmvsError
from polmvs.evaluation.deviation import DeviationFigures
from polmvs.evaluation.tables import number
from polmvs.io.clouds import Cloud, read_cloud
from polmvs.io.images import read_bytes
from polmvs.io.plain_files import read_text
from polmvs.io.typed_json import from_json, parse_json
from polmvs.pipeline.checks import digest_of
from polmvs.pipeline.run_folder import RunFolder
from polmvs.polarization.kinds import AngleModel
from polmvs.report.deviation_files import COLORS, color_limit
from polmvs.report.layers import Layer, PointColoring
from polmvs.report.page import DeviationSection, Table

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class FoundDeviation:
    """Results of ``polmvs deviation --report`` in the run folder.

    Attributes
    ----------
    cloud : the compared points, registered to the reference.
    histogram : SVG text.
    picture : encoded.
    is_stale : the run's cloud has changed since.
    """

    figures: DeviationFigures
    cloud: Cloud
    histogram: str
    picture: str
    is_stale: bool


def open_deviation(folder: RunFolder, models: Iterable[AngleModel]) -> FoundDeviation | None:
    """The comparison with a reference, if there is a complete one."""
    made = folder.deviation
    if not made.is_dir():
        return None
    try:
        figures = from_json(DeviationFigures, parse_json(read_text(made / "deviation.json")))
        picture = base64.b64encode(read_bytes(made / "deviation.png")).decode("ascii")
        return FoundDeviation(
            figures=figures,
            cloud=read_cloud(made / "deviation.ply"),
            histogram=read_text(made / "deviation.svg"),
            picture=f"data:image/png;base64,{picture}",
            is_stale=figures.result_digest not in {digest_of(folder.cloud(m)) for m in models},
        )
    except PolmvsError as error:
        said = str(error)
    except (OSError, ValueError) as error:
        said = f"{made / 'deviation.json'}: is no result of 'polmvs deviation' ({error})."
    logger.warning("the report shows no deviation: %s", said)
    return None


def deviation_layer(found: FoundDeviation) -> tuple[Layer, PointColoring]:
    """The compared points in the model's frame, and the colours of their distances."""
    matrix = np.linalg.inv(np.asarray(found.figures.reference_from_result))
    distance = np.asarray(found.cloud.scalars["distance_mm"], np.float64)
    limit = color_limit(found.figures, distance)
    turned = np.asarray(found.cloud.normals) @ matrix[:3, :3].T
    layer = Layer(
        label="deviation from the reference",
        points=found.cloud.points @ matrix[:3, :3].T + matrix[:3, 3],
        normals=turned / np.linalg.norm(turned, axis=1, keepdims=True),
        values={"deviation": distance},
    )
    channel = PointColoring(
        label="deviation from the reference",
        unit="mm",
        low=-limit,
        high=limit,
        colors=COLORS,
        note="Signed distance: blue is inside the reference, red outside.",
    )
    return layer, channel


def deviation_section(found: FoundDeviation | None) -> DeviationSection | None:
    """The comparison with the reference, in words, numbers and pictures."""
    if found is None or found.is_stale:
        return None
    f = found.figures
    name = Path(f.reference).name
    sentence = (
        f"Against {name} the part is {number(f.rms, 1, 3)} mm off in the root mean square, "
        f"{number(abs(f.mean), 1, 3)} mm {'outside' if f.mean >= 0 else 'inside'} in the mean."
    )
    if f.passed is not None and f.share_within is not None:
        verdict = "passes" if f.passed else "fails"
        sentence = (
            f"The part {verdict}: {number(f.share_within, 100, 2)} % of its points are within "
            f"{f.tolerance:g} mm of {name}, {100 * f.least_share:g} % are asked for. " + sentence
        )
    rows = [
        ["compared points", f"{f.num_points:,}"],
        ["mean, mm", f"{f.mean:+.4f}"],
        ["standard deviation, mm", number(f.standard_deviation, 1, 4)],
        ["RMS, mm", number(f.rms, 1, 4)],
        *[[f"percentile {p} %, mm", f"{value:+.3f}"] for p, value in f.percentiles.items()],
        ["uncertainty (1 sigma) of a distance, median, mm", number(f.median_sigma, 1, 4)],
        ["farther off than three of these, %", number(f.significant_share, 100, 1)],
    ]
    if f.share_within is not None:
        rows.append(["within the tolerance, %", number(f.share_within, 100, 2)])
    if f.repeatability is not None:
        rows.append(["repeatability of one run, mm", number(f.repeatability, 1, 4)])
    if f.scale != 1:
        rows.append(["scale that was fitted", f"{f.scale:.6g}"])
    return DeviationSection(
        sentence=sentence,
        passed=f.passed,
        table=Table(header=["", "value"], rows=rows),
        picture=found.picture,
        histogram=found.histogram.replace("#555555", "currentColor"),
    )
