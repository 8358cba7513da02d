"""COLMAP's models, maps and workspaces: the only importer of pycolmap.

When pycolmap is imported, COLMAP's log installs a handler of SIGTERM that prints a native stack
trace. Here pycolmap is imported first and the former handler is restored, in every process.
"""

import signal
import threading

_before = signal.getsignal(signal.SIGTERM)

import pycolmap  # noqa: E402, F401

# The handler is None if it was not installed from Python.
if _before is not None and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, _before)
