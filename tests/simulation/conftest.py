import pytest

from polmvs.simulation.renderer_import import Renderer, import_renderer


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    """Mitsuba, or a reason to skip."""
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed (extra 'simulate')")
    found = import_renderer()
    if found.is_scalar:
        pytest.skip("LLVM's library is not installed, and the scalar renderer is slow")
    return found
