"""The commands that show results: the report, the viewer, and still pictures."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from polmvs.cli.call import Call, RecordingOptions, require_new
from polmvs.cli.commands import FolderArguments, RenderArguments
from polmvs.cli.terminal import Terminal
from polmvs.errors import DataError
from polmvs.io.clouds import Cloud, Mesh, has_triangles, read_cloud, read_mesh, show_in_viewer
from polmvs.io.images import write_png
from polmvs.pipeline.export import part_of
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.runner import load_record
from polmvs.pipeline.stages.poses import PosesResult
from polmvs.polarization.kinds import AngleModel
from polmvs.report.recording import num_recorded_steps, require_rerun, write_recording
from polmvs.report.rendering import Viewpoint, contact_sheet
from polmvs.report.report import write_report
from polmvs.separate import CrashError, run_separately


def report(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs report``."""
    folder, recording = RunFolder(call.get(FolderArguments).out), call.get(RecordingOptions).rerun
    if recording is not None:
        require_rerun(recording)
    path = make_report(folder, terminal)
    shown = {"report": path}
    if recording is not None:
        make_recording(folder, recording, terminal)
        shown["recording"] = str(recording)
    terminal.show(list(shown.values()), shown)
    return 0


def make_report(run_folder: RunFolder, terminal: Terminal) -> str:
    """Write the report with a progress bar and a line, as for a stage; return its path."""
    found = load_record(run_folder).find(PosesResult)
    start = time.perf_counter()
    with terminal.stage("report", found.num_views if found is not None else None) as on_progress:
        path = write_report(run_folder, on_progress=on_progress)
    megabytes = path.stat().st_size / 1e6
    terminal.finished("report", time.perf_counter() - start, f"{path}, {megabytes:.1f} MB")
    return str(path)


def make_recording(run_folder: RunFolder, path: Path, terminal: Terminal) -> None:
    """Write a recording with a progress bar and a line, as for a stage."""
    start = time.perf_counter()
    with terminal.stage("recording", num_recorded_steps(run_folder)) as on_progress:
        write_recording(run_folder, path, on_progress=on_progress)
    megabytes = path.stat().st_size / 1e6
    terminal.finished("recording", time.perf_counter() - start, f"{path}, {megabytes:.1f} MB")


def view(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs view``."""
    folder = RunFolder(call.get(FolderArguments).out)
    load_record(folder)
    files = [
        path
        for model in AngleModel
        for path in (folder.cloud(model), folder.mesh(model))
        if path.is_file()
    ]
    if not files:
        raise DataError(folder.root, "has no cloud to show. Run 'polmvs densify' first.")
    if _shown(files):
        terminal.show(list(map(str, files)), {"shown": files})
        return 0
    page = folder.report if folder.report.is_file() else make_report(folder, terminal)
    terminal.show(
        [f"there is no display here to open a window on; {page} shows the same in a browser"],
        {"report": page},
    )
    return 0


def _shown(files: Sequence[Path]) -> bool:
    """Show files in the viewer until its window is closed; False where none opens."""
    displays = ("DISPLAY", "WAYLAND_DISPLAY")
    if sys.platform == "linux" and not any(os.environ.get(name) for name in displays):
        return False
    try:
        # Open3D ends the process if the display does not answer.
        run_separately(_show, files)
    except CrashError:
        return False
    return True


def _show(files: Sequence[Path], on_message: Callable[[str], None]) -> None:
    show_in_viewer(files)


def render(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs render``."""
    arguments = call.get(RenderArguments)
    require_new(arguments.picture, overwrite=arguments.overwrite)
    subjects: list[Cloud | Mesh] = [
        read_mesh(path) if has_triangles(path) else read_cloud(path) for path in arguments.files
    ]
    if arguments.part:
        subjects = [part_of(one) if isinstance(one, Cloud) else one for one in subjects]
    viewpoints = [
        Viewpoint(elevation_deg=elevation, azimuth_deg=azimuth)
        for elevation, azimuth in product(arguments.elevations, arguments.azimuths)
    ]
    sheet = contact_sheet(
        subjects,
        viewpoints,
        labels=arguments.labels,
        size_px=arguments.size,
        plain=arguments.plain,
    )
    write_png(arguments.picture, np.ascontiguousarray(sheet[..., ::-1]))  # OpenCV counts BGR
    terminal.show([str(arguments.picture)], {"picture": arguments.picture})
    return 0
