"""What a sensor's resolution costs and gains: one object with fine detail, at several image sizes.

    python pipelines/sensor_size.py WORK [--sizes 612,1224,2448] [--views 24]

Renders an ellipsoid with waves, the finest of 4 mm and 0.2 mm high, by cameras that differ in their
resolution alone, and runs ``polmvs reconstruct`` on each capture, in a process of its own. Two
tables have time and peak memory of the stages, with their ratios to the next smaller size, and the
errors. Captures and runs stay in WORK; what is rendered is not rendered again.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, replace
from pathlib import Path

import numpy as np
import trimesh

from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.running import script
from polmvs.cli.terminal import Terminal
from polmvs.colmap.models import read_model
from polmvs.config import OptionGroup, option
from polmvs.errors import PolmvsError
from polmvs.evaluation.comparison import named_as_truth
from polmvs.evaluation.metrics import evaluate_cloud
from polmvs.evaluation.tables import format_table, number
from polmvs.geometry import lengths
from polmvs.io.clouds import Mesh, read_mesh, write_mesh
from polmvs.io.ground_truth import open_ground_truth
from polmvs.io.images import write_bytes
from polmvs.pipeline.record import POSE_STAGES, Record
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.runner import load_record
from polmvs.polarization.kinds import AngleModel
from polmvs.poses.alignment import align_views
from polmvs.simulation.capture import simulate_capture
from polmvs.simulation.options import (
    LightingOptions,
    LightName,
    MaterialName,
    ObjectOptions,
    PathOptions,
    RenderingOptions,
    SensorOptions,
    Simulation,
    SimulationRun,
)
from polmvs.simulation.trial import options_of
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh

SEMI_AXES_M = (0.1, 0.08, 0.06)
WAVES_M = ((0.016, 0.0008), (0.008, 0.0004), (0.004, 0.0002))  # lengths and heights
SUBDIVISIONS = 8  # edges of 0.6 mm: a seventh of the shortest wave
MODEL = AngleModel.PPA
DISTANCES_M = (0.00025, 0.0005, 0.001)


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    work: Path = option(MISSING, "folder of the captures and runs", positional=True)
    sizes: tuple[int, ...] = option((612, 1224, 2448), "widths of the mosaics, px", least=64)
    views: int = option(24, "of each capture", least=3)
    noise: float = option(0.5, "of the rendering, as a share of the sensor's", above=0)


@dataclass(frozen=True, kw_only=True)
class SizeResult:
    """One capture.

    Attributes
    ----------
    width : of its mosaics, px.
    record : of the run.
    f_score : shares at ``DISTANCES_M``.
    normal_median_deg : error of the mesh's normals.
    """

    width: int
    record: Record
    f_score: tuple[float, ...]
    normal_median_deg: float


def _run(call: Call, terminal: Terminal) -> int:
    arguments = call.get(Arguments)
    arguments.work.mkdir(parents=True, exist_ok=True)
    mesh = arguments.work / "waves.ply"
    write_mesh(mesh, waves())
    results: list[SizeResult] = []
    with terminal.stage("sizes", len(arguments.sizes)) as on_progress:
        for width in sorted(arguments.sizes):
            results.append(_result(arguments, mesh, width))
            text = tables(results)
            write_bytes(arguments.work / "table.md", (text + "\n").encode())
            on_progress(1)
    terminal.show(text, results)
    return 0


def waves() -> Mesh:
    """An ellipsoid with waves of several lengths."""
    ball = trimesh.creation.icosphere(SUBDIVISIONS)
    vertices = np.asarray(ball.vertices) * SEMI_AXES_M
    normals = np.asarray(ball.vertices) / SEMI_AXES_M
    normals /= lengths(normals)[:, None]
    heights = sum(
        height * np.sin(2 * np.pi / length * vertices).prod(axis=1) for length, height in WAVES_M
    )
    moved = trimesh.Trimesh(vertices + heights[:, None] * normals, ball.faces, process=False)
    return Mesh(
        np.asarray(moved.vertices),
        np.asarray(moved.vertex_normals),
        np.asarray(moved.faces, np.int32),
    )


def _result(arguments: Arguments, mesh: Path, width: int) -> SizeResult:
    capture, out = (arguments.work / f"{name}_{width}" for name in ("capture", "run"))
    simulation = Simulation(
        object=ObjectOptions(material=MaterialName.BLACK_PLASTIC),
        lighting=LightingOptions(light=LightName.OVERCAST),
        path=PathOptions(views=arguments.views),
        sensor=SensorOptions(image_size=(width, width * 2048 // 2448 // 2 * 2), bits=12),
        rendering=RenderingOptions(noise=arguments.noise),
    )
    simulate_capture(mesh, capture, simulation, SimulationRun(resume=True))
    sensor = options_of(capture, simulation.sensor)
    command = [sys.executable, "-m", "polmvs", "reconstruct", str(capture), str(out), "--overwrite"]
    command += ["--camera", str(sensor.sfm.camera)]
    command += ["--full-scale", f"{sensor.capture.full_scale:g}"]
    if subprocess.run([*command, "--no-report", "--quiet"], check=False).returncode:
        raise PolmvsError(f"{capture}: {' '.join(command)} failed.")
    folder = RunFolder(out)
    f_score, normal_median_deg = _errors(folder, capture)
    return SizeResult(
        width=width,
        record=load_record(folder),
        f_score=f_score,
        normal_median_deg=normal_median_deg,
    )


def _errors(folder: RunFolder, capture: Path) -> tuple[tuple[float, ...], float]:
    """F-scores of the mesh at ``DISTANCES_M``, and the median error of its normals, deg.

    Its vertices are measured against the true surface, and this against its triangles.
    """
    truth = open_ground_truth(capture / "gt")
    views = named_as_truth(read_model(folder.sparse).views, truth)
    truth_from_world, _ = align_views(views, truth.views, source=truth.cameras)
    mesh = read_mesh(folder.mesh(MODEL))
    vertices = truth_from_world * mesh.vertices
    surface = truth.surface_points()
    metrics = evaluate_cloud(
        vertices,
        None if mesh.normals is None else mesh.normals @ truth_from_world.rotation.T,
        surface.points,
        surface.normals,
        surface.is_part,
        DISTANCES_M,
        spacing_m=surface.spacing_m,
    )
    part = surface.points[surface.is_part]
    scene = RayScene(TriangleMesh.of(replace(mesh, vertices=vertices)))
    distances = lengths(scene.closest(part)[0] - part)
    completeness = [float(np.mean(distances <= limit)) for limit in DISTANCES_M]
    both = zip(metrics.accuracy, completeness, strict=True)
    return tuple(2 * a * c / max(a + c, 1e-9) for a, c in both), metrics.normal_median_deg


def tables(results: Sequence[SizeResult]) -> str:
    """Time and memory of the stages, and the errors."""
    header, names = ["stage"], dict.fromkeys(s.name for r in results for s in r.record.stages)
    for index, result in enumerate(results):
        header += [f"{result.width} px, s", "CPU s", "peak MB", *(["ratio of s"] if index else [])]
    rows = [[name, *_cells(results, {name})] for name in names]
    rows.append(["all", *_cells(results, set(names))])
    rows.append(["all but poses", *_cells(results, set(names) - POSE_STAGES)])
    errors = [
        [str(r.width), *(f"{100 * share:.1f}" for share in r.f_score), number(r.normal_median_deg)]
        for r in results
    ]
    limits = [f"F at {1e3 * limit:g} mm, %" for limit in DISTANCES_M]
    shown = format_table(["width, px", *limits, "normals, median deg"], errors)
    return format_table(header, rows) + "\n\n" + shown


def _cells(results: Sequence[SizeResult], names: set[str]) -> list[str]:
    """Of some stages together."""
    cells, before = [], np.nan
    for index, result in enumerate(results):
        stages = [stage for stage in result.record.stages if stage.name in names]
        seconds = sum(stage.seconds for stage in stages)
        cells += [number(seconds), number(sum(stage.cpu_s for stage in stages))]
        cells.append(number(max((stage.peak_rss_mb for stage in stages), default=None), 1, 0))
        cells += [number(seconds / before if before else None)] if index else []
        before = seconds
    return cells


main = script(__file__, __doc__, _run, (Arguments, TerminalOptions))

if __name__ == "__main__":
    raise SystemExit(main())
