"""Runs the command line again and again in forks of one process that has imported everything.

Reads a JSON object a line: ``argv``; ``signal`` to send, or null; ``after`` so many seconds since
the call or, if ``stage`` is named, since that stage began. Answers with ``status``, as of
``subprocess``, ``seconds``, ``stdout``, ``stderr``, and ``orphans``, processes of the call that
were alive when it had ended.
"""

import json
import os
import signal
import sys
import tempfile
import threading
import time

import cv2
import pycolmap

from polmvs.cli import jobs
from polmvs.cli.terminal import Terminal
from polmvs.surface import global_surface

assert cv2, pycolmap
assert jobs, global_surface


def interrupted_at(stage: str, number: int, after: float) -> None:
    """Have this process send itself a signal while a stage is at work."""
    original = Terminal.stage

    def watched(self, name, total):
        if name == stage:
            timer = threading.Timer(after, os.kill, (os.getpid(), number))
            timer.daemon = True
            timer.start()
        return original(self, name, total)

    Terminal.stage = watched


def call(request: dict, out: int, err: int) -> None:
    """The fork: never returns."""
    os.setsid()
    os.dup2(out, 1)
    os.dup2(err, 2)
    sys.argv = ["polmvs", *request["argv"]]
    if request["signal"] is not None and request["stage"] is not None:
        interrupted_at(request["stage"], request["signal"], request["after"])
    status = 1
    try:
        from polmvs.cli import entry_point

        entry_point()
    except SystemExit as error:
        status = error.code
    finally:
        sys.stdout.flush()
        os._exit(status)


def group(leader: int) -> list[int]:
    """Processes of a session that live."""
    found = []
    for name in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{name}/stat") as file:
                fields = file.read().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == leader and fields[0] != "Z":
            found.append(int(name))
    return found


def serve(request: dict) -> dict:
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        start = time.perf_counter()
        child = os.fork()
        if child == 0:
            call(request, out.fileno(), err.fileno())
        if request["signal"] is not None and request["stage"] is None:
            time.sleep(request["after"])
            os.kill(child, request["signal"])
        _, status = os.waitpid(child, 0)
        seconds = time.perf_counter() - start
        # What has lost its parent notices after the native call that it is in: Open3D's keep
        # Python's lock, 0.4 s for the distances of 400,000 points on an idle core.
        until = time.perf_counter() + (2 if status else 0)
        while (orphans := group(child)) and time.perf_counter() < until:
            time.sleep(0.1)
        for path in (out, err):
            path.seek(0)
        return {
            "status": os.waitstatus_to_exitcode(status),
            "seconds": seconds,
            "stdout": out.read(),
            "stderr": err.read(),
            "orphans": orphans,
        }


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for line in sys.stdin:
        print(json.dumps(serve(json.loads(line))), flush=True)
