"""A process with COLMAP in it that is told to end says nothing."""

import os
import signal
import subprocess
import sys

import pytest

POSIX = os.name == "posix"

ALONE = "import polmvs.colmap.models, os, signal; os.kill(os.getpid(), signal.SIGTERM)"
# The whole group is told, as by a service manager: the workers too, in the midst of a task.
WITH_WORKERS = """
import os, signal, sys, time
from polmvs.colmap.models import read_model
from polmvs.parallel import Workers

if __name__ == "__main__":
    os.setpgrp()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(-signal.SIGTERM % 256))
    with Workers(2) as workers:
        tasks = workers.outcomes(read_model, ["nowhere", "nowhere"])
        for task in tasks:  # COLMAP is imported in each
            try:
                task()
            except Exception:
                pass
        tasks = workers.outcomes(time.sleep, [60, 60])
        time.sleep(0.5)
        os.killpg(0, signal.SIGTERM)
        next(tasks)()
"""
# Workers that are stopped while COLMAP is imported, and its handler not yet replaced.
WHILE_IMPORTED = """
import pathlib, signal, sys, time
from polmvs.parallel import Workers

def import_colmap(at_it):
    import pycolmap

    at_it.touch()
    time.sleep(60)

if __name__ == "__main__":
    files = [pathlib.Path(f"{__file__}.{i}") for i in range(2)]
    with Workers(2) as workers:
        workers.outcomes(import_colmap, files)
        while not all(path.exists() for path in files):
            time.sleep(0.01)
        sys.exit(-signal.SIGTERM % 256)
"""


@pytest.mark.skipif(not POSIX, reason="there is no SIGTERM to speak of")
@pytest.mark.parametrize("script", [ALONE, WITH_WORKERS, WHILE_IMPORTED])
def test_a_process_that_is_told_to_end_prints_no_stack(tmp_path, script: str) -> None:
    path = tmp_path / "script.py"
    path.write_text(script)
    done = subprocess.run([sys.executable, path], capture_output=True, text=True, timeout=120)
    assert done.returncode % 256 == -signal.SIGTERM % 256
    assert done.stderr == ""
