"""Render a board of the same numbers as a shared capture's, and measure both alike.

    python pipelines/simulated_board.py BOARD WORK [--seeds 3,4,5,6,7] [--light overcast]

BOARD is a capture with ground truth of a black glossy board of 300 x 400 x 12 mm, turned by 12
degrees on a textured table, that another program rendered. The board here has the same place,
size and index, marks at the same places, the same cameras and sensor; prints, clutter and noise
differ with each seed. The shared capture's truth is the top of the board, so the masks of the
rendered truth are cut to it. Captures and runs stay in WORK.

A figure of the shared capture agrees if it lies in the 95 % prediction interval for one more board,
which the seeds give (Student's t), or differs from their mean by no more than AGREES: what a change
of the program may cost.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from scipy import stats
from scipy.spatial.transform import Rotation

from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.running import script
from polmvs.cli.terminal import Terminal
from polmvs.config import (
    EvaluationOptions,
    OptionGroup,
    Options,
    SfmOptions,
    option,
)
from polmvs.evaluation.tables import format_table
from polmvs.io.clouds import Mesh, write_mesh
from polmvs.io.ground_truth import GroundTruth, open_ground_truth, write_true_maps
from polmvs.io.images import write_bytes
from polmvs.io.intrinsics import Intrinsics, write_intrinsics
from polmvs.polarization.kinds import AngleModel
from polmvs.scene import stem_of
from polmvs.simulation.camera_model import pinhole_of
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
from polmvs.simulation.trial import TrialResult, measure, trial_table

SIDES_M = (0.3, 0.4, 0.012)
TURN_DEG = 12.0
# x, y of the middles of the shared board's prints, in its own axes: of what is light in the median
# of its views, each warped onto the top.
MARKS_MM = (
    (-124, -170),
    (112, -153),
    (-1, -115),
    (9, 3),
    (78, 15),
    (-93, 27),
    (-88, 127),
    (111, 124),
    (-13, 150),
)
LONGEST_EDGE_M = 0.02
MODELS = (AngleModel.OPA, AngleModel.PPA)
AGREES = {"F 1 mm, %": 0.3, "F 2 mm, %": 0.3, "normals, median deg": 0.1}
COVERAGE = 0.95  # of the prediction interval


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    board: Path = option(MISSING, "the other program's capture", positional=True)
    work: Path = option(MISSING, "folder of the captures and runs", positional=True)
    seeds: tuple[int, ...] = option((3, 4, 5, 6, 7), "of the captures that are rendered")
    light: LightName = option(LightName.OVERCAST, "preset of the light")


def _run(call: Call, terminal: Terminal) -> int:
    arguments = call.get(Arguments)
    arguments.work.mkdir(parents=True, exist_ok=True)
    truth = open_ground_truth(arguments.board)
    mesh, camera, poses, marks = (
        arguments.work / n for n in ("board.ply", "camera.txt", "poses.txt", "marks.txt")
    )
    write_mesh(mesh, _board())
    write_intrinsics(camera, _intrinsics(truth), "of the polarization images")
    write_bytes(poses, _trajectory(truth).encode())
    write_bytes(marks, _mark_places().encode())
    captures = [("shared", arguments.board, truth.folder)]
    with terminal.stage("render", len(arguments.seeds)) as on_progress:
        for seed in arguments.seeds:
            made = simulate_capture(
                mesh,
                arguments.work / f"simulated_{seed}",
                Simulation(
                    object=ObjectOptions(material=MaterialName.BLACK_PLASTIC, mark_places=marks),
                    lighting=LightingOptions(light=arguments.light),
                    path=PathOptions(cameras=poses),
                    sensor=SensorOptions(image_size=(1224, 1024), camera_file=camera),
                    rendering=RenderingOptions(seed=seed),
                ),
                SimulationRun(resume=True),
            )
            top = arguments.work / f"top_{seed}"
            _write_top(open_ground_truth(made.folder), top)
            captures.append((f"simulated, seed {seed}", made.folder, top))
            on_progress(1)
    trials: dict[AngleModel, list[TrialResult]] = {model: [] for model in MODELS}
    with terminal.stage("measure", len(captures)) as on_progress:
        for name, capture, judged_by in captures:
            options = Options(
                sfm=SfmOptions(camera=camera), evaluation=EvaluationOptions(gt=judged_by)
            )
            found = measure(
                name,
                capture,
                arguments.work / f"run_{name.replace(', ', '_').replace(' ', '_')}",
                options,
                views=len(truth.views),
                models=MODELS,
            )
            for model, trial in zip(MODELS, found, strict=True):
                trials[model].append(replace(trial, name=f"{name}, {model.upper()}"))
            rows = [trial for found in zip(*trials.values(), strict=True) for trial in found]
            tables = trial_table(rows) + "\n\n" + _agreement(trials) + "\n"
            write_bytes(arguments.work / "table.md", tables.encode())
            on_progress(1)
    terminal.show(tables, rows)
    return 0


def _agreement(trials: Mapping[AngleModel, Sequence[TrialResult]]) -> str:
    """A row for each model and figure: whether the first capture agrees with the others."""
    rows = []
    for model, (shared, *seeds) in trials.items():
        if len(seeds) < 2:
            continue
        for figure, tolerance in AGREES.items():
            value = _figure(shared, figure)
            others = np.array([_figure(trial, figure) for trial in seeds])
            mean = others.mean()
            # The next of n + 1 normal values deviates from the mean of n by this.
            deviation = others.std(ddof=1) * np.sqrt(1 + 1 / len(others))
            reach = deviation * stats.t.ppf(0.5 + 0.5 * COVERAGE, len(others) - 1)
            agrees = abs(value - mean) <= max(reach, tolerance)
            interval = f"{mean - reach:.2f} to {mean + reach:.2f}"
            verdict = "yes" if agrees else "no"
            rows.append(
                (f"{model.upper()}, {figure}", f"{value:.2f}", f"{mean:.2f}", interval, verdict)
            )
    header = ("figure", "shared", "mean of seeds", "95 % of boards", "agrees")
    return format_table(header, rows)


def _figure(trial: TrialResult, name: str) -> float:
    return {
        "F 1 mm, %": 100 * trial.f_score[0],
        "F 2 mm, %": 100 * trial.f_score[1],
        "normals, median deg": trial.normal_median_deg,
    }[name]


def _board() -> Mesh:
    """In squares small enough for the light on it to vary."""
    box = trimesh.creation.box(SIDES_M).subdivide_to_size(LONGEST_EDGE_M)
    vertices = np.asarray(box.vertices) @ _turn().T + [0, 0, 0.5 * SIDES_M[2]]
    normals = np.zeros_like(vertices)  # those of its facets are taken
    normals[:, 2] = 1
    return Mesh(vertices, normals, np.asarray(box.faces, np.int32))


def _mark_places() -> str:
    """Lines ``x y z`` on the top of the board, metres."""
    on_top = np.column_stack([1e-3 * np.array(MARKS_MM), np.full(len(MARKS_MM), SIDES_M[2])])
    return "".join(" ".join(f"{v:.6f}" for v in row) + "\n" for row in on_top @ _turn().T)


def _write_top(truth: GroundTruth, folder: Path) -> None:
    """Ground truth whose part is what faces upwards."""
    folder.mkdir(exist_ok=True)
    write_bytes(folder / truth.cameras.name, truth.cameras.read_bytes())
    for name, view in truth.views.items():
        normals = truth.normals(name).astype(np.float64)
        upwards = normals @ view.cam_from_world.rotation[:, 2] > 0.5  # not where they are NaN
        depth = np.nan_to_num(truth.depth(name)).astype(np.float64)
        unit = truth.depth_unit_m
        write_true_maps(folder / stem_of(name), depth, normals, upwards, depth_unit_m=unit)


def _turn() -> np.ndarray:
    return np.asarray(Rotation.from_euler("z", TURN_DEG, degrees=True).as_matrix())


def _intrinsics(truth: GroundTruth) -> Intrinsics:
    camera = pinhole_of(next(iter(truth.views.values())).camera)
    params = (camera.fx, camera.fy, camera.cx, camera.cy)
    return Intrinsics(model="PINHOLE", width=camera.width, height=camera.height, params=params)


def _trajectory(truth: GroundTruth) -> str:
    lines = []
    for name, view in truth.views.items():
        pose = view.cam_from_world
        x, y, z, w = Rotation.from_matrix(pose.rotation).as_quat()
        lines.append(" ".join([name, *(f"{v:.12g}" for v in (w, x, y, z, *pose.translation))]))
    return "\n".join(lines) + "\n"


main = script(__file__, __doc__, _run, (Arguments, TerminalOptions))

if __name__ == "__main__":
    raise SystemExit(main())
