"""Workers end with their parent, however it ends; what is lost with one is done again."""

import os
import signal
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool

import pytest

from polmvs.parallel import Workers

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
