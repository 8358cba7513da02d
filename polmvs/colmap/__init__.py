"""COLMAP's models, maps and workspaces: the only importer of pycolmap.

When pycolmap is imported, COLMAP's log takes SIGTERM, and prints a native stack trace where a
process is told to end. Here it is imported first and the signal given back, in every process.
"""

import signal
import threading

_before = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402, F401

# The handler is None where something that is not Python's had the signal before.
if _before is not None and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, _before)
