"""Import of Open3D; a missing system library is found, or the message names the remedy."""

from __future__ import annotations

import ctypes
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

from polmvs.errors import PolmvsError

# Packages of Debian and Ubuntu that hold the libraries of the system which Open3D's wheels need.
SYSTEM_PACKAGES = {
    "libusb-1.0": "libusb-1.0-0",
    "libX11": "libx11-6",
    "libxcb": "libxcb1",
    "libGL": "libgl1",
    "libEGL": "libegl1",
    "libgomp": "libgomp1",
    "libudev": "libudev1",
    "libidn2": "libidn2-0",
}


def import_open3d() -> Any:
    """Open3D, imported when it is needed, which takes seconds.

    Raises
    ------
    PolmvsError
        It cannot be imported; the message says what to install.
    """
    if "open3d" not in sys.modules:
        find_libusb()
    try:
        with _without_ml():
            import open3d
    except (ImportError, OSError) as error:  # OSError: it loads its library by ctypes
        raise PolmvsError(f"Open3D cannot be imported ({error}); {remedy(str(error))}.") from error
    return open3d


@contextmanager
def _without_ml() -> Iterator[None]:
    """Import Open3D without its data sets for machine learning, which take half of the time.

    They bring scikit-learn and pandas. A later ``import open3d.ml`` finds them.
    """
    name = "open3d.ml"
    if "open3d" in sys.modules:
        yield
        return
    sys.modules[name] = ModuleType(name)
    try:
        yield
    finally:
        del sys.modules[name]


def remedy(reason: str) -> str:
    """Remedy for an import that failed for this reason, a clause without its end."""
    found = re.search(r"(lib[\w+.-]+?)\.so", reason)
    if found is None:
        return "run 'pip install open3d' again"
    package = SYSTEM_PACKAGES.get(found[1])
    if package is None:
        return f"install the system library {found[1]}"
    return f"install the system library {found[1]} (Debian, Ubuntu: apt install {package})"


def find_libusb() -> None:
    """Load libusb from its wheel if the system has none.

    Open3D 0.20, the only version for Python 3.13, is linked against it for depth cameras. The
    linker reuses a loaded library of the same name.
    """
    try:
        ctypes.CDLL("libusb-1.0.so.0")
    except OSError:
        pass
    else:
        return
    try:
        from libusb_package import get_library_path
    except ImportError:  # it is required where Open3D needs it
        return
    ctypes.CDLL(str(get_library_path()), mode=ctypes.RTLD_GLOBAL)
