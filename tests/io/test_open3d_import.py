"""What Open3D's wheels lack is found in another wheel, or named with its remedy."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from polmvs.errors import PolmvsError
from polmvs.io import open3d_import
from polmvs.io.open3d_import import import_open3d, remedy


@pytest.fixture
def loaded(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Libraries asked for on a system without libusb."""
    asked: list[tuple[str, int]] = []

    def load(name: str, mode: int = ctypes.DEFAULT_MODE) -> None:
        if name == "libusb-1.0.so.0":
            raise OSError("libusb-1.0.so.0: cannot open shared object file")
        asked.append((name, mode))

    monkeypatch.setattr(open3d_import.ctypes, "CDLL", load)
    return asked


def test_libusb_comes_from_its_wheel_where_the_system_has_none(
    loaded, monkeypatch: pytest.MonkeyPatch
) -> None:
    wheel = SimpleNamespace(get_library_path=lambda: Path("/wheel/libusb-1.0.so"))
    monkeypatch.setitem(sys.modules, "libusb_package", wheel)
    open3d_import.find_libusb()
    assert loaded == [("/wheel/libusb-1.0.so", ctypes.RTLD_GLOBAL)]


def test_without_that_wheel_nothing_is_loaded(loaded, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "libusb_package", None)
    open3d_import.find_libusb()
    assert loaded == []


def test_the_message_names_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)  # Python's way to make an import fail
    with pytest.raises(PolmvsError, match="run 'pip install open3d' again"):
        import_open3d()


@pytest.mark.parametrize(
    ("reason", "package"),
    [
        ("libusb-1.0.so.0: cannot open shared object file", "apt install libusb-1.0-0"),
        ("libGL.so.1: cannot open shared object file", "apt install libgl1"),
        ("libX11.so.6: cannot open shared object file", "apt install libx11-6"),
        ("libfoo++.so.2: cannot open shared object file", "install the system library libfoo++"),
    ],
)
def test_remedies(reason: str, package: str) -> None:
    assert package in remedy(reason)


def test_data_sets_for_learning_wait_until_they_are_asked_for() -> None:
    """They bring pandas and scikit-learn, half of the time of the import."""
    script = (
        "import sys\n"
        "from polmvs.io.open3d_import import import_open3d\n"
        "import_open3d()\n"
        "print('sklearn' in sys.modules, 'open3d.ml' in sys.modules)\n"
        "import open3d.ml\n"
        "print(open3d.ml.datasets.__name__)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["False", "False", "open3d.ml.datasets"]
