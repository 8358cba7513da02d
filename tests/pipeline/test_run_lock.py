"""One run at a time, and nothing is taken for half done that no run made."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import content_of

from polmvs.cli.terminal import Terminal, TerminalOptions
from polmvs.errors import DataError
from polmvs.io.temporary import PREFIX, TOKEN, temporary_path
from polmvs.pipeline.run_folder import RunFolder, scratch
from polmvs.pipeline.run_lock import LOCK_FILE, left_over_names, locked

HOLDER = """
import sys
from pathlib import Path
from polmvs.io.temporary import temporary_path
from polmvs.pipeline.run_lock import locked

out = Path(sys.argv[1])
with locked(out):
    (out / "tracks").mkdir()
    (temporary_path(out / "sparse") / "work").mkdir(parents=True)
    for name in ("run.json", "tracks/seeds.npy"):
        temporary_path(out / name).write_text("half")
    (out / "mine.txt").write_text("whole")
    print(flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path: Path):
    """A process that is at work in the folder ``out``."""
    arguments = [sys.executable, "-c", HOLDER, str(tmp_path / "out")]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(arguments, **pipes) as process:
        assert process.stdout is not None
        assert process.stdout.readline()
        yield process
        process.kill()


def test_a_second_run_is_refused_and_changes_nothing(holder, tmp_path: Path) -> None:
    before = content_of(tmp_path)
    message = rf"out: another run is at work in it \(process {holder.pid}\)\. Wait for its end"
    with pytest.raises(DataError, match=message), locked(tmp_path / "out"):
        pass
    assert content_of(tmp_path) == before


def test_a_killed_run_leaves_the_folder_free_and_is_cleared_away(holder, tmp_path: Path) -> None:
    out = tmp_path / "out"
    mine = [
        *(".something.tmp", ".env.tmpl", ".photos.tmp", f"{PREFIX}0123456789abcdef-1-0-sparse"),
        f"{PREFIX}mine",
    ]
    token = (out / LOCK_FILE).read_text().split()[0]
    # A list of tokens may be forged: it names nothing that this program does not make.
    mine += [f"{PREFIX}{token}-{rest}" for rest in ("notes", "1-0-notes.txt", "1-x-sparse", "1-0-")]
    for name in mine:
        (out / name).mkdir()
        (out / name / "photo.png").write_text("mine")
        (out / "tracks" / name).write_text("mine")
    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    left = {path.name for path in out.iterdir()} - left_over_names(out)
    assert left == {"tracks", "mine.txt", *mine}
    with locked(out):
        assert len(list(out.rglob(f"{PREFIX}*-seeds.npy"))) == 0
    expected = {"mine.txt", *(f"{name}/photo.png" for name in mine)}
    assert set(content_of(out)) == expected | {f"tracks/{name}" for name in mine}


def test_no_lock_stays_behind_whatever_happens(tmp_path: Path) -> None:
    for error in (None, KeyError, KeyboardInterrupt):
        try:
            with locked(tmp_path / "out"), scratch(tmp_path / "out" / "maps") as folder:
                assert LOCK_FILE in left_over_names(tmp_path / "out")
                (folder / "a").touch()
                with pytest.raises(DataError, match="another run"), locked(tmp_path / "out"):
                    pass  # in one process, too
                if error is not None:
                    raise error
        except (KeyError, KeyboardInterrupt):
            pass
        assert list(tmp_path.iterdir()) == []  # not the folder, in which nothing came to be


def test_a_cut_list_names_what_it_can(tmp_path: Path) -> None:
    """Killed while it wrote: the last line is not whole, or an older one shows behind it."""
    token = "0123456789abcdef"
    (tmp_path / f"{PREFIX}{token}-1-0-maps").mkdir()
    (tmp_path / LOCK_FILE).write_text(f"{token} 12\nfedcba98")
    with locked(tmp_path):
        assert (tmp_path / LOCK_FILE).read_text() == f"{TOKEN} {os.getpid()}\n{token} 12\n"
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_removed_stays_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a folder that someone holds open elsewhere: the next run tries again."""
    token = "0123456789abcdef"
    (tmp_path / f"{PREFIX}{token}-1-0-maps").mkdir()
    (tmp_path / LOCK_FILE).write_text(f"{token} 12\n")
    with monkeypatch.context() as patched:
        patched.setattr("polmvs.pipeline.run_lock.remove_temporary", lambda path: None)
        with locked(tmp_path):
            pass
    assert token in (tmp_path / LOCK_FILE).read_text()
    with locked(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [b"mine", b"\xff\xfe", b"\n"])
def test_a_file_of_that_name_that_no_run_wrote_is_kept(tmp_path: Path, content: bytes) -> None:
    (tmp_path / LOCK_FILE).write_bytes(content)
    with pytest.raises(DataError, match=r"lock: was not written by polmvs"), locked(tmp_path):
        pass
    assert (tmp_path / LOCK_FILE).read_bytes() == content


def test_links_are_not_followed(tmp_path: Path) -> None:
    """Neither that of the lock, nor that of the log, nor a folder in which results lie."""
    out, other = tmp_path / "out", tmp_path / "mine.txt"
    out.mkdir()
    other.write_text("mine")
    for name in (LOCK_FILE, "polmvs.log"):
        (out / name).symlink_to(other)
    with pytest.raises(DataError, match="cannot be written"), locked(out):
        pass
    with Terminal(TerminalOptions()) as terminal, pytest.raises(DataError, match=r"polmvs\.log"):
        terminal.opened(RunFolder(out))
    assert other.read_text() == "mine"
    (out / LOCK_FILE).unlink()
    (tmp_path / "tracks").mkdir()
    (out / "tracks").symlink_to(tmp_path / "tracks")
    temporary = temporary_path(tmp_path / "tracks" / "seeds.npy")
    temporary.touch()
    with locked(out):
        pass
    assert temporary.exists()


def test_long_names_have_short_temporary_names(tmp_path: Path) -> None:
    with scratch(tmp_path / (255 * "x")) as folder:
        assert len(folder.name) < 100
