"""Groups of options: ranges, paths, and JSON."""

import json
import pickle
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from polmvs.config import (
    CaptureOptions,
    ExportOptions,
    FusionOptions,
    Method,
    Options,
    PropagationOptions,
    Range,
    ReferenceOptions,
    SfmOptions,
    from_plain,
    get_option,
    groups_of,
    option_paths,
    options_from_plain,
    plain_options,
    replace_option,
    show_value,
    to_plain,
)
from polmvs.errors import DataError, OptionError


def test_errors_name_the_field() -> None:
    with pytest.raises(OptionError) as caught:
        PropagationOptions(step_px=9)
    error = caught.value
    assert error.field == "propagation.step_px"
    assert error.reason == "must lie in 0.05 to 4, not 9."
    assert str(error) == "`propagation.step_px` must lie in 0.05 to 4, not 9."
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.field, again.reason) == (str(error), error.field, error.reason)
    assert error.exit_status == 2
    assert DataError("a", "b").exit_status == 1


def test_text_names_choices_and_paths() -> None:
    assert PropagationOptions(method="contour").method is Method.CONTOUR
    assert SfmOptions(sparse="model").sparse == Path("model")
    with pytest.raises(OptionError, match=r"must be one of .*contour, not magic"):
        PropagationOptions(method="magic")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: PropagationOptions(stride_px=2.5),
            "`propagation.stride_px` cannot be 2.5: Expected int, got float.",
        ),
        (
            lambda: PropagationOptions(stride_px="2"),
            "`propagation.stride_px` cannot be '2': Expected int, got str.",
        ),
        (
            lambda: PropagationOptions(step_px=True),
            "`propagation.step_px` cannot be True: Expected float, got bool.",
        ),
        (lambda: PropagationOptions(stride_px=None), "`propagation.stride_px` cannot be none."),
        (
            lambda: PropagationOptions(method=3),
            "`propagation.method` must be one of surface, contour, not 3.",
        ),
        (lambda: SfmOptions(seed=1.5), "`sfm.seed` cannot be 1.5: Expected int, got float."),
        (
            lambda: SfmOptions(single_camera="no"),
            "`sfm.single_camera` cannot be 'no': Expected bool, got str.",
        ),
        (lambda: SfmOptions(sparse=3), "`sfm.sparse` cannot be 3: Expected a path."),
        (
            lambda: SfmOptions(intrinsics=("a", 1, 1, 1)),
            "`sfm.intrinsics` cannot be ('a', 1, 1, 1): Expected float, got str.",
        ),
        (
            lambda: CaptureOptions(pattern=(0, 45, 90)),
            "`capture.pattern` cannot be (0, 45, 90): Expected array of length 4, got 3.",
        ),
        (lambda: ExportOptions(mesh="no"), "`export.mesh` cannot be 'no': Expected bool, got str."),
        (lambda: Options(sfm=3), "`sfm` must be SfmOptions, not 3."),
    ],
)
def test_groups_take_values_of_their_fields_types_only(make, message: str) -> None:
    with pytest.raises(OptionError) as caught:
        make()
    assert str(caught.value) == message


def test_numbers_of_numpy_and_lists_are_values_too() -> None:
    made = SfmOptions(seed=np.int64(3), intrinsics=np.array([4, 5, 6, 7]), single_camera=np.True_)
    assert made == SfmOptions(seed=3, intrinsics=(4.0, 5.0, 6.0, 7.0), single_camera=True)
    assert isinstance(made.seed, int)
    propagation = PropagationOptions(step_px=1, spacing_px=np.float32(2))
    assert (propagation.step_px, propagation.spacing_px) == (1.0, 2.0)
    assert {type(propagation.step_px), type(propagation.spacing_px)} == {float}
    assert CaptureOptions(pattern=[0, 45, 135, 90]).pattern == (0, 45, 135, 90)
    assert SfmOptions(pairs=Path("/pairs.txt")).pairs == "/pairs.txt"


@pytest.mark.parametrize(
    ("span", "inside", "outside", "text"),
    [
        (Range(least=1, most=2), (1, 2), (0.9, 2.1), "lie in 1 to 2"),
        (Range(above=0, below=1), (0.5,), (0, 1), "lie in 0 to 1, ends excluded"),
        (Range(least=1), (1, 1e9), (0, float("inf"), float("nan")), "be 1 or more"),
        (Range(above=0), (1e-9,), (0,), "be positive"),
        (Range(most=3), (-5,), (4,), "be 3 or less"),
        (Range(), (-1e300,), (float("inf"), float("nan"), 10**400), "be a finite number"),
    ],
)
def test_ranges(span: Range, inside, outside, text: str) -> None:
    assert all(value in span for value in inside)
    assert not any(value in span for value in outside)
    assert str(span) == text


def test_every_range_holds_its_default() -> None:
    for cls in groups_of(Options).values():
        cls()
        assert all(f.metadata["help"] for f in fields(cls))


def test_paths() -> None:
    assert option_paths()[:2] == ("capture.pattern", "capture.gamma")
    assert option_paths()[-1] == "evaluation.gt"
    assert option_paths(SfmOptions)[-1] == "sfm.without"
    options = replace_option(Options(), "sfm.seed", 7)
    assert get_option(options, "sfm.seed") == 7
    assert replace_option(options, "sfm.seed", 0) == Options()
    with pytest.raises(OptionError, match=r"capture\.gamma"):
        replace_option(options, "capture.gamma", 99.0)
    for path in ("sfm", "sfm.sed", "sfm.seed.x", "gamma", "run.workers"):
        with pytest.raises(KeyError):
            get_option(options, path)


def test_plain_options_of_paths_and_groups() -> None:
    plain = plain_options(Options(), ("capture", "sfm.seed"))
    assert list(plain) == [*option_paths(CaptureOptions), "sfm.seed"]
    assert plain["capture.pattern"] == [90, 45, 135, 0]
    with pytest.raises(KeyError):
        plain_options(Options(), ("captures",))


def test_options_survive_json() -> None:
    options = Options(
        sfm=SfmOptions(intrinsics=(4.0, 5.0, 6.0, 7.0), sparse=Path("/m")),
        reference=ReferenceOptions(scale=("a", "2", 0.5)),
        fusion=FusionOptions(voxel=0.0),
        propagation=PropagationOptions(method=Method.CONTOUR),
    )
    plain = json.loads(json.dumps(to_plain(options)))
    assert options_from_plain(plain) == options
    assert options_from_plain({}) == Options()


def test_what_is_read_is_named() -> None:
    for values, message in (
        ({"gama": 1}, r"f: \[capture\] has an unknown key 'gama'; did you mean 'gamma'\?"),
        ({"gamma": "1"}, r"f: \[capture\] gamma cannot be '1': Expected float, got str"),
        ({"gamma": 99}, r"f: \[capture\] gamma must lie in 0\.1 to 10, not 99"),
        ({"kind": "foo"}, r"f: \[capture\] kind must be one of mosaic, .*, aolp, not foo\."),
    ):
        with pytest.raises(OptionError, match=message) as caught:
            from_plain(CaptureOptions, values, "f")
        assert caught.value.field is None
    with pytest.raises(OptionError) as caught:
        from_plain(PropagationOptions, {"spacing_px": 0.3}, "f")
    reason = "must be as long as [propagation] step_px or longer, not 0.3."
    assert str(caught.value) == f"f: [propagation] spacing_px {reason}"
    with pytest.raises(OptionError, match=r"`capture\.gamma` cannot be '1'") as caught:
        from_plain(CaptureOptions, {"gamma": "1"})
    assert caught.value.field == "capture.gamma"
    with pytest.raises(OptionError, match="unknown table 'sfn'; did you mean 'sfm'"):
        options_from_plain({"sfn": {}})


def test_values_are_shown_as_flags_take_them() -> None:
    shown = [show_value(v) for v in ((1.5, 2.0), True, None, 1e-3, Path("a"), ((1.0, 2.0),))]
    assert shown == ["1.5,2", "yes", "none", "0.001", "a", "1,2"]
