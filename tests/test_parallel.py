"""Workers end with their parent, however it ends; what is lost with one is done again."""

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress

import pytest

from polmvs.errors import DataError
from polmvs.parallel import Workers
from polmvs.pipeline.run_folder import scratch

SLEEPERS = """
import os, time
from polmvs.parallel import Workers

def wait(index):
    print(os.getpid(), flush=True)
    time.sleep(60)

if __name__ == "__main__":
    with Workers(2) as workers:
        list(workers.map(wait, range(2)))
"""


def test_workers_of_a_killed_parent_end(tmp_path) -> None:
    script = tmp_path / "sleepers.py"
    script.write_text(SLEEPERS)
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert all(process.stdout.readline() for _ in range(2))
    os.kill(process.pid, signal.SIGKILL)
    # The pipe closes when the last of its holders, the workers, has ended.
    process.communicate(timeout=20)


def die_once(folder, index):
    try:
        (folder / f"{index // 3}").touch(exist_ok=False)
    except FileExistsError:
        return index
    os._exit(9)


def die_or_fail(index):
    if index == 1:
        os._exit(9)
    return 12 // (index - 2)


def test_lost_tasks_are_done_again(tmp_path) -> None:
    with Workers(2) as workers:
        assert list(workers.map(die_once, [tmp_path] * 6, range(6))) == list(range(6))
    assert len(list(tmp_path.iterdir())) == 2


def test_an_error_stops_no_other() -> None:
    with Workers(2) as workers:
        outcomes = list(workers.outcomes(die_or_fail, range(5)))
        assert outcomes[0]() == -6
        with pytest.raises(BrokenProcessPool):
            outcomes[1]()
        with pytest.raises(ZeroDivisionError):
            outcomes[2]()
        assert [outcomes[3](), outcomes[4]()] == [12, 6]


def test_one_worker_is_this_process() -> None:
    asked: list[int] = []
    outcomes = Workers().outcomes(asked.append, range(3))
    next(outcomes)()
    assert asked == [0]
    assert list(Workers().map(pow, [2, 3], [3, 2])) == [8, 9]


def fail_or_write(folder, diary, index):
    if index == 0:
        raise DataError("a", "is bad.")
    (folder / f"begun {index}").touch()
    try:
        time.sleep(1)
    finally:
        with diary.open("a") as file:
            file.write(f"left {index}, folder there: {folder.is_dir()}\n")


def test_a_failing_worker_stops_the_others_before_their_files_go(tmp_path) -> None:
    """What is under way is left before its folder goes, and nothing begins after that."""
    diary = tmp_path / "diary"
    diary.touch()
    with Workers(3) as workers:
        with (
            suppress(DataError),
            scratch(tmp_path / "views") as folder,
            workers.stopped_on_error(),
        ):
            tasks = workers.outcomes(fail_or_write, [folder] * 20, [diary] * 20, range(20))
            first = next(tasks)
            while len(list(folder.iterdir())) < 2:
                time.sleep(0.01)
            first()
        lines = diary.read_text().splitlines()
        assert 1 <= len(lines) < 19
        assert all(line.endswith("folder there: True") for line in lines)
        assert [path.name for path in tmp_path.iterdir()] == ["diary"]
        time.sleep(1.2)
        assert diary.read_text().splitlines() == lines


def fail_or_wait(folder, index):
    """The first fails when the second is at work, which would take a minute."""
    if index == 0:
        while not any(folder.glob(".polmvs-*")):
            time.sleep(0.01)
        raise DataError("a", "is bad.")
    with scratch(folder / "result"):
        for _ in range(600):
            time.sleep(0.1)
    return index


def test_what_is_cancelled_ends_at_once_and_leaves_nothing(tmp_path) -> None:
    start = time.monotonic()
    with pytest.raises(DataError, match="a: is bad"), Workers(2) as workers:
        list(workers.map(fail_or_wait, [tmp_path] * 2, range(2)))
    assert time.monotonic() - start < 30
    assert list(tmp_path.iterdir()) == []


def deaf(folder):
    (folder / "begun").touch()
    for _ in range(600):
        with suppress(BaseException):  # as a callback of a library
            time.sleep(0.1)


def test_a_worker_that_does_not_listen_ends_all_the_same(tmp_path) -> None:
    start = time.monotonic()
    with suppress(KeyboardInterrupt), Workers(2) as workers:
        tasks = workers.outcomes(deaf, [tmp_path] * 2)
        threading.Thread(target=next, args=(tasks,)).start()
        while not (tmp_path / "begun").exists():
            time.sleep(0.01)
        raise KeyboardInterrupt
    assert time.monotonic() - start < 30
