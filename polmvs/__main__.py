"""``python -m polmvs``: the command ``polmvs``."""

from polmvs.cli import entry_point

if __name__ == "__main__":
    entry_point()
