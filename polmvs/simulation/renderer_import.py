"""Import of Mitsuba: the variant for this machine, and what to install for it.

Mitsuba's vectorized variants are compiled with LLVM, a library of the system. If it is not in the
usual folders, or is too old, the scalar variant is used, which is slower.
"""

from __future__ import annotations

import glob
import logging
import os
import re
import sys
from dataclasses import dataclass
from typing import Any

from polmvs.errors import OptionError
from polmvs.unprinted import unprinted

logger = logging.getLogger(__name__)

INSTALL = "Mitsuba is not installed; install the extra: pip install '.[simulate]'."
HOW_TO_GET_LLVM = (
    "Install it (Debian and Ubuntu: apt install libllvm19; Fedora: dnf install llvm-libs; conda: "
    "libllvm19; macOS: brew install llvm), or name it by the environment variable "
    "DRJIT_LIBLLVM_PATH."
)
# Older ones cannot compile Dr.Jit 1.5's `llvm.maximum` for x86, and end the whole process.
OLDEST_LLVM = 17
UNUSABLE = "Dr.Jit cannot use LLVM's library"
LLVM_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/lib/llvm-*/lib",
    "/usr/local/lib",
    "/opt/homebrew/opt/llvm/lib",
    "/usr/local/opt/llvm/lib",
)


@dataclass(frozen=True)
class Renderer:
    """Mitsuba with its variant set.

    Attributes
    ----------
    mi, dr : the modules ``mitsuba`` and ``drjit``.
    variant : name of the variant.
    """

    mi: Any
    dr: Any
    variant: str

    @property
    def is_scalar(self) -> bool:
        """Whether the variant computes one ray at a time."""
        return self.variant.startswith("scalar")


def import_renderer(*, colour: bool = False, variant: str | None = None) -> Renderer:
    """Mitsuba in the fastest polarized variant that runs here.

    Parameters
    ----------
    colour : spectra instead of one brightness.
    variant : required variant.

    Raises
    ------
    OptionError
        Mitsuba is not installed, or it does not have the variant.
    """
    llvm = find_llvm()
    if llvm is not None:
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", llvm)
    fault = _fault_of(llvm)
    try:
        with unprinted("Dr.Jit"):  # which libraries it cannot load, as is said below
            import drjit
            import mitsuba
    except ImportError as error:
        raise OptionError(INSTALL) from error
    mi: Any = mitsuba
    dr: Any = drjit
    chosen = variant or _best(dr, fault, colour=colour)
    if chosen not in mi.variants():
        raise OptionError(
            f"must be one of {', '.join(v for v in mi.variants() if 'polarized' in v)}, not "
            f"{chosen}.",
            field="rendering.variant",
        )
    _require_backend(dr, chosen, fault)
    mi.set_variant(chosen)
    mi.set_log_level(mi.LogLevel.Error)
    return Renderer(mi, dr, chosen)


def find_llvm() -> str | None:
    """Path of the newest library of LLVM in the usual folders, even if too old; None if none."""
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    if given:
        return given if os.path.exists(given) else None
    folders = (*LLVM_FOLDERS, os.path.join(sys.prefix, "lib"))
    names = ("libLLVM*.so*", "libLLVM*.dylib", "LLVM-C.dll")
    found = [path for folder in folders for name in names for path in glob.glob(f"{folder}/{name}")]
    return max(found, key=_version, default=None)


def _fault_of(llvm: str | None) -> str | None:
    """Reason why LLVM's library is unusable; None if it is usable, as far as its name shows."""
    if llvm is None:
        return "LLVM's library was not found"
    major = _version(llvm)[0]
    if 0 < major < OLDEST_LLVM:
        return f"{llvm} is LLVM {major}, older than {OLDEST_LLVM}"
    return None


def _require_backend(dr: Any, variant: str, fault: str | None) -> None:
    """Refuse a variant whose machine or library is not here.

    Parameters
    ----------
    fault : why LLVM's library does not serve.

    Raises
    ------
    OptionError
        Which that is.
    """
    if variant.startswith("llvm") and (fault or not dr.has_backend(dr.JitBackend.LLVM)):
        reason = fault or UNUSABLE
        raise OptionError(
            f"{variant} needs LLVM, but {reason}. {HOW_TO_GET_LLVM}", field="rendering.variant"
        )
    if variant.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise OptionError(f"{variant} needs a GPU of NVIDIA.", field="rendering.variant")


def _version(path: str) -> tuple[int, ...]:
    """Numbers of a library's name, of a link that of its target."""
    return tuple(map(int, re.findall(r"\d+", os.path.basename(os.path.realpath(path))))) or (0,)


def _best(dr: Any, fault: str | None, *, colour: bool) -> str:
    """The fastest variant that runs here."""
    kind = "spectral" if colour else "mono"
    if dr.has_backend(dr.JitBackend.CUDA):
        return f"cuda_ad_{kind}_polarized"
    if not fault and dr.has_backend(dr.JitBackend.LLVM):
        return f"llvm_ad_{kind}_polarized"
    reason = fault or UNUSABLE
    logger.warning("%s, so that the slow scalar renderer is used. %s", reason, HOW_TO_GET_LLVM)
    return "scalar_spectral_polarized"
