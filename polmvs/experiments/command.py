"""The command ``polmvs experiment NAME CAPTURE --gt DIR OUT``."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Protocol

from polmvs.cli.flags import add_flags, options_from
from polmvs.config import CaptureOptions, Options, default_num_workers
from polmvs.errors import DataError, OptionError
from polmvs.experiments.contours import DEFAULT_NUM_SEEDS, DEFAULT_STEP_PX
from polmvs.experiments.data import DEFAULT_BLUR_PX, Scene, Truth, open_scene
from polmvs.experiments.output import NAMES, check_output, write_report
from polmvs.experiments.plane import DEFAULT_PLANAR_DEG
from polmvs.experiments.tracks import DEFAULT_NUM_POINTS, TrackOptions
from polmvs.experiments.view_choice import Selection
from polmvs.io.ground_truth import open_ground_truth
from polmvs.io.layouts import is_author_layout, open_author_capture
from polmvs.parallel import Workers
from polmvs.polarization.capture import Capture, open_capture

logger = logging.getLogger(__name__)

HELP = {
    "phase": "error of the phases that the models predict from true normals",
    "plane": "normal of a planar region from one view",
    "tracks": "normals of surface points from K views",
    "contours": "contours traced from seeds on the part's edge",
}


class Monitor(Protocol):
    """Who watches; :class:`polmvs.cli.terminal.Terminal` does."""

    def stage(self, name: str, total: int | None) -> AbstractContextManager[Any]:
        """A stage begins; its value is called with the number of steps done."""


class _Silence:
    """Nobody watches."""

    def stage(self, name: str, total: int | None) -> AbstractContextManager[Any]:
        """Do nothing."""
        return nullcontext(lambda count: None)


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add ``experiment`` to the commands; its ``run`` is :func:`run`."""
    description = (
        "the paper's experiments: OPA, PPA and tilted side by side on a capture with truth"
    )
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "experiment",
        help=description,
        description=description[0].upper() + description[1:] + ".",
        epilog="; ".join(f"{name}: {text}" for name, text in HELP.items())
        + ". The model 'tilted' presumes a lens that is not telecentric on the image side.",
    )
    parser.add_argument("name", choices=NAMES, metavar="NAME", help=", ".join(NAMES))
    parser.add_argument(
        "capture",
        type=Path,
        metavar="CAPTURE",
        help="folder of raw polarizer mosaics, in it or in its raw/, or in the layout of the "
        "authors' demo (images/, cams/)",
    )
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the results")
    parser.add_argument("-v", "--verbose", action="store_true", help="show every step")
    add_experiment_flags(parser)
    add_flags(parser, ["capture", "region"])
    parser.set_defaults(run=run)
    return parser


def add_experiment_flags(parser: argparse.ArgumentParser) -> None:
    """Flags that :func:`experiment_options`, :func:`scene_from` and the output read."""
    add = parser.add_argument
    add("--gt", type=Path, metavar="DIR", help="ground truth (default: that of CAPTURE)")
    add("--overwrite", action="store_true", help="replace earlier results of NAME in OUT")
    add(
        "--workers",
        type=int,
        default=default_num_workers(),
        metavar="INT",
        help=_default("processes"),
    )
    add("--poses", choices=("true", "sfm"), default="true", help=_default("whose poses are used"))
    add("--sparse", type=Path, metavar="DIR", help="COLMAP model of the poses of --poses sfm")
    add(
        "--blur-px",
        type=float,
        default=DEFAULT_BLUR_PX,
        metavar="NUMBER",
        help=_default("deviation of the Gaussian blur before phase and DoLP, px; 0: none"),
    )
    add(
        "--views",
        metavar="NAME,...",
        help="images that contours are traced in and that figures show (default: all, and a few)",
    )
    add(
        "--planar-deg",
        type=float,
        default=DEFAULT_PLANAR_DEG,
        metavar="NUMBER",
        help=_default("plane: spread of the true normals of a planar region, degrees"),
    )
    add(
        "--num-points",
        type=int,
        default=DEFAULT_NUM_POINTS,
        metavar="INT",
        help=_default("tracks: surface points"),
    )
    add(
        "--k",
        metavar="INT,...",
        help="tracks: numbers of views (default: 2 to 20, as far as the capture goes)",
    )
    add(
        "--select",
        choices=list(Selection),
        type=Selection,
        default=Selection.RANDOM,
        help=_default("tracks: how the K views of a point are chosen"),
    )
    add("--seed", type=int, default=0, metavar="INT", help=_default("tracks: random seed"))
    add(
        "--num-seeds",
        type=int,
        default=DEFAULT_NUM_SEEDS,
        metavar="INT",
        help=_default("contours: seeds along the edge in each view"),
    )
    add(
        "--step-px",
        type=float,
        default=DEFAULT_STEP_PX,
        metavar="NUMBER",
        help=_default("contours: step of the tracing, px"),
    )


def run(args: argparse.Namespace, monitor: Monitor | None = None) -> int:
    """Run one experiment and write its results.

    Parameters
    ----------
    args : of the parser of :func:`add_parser`.
    monitor : shows the progress.

    Returns
    -------
    The exit status, 0.

    Raises
    ------
    PolmvsError
        One line that says what is wrong; nothing is written then.
    """
    # matplotlib takes half a second to import: only where figures are drawn.
    from polmvs.experiments.reports import num_steps, run_experiment

    check_output(args.out, args.name, overwrite=args.overwrite)
    require_apart(args)
    scene = scene_from(args)
    options = experiment_options(args, scene, (args.name,))
    watcher = _Silence() if monitor is None else monitor
    with (
        Workers(args.workers) as workers,
        watcher.stage(args.name, num_steps(args.name, scene, options)) as progress,
    ):
        report = run_experiment(args.name, scene, options, workers, progress)
    write_report(args.out, report)
    print(report.text)
    print(f"{args.out / args.name}.json")
    return 0


def scene_from(args: argparse.Namespace) -> Scene:
    """The capture and truth of the arguments, checked."""
    if args.workers < 1:
        raise OptionError(f"--workers must be 1 or more, not {args.workers}.")
    if not 0 <= args.blur_px <= 20:
        raise OptionError(f"--blur-px must lie in 0 to 20, not {args.blur_px:g}.")
    if (args.poses == "sfm") != (args.sparse is not None):
        raise OptionError("--poses sfm and --sparse DIR go together.")
    options = options_from(args)
    capture, truth = open_data(args.capture, args.gt, options)
    return open_scene(capture, truth, options.region, blur_px=args.blur_px, sparse=args.sparse)


def open_data(folder: Path, gt: Path | None, options: Options) -> tuple[Capture, Truth]:
    """A capture with its truth, of either layout.

    Raises
    ------
    DataError
        Something is missing or damaged.
    """
    if is_author_layout(folder):
        if gt is not None and gt.resolve() != folder.resolve():
            raise OptionError(f"{gt}: {folder} brings its own truth. Leave --gt out.")
        given = None if options.capture == CaptureOptions() else options.capture
        return open_author_capture(folder, given)
    return open_capture(folder, options.capture), open_ground_truth(folder if gt is None else gt)


def experiment_options(args: argparse.Namespace, scene: Scene, names: Sequence[str]) -> Any:
    """Options of some experiments, checked against the scene."""
    from polmvs.experiments.reports import ExperimentOptions, check_options

    for name, value, least in (
        ("--planar-deg", args.planar_deg, 0.01),
        ("--num-points", args.num_points, 10),
        ("--num-seeds", args.num_seeds, 1),
        ("--step-px", args.step_px, 0.05),
    ):
        if not least <= value < 1e7:
            raise OptionError(f"{name} must be {least:g} or more, not {value:g}.")
    if args.step_px > 4:
        raise OptionError(f"--step-px must be 4 or less, not {args.step_px:g}.")
    options = ExperimentOptions(
        views=_view_indices(args.views, scene),
        planar_deg=args.planar_deg,
        tracks=TrackOptions(
            num_points=args.num_points,
            k=_numbers(args.k),
            selection=args.select,
            seed=args.seed,
        ),
        num_seeds=args.num_seeds,
        step_px=args.step_px,
    )
    check_options(scene, options, names)
    return options


def _view_indices(text: str | None, scene: Scene) -> tuple[int, ...] | None:
    """Indices of the views of a list of image names, with or without their suffix."""
    if text is None:
        return None
    by_name = {view.name: i for i, view in enumerate(scene.views)}
    by_name |= {Path(view.name).stem: i for i, view in enumerate(scene.views)}
    indices = []
    for name in text.split(","):
        if name.strip() not in by_name:
            raise OptionError(f"--views: no image {name.strip()!r} with truth and pose.")
        indices.append(by_name[name.strip()])
    return tuple(dict.fromkeys(indices))


def _numbers(text: str | None) -> tuple[int, ...] | None:
    if text is None:
        return None
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise OptionError(f"--k needs whole numbers with commas, not {text!r}.") from error


def require_apart(args: argparse.Namespace) -> None:
    """Results must not mix with the input."""
    out = args.out.resolve()
    places = [args.capture, *(args.capture / name for name in ("raw", "images", "cams", "gt"))]
    if out in [place.resolve() for place in places if place.exists()]:
        raise OptionError(f"{args.out}: OUT is a folder of the capture. Give another OUT.")
    if args.out.exists() and not args.out.is_dir():
        raise DataError(args.out, "is a file; OUT must be a folder.")


def _default(text: str) -> str:
    return f"{text} (default: %(default)s)"
