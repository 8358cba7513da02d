"""A rendered capture, in folders for ``polmvs reconstruct`` and ``compare --gt``.

``OUT/raw/`` has the files of the sensor, ``OUT/camera.txt`` its intrinsics for ``--camera``,
``OUT/capture.toml`` the options of its samples for ``--config``, ``OUT/masks/`` optional masks,
``OUT/gt/`` the ground truth (:mod:`polmvs.simulation.truth`) with the mesh, ``OUT/simulation.json``
all options and derived values. The first file of a view in ``raw/`` is written last: a view that
has it is finished, and ``resume`` continues after it.
"""

from __future__ import annotations

import logging
import shutil
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from polmvs._version import __version__
from polmvs.arrays import Array
from polmvs.camera import pixel_centers
from polmvs.config import to_plain
from polmvs.errors import DataError, OptionError, as_data_error
from polmvs.geometry import RigidTransform
from polmvs.io.clouds import Mesh, write_mesh
from polmvs.io.ground_truth import depth_unit
from polmvs.io.images import write_bytes, write_mask, write_png
from polmvs.io.intrinsics import write_intrinsics
from polmvs.io.plain_files import read_text
from polmvs.io.typed_json import parse_json, write_json
from polmvs.parallel import OnProgress, no_progress
from polmvs.polarization.mosaic import ANGLES_DEG
from polmvs.scene import View, short_list, stem_of
from polmvs.simulation.camera_model import (
    camera_of,
    lens_of,
    object_distance,
    pinhole_of,
    polarization_intrinsics,
)
from polmvs.simulation.camera_path import camera_views
from polmvs.simulation.irradiance import bake
from polmvs.simulation.lights import environment
from polmvs.simulation.marks import Marks, marks_at, marks_on
from polmvs.simulation.materials import material_of, varnish_of
from polmvs.simulation.mesh_input import PLACES, ObjectMesh, object_mesh
from polmvs.simulation.options import (
    LightName,
    ObjectOptions,
    Scenery,
    SensorKind,
    SensorOptions,
    Simulation,
    SimulationRun,
)
from polmvs.simulation.picture import Picture, expose_picture, render_picture
from polmvs.simulation.renderer_import import Renderer, import_renderer
from polmvs.simulation.scene import MitsubaScene, SceneDescription, build_scene
from polmvs.simulation.sensor import Channels, draw_channels, stated_sigma
from polmvs.simulation.surroundings import TABLE_SIDE, surroundings
from polmvs.simulation.truth import CAMERAS_FILE, true_maps, write_cameras, write_truth

logger = logging.getLogger(__name__)


RECORD = "simulation.json"
FILLED = 0.8  # of the image's smaller side by the object's circumscribed sphere
METERED_VIEWS = 4  # views for the exposure
METERED_STEP = 13  # samples between two that are metered; coprime with the mosaic's cell
METERED_PERCENTILE, METERED_LEVEL = 99.0, 0.85  # of the light, and its level in full scales
CHECKED_SIDE = 96  # px, size of the images that check the views before rendering
MIN_SEEN = 50  # px of these that must show the object: 0.5 %
MOVING_SHARE = 4  # by which directions are fewer where light is baked for each view


@dataclass(frozen=True, kw_only=True)
class SimulatedView:
    """Statistics of a finished view.

    Attributes
    ----------
    rays : mean number of rays of a sample of the file.
    noise : median over the samples of the rendering's noise over the sensor's.
    noisier : share of the samples whose rendering is noisier than required.
    """

    rays: float
    noise: float
    noisier: float


@dataclass(frozen=True, kw_only=True)
class SimulatedCapture:
    """A finished capture.

    Attributes
    ----------
    folder : of it.
    views : by name, rendered by this call.
    num_views : of the whole capture.
    exposure : full scales for each unit of radiance.
    variant : Mitsuba's.
    """

    folder: Path
    views: dict[str, SimulatedView]
    num_views: int
    exposure: float
    variant: str

    @property
    def lines(self) -> tuple[str, ...]:
        """Lines of text for the terminal."""
        lines = [
            f"{self.folder}: {self.num_views} views, raw/, gt/, camera.txt; Mitsuba {self.variant}"
        ]
        if self.views:
            rays = np.mean([view.rays for view in self.views.values()])
            noise = np.median([view.noise for view in self.views.values()])
            noisier = np.mean([view.noisier for view in self.views.values()])
            lines.append(
                f"{rays:.0f} rays a sample; noise of the rendering {noise:.2f} of the sensor's "
                f"(median), above the limit in {100 * noisier:.1f} % of the samples"
            )
        return tuple(lines)


def simulate_capture(
    mesh: str | Path | Mesh,
    out: Path,
    simulation: Simulation,
    run: SimulationRun,
    *,
    on_progress: OnProgress = no_progress,
) -> SimulatedCapture:
    """Render a capture.

    Parameters
    ----------
    mesh : file of the object or name of a built-in shape.
    out : folder of the capture.
    simulation : what is rendered.
    run : whether to replace or continue an earlier capture.
    on_progress : called for each view.

    Raises
    ------
    DataError, OptionError
        A file is unusable, options contradict each other, or a view sees nothing.
    """
    options = simulation.for_preview() if simulation.rendering.preview else simulation
    plan = _Plan.make(mesh, options)
    record = {"version": __version__, "mesh": plan.mesh.source, **to_plain(asdict(options))}
    finished = _open_folder(out, record, run)
    whole = _whole(out, plan, finished)
    if whole is not None:
        on_progress(len(plan.views))
        return whole
    renderer = import_renderer(
        colour=options.sensor.colour is not None, variant=options.rendering.variant
    )
    studio = _Studio(renderer, plan)
    studio.check_views()
    exposure = options.sensor.exposure or studio.metered_exposure()
    if run.overwrite and out.exists():  # when nothing stands in the way of another any more
        with as_data_error(out, "removed"):
            shutil.rmtree(out)
    found_here = {"variant": renderer.variant, "exposure": exposure}
    _write_head(out, plan, {**record, **found_here, "channels": asdict(plan.channels)})
    found: dict[str, SimulatedView] = {}
    for index, view in enumerate(plan.views):
        if view.name not in finished:
            found[view.name] = _write_view(out, studio, index, exposure)
        on_progress(1)
    # Written last: it completes the ground truth.
    write_cameras(out / "gt", plan.views, depth_unit_m=plan.depth_unit_m)
    return SimulatedCapture(
        folder=out,
        views=found,
        num_views=len(plan.views),
        exposure=exposure,
        variant=renderer.variant,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Plan:
    """All that is decided before anything is rendered."""

    options: Simulation
    mesh: ObjectMesh
    size: float
    target: Array
    views: list[View]
    description: SceneDescription
    channels: Channels

    @property
    def depth_unit_m(self) -> float:
        """Of the true depth maps: all of the table fits."""
        away = [float(np.linalg.norm(view.center_in_world - self.target)) for view in self.views]
        return depth_unit(max(away) + np.sqrt(0.5) * TABLE_SIDE * self.size)

    @classmethod
    def make(cls, source: str | Path | Mesh, options: Simulation) -> _Plan:
        """Read the inputs and place everything.

        Raises
        ------
        DataError, OptionError
            It cannot be used.
        """
        _require_compatible(options)
        material = material_of(options.object)
        sky = environment(options.lighting)
        intrinsics = polarization_intrinsics(options.sensor)
        camera = camera_of(intrinsics)
        mesh = object_mesh(source, options.object)
        vertices = mesh.mesh.vertices
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        size = float((high - low).max())
        if high[2] <= low[2] and options.scenery.surroundings is not Scenery.NOTHING:
            raise DataError(
                mesh.source,
                "is flat, so it would lie within the table. Turn it upright, give it a thickness, "
                "or set `scenery.surroundings` to nothing.",
            )
        target = 0.5 * (low + high)
        seed = options.rendering.seed
        pinhole = pinhole_of(camera)
        half_field = np.arctan(
            0.5 * FILLED * min(camera.height / pinhole.fy, camera.width / pinhole.fx)
        )
        reach = float(np.linalg.norm(vertices - target, axis=1).max())
        distance = options.path.distance or reach / float(np.sin(half_field))
        description = SceneDescription(
            part=mesh.mesh,
            material=material,
            vertex_albedo=None if options.object.albedo is not None else mesh.vertex_albedo,
            marks=_marks(mesh.mesh, options.object, size, seed),
            surroundings=surroundings(
                options.scenery,
                size,
                float(np.linalg.norm(vertices[:, :2], axis=1).max()),
                seed,
            ),
            varnish=varnish_of(options.scenery),
            environment=sky,
            colour=options.sensor.colour is not None,
        )
        return cls(
            options=options,
            mesh=mesh,
            size=size,
            target=target,
            views=camera_views(options.path, camera, target, distance, seed),
            description=description,
            channels=draw_channels(options.sensor, seed),
        )


def _marks(mesh: Mesh, options: ObjectOptions, size: float, seed: int) -> Marks:
    diameter = options.mark_size * size
    if options.mark_places is not None:
        return marks_at(mesh, options.mark_places, diameter, seed)
    return marks_on(mesh, options.marks, diameter, seed)


class _Studio:
    """The scene with its light, rebuilt for each view only if the light moves with it."""

    def __init__(self, renderer: Renderer, plan: _Plan) -> None:
        self.renderer, self.plan = renderer, plan
        options = plan.options
        self.moves = options.scenery.turntable or options.lighting.light is LightName.RING
        self._fixed: MitsubaScene | None = None

    def scene(self, view: View) -> MitsubaScene:
        """The scene as it is lit in a view."""
        options = self.plan.options
        if not self.moves:
            if self._fixed is None:
                self._fixed = self._lit(options.rendering.directions, 0.0, None)
            return self._fixed
        turn = 0.0
        if options.scenery.turntable:
            # Camera and light stand still together: the light turns with the camera.
            x, y = (view.center_in_world - self.plan.target)[:2]
            turn = float(np.arctan2(y, x))
        ring = None
        if options.lighting.light is LightName.RING:
            ring = (view.cam_from_world, object_distance(view, self.plan.target))
        return self._lit(max(4, options.rendering.directions // MOVING_SHARE), turn, ring)

    def _lit(
        self, directions: int, turn: float, ring: tuple[RigidTransform, float] | None
    ) -> MitsubaScene:
        scene = build_scene(self.renderer, self.plan.description, turn=turn, ring=ring)
        if self.renderer.is_scalar:  # its path tracer finds the light anew for each ray
            return scene
        bake(
            scene,
            bounces=self.plan.options.lighting.bounces,
            samples=directions,
            spacing=self.plan.size / PLACES,
            seed=self.plan.options.rendering.seed,
        )
        return scene

    def check_views(self) -> None:
        """Refuse cameras in the object, and those that see nothing of it.

        Raises
        ------
        OptionError
            Which they are.
        """
        scene = build_scene(self.renderer, self.plan.description)
        inside, blind = [], []
        for view in self.plan.views:
            pinhole = pinhole_of(view.camera)
            scale = CHECKED_SIDE / max(pinhole.width, pinhole.height)
            small = replace(
                pinhole,
                width=max(8, round(pinhole.width * scale)),
                height=max(8, round(pinhole.height * scale)),
                fx=pinhole.fx * scale,
                fy=pinhole.fy * scale,
                cx=pinhole.cx * scale,
                cy=pinhole.cy * scale,
            )
            checked = replace(view, camera=small)
            _, normals, mask = true_maps(scene, checked)
            rays = small.rays(pixel_centers(small.width, small.height))
            away = (normals * rays).sum(axis=-1) > 0
            if mask.sum() < MIN_SEEN:
                blind.append(view.name)
            elif (away & mask).sum() > 0.5 * mask.sum():
                inside.append(view.name)
        for names, what in (
            (inside, "look at the object from inside, or at the backs of its faces"),
            (blind, "see nothing of it"),
        ):
            if names:
                raise OptionError(
                    f"there are views that {what}: {short_list(names)}. Change "
                    "`path.distance`, `path.elevation` or `path.cameras`."
                )

    def metered_exposure(self) -> float:
        """Full scales for each unit of radiance that suit all views."""
        plan = self.plan
        step = max(1, len(plan.views) // METERED_VIEWS)
        levels = []
        for index in range(0, len(plan.views), step):
            scene = self.scene(plan.views[index])
            picture = self.render(scene, index, np.inf, step=METERED_STEP)
            stokes = picture.stokes.reshape(-1, 3)[::METERED_STEP]
            levels.append(0.5 * (stokes[:, 0] + np.hypot(stokes[:, 1], stokes[:, 2])))
        level = float(np.percentile(np.concatenate(levels), METERED_PERCENTILE))
        if not level > 0:
            raise OptionError(
                "is too dark to expose for; give `sensor.exposure`.", field="lighting.light"
            )
        return float(f"{(METERED_LEVEL - plan.options.sensor.black_level) / level:.4g}")

    def render(self, scene: MitsubaScene, index: int, exposure: float, *, step: int = 1) -> Picture:
        """One view, or each such sample of it."""
        plan = self.plan
        view = plan.views[index]
        seed = plan.options.rendering.seed * 100_003 + index
        distance = object_distance(view, plan.target)
        lens = lens_of(plan.options.sensor, view.camera, distance, seed)
        return render_picture(
            scene, view, lens, plan.options, plan.channels, exposure, seed=seed, step=step
        )


def _require_compatible(options: Simulation) -> None:
    """Refuse options of two groups that contradict each other."""
    even = options.lighting.light in (LightName.EVEN, LightName.RING)
    if even and options.lighting.contrast is not None:
        raise OptionError(
            f"is of a light that varies, and {options.lighting.light} does not.",
            field="lighting.contrast",
        )


def _open_folder(out: Path, record: dict[str, Any], run: SimulationRun) -> set[str]:
    """Names of the views that are finished in a folder; none where it is to be replaced.

    Raises
    ------
    DataError, OptionError
        It holds something else.
    """
    if out.exists() and not out.is_dir():
        raise DataError(out, "exists and is no folder. Choose another name.")
    old = out / RECORD
    if not out.exists() or not any(out.iterdir()):
        return set()
    if not old.is_file():
        raise DataError(
            out, f"exists and is no simulated capture (it has no {RECORD}). Choose another folder."
        )
    if run.overwrite:
        return set()
    if not run.resume:
        raise OptionError(
            f"{out}: exists. Give `run.resume` to go on with it or `run.overwrite` to replace it."
        )
    try:
        earlier = parse_json(read_text(old))
    except (OSError, ValueError) as error:
        raise DataError(old, "cannot be read. Give `run.overwrite`.") from error
    wanted = to_plain(record)
    changed = [
        f"{group}.{name}" if isinstance(wanted[group], dict) else group
        for group in wanted
        for name in (wanted[group] if isinstance(wanted[group], dict) else (group,))
        if _entry(earlier, group, name) != _entry(wanted, group, name)
    ]
    if changed:
        raise OptionError(
            f"{out}: was begun with other options ({', '.join(changed[:5])}). Give the same, "
            "another folder, or `run.overwrite`."
        )
    return {path.name for path in (out / "raw").glob("*.png")} | {
        path.name.replace(f"_{ANGLES_DEG[0]:03d}.png", ".png")
        for path in (out / "raw").glob("*.png")
    }


def _whole(out: Path, plan: _Plan, finished: set[str]) -> SimulatedCapture | None:
    """The capture of the folder where nothing of it is missing; else None."""
    missing = any(view.name not in finished for view in plan.views)
    if missing or not (out / "gt" / CAMERAS_FILE).is_file():
        return None
    try:
        record: Any = parse_json(read_text(out / RECORD))
        exposure, variant = float(record["exposure"]), str(record["variant"])
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(out / RECORD, "is damaged. Give `run.overwrite`.") from error
    return SimulatedCapture(
        folder=out, views={}, num_views=len(plan.views), exposure=exposure, variant=variant
    )


def _entry(record: Any, group: str, name: str) -> Any:
    value = record.get(group) if isinstance(record, dict) else None
    return value.get(name) if isinstance(value, dict) else value


def _write_head(out: Path, plan: _Plan, record: dict[str, Any]) -> None:
    """Write the files of a capture other than its views."""
    options = plan.options
    with as_data_error(out, "written"):
        for folder in (out / "raw", out / "gt"):
            folder.mkdir(parents=True, exist_ok=True)
        if options.rendering.masks:
            (out / "masks").mkdir(exist_ok=True)
    write_json(out / RECORD, record)  # first: by it the folder is known
    intrinsics = polarization_intrinsics(options.sensor)
    write_intrinsics(out / "camera.txt", intrinsics, "of the polarization images")
    write_bytes(out / "capture.toml", _capture_table(options.sensor).encode())
    write_mesh(out / "gt" / "mesh.ply", plan.mesh.mesh)


def _capture_table(sensor: SensorOptions) -> str:
    """The table of options that the capture's files need."""
    lines = ["[capture]"]
    if sensor.sensor is SensorKind.MOSAIC:
        lines.append(f"pattern = {list(sensor.pattern)}")
    lines.append(f"full_scale = {float(2**sensor.bits - 1)}")
    if sensor.colour is not None:
        lines.append(f'bayer = "{sensor.colour}"')
    return "\n".join(lines) + "\n"


def _write_view(out: Path, studio: _Studio, index: int, exposure: float) -> SimulatedView:
    """Render one view and write its files, that of the sensor last."""
    plan = studio.plan
    options, view = plan.options, plan.views[index]
    scene = studio.scene(view)
    picture = studio.render(scene, index, exposure)
    maps = true_maps(scene, view)
    write_truth(out / "gt", view, maps, picture, depth_unit_m=plan.depth_unit_m)
    if options.rendering.masks:
        write_mask(out / "masks" / view.name, maps[2])
    rng = np.random.default_rng([options.rendering.seed, 3, index])
    files = expose_picture(picture, view, options.sensor, plan.channels, exposure, rng)
    names = [view.name]
    if options.sensor.sensor is SensorKind.FILTER:
        names = [f"{stem_of(view.name)}_{angle:03d}.png" for angle in ANGLES_DEG]
    for name, image in reversed(list(zip(names, files, strict=True))):
        write_png(out / "raw" / name, image)
    light = 0.5 * picture.stokes[..., 0]
    ratio = picture.sigma / stated_sigma(light, options.sensor, exposure)
    return SimulatedView(
        rays=float(picture.rays.mean()),
        noise=float(np.median(ratio)),
        noisier=float((ratio > 1.5 * options.rendering.noise).mean()),
    )
