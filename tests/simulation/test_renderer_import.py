"""Which renderer runs here, and what to install for one."""

import sys
from types import SimpleNamespace

import pytest

from polmvs.errors import OptionError
from polmvs.simulation import renderer_import
from polmvs.simulation.renderer_import import find_llvm, import_renderer

BACKENDS = SimpleNamespace(LLVM="llvm", CUDA="cuda")


@pytest.fixture
def modules(monkeypatch):
    """Mitsuba on a machine with some backends."""

    def given(*backends):
        variants = ("scalar_spectral_polarized", "llvm_ad_mono_polarized", "cuda_ad_mono_polarized")
        chosen = []
        mitsuba = SimpleNamespace(
            variants=lambda: variants,
            set_variant=chosen.append,
            set_log_level=lambda level: None,
            LogLevel=SimpleNamespace(Error=0),
        )
        drjit = SimpleNamespace(JitBackend=BACKENDS, has_backend=lambda name: name in backends)
        monkeypatch.setitem(sys.modules, "mitsuba", mitsuba)
        monkeypatch.setitem(sys.modules, "drjit", drjit)
        monkeypatch.setattr(
            renderer_import, "find_llvm", lambda: "libLLVM.so" if "llvm" in backends else None
        )
        monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "")
        return chosen

    return given


def test_the_fastest_backend_is_taken(modules, caplog):
    for backends, variant in (
        (("llvm", "cuda"), "cuda_ad_mono_polarized"),
        (("llvm",), "llvm_ad_mono_polarized"),
    ):
        chosen = modules(*backends)
        assert import_renderer().variant == variant
        assert chosen == [variant]
    assert not caplog.messages


def test_without_llvm_the_scalar_renderer_serves_and_the_library_is_named(modules, caplog):
    modules()
    found = import_renderer()
    assert found.variant == "scalar_spectral_polarized"
    assert found.is_scalar
    (message,) = caplog.messages
    assert "libllvm19" in message
    assert "DRJIT_LIBLLVM_PATH" in message


def test_a_variant_that_cannot_run_here_is_refused(modules):
    modules()
    for variant, message in (
        ("llvm_ad_mono_polarized", "libllvm19"),
        ("cuda_ad_mono_polarized", "GPU"),
        ("scalar_rgb", "must be one of"),
    ):
        with pytest.raises(OptionError, match=message) as found:
            import_renderer(variant=variant)
        assert found.value.field == "rendering.variant"


def test_an_llvm_that_is_too_old_is_not_used(modules, monkeypatch, caplog):
    """It cannot compile what Dr.Jit sends it, and ends the process."""
    modules("llvm")
    monkeypatch.setattr(renderer_import, "find_llvm", lambda: "/usr/lib/libLLVM-15.so.1")
    assert import_renderer().is_scalar
    (message,) = caplog.messages
    assert "libLLVM-15.so.1 is LLVM 15, older than 17" in message
    assert "libllvm19" in message
    with pytest.raises(OptionError, match="older than 17"):
        import_renderer(variant="llvm_ad_mono_polarized")


def test_without_mitsuba_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(OptionError, match=r"'\.\[simulate\]'"):
        import_renderer()


def test_the_newest_llvm_is_found_unless_another_is_given(monkeypatch, tmp_path):
    for name in ("libLLVM-14.so.1", "libLLVM.so.19.1", "libLLVM-9.so"):
        (tmp_path / name).touch()
    monkeypatch.setattr(renderer_import, "LLVM_FOLDERS", (str(tmp_path),))
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "none"))
    assert find_llvm() == str(tmp_path / "libLLVM.so.19.1")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM-9.so"))
    assert find_llvm() == str(tmp_path / "libLLVM-9.so")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "nothing"))
    assert find_llvm() is None
