"""The bundled capture, one finished run of it, and the command line as a function."""

from collections.abc import Callable
from pathlib import Path

import pytest

import polmvs
from polmvs.cli import main

DEMO = Path(polmvs.__file__).parent / "demo_capture"

# Status, stdout and stderr of one call of the command.
Cli = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="session")
def demo_capture() -> Path:
    return DEMO


@pytest.fixture(scope="session")
def demo_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of ``polmvs demo``; tests that change it take a copy."""
    out = tmp_path_factory.mktemp("demo") / "out"
    assert main(["demo", str(out), "--workers", "2"]) == 0
    return out


@pytest.fixture
def cli(capfd: pytest.CaptureFixture[str]) -> Cli:
    def call(*arguments: object) -> tuple[int, str, str]:
        capfd.readouterr()
        status = main([str(argument) for argument in arguments])
        captured = capfd.readouterr()
        return status, captured.out, captured.err

    return call
