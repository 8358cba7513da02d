"""What ``run.json`` holds: the record of a run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from polmvs.config import to_plain
from polmvs.io.images import write_bytes


@dataclass(frozen=True, kw_only=True)
class StageRecord:
    """A finished stage.

    Attributes
    ----------
    name : of the stage.
    seconds : wall time.
    peak_rss_mb : largest memory so far of the run's processes together.
    """

    name: str
    seconds: float
    peak_rss_mb: float


@dataclass(kw_only=True)
class Record:
    """Content of ``run.json``.

    Attributes
    ----------
    command_line : how the run was last called.
    capture : the capture's folder, its size in px, and the size in bytes of each file by name.
    images : names of the files in ``images/``.
    options : resolved options of the last call.
    stage_options : those that each finished stage used.
    versions : of the software.
    stages : finished ones, in order.
    results : what the stages found: numbers of views, points and seeds.
    wall_s : seconds of all calls together.
    finished : whether the command that was asked for has come to its end.
    """

    command_line: list[str] = field(default_factory=list)
    capture: dict[str, Any] = field(default_factory=dict)
    images: list[str] = field(default_factory=list)
    options: dict[str, Any] = field(default_factory=dict)
    stage_options: dict[str, dict[str, Any]] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    stages: list[StageRecord] = field(default_factory=list)
    results: dict[str, Any] = field(default_factory=dict)
    wall_s: float = 0.0
    finished: bool = False

    def is_done(self, *names: str) -> bool:
        """Whether one of some stages is finished."""
        return any(stage.name in names for stage in self.stages)

    def forget(self, names: Sequence[str]) -> None:
        """Drop stages that are to be done again."""
        self.stages = [stage for stage in self.stages if stage.name not in names]
        for name in names:
            self.stage_options.pop(name, None)


def write_json(path: Path, content: Any) -> None:
    """Write JSON whole or not at all; NaN becomes null."""
    text = json.dumps(to_plain(content), indent=1, allow_nan=False)
    write_bytes(path, (text + "\n").encode())
