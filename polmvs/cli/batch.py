"""``polmvs batch``: many captures, a folder each, and one table."""

from __future__ import annotations

from polmvs.cli.call import Call
from polmvs.cli.commands import BatchArguments, ModelChoice
from polmvs.cli.flags import in_flags
from polmvs.cli.terminal import Terminal
from polmvs.config import RunOptions
from polmvs.pipeline.batch import (
    TABLE_FILE,
    BatchRow,
    State,
    batch_table,
    read_batch,
    run_batch,
)

FAILED_STATUS, EMPTY_STATUS = 1, 3


def batch(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs batch``."""
    arguments = call.get(BatchArguments)
    model = call.get(ModelChoice).angle_model
    entries = read_batch(arguments.list_file, call.options(), model)
    with terminal.stage("captures", len(entries)) as progress:

        def show(row: BatchRow) -> None:
            progress(1)
            found = row.message or f"{row.num_points:,} points"
            terminal.say(in_flags(f"{row.name:<20} {row.seconds:7.1f} s  {row.state}: {found}"))

        rows = run_batch(entries, arguments.out, call.get(RunOptions), show)
    states = [row.state for row in rows]
    text = f"{in_flags(batch_table(rows))}\n{arguments.out / TABLE_FILE}: " + ", ".join(
        f"{states.count(state)} {state}" for state in State if state in states
    )
    terminal.show(text, {"out": arguments.out, "captures": rows})
    if State.FAILED in states:
        return FAILED_STATUS
    return EMPTY_STATUS if State.EMPTY in states else 0
