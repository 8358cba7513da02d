"""Functions in processes of their own: results, messages, logs, errors, crashes and interrupts."""

import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from polmvs.errors import DataError
from polmvs.separate import CrashError, run_separately


def answer(number, on_message):
    on_message("begins")
    print("a library speaks")
    logging.getLogger("polmvs.library").warning("take %s", "care")
    return {"answer": number + 1}


def fail(path, on_message):
    raise DataError(path, "is bad.")


def crash(on_message):
    sys.stderr.write("disk I/O error")
    sys.stderr.flush()
    os.abort()


def crash_farther_down(on_message):
    run_separately(crash)


def test_what_a_function_returns_says_and_raises(caplog, tmp_path: Path) -> None:
    said: list[str] = []
    with caplog.at_level(logging.INFO, "polmvs"):
        assert run_separately(answer, 41, on_message=said.append) == {"answer": 42}
    assert said == ["begins"]
    assert [(r.name, r.getMessage()) for r in caplog.records] == [("polmvs.library", "take care")]
    with pytest.raises(DataError, match="a: is bad") as found:
        run_separately(fail, "a", on_message=said.append)
    assert found.value.path == "a"


def test_a_crash_is_an_error(caplog) -> None:
    with pytest.raises(CrashError, match="a library crashed \\(signal 6\\)") as found:
        run_separately(crash, on_message=print)
    assert found.value.said.startswith("disk I/O error")
    assert "disk I/O error" in caplog.text


def test_a_crash_of_a_process_of_the_process_is_the_same_error() -> None:
    with pytest.raises(CrashError, match="a library crashed \\(signal 6\\)") as found:
        run_separately(crash_farther_down)
    assert found.value.status == -6
    assert found.value.said.startswith("disk I/O error")


WAITING = """
import signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from helpers import wait_for_the_end
from polmvs.separate import run_separately
for number in (signal.SIGINT, signal.SIGTERM):  # a shell's background ignores the first
    signal.signal(number, signal.default_int_handler)
try:
    run_separately(wait_for_the_end, Path(sys.argv[2]), on_message=print)
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_the_process_ends_with_its_parent(tmp_path: Path, number: int) -> None:
    place = tmp_path / "pid"
    arguments = [sys.executable, "-c", WAITING, str(Path(__file__).parent), str(place)]
    with subprocess.Popen(arguments, stderr=subprocess.PIPE) as parent:
        while not place.exists() or not place.read_text():
            time.sleep(0.05)
        parent.send_signal(number)
        _, err = parent.communicate(timeout=60)
        assert err == b""
        assert parent.returncode == (-9 if number == signal.SIGKILL else 130)
    child = int(place.read_text())
    for _ in range(100):
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    pytest.fail("the process lives on")
