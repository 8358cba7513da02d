"""What an experiment is run on: the capture and its truth, opened and checked before any work."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from polmvs.config import CaptureOptions, ExperimentOptions, RegionOptions
from polmvs.errors import DataError, OptionError
from polmvs.experiments.data import Scene, Truth, open_scene
from polmvs.experiments.view_choice import check_k
from polmvs.io.ground_truth import open_ground_truth
from polmvs.io.layouts import is_author_layout, open_author_capture
from polmvs.polarization.capture import Capture, open_capture


def open_experiment(
    folder: Path,
    options: ExperimentOptions,
    capture: CaptureOptions,
    region: RegionOptions,
) -> Scene:
    """The scene of a capture with truth, of either layout.

    Parameters
    ----------
    folder : of the capture.
    options : truth, poses and blur.
    capture : how the mosaics are read; for the layout of the authors' demo only what differs from
        the defaults, which are not its own.
    region : light, DoLP threshold and masks.

    Raises
    ------
    PolmvsError
        Something is missing, damaged or contradictory.
    """
    opened, truth = _open_data(folder, options.gt, capture)
    return open_scene(opened, truth, region, blur_px=options.blur_px, sparse=options.sparse)


def _open_data(folder: Path, gt: Path | None, options: CaptureOptions) -> tuple[Capture, Truth]:
    if is_author_layout(folder):
        if gt is not None and gt.resolve() != folder.resolve():
            raise OptionError(
                f"is {gt}, but {folder} brings its own truth. Leave it out.", field="experiment.gt"
            )
        given = None if options == CaptureOptions() else options
        return open_author_capture(folder, given)
    return open_capture(folder, options), open_ground_truth(folder if gt is None else gt)


def check_options(scene: Scene, options: ExperimentOptions, names: Sequence[str]) -> None:
    """Refuse what cannot be done before anything is measured.

    Parameters
    ----------
    scene : what is measured on.
    options : of the experiments.
    names : the experiments that are to be run.

    Raises
    ------
    OptionError
        A view is unknown, or more views are asked for than there are.
    """
    view_indices(options.views, scene)
    if "tracks" in names:
        check_k(options.k, len(scene.views))


def view_indices(names: Sequence[str] | None, scene: Scene) -> tuple[int, ...] | None:
    """Indices of views by their images' names, with or without suffix; None for None.

    Raises
    ------
    OptionError
        There is no such view.
    """
    if names is None:
        return None
    by_name = {view.name: i for i, view in enumerate(scene.views)}
    by_name |= {Path(view.name).stem: i for i, view in enumerate(scene.views)}
    for name in names:
        if name not in by_name:
            raise OptionError(
                f"names {name!r}, and there is no such image with truth and pose.",
                field="experiment.views",
            )
    return tuple(dict.fromkeys(by_name[name] for name in names))


def require_apart(out: Path, capture: Path) -> None:
    """Refuse an output folder in which results would mix with the input.

    Raises
    ------
    OptionError
        It is a folder of the capture.
    DataError
        It is a file.
    """
    places = [capture, *(capture / name for name in ("raw", "images", "cams", "gt"))]
    if out.resolve() in [place.resolve() for place in places if place.exists()]:
        raise OptionError(f"{out}: OUT is a folder of the capture. Give another OUT.")
    if out.exists() and not out.is_dir():
        raise DataError(out, "is a file; OUT must be a folder.")
