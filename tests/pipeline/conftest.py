"""The command line as the tests of the jobs use it: results and errors, no progress, no page."""

from collections.abc import Callable

import pytest

from polmvs.cli import main

WITH_REPORT = ("demo", "reconstruct", "compare")


@pytest.fixture
def cli(capfd: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """One call of the command: its status, stdout and stderr."""

    def call(*arguments: object) -> tuple[int, str, str]:
        capfd.readouterr()
        quiet = ["--no-report"] if arguments[0] in WITH_REPORT else []
        if "--json" not in arguments:
            quiet.append("--quiet")
        status = main([*map(str, arguments), *quiet])
        captured = capfd.readouterr()
        return status, captured.out, captured.err

    return call
