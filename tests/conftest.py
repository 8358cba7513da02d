"""The bundled capture, one finished run of it, and the command line as a function."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

# Before numpy is imported, here and in what tests start: with a process for each core, threads of
# linear algebra wait for each other and take twice the time.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest

import polmvs
from polmvs.cli import main

DEMO = Path(polmvs.__file__).parent / "demo_capture"

# Status, stdout and stderr of one call of the command.
Cli = Callable[..., tuple[int, str, str]]


def pytest_configure(config: pytest.Config) -> None:
    # Of pytest-xdist, which would begin with the largest files: the order is that below.
    config.option.loadscopereorder = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order files so that no process waits for the demo's run.

    One process makes it, with the first file that needs it, while the others run all tests without.
    """
    users = {item.path for item in items if "demo_run" in getattr(item, "fixturenames", ())}
    first = next((item.path for item in items if item.path in users), None)
    items.sort(key=lambda item: 0 if item.path == first else 1 + (item.path in users))


@pytest.fixture(scope="session")
def demo_capture() -> Path:
    return DEMO


@pytest.fixture(scope="session")
def demo_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of ``polmvs demo``; tests that change it take a copy.

    Of several processes of pytest-xdist one makes it, and each has a copy. So do several runs of
    the tests that have the same path in the environment variable ``POLMVS_TEST_DEMO``.
    """
    out = tmp_path_factory.mktemp("demo") / "out"
    given = os.environ.get("POLMVS_TEST_DEMO")
    if given is None and "PYTEST_XDIST_WORKER" not in os.environ:
        make_demo_run(out)
        return out
    import fcntl

    shared = Path(given) if given else tmp_path_factory.getbasetemp().parent / "demo"
    with shared.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not shared.with_suffix(".done").exists():
            make_demo_run(shared)
            shared.with_suffix(".done").touch()
    return Path(shutil.copytree(shared, out))


def make_demo_run(out: Path) -> None:
    assert main(["demo", str(out), "--workers", "2"]) == 0


@pytest.fixture
def cli(capfd: pytest.CaptureFixture[str]) -> Cli:
    def call(*arguments: object) -> tuple[int, str, str]:
        capfd.readouterr()
        status = main([str(argument) for argument in arguments])
        captured = capfd.readouterr()
        return status, captured.out, captured.err

    return call
