"""The study of the constants: finds them all, varies the one that is asked for, judges moves."""

import ast
import importlib.util
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

SCRIPT = Path(__file__).parents[2] / "pipelines" / "constants.py"


@pytest.fixture(scope="module")
def study():
    spec = importlib.util.spec_from_file_location("pipelines_constants", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("value", "factor", "expected"),
    [
        (3.0, 2.0, 6.0),
        (4, 0.5, 2),
        (1, 0.5, 1),  # a count of none would be another algorithm
        (17, 2.0, 33),  # windows stay odd
        (17, 0.5, 9),
        (0.9, 2.0, 0.8),  # shares and cosines: their complement
        (99.5, 2.0, 99.0),
        (30.0, 2.0, 60.0),
        ((4, 2, 1), 2.0, (8, 4, 2)),
    ],
)
def test_varied(study, value, factor, expected):
    result = study.varied(value, factor)
    assert result == pytest.approx(expected)
    assert type(result) is type(value)


def test_finds_names_fields_parameters_and_unnamed_numbers(study):
    source = """
import numpy as np
LIMIT_PX = 3.0
SQUARE = LIMIT_PX**2
ANGLE = np.radians(15.0)
NAME = "text"
PAIR = (1.0, 99.0)
SWITCH = True

class Tolerances:
    reach: float = 2.5
    seed: str = "x"

def work(image, margin=7, *, share: float = 0.3, flag=True, limit=LIMIT_PX):
    return image + 0.7 * margin + 1e-9 + 0.5
"""
    names = [name for name, _ in study._numbers_of(ast.parse(source))]
    assert names == [
        "LIMIT_PX",
        "ANGLE",
        "PAIR",
        "Tolerances.reach",
        "work(margin)",
        "work(share)",
        "work[0.7]",
    ]


def test_the_package_holds_constants_of_each_kind(study):
    found = {c.key: c for c in study.find_constants()}
    assert len(found) > 50
    assert found["polmvs.config:RegionOptions.min_dolp"].flag == "--min-dolp"
    assert not any("experiments" in key or "cli" in key for key in found)


def test_varies_a_constant_its_copies_and_what_is_derived_from_it(tmp_path):
    """In a process of its own, as the package is imported anew."""
    package = tmp_path / "polmvs_like"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "a.py").write_text("LIMIT = 3.0\nTWICE = 2 * LIMIT\ndef f(x=LIMIT): return x\n")
    (package / "b.py").write_text("from polmvs_like.a import LIMIT\n")
    code = f"""
import importlib.util, sys
spec = importlib.util.spec_from_file_location("study", {str(SCRIPT)!r})
study = importlib.util.module_from_spec(spec)
sys.modules["study"] = study
spec.loader.exec_module(study)
sys.path.insert(0, {str(tmp_path)!r})
constant = study.Constant(module="polmvs_like.a", name="LIMIT", line=1, value="3.0")
sys.meta_path.insert(0, study.VaryingFinder([constant], 2.0))
from polmvs_like import a, b
print(a.LIMIT, a.TWICE, a.f(), b.LIMIT)
"""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.split() == ["6.0", "12.0", "6.0", "6.0"]


def test_reads_through_defaults_and_derived_numbers(study):
    from polmvs.surface import contour, stereo

    constants = study.find_constants()
    called = [contour.cover_with_contours.__code__]
    read = study.constants_read(called, constants)
    assert "polmvs.surface.contour:MIN_COHERENCE" in read
    assert "polmvs.surface.contour:cover_with_contours(step_px)" in read
    assert "polmvs.surface.contour:MEETING_PX" not in read
    users = [f for f in vars(stereo).values() if "TEXTURE_PX" in _names_of(f)]
    assert users, "stereo derives TEXTURE_PX from BORDER_PX"
    read = study.constants_read([users[0].__code__], constants)
    assert "polmvs.surface.stereo:BORDER_PX" in read


def _names_of(thing):
    return getattr(getattr(thing, "__code__", None), "co_names", ())


def test_effect_counts_moves_beyond_rounding_and_noise(study):
    still = {"figures": {"f_1mm": 0.9, "depth_rmse_mm": 0.2, "normal_deg": math.nan}, "seconds": {}}
    line = {"figures": {"f_1mm": 0.9005, "depth_rmse_mm": 0.5, "normal_deg": 1.0, "cpu_s": 0.0}}
    line["commands"] = []
    moved, refused = study.effect_of(line, still, {"depth_rmse_mm": 0.02})
    assert list(moved) == ["depth_rmse_mm"]
    assert moved["depth_rmse_mm"][2] == pytest.approx(0.3 / (study.NUM_SIGMAS * 0.02))
    assert refused == ""
    assert study.effect_of({"identical": True}, still, {}) == ({}, "")
    assert study.effect_of({"error": "ValueError: no"}, still, {}) == ({}, "ValueError: no")
    line["figures"]["f_1mm"] = math.nan  # an empty cloud is a move
    assert "f_1mm" in study.effect_of(line, still, {})[0]


def test_groups_that_move_something_are_halved(study):
    names = ["a", "b", "c"]
    group = tuple(study.Constant(module="m", name=n, line=1, value="1.0") for n in names)
    quiet = tuple(study.Constant(module="m", name=n, line=1, value="1.0") for n in "de")
    base = study.Base(
        capture=Path("x"), out=Path("y"), way="default", truth=None, reads={}, hashes={}
    )
    common = {"capture": "x", "way": "default"}
    figures = {"f_1mm": 0.9, "cpu_s": 1.0}
    results = [
        common | {"constant": "noise", "factor": 0.0, "figures": figures, "seconds": {}},
        common
        | {
            "constant": "m:a+m:b+m:c",
            "factor": 2.0,
            "figures": {"f_1mm": 0.5, "cpu_s": 1.0},
            "commands": [],
        },
        common | {"constant": "m:d+m:e", "factor": 2.0, "figures": figures, "commands": []},
    ]
    halves = study.halves_of_moved([group, quiet], results, base, 2.0)
    assert halves == [group[:1], group[1:]]


def test_noise_is_the_deviation_of_the_noisy_runs_alone(study):
    common = {"capture": "x", "way": "default", "constant": "noise"}
    results = [
        common | {"factor": float(f), "figures": {"f_1mm": v}}
        for f, v in enumerate([9.0, 1.0, 2.0, 3.0])
    ]
    noise = study.noise_of(results)[("x", "default")]
    assert noise["f_1mm"] == pytest.approx(np.std([1, 2, 3], ddof=1))
