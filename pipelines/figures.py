"""Figures of a list of captures in one table, beside those of another version.

    python pipelines/figures.py LIST OUT [--before figures.json]

LIST is one of `polmvs batch`: captures with their options; `evaluation.gt` is the ground truth of
those that have some. Each is reconstructed into OUT/NAME and measured. ``OUT/figures.json`` keeps
the rows: given as ``--before`` to a later version, each figure is printed as ``before > now``.
Captures run one after the other, so that times are comparable on an idle machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path

from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.running import script
from polmvs.cli.terminal import Terminal
from polmvs.config import OptionGroup, RunOptions, option
from polmvs.errors import DataError, PolmvsError
from polmvs.evaluation.comparison import evaluate_file
from polmvs.evaluation.tables import NONE, format_table, number
from polmvs.evaluation.trust import Trust
from polmvs.io.images import write_bytes
from polmvs.io.plain_files import read_text
from polmvs.io.typed_json import from_json, parse_json, write_json
from polmvs.pipeline.batch import BatchEntry, read_batch
from polmvs.pipeline.jobs import reconstruct
from polmvs.pipeline.record import POSE_STAGES
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.runner import Job, load_record
from polmvs.pipeline.stages.poses import PosesResult

ROWS, TABLE = "figures.json", "figures.md"


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    captures: Path = option(MISSING, "list of captures", positional=True, metavar="LIST")
    out: Path = option(MISSING, "folder of the runs", positional=True)
    before: Path | None = option(None, "figures.json of another version")


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Figures of one capture; None if not measured.

    Attributes
    ----------
    name : of the capture.
    views : with a pose.
    f_score : at 1 mm, %.
    chamfer_mm : mean distance of cloud and true surface.
    normal_mean_deg, normal_median_deg : error of the cloud's normals.
    is_trusted : the verdict.
    seconds : of all stages but the poses.
    peak_mb : of memory.
    message : why there is no result, else empty.
    """

    name: str
    views: int | None = None
    f_score: float | None = None
    chamfer_mm: float | None = None
    normal_mean_deg: float | None = None
    normal_median_deg: float | None = None
    is_trusted: bool | None = None
    seconds: float | None = None
    peak_mb: float | None = None
    message: str = ""


DIGITS = {
    "views": 0,
    "f_score": 1,
    "chamfer_mm": 2,
    "normal_mean_deg": 2,
    "normal_median_deg": 2,
    "seconds": 1,
    "peak_mb": 0,
}
HEADER = (
    "capture",
    "views",
    "F 1 mm, %",
    "Chamfer, mm",
    "normals, mean deg",
    "median deg",
    "trusted",
    "s but poses",
    "peak MB",
    "",
)


def _run(call: Call, terminal: Terminal) -> int:
    arguments = call.get(Arguments)
    entries = read_batch(arguments.captures, call.options())
    before = {} if arguments.before is None else _read_rows(arguments.before)
    rows: list[Figures] = []
    with terminal.stage("captures", len(entries)) as on_progress:
        for entry in entries:
            rows.append(_figures(entry, arguments.out / entry.name))
            text = figures_table(rows, before)
            write_json(arguments.out / ROWS, rows)
            write_bytes(arguments.out / TABLE, (text + "\n").encode())
            on_progress(1)
    terminal.show(text, rows)
    return 0


def _figures(entry: BatchEntry, out: Path) -> Figures:
    """Reconstruct and measure a capture; a failure is a row."""
    run_options = RunOptions(overwrite=out.exists())
    job = Job(capture=entry.capture, out=out, options=entry.options, run_options=run_options)
    model, folder = entry.angle_model, RunFolder(out)
    try:
        reconstruct(job, model)
    except PolmvsError as error:
        return Figures(name=entry.name, message=" ".join(str(error).split())[:160])
    record = load_record(folder)
    trust, poses = record.find(Trust, model), record.find(PosesResult)
    gt = entry.options.evaluation.gt
    cloud = None
    if gt is not None and folder.cloud(model).is_file():
        cloud = evaluate_file(folder.cloud(model), gt, folder.sparse).cloud
    stages = [stage for stage in record.stages if stage.name not in POSE_STAGES]
    return Figures(
        name=entry.name,
        views=None if poses is None else poses.num_views,
        f_score=None if cloud is None else 100 * cloud.f_score[0],
        chamfer_mm=None if cloud is None else 1e3 * cloud.chamfer_m,
        normal_mean_deg=None if cloud is None else cloud.normal_mean_deg,
        normal_median_deg=None if cloud is None else cloud.normal_median_deg,
        is_trusted=None if trust is None else trust.is_trusted,
        seconds=sum(stage.seconds for stage in stages),
        peak_mb=max(stage.peak_rss_mb for stage in record.stages),
    )


def _read_rows(path: Path) -> dict[str, Figures]:
    try:
        rows = from_json(tuple[Figures, ...], parse_json(read_text(path)))
    except (OSError, ValueError) as error:
        raise DataError(path, f"holds no figures of captures ({error}).") from error
    return {row.name: row for row in rows}


def figures_table(rows: Sequence[Figures], before: Mapping[str, Figures]) -> str:
    """A row for each capture; ``before`` by the captures' names."""
    return format_table(HEADER, [_cells(row, before.get(row.name)) for row in rows])


def _cells(row: Figures, before: Figures | None) -> list[str]:
    now = _texts(row)
    if before is None:
        return now
    pairs = zip(_texts(before), now, strict=True)
    return [new if old == new else f"{old} > {new}" for old, new in pairs]


def _texts(row: Figures) -> list[str]:
    texts = []
    for one in fields(Figures):
        value = getattr(row, one.name)
        if one.name in DIGITS:
            texts.append(number(value, digits=DIGITS[one.name]))
        elif isinstance(value, bool):
            texts.append("yes" if value else "no")
        else:
            texts.append(NONE if value is None else str(value))
    return texts


main = script(__file__, __doc__, _run, (Arguments, TerminalOptions))

if __name__ == "__main__":
    raise SystemExit(main())
