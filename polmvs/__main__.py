"""``python -m polmvs``: the command ``polmvs``."""

import os
import sys

import polmvs

# Python puts the current directory first on its path. It holds data, unless it is this package's.
if (
    not sys.flags.safe_path
    and sys.path[0] == os.getcwd()
    and os.path.dirname(os.path.dirname(os.path.abspath(polmvs.__file__))) != sys.path[0]
):
    del sys.path[0]

from polmvs.cli import entry_point

if __name__ == "__main__":
    entry_point()
