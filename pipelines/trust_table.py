"""Do results know whether they are right? Verdicts of finished runs beside their true errors.

    python pipelines/trust_table.py RUN [RUN ...] [--write FILE]

RUN is a folder that ``polmvs compare`` wrote with ``--gt``; it is judged as ``polmvs reconstruct``
judges its own result. A run is *right* whose normals are known to 2 deg in the median and whose
F-score at 2 mm is 90 % or more, *wrong* whose normals are 4 deg off or whose F-score is below 70 %,
and else in between. A right one that is not trusted is a false alarm, a wrong one that is trusted a
miss.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path

from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.running import script
from polmvs.cli.terminal import Terminal
from polmvs.config import OptionGroup, option
from polmvs.errors import DataError
from polmvs.evaluation.comparison import read_comparison
from polmvs.evaluation.metrics import CloudMetrics
from polmvs.evaluation.tables import format_table
from polmvs.io.images import write_bytes
from polmvs.pipeline.jobs import judge
from polmvs.pipeline.run_folder import RunFolder
from polmvs.polarization.kinds import AngleModel

MODEL = AngleModel.PPA
RIGHT_DEG, WRONG_DEG = 2.0, 4.0
RIGHT_SCORE, WRONG_SCORE = 0.9, 0.7
SCORE_AT_M = 0.002
HEADER = (
    *("run", "normals, median deg", "F 2 mm, %", "it is", "predicted phases, deg"),
    *("silhouettes, %", "unexplained, %", "trusted", "verdict"),
)


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    runs: tuple[Path, ...] = option(
        MISSING, "folders of finished runs with truth", positional=True, metavar="RUN"
    )
    write: Path | None = option(None, "Markdown file of the table")


def state_of(cloud: CloudMetrics) -> str:
    """Right, wrong or between, by the truth."""
    score = dict(zip(cloud.thresholds_m, cloud.f_score, strict=True))[SCORE_AT_M]
    if not cloud.normal_median_deg < WRONG_DEG or score < WRONG_SCORE:
        return "wrong"
    return "right" if cloud.normal_median_deg <= RIGHT_DEG and score >= RIGHT_SCORE else "between"


def _row(folder: Path) -> tuple[str, ...]:
    run_folder = RunFolder(folder)
    truth = read_comparison(run_folder.metrics).models[MODEL].truth
    if truth is None:
        raise DataError(run_folder.metrics, "holds no figures against a truth; give `--gt`.")
    trust, cloud = judge(run_folder, MODEL), truth.cloud
    predicted = trust.predicted
    return (
        folder.parent.name if folder.name == "run" else folder.name,
        f"{cloud.normal_median_deg:.2f}",
        f"{100 * cloud.f_score[cloud.thresholds_m.index(SCORE_AT_M)]:.1f}",
        state_of(cloud),
        "" if predicted is None else f"{predicted.error_deg:.1f}",
        "" if predicted is None else f"{100 * predicted.overlap:.1f}",
        "" if trust.fitted is None else f"{100 * trust.fitted.unexplained:.1f}",
        "yes" if trust.is_trusted else "no",
        " ".join(trust.verdict.replace("|", "/").split()),
    )


def counts(rows: Sequence[Sequence[str]]) -> str:
    """False alarms and misses in a sentence."""
    found = Counter((row[3], row[7]) for row in rows)
    right = found["right", "yes"] + found["right", "no"]
    wrong = found["wrong", "yes"] + found["wrong", "no"]
    between = len(rows) - right - wrong
    return (
        f"{found['right', 'no']} false alarms of {right} right results, {found['wrong', 'yes']} "
        f"misses of {wrong} wrong ones; {found['between', 'yes']} of {between} in between are "
        "trusted."
    )


def _measure(call: Call, terminal: Terminal) -> int:
    arguments = call.get(Arguments)
    rows: list[tuple[str, ...]] = []
    with terminal.stage("runs", len(arguments.runs)) as on_progress:
        for folder in arguments.runs:
            rows.append(_row(folder))
            on_progress(1)
    text = f"{format_table(HEADER, rows)}\n\n{counts(rows)}"
    if arguments.write is not None:
        write_bytes(arguments.write, (text + "\n").encode())
    terminal.show(text, rows)
    return 0


main = script(__file__, __doc__, _measure, (Arguments, TerminalOptions))

if __name__ == "__main__":
    raise SystemExit(main())
