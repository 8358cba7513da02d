"""Reconstruct a capture with one model: the whole chain as one call of the library.

    python pipelines/reconstruct.py CAPTURE OUT [--model opa] [--intrinsics fx,fy,cx,cy] ...

The same as ``polmvs reconstruct``, to copy and change.
"""

from __future__ import annotations

from collections.abc import Sequence

from polmvs.cli.call import Call
from polmvs.cli.commands import EXECUTION, TO_CLOUD, JobArguments, ModelChoice
from polmvs.cli.exit_status import EMPTY_STATUS
from polmvs.cli.flags import Command
from polmvs.cli.jobs import job_of
from polmvs.cli.running import run
from polmvs.cli.terminal import Terminal
from polmvs.config import ExportOptions
from polmvs.pipeline.jobs import reconstruct
from polmvs.pipeline.stages.densify import DensifyResult


def _reconstruct(call: Call, terminal: Terminal) -> int:
    model = call.get(ModelChoice).model
    outcome = reconstruct(job_of(call, terminal), model)
    cloud = outcome.run_folder.cloud(model)
    print(outcome.empty or f"{cloud}: {outcome.record.result(DensifyResult, model)}")
    return 0 if outcome.empty is None else EMPTY_STATUS


COMMAND = Command(
    help_text="reconstruct a capture with one model",
    run=_reconstruct,
    groups=(JobArguments, ModelChoice, *TO_CLOUD, ExportOptions, *EXECUTION),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; the exit status."""
    return run((COMMAND,), "reconstruct.py", argv)


if __name__ == "__main__":
    raise SystemExit(main())
