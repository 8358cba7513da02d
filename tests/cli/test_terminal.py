"""Stage lines, warnings and the log of one call."""

import json
import logging
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from polmvs.cli.call import TerminalOptions
from polmvs.cli.terminal import Terminal
from polmvs.errors import DataError

logger = logging.getLogger("polmvs.somewhere")


@dataclass(frozen=True)
class Folder:
    """What the terminal needs of a run folder."""

    log: Path


def run(options: TerminalOptions) -> Terminal:
    with Terminal(options) as terminal:
        with terminal.stage("maps", 10) as progress:
            for _ in range(10):
                progress(1)
            logger.info("a detail")
            logger.warning("3 views are dark; give `capture.gamma`")
        terminal.finished("maps", 3.25, "10 of 10 views")
        logger.warning("3 views are dark; give `capture.gamma`")
        terminal.skipped("mesh_ppa")
        terminal.show("done", {"num_views": 10})
    return terminal


def test_a_line_for_each_stage_and_warnings_repeated_at_the_end(capsys) -> None:
    terminal = run(TerminalOptions())
    out, err = capsys.readouterr()
    assert out == "done\n"
    assert err.splitlines() == [
        "warning: 3 views are dark; give --gamma",
        "maps                     3.2 s  10 of 10 views",
        "1 warning:",
        "  3 views are dark; give --gamma",
    ]
    assert terminal.warnings == ["3 views are dark; give --gamma"]
    assert not logging.getLogger("polmvs").handlers


def test_a_warning_after_the_last_line_is_not_repeated(capsys) -> None:
    with Terminal(TerminalOptions()) as terminal:
        terminal.finished("maps", 1.0, "")
        logger.warning("late")
    assert capsys.readouterr().err.splitlines() == [
        "maps                     1.0 s",
        "warning: late",
    ]


def test_verbose_shows_details(capsys) -> None:
    run(TerminalOptions(verbose=True))
    lines = capsys.readouterr().err.splitlines()
    assert "a detail" in lines
    assert "mesh_ppa             finished earlier" in lines


def test_quiet_shows_the_result_only(capsys) -> None:
    run(TerminalOptions(quiet=True))
    assert capsys.readouterr() == ("done\n", "")


def test_json_is_all_there_is(capsys) -> None:
    terminal = run(TerminalOptions(json=True))
    out, err = capsys.readouterr()
    assert (json.loads(out), err) == ({"num_views": 10}, "")
    assert [line.stage for line in terminal.stages] == ["maps"]


def test_the_log_file_has_everything(tmp_path, capsys) -> None:
    with Terminal(TerminalOptions()) as terminal:
        terminal.opened(Folder(tmp_path / "polmvs.log"))
        logger.info("a detail")
        logger.error("traceback", extra={"file_only": True})
    assert capsys.readouterr().err == ""
    text = (tmp_path / "polmvs.log").read_text()
    assert "INFO polmvs.somewhere: a detail" in text
    assert "traceback" in text


def test_a_log_that_cannot_be_written(tmp_path) -> None:
    with (
        Terminal(TerminalOptions()) as terminal,
        pytest.raises(DataError, match=r"polmvs\.log: cannot be written"),
    ):
        terminal.opened(Folder(tmp_path / "none" / "polmvs.log"))


BAR = """
import pty, sys, os
def child():
    from polmvs.cli.call import TerminalOptions
    from polmvs.cli.terminal import Terminal
    import logging, time
    with Terminal(TerminalOptions()) as terminal:
        with terminal.stage("densify_ppa", 4) as progress:
            for _ in range(4):
                progress(1)
                time.sleep(0.15)
            logging.getLogger("polmvs").warning("look")
        terminal.finished("densify_ppa", 1.0, "12 points")
pid, fd = pty.fork()
if pid == 0:
    child()
    os._exit(0)
data = b""
while True:
    try:
        part = os.read(fd, 4096)
    except OSError:
        break
    if not part:
        break
    data += part
os.waitpid(pid, 0)
sys.stdout.buffer.write(data)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals")
def test_a_terminal_gets_a_bar_with_name_and_count() -> None:
    done = subprocess.run([sys.executable, "-c", BAR], capture_output=True, check=True)
    text = done.stdout.decode()
    assert "densify_ppa" in text
    assert "4/4" in text
    assert "warning: look" in text
    assert "12 points" in text


def test_what_goes_wrong_after_an_interrupt_is_the_interrupt(monkeypatch, capsys):
    """Libraries that it reaches make errors of their own of it."""
    from polmvs.cli import running
    from polmvs.cli.exit_status import interrupts

    class Silent:
        log = None

        def close(self) -> None:
            pass

    def command() -> int:
        raise RuntimeError("a callback failed")

    shown: list[str] = []
    monkeypatch.setattr(running, "_complain", lambda terminal, prog, text: shown.append(text))
    assert running.guarded(command, Silent(), "polmvs") == 1
    monkeypatch.setitem(vars(running), "interrupts", [15])
    assert interrupts == []
    assert running.guarded(command, Silent(), "polmvs") == 130
    assert shown[-1] == "interrupted"
