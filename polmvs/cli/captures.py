"""The commands on the files of a capture: inspect, import and calibrate."""

from __future__ import annotations

import shlex
from pathlib import Path

from polmvs.cli.call import Call, require_new
from polmvs.cli.commands import (
    BoardOptions,
    CalibrateArguments,
    CalibrationKind,
    ImportArguments,
    InspectArguments,
    PolarizerFrames,
)
from polmvs.cli.flags import in_flags
from polmvs.cli.terminal import Terminal
from polmvs.config import CaptureOptions
from polmvs.errors import DataError, OptionError
from polmvs.io.data_sets import read_data_set, recognise_data_set
from polmvs.io.images import write_png
from polmvs.io.intrinsics import write_intrinsics
from polmvs.pipeline.data_set_import import ImportedSet, import_data_set
from polmvs.polarization.calibration import write_calibration
from polmvs.polarization.calibration_frames import calibrate_polarizers
from polmvs.polarization.capture import intensity_image_8bit, open_capture
from polmvs.polarization.inspection import contact_sheet, inspect_capture
from polmvs.poses.board_calibration import Board, calibrate_camera


def inspect(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs inspect``."""
    arguments = call.get(InspectArguments)
    if arguments.sheet is not None and arguments.sheet.is_dir():
        raise OptionError("is a folder; name a PNG file.", field="arguments.sheet")
    folder, options, notes = arguments.capture, call.get(CaptureOptions), []
    if folder.is_dir() and recognise_data_set(folder) is not None:
        data_set = read_data_set(folder, options)
        cameras = f"{len(data_set.cameras)} cameras" if data_set.cameras else "a COLMAP model"
        masks = f" and {len(data_set.masks)} masks" if data_set.masks else ""
        notes.append(
            f"a set in the layout of {data_set.kind}, with {cameras}{masks}, which 'polmvs "
            "reconstruct' uses"
        )
        if data_set.capture is None:
            raise DataError(
                folder,
                f"is a set in the layout of {data_set.kind}, whose images are converted first: "
                "run 'polmvs import', and inspect the capture/ that it makes.",
            )
        folder, options = data_set.capture, data_set.options
    capture = open_capture(folder, options)
    with terminal.stage("inspect", len(capture.names)) as on_progress:
        inspection = inspect_capture(capture, on_progress=on_progress)
    lines = [*notes, *inspection.lines]
    if arguments.sheet is not None:
        write_png(arguments.sheet, contact_sheet(capture, in_flags))
        lines.append(f"{arguments.sheet}: contact sheet")
    content = {
        "notes": (*notes, *capture.notes),
        "levels": capture.levels,
        "pattern_check": capture.pattern_check,
        "linearity_check": capture.linearity_check,
        "white": inspection.white,
        "views": inspection.views,
        "warnings": inspection.warnings,
        "obstacles": inspection.obstacles,
        "verdict": inspection.verdict,
    }
    terminal.show([in_flags(line) for line in lines], content)
    return 0


def import_set(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs import``."""
    given = call.get(ImportArguments)
    imported = import_data_set(given.folder, given.out, call.get(CaptureOptions))
    num_views = len(imported.data_set.names)
    lines = [f"{given.out}: {num_views} views of {imported.data_set.kind}"]
    if imported.num_points is not None:
        lines.append(f"{imported.sparse}: given poses, {imported.num_points:,} points")
    words = ["polmvs", "reconstruct", *_arguments_of(imported)]
    lines.append(shlex.join(words))
    content = {
        "kind": imported.data_set.kind,
        "num_views": num_views,
        "points": imported.num_points,
        "command": words,
    }
    terminal.show("\n".join(lines), content)
    return 0


def _arguments_of(imported: ImportedSet) -> list[str]:
    """Arguments of ``polmvs reconstruct`` for an imported set."""
    words = [str(imported.capture), "RUN", "--config", str(imported.options_file)]
    if imported.sparse is not None:
        words += ["--sparse", str(imported.sparse)]
    if imported.masks is not None:
        words += ["--mask", str(imported.masks)]
    if imported.light is not None:
        words += ["--light", str(imported.light)]
    return words


def calibrate(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs calibrate``."""
    arguments = call.get(CalibrateArguments)
    require_new(arguments.out, overwrite=arguments.overwrite)
    if not arguments.out.parent.is_dir():
        raise DataError(arguments.out.parent, "no such folder.")
    if arguments.kind is CalibrationKind.CAMERA:
        return _camera(call, terminal, arguments.capture, arguments.out)
    per_sample = call.get(PolarizerFrames).per_sample
    response = calibrate_polarizers(
        arguments.capture, call.get(CaptureOptions), per_sample=per_sample
    )
    stored = write_calibration(arguments.out, response)
    blocks = ("",) if stored.bayer is None else tuple(f"{c} " for c in stored.bayer)
    channels = zip(
        [f"{block}{nominal:>3}" for block in blocks for nominal in (0, 45, 90, 135)],
        stored.gains,
        stored.angles_deg,
        stored.extinction_ratios,
        strict=True,
    )
    lines = [
        f"{nominal} deg: gain {gain:.4f}, angle {angle:.2f} deg, extinction ratio {ratio:.0f}:1"
        for nominal, gain, angle, ratio in channels
    ]
    lines.append(f"{arguments.out}: residual {100 * response.residual:.2f} % of the mean")
    content = {
        "gains": stored.gains,
        "angles_deg": stored.angles_deg,
        "diattenuations": stored.diattenuations,
        "residual": response.residual,
    }
    terminal.show(lines, content)
    return 0


def _camera(call: Call, terminal: Terminal, folder: Path, out: Path) -> int:
    """Intrinsics from pictures of a board."""
    given = call.get(BoardOptions)
    if given.cols is None or given.rows is None:
        raise OptionError("a board needs --cols and --rows, its squares along each side.")
    capture = open_capture(folder, call.get(CaptureOptions))
    white = capture.exposure()
    pictures = {name: intensity_image_8bit(capture.load(name), white) for name in capture.names}
    try:
        found = calibrate_camera(pictures, Board(**vars(given)))
    except ValueError as error:
        raise DataError(folder, str(error)) from error
    comment = f"rms {found.rms_px:.3f} px over {len(found.views)} views of a board"
    write_intrinsics(out, found.intrinsics, comment)
    lines = [
        f"{len(found.views)} of {len(pictures)} pictures show the board, in "
        f"{100 * found.coverage:.0f} % of the image; rms {found.rms_px:.3f} px",
        found.intrinsics.line,
        f"{out}: give it as --camera {out}",
    ]
    terminal.show(lines, found)
    return 0
