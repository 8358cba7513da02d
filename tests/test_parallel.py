"""Workers end with their parent, however it ends."""

import os
import signal
import subprocess
import sys

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
