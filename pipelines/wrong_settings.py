"""What wrong settings do, and what is said of them: each on one capture, against its truth.

    python pipelines/wrong_settings.py CAPTURE WORK [--other CAPTURE] [--moved CAPTURE] [--only ...]

Each setting is a run of ``polmvs compare`` in ``WORK/NAME``, with PPA alone; ``WORK/table.md`` says
how far the result is from the truth, how much worse than with right settings (harm), what was said,
and whether the result called itself trustworthy. CAPTURE has a ``gt`` folder. OTHER is a capture
with truth whose frames, model and truth are mistaken for CAPTURE's; MOVED one with the same cameras
and the object elsewhere, two of whose frames take the place of CAPTURE's of the same names. A
finished run is not done again, but judged again.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import MISSING, asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from polmvs.camera import PinholeCamera
from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.running import script
from polmvs.cli.terminal import Terminal
from polmvs.colmap.models import read_model, write_model
from polmvs.config import OptionGroup, option
from polmvs.errors import PolmvsError
from polmvs.evaluation.tables import format_table
from polmvs.evaluation.trust import Trust
from polmvs.geometry import RigidTransform
from polmvs.io.ground_truth import open_ground_truth
from polmvs.io.images import write_bytes
from polmvs.pipeline.jobs import judge
from polmvs.pipeline.run_folder import RunFolder
from polmvs.scene import View

RIGHT = "right"
MAX_NORMAL_HARM_DEG = 1.0  # that a run may do without a word
MAX_F_HARM = 0.005
MASK_SHIFT_PX = 20
HEADER = (
    *("setting", "normals, median deg", "harm", "F 1 mm, %", "harm", "F 2 mm, %"),
    *("outcome", "trusted", "said"),
)


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    capture: Path = option(MISSING, "folder with raw mosaics and truth", positional=True)
    work: Path = option(MISSING, "folder of the runs", positional=True)
    other: Path | None = option(None, "a capture of something else, with truth")
    moved: Path | None = option(None, "the same with the object moved")
    only: tuple[str, ...] | None = option(None, "names of the settings to run")
    flags: str = option("", "more flags of polmvs compare, for all runs")


@dataclass(frozen=True)
class Setting:
    """One way to run a capture.

    Attributes
    ----------
    name : of it.
    flags : of ``polmvs compare``; called with a new folder for the files that they name.
    frames : changes a copy of the raw frames (sorted paths); None: the capture's own are read.
    own_poses : SfM is run; else the model of the right run is given.
    """

    name: str
    flags: Callable[[Path], Sequence[str]] = lambda folder: ()
    frames: Callable[[list[Path]], None] | None = None
    own_poses: bool = False


@dataclass(frozen=True, kw_only=True)
class Found:
    """What came of a setting.

    Attributes
    ----------
    name : of the setting.
    status : exit status.
    error : of a run that was refused.
    warnings : of the run.
    normal_deg : median error of the normals; NaN without a result, as the next two.
    f_1mm, f_2mm : F-scores.
    seconds : of the run.
    """

    name: str
    status: int
    error: str
    warnings: tuple[str, ...]
    normal_deg: float
    f_1mm: float
    f_2mm: float
    seconds: float


class Settings:
    """The settings for one capture."""

    def __init__(self, arguments: Arguments) -> None:
        self.arguments = arguments
        self.capture, self.other = arguments.capture, arguments.other
        self.truth = open_ground_truth(self.capture / "gt")
        self.names = sorted(self.truth.views)
        camera = self.truth.views[self.names[0]].camera
        assert isinstance(camera, PinholeCamera)
        self.camera = camera
        self.model = arguments.work / RIGHT / "run" / "sparse"

    def __iter__(self) -> Iterator[Setting]:
        camera, f = self.camera, self.camera.fx
        yield Setting(RIGHT, own_poses=True)
        for name, pattern in {
            "pattern swapped": "0,45,135,90",
            "pattern mirrored": "45,90,0,135",
            "pattern turned": "0,135,45,90",
        }.items():
            yield _flagged(name, "--pattern", pattern)
        yield _flagged("clockwise", "--clockwise")
        yield _flagged("zero-deg 10", "--zero-deg", "10")
        yield _flagged("gamma 2.2", "--gamma", "2.2")
        yield _flagged("gamma 0.5", "--gamma", "0.5")
        yield _flagged("light diffuse", "--light", "diffuse")
        yield _flagged("light specular", "--light", "specular")
        yield Setting("frames swapped", frames=_swap)
        yield Setting("frame duplicated", frames=_duplicate, own_poses=True)
        if self.other is not None:
            yield Setting(
                "frames of another capture", frames=self._from(self.other), own_poses=True
            )
        yield Setting("mask right", partial(self._masks, np.array))
        yield Setting("mask inverted", partial(self._masks, np.invert))
        yield Setting("mask of another view", partial(self._masks, _roll))
        yield Setting("mask shifted", partial(self._masks, _shift))
        for name, changed in {
            "focal length 1.03": replace(camera, fx=1.03 * f, fy=1.03 * f),
            "focal length 1.1": replace(camera, fx=1.1 * f, fy=1.1 * f),
            "principal point 6 px": replace(camera, cx=camera.cx + 6),
            "intrinsics of the mosaic": replace(
                camera, fx=2 * f, fy=2 * f, cx=2 * camera.cx, cy=2 * camera.cy
            ),
        }.items():
            values = ",".join(str(v) for v in (changed.fx, changed.fy, changed.cx, changed.cy))
            yield Setting(name, partial(_given, ("--intrinsics", values)), own_poses=True)
        changes: dict[str, Callable[[View], View]] = {
            "model with focal length 1.1": partial(_with_focal, factor=1.1),
            "model with focal length 1.03": partial(_with_focal, factor=1.03),
        }
        for name, change in changes.items():
            yield Setting(name, partial(self._model, change))
        changes = {
            "pose off by 1 deg": partial(_turned, degrees=1.0),
            "pose off by 5 deg": partial(_turned, degrees=5.0),
            "camera 4 % farther": self._farther,
        }
        for name, change in changes.items():
            yield Setting(name, partial(self._model, change, index=2))
        if self.arguments.moved is not None:
            yield Setting(
                "object moved in two views", frames=self._from(self.arguments.moved), own_poses=True
            )
        yield Setting("two views", frames=partial(_keep, num=2), own_poses=True)
        yield Setting("three views", frames=partial(_keep, num=3), own_poses=True)
        if self.other is not None:
            truth = ("--gt", str(self.other / "gt"))
            yield Setting("truth of another capture", partial(_given, truth))
            yield Setting("model of another capture", self._model_of_other)

    def _from(self, other: Path) -> Callable[[list[Path]], None]:
        """Puts two frames of another capture in the place of its own of these names."""

        def mix(frames: list[Path]) -> None:
            names = {path.name for path in (other / "raw").iterdir()}
            common = [frame for frame in frames if frame.name in names]
            for index in sorted({len(common) // 3, 2 * len(common) // 3}):
                shutil.copy(other / "raw" / common[index].name, common[index])

        return mix

    def _masks(
        self, change: Callable[[NDArray[np.uint8]], NDArray[np.uint8]], folder: Path
    ) -> tuple[str, ...]:
        truth = self.truth
        masks = np.stack([np.asarray(truth.mask(name), np.uint8) * 255 for name in self.names])
        for name, mask in zip(self.names, change(masks), strict=True):
            cv2.imwrite(str(folder / f"{Path(name).stem}.png"), mask)
        return ("--mask", str(folder))

    def _model(
        self, change: Callable[[View], View], folder: Path, index: int | None = None
    ) -> tuple[str, ...]:
        """The right run's model with one view changed, or all."""
        model = read_model(self.model)
        views = [
            change(view) if index is None or number == index else view
            for number, view in enumerate(model.views)
        ]
        write_model(replace(model, views=tuple(views)), folder / "model")
        return ("--sparse", str(folder / "model"))

    def _model_of_other(self, folder: Path) -> tuple[str, ...]:
        """The model that SfM finds of another capture."""
        assert self.other is not None
        camera = next(iter(open_ground_truth(self.other / "gt").views.values())).camera
        assert isinstance(camera, PinholeCamera)
        values = ",".join(map(str, (camera.fx, camera.fy, camera.cx, camera.cy)))
        subprocess.run(
            [
                *(sys.executable, "-m", "polmvs", "sfm", str(self.other), str(folder / "other")),
                *("--intrinsics", values),
            ],
            capture_output=True,
            check=True,
        )
        return ("--sparse", str(folder / "other" / "sparse"))

    def _farther(self, view: View) -> View:
        center = read_model(self.model).tracks.points_in_world.mean(axis=0)
        pose = view.cam_from_world
        moved = view.center_in_world + 0.04 * (view.center_in_world - center)
        return replace(
            view,
            cam_from_world=RigidTransform(pose.rotation, -np.asarray(pose.rotation) @ moved),
        )


def _flagged(name: str, *flags: str) -> Setting:
    return Setting(name, partial(_given, flags))


def _given(flags: Sequence[str], folder: Path) -> Sequence[str]:
    return flags


def _turned(view: View, degrees: float) -> View:
    turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    pose = view.cam_from_world
    return replace(
        view, cam_from_world=RigidTransform(turn @ pose.rotation, turn @ pose.translation)
    )


def _with_focal(view: View, factor: float) -> View:
    camera: Any = view.camera
    return replace(view, camera=replace(camera, fx=factor * camera.fx, fy=factor * camera.fy))


def _swap(frames: list[Path]) -> None:
    first, second = frames[1], frames[len(frames) // 2]
    content = first.read_bytes()
    shutil.copy(second, first)
    second.write_bytes(content)


def _duplicate(frames: list[Path]) -> None:
    shutil.copy(frames[1], frames[len(frames) // 2])


def _keep(frames: list[Path], num: int) -> None:
    for frame in frames[num:]:
        frame.unlink()


def _roll(masks: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.roll(masks, len(masks) // 2, axis=0)


def _shift(masks: NDArray[np.uint8]) -> NDArray[np.uint8]:
    shifted = np.zeros_like(masks)
    shifted[:, :, MASK_SHIFT_PX:] = masks[:, :, :-MASK_SHIFT_PX]
    return shifted


def _folder(settings: Settings, setting: Setting) -> Path:
    name = setting.name.replace(" ", "_").replace(",", "").replace("%", "pc")
    return settings.arguments.work / name


def _found(settings: Settings, setting: Setting) -> Found:
    """Run a setting, or read what came of it."""
    arguments = settings.arguments
    folder = _folder(settings, setting)
    stored = folder / "found.json"
    if stored.is_file():
        return Found(**json.loads(stored.read_text(encoding="utf-8")))
    shutil.rmtree(folder, ignore_errors=True)
    files = folder / "files"
    files.mkdir(parents=True)
    capture = settings.capture
    if setting.frames is not None:
        capture = folder / "capture"
        shutil.copytree(settings.capture / "raw", capture / "raw")
        setting.frames(sorted((capture / "raw").iterdir()))
    camera = settings.camera
    flags = list(setting.flags(files))
    if "--gt" not in flags:
        flags += ["--gt", str(settings.capture / "gt")]
    if not setting.own_poses and "--sparse" not in flags:
        flags += ["--sparse", str(settings.model)]
    if setting.own_poses and "--intrinsics" not in flags:
        values = (camera.fx, camera.fy, camera.cx, camera.cy)
        flags += ["--intrinsics", ",".join(map(str, values))]
    begun = time.perf_counter()
    done = subprocess.run(
        [
            *(sys.executable, "-m", "polmvs", "compare", str(capture), str(folder / "run")),
            *("--models", "ppa", "--no-report", "--json", "--overwrite"),
            *(*flags, *arguments.flags.split()),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    found = _read(setting.name, done, time.perf_counter() - begun)
    write_bytes(stored, json.dumps(asdict(found), indent=1).encode())
    return found


def _read(name: str, done: subprocess.CompletedProcess[str], seconds: float) -> Found:
    content: dict[str, Any] = json.loads(done.stdout) if done.stdout.strip() else {}
    truth = content.get("metrics", {}).get("models", {}).get("ppa", {}).get("truth") or {}
    cloud = truth.get("cloud") or {}
    score = cloud.get("f_score") or (float("nan"), float("nan"))

    def as_float(value: Any) -> float:
        return float("nan") if value is None else float(value)

    return Found(
        name=name,
        status=done.returncode,
        error=done.stderr.strip() if done.returncode else "",
        warnings=tuple(map(str, content.get("warnings", ()))),
        normal_deg=as_float(cloud.get("normal_median_deg")),
        f_1mm=as_float(score[0]),
        f_2mm=as_float(score[1]),
        seconds=seconds,
    )


def _judged(folder: Path) -> Trust | None:
    """What a run says of itself; None without a result."""
    try:
        return judge(RunFolder(folder / "run"))
    except PolmvsError:
        return None


def _outcome(found: Found, right: Found, trust: Trust | None) -> str:
    """Refused, harmless, named or silent."""
    if found.status:
        return "refused"
    normals, score = found.normal_deg - right.normal_deg, right.f_1mm - found.f_1mm
    if normals <= MAX_NORMAL_HARM_DEG and score <= MAX_F_HARM:
        return "harmless"
    new = set(found.warnings) - set(right.warnings)
    return "named" if new or trust is None or not trust.is_trusted else "silent"


def _cells(found: Found, right: Found, trust: Trust | None) -> tuple[str, ...]:
    verdict = () if trust is None else (trust.verdict,)
    said = found.error or " / ".join([*verdict, *found.warnings])
    return (
        found.name,
        f"{found.normal_deg:.2f}",
        f"{found.normal_deg - right.normal_deg:+.2f}",
        f"{100 * found.f_1mm:.1f}",
        f"{100 * (found.f_1mm - right.f_1mm):+.1f}",
        f"{100 * found.f_2mm:.1f}",
        _outcome(found, right, trust),
        "" if trust is None else "yes" if trust.is_trusted else "no",
        " ".join(said.replace("|", "/").split()),
    )


def _measure(call: Call, terminal: Terminal) -> int:
    arguments = call.get(Arguments)
    arguments.work.mkdir(parents=True, exist_ok=True)
    settings = Settings(arguments)
    wanted = [
        setting
        for setting in settings
        if arguments.only is None or setting.name in (RIGHT, *arguments.only)
    ]
    rows: list[tuple[str, ...]] = []
    right = None
    with terminal.stage("settings", len(wanted)) as on_progress:
        for setting in wanted:
            found = _found(settings, setting)
            right = right or found
            rows.append(_cells(found, right, _judged(_folder(settings, setting))))
            table = format_table(HEADER, rows)
            write_bytes(arguments.work / "table.md", (table + "\n").encode())
            terminal.say(" | ".join(rows[-1]))
            on_progress(1)
    terminal.show(table, rows)
    return 0


main = script(__file__, __doc__, _measure, (Arguments, TerminalOptions))

if __name__ == "__main__":
    raise SystemExit(main())
