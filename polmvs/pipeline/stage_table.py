"""The stage table: every stage of a run, its files, and the options that decide its result.

A run derives all from :func:`stage_table`: the order of the stages, which of them a command runs,
which are stale when another runs again, which files belong to them, and when a finished one may be
reused. A new stage is one entry here and one file in ``stages/``.

A stage reads files of other stages, and options. It writes files that no other stage writes. The
function of an entry passes only the run's folder and options to a stage.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from polmvs.config import (
    Method,
    Options,
    SfmOptions,
    option_paths,
)
from polmvs.evaluation.comparison import SparseFigures
from polmvs.evaluation.trust import Trust
from polmvs.memory import MemoryNeeds
from polmvs.parallel import OnProgress, Workers, no_progress
from polmvs.pipeline.record import Record
from polmvs.pipeline.run_folder import HERE, LOG_FILE, RUN_FILE, RunFolder
from polmvs.pipeline.stages import (
    box,
    dense_workspace,
    densify,
    evaluation,
    images,
    maps,
    mesh,
    normals,
    poses,
    seeds,
    sfm,
    silhouettes,
    sparse_cloud,
    trust,
)
from polmvs.polarization.capture import Capture
from polmvs.polarization.kinds import AngleModel
from polmvs.scene import SparseModel

# Commands that run single stages, by stage; no command runs the stages of ``compare`` alone.
SFM, NORMALS, DENSIFY, FINISH, COMPARE = "sfm", "normals", "densify", "finish", "compare"
WITHOUT = "sfm.without"
TILT_AWARE = "normals.tilt_aware_weights"
CROPPING = ("crop", "reference.aruco")


@dataclass(kw_only=True)
class StageInput:
    """Input of a stage from the run.

    Attributes
    ----------
    run_folder, capture, options, workers : of the run.
    max_rows : rows of points and views from which normals are solved at a time.
    given_model : the sparse model of the options, fitted to the capture.
    record : the finished stages, as in ``run.json``.
    on_progress : called with the steps of the current stage.
    """

    run_folder: RunFolder
    capture: Capture
    options: Options
    workers: Workers
    max_rows: int = MemoryNeeds().max_rows
    given_model: SparseModel | None
    record: Record
    on_progress: OnProgress = no_progress

    @property
    def num_views(self) -> int:
        """Images with a pose."""
        return self.record.result(poses.PosesResult).num_views


@dataclass(frozen=True, kw_only=True)
class StageSpec:
    """One stage of a run.

    Attributes
    ----------
    name : in ``run.json``.
    command : the command that runs it alone.
    angle_model : its angle model; None for stages of all models.
    reads, writes : files and folders of other stages and of this one, as paths in the run folder.
    decides : paths of the options that decide its result; a group's name stands for all of its.
    work : function that does the work and returns the result.
    result : type of the result; no other stage of the same angle model has it.
    num_steps : number of steps that it will report; None if unknown.
    is_wanted : whether the options ask for it, if a command may skip it.
    call : function that does the work in its own process; None if the stage uses workers itself or
        is too short. Consecutive stages with a call run in parallel.
    is_redone : whether a change of its options makes it run again instead of an error: for quick
        stages from which no other stage is made.
    """

    name: str
    command: str
    angle_model: AngleModel | None = None
    reads: tuple[Path, ...] = ()
    writes: tuple[Path, ...]
    decides: tuple[str, ...] = ()
    work: Callable[[StageInput], Any]
    result: type
    num_steps: Callable[[StageInput], int | None] = lambda run: None
    is_wanted: Callable[[Options], bool] = lambda options: True
    call: Callable[[StageInput], Callable[[], Any] | None] = lambda run: None
    is_redone: bool = False


# What the stages that take more than a line are given


def _find_model(run: StageInput) -> sfm.SfmResult:
    folder, options = run.run_folder, run.options.sfm
    if run.given_model is not None and options.sparse is not None:
        return sfm.take_model(run.given_model, options.sparse, folder.sfm)
    names = list(images.image_names(run.capture))
    return sfm.find_model(folder.images, names, folder.sfm, options, on_progress=run.on_progress)


def _densify_apart(model: AngleModel, run: StageInput) -> Callable[[], Any] | None:
    """The surface of all views is one process's work, the views one by one are many's."""
    whole = run.options.propagation.method is Method.SURFACE
    return partial(densify.densify, model, run.run_folder, run.options) if whole else None


def _write_workspace(model: AngleModel, run: StageInput) -> dense_workspace.DenseWorkspaceResult:
    folder, given = run.run_folder, run.options.fusion.workspace
    if run.record.result(densify.DensifyResult, model).num_points == 0:
        return dense_workspace.DenseWorkspaceResult(folder=None)
    if given is None:
        return dense_workspace.write_workspace(model, folder)
    in_place = run.options.export.in_place
    return dense_workspace.fill_given(model, folder, given, in_place=in_place)


def _evaluate(models: Sequence[AngleModel], run: StageInput) -> evaluation.EvaluationResult:
    comparison = evaluation.evaluate_models(
        run.capture,
        sparse_figures(run.record),
        run.run_folder,
        models,
        run.options.evaluation.gt,
        workers=run.workers,
    )
    return evaluation.write_comparison(comparison, run.run_folder.metrics, run.run_folder.summary)


def sparse_figures(record: Record) -> SparseFigures:
    """Numbers of the input that all models of a run share."""
    found, chosen = record.result(poses.PosesResult), record.result(seeds.SeedsResult)
    return SparseFigures(
        num_views=found.num_views,
        unregistered=found.unregistered,
        num_tracks=found.num_tracks,
        num_seeds=chosen.num_seeds,
    )


# The table


# Stages that all angle models share, up to their phase maps.
COMMON_STAGES = (
    StageSpec(
        name="images",
        command=SFM,
        writes=(HERE.images,),
        decides=("capture",),
        work=lambda run: images.write_images(
            run.capture,
            run.run_folder.images,
            workers=run.workers,
            on_progress=run.on_progress,
        ),
        result=images.ImagesResult,
        num_steps=lambda run: len(run.capture.names),
    ),
    StageSpec(
        name="sfm",
        command=SFM,
        reads=(HERE.images,),
        writes=(HERE.sfm,),
        decides=tuple(path for path in option_paths(SfmOptions) if path != WITHOUT),
        work=_find_model,
        result=sfm.SfmResult,
        num_steps=lambda run: None if run.given_model else sfm.NUM_SFM_STEPS,
    ),
    StageSpec(
        name="poses",
        command=SFM,
        reads=(HERE.images, HERE.sfm),
        writes=(HERE.sparse, HERE.camera_modes, HERE.pose_covariances),
        decides=("reference", WITHOUT),
        work=lambda run: poses.place_model(
            run.run_folder,
            images.image_names(run.capture),
            run.options.reference,
            run.options.sfm.without,
        ),
        result=poses.PosesResult,
    ),
    StageSpec(
        name="box",
        command=NORMALS,
        reads=(HERE.images, HERE.sparse),
        writes=(),
        decides=CROPPING,
        work=lambda run: box.check_box(
            run.run_folder, run.options.crop, run.options.reference.aruco
        ),
        result=box.BoxResult,
        is_wanted=lambda options: options.crop.box is not None,
        is_redone=True,
    ),
    StageSpec(
        name="maps",
        command=NORMALS,
        reads=(HERE.sparse,),
        writes=(HERE.maps(AngleModel.PPA),),
        decides=("capture", "region"),
        work=lambda run: maps.build_maps(
            run.capture,
            run.run_folder,
            run.options.region,
            max_rows=run.max_rows,
            workers=run.workers,
            on_progress=run.on_progress,
        ),
        result=maps.MapsResult,
        num_steps=lambda run: run.num_views,
    ),
    StageSpec(
        name="maps_tilted",
        command=NORMALS,
        angle_model=AngleModel.TILTED,
        reads=(HERE.sparse, HERE.maps(AngleModel.PPA)),
        writes=(HERE.maps(AngleModel.TILTED),),
        work=lambda run: maps.tilt_maps(
            run.run_folder, workers=run.workers, on_progress=run.on_progress
        ),
        result=maps.TiltedMapsResult,
        num_steps=lambda run: run.num_views,
    ),
    StageSpec(
        name="silhouettes",
        command=NORMALS,
        reads=(HERE.sparse, HERE.maps(AngleModel.PPA)),
        writes=(HERE.silhouettes,),
        decides=("region.mask",),
        work=lambda run: silhouettes.find_silhouettes(
            run.run_folder,
            masks_given=run.options.region.mask is not None,
            workers=run.workers,
            on_progress=run.on_progress,
        ),
        result=silhouettes.SilhouettesResult,
        num_steps=lambda run: run.num_views,
    ),
)
# The seeds are chosen by the normals of PPA for all angle models.
SEEDS_STAGE = StageSpec(
    name="seeds",
    command=NORMALS,
    reads=(HERE.sparse, HERE.maps(AngleModel.PPA), HERE.track_normals(AngleModel.PPA)),
    writes=(HERE.seeds,),
    work=lambda run: seeds.find_seeds(run.run_folder),
    result=seeds.SeedsResult,
)


def _evaluation_stage(compared: tuple[AngleModel, ...]) -> StageSpec:
    """The measures of several models together."""
    return StageSpec(
        name="evaluation",
        command=COMPARE,
        reads=(
            HERE.sparse,
            HERE.seeds,
            # PPA's once: OPA's are the same, and all are measured with them.
            *dict.fromkeys(HERE.maps(model) for model in (AngleModel.PPA, *compared)),
            *(HERE.sparse_cloud(model) for model in compared),
            *(HERE.cloud(model) for model in compared),
            *(HERE.views(model) for model in compared),
        ),
        writes=(HERE.metrics, HERE.summary),
        decides=("evaluation",),
        work=partial(_evaluate, compared),
        result=evaluation.EvaluationResult,
        is_redone=True,
    )


def _stages_to_cloud(model: AngleModel) -> list[StageSpec]:
    """The stages of an angle model up to its dense cloud."""
    track_normals = HERE.track_normals(model)
    return [
        StageSpec(
            name=f"normals_{model}",
            command=NORMALS,
            angle_model=model,
            reads=(HERE.sparse, HERE.maps(model)),
            writes=(track_normals,),
            decides=("normals.estimator", "normals.window_px", "region.light", TILT_AWARE),
            work=lambda run: normals.solve_track_normals(
                model,
                run.run_folder,
                run.options.normals,
                run.options.region.light,
                max_rows=run.max_rows,
            ),
            result=normals.NormalsResult,
        ),
        StageSpec(
            name=f"sparse_cloud_{model}",
            command=NORMALS,
            angle_model=model,
            reads=(HERE.sparse, track_normals, HERE.seeds),
            writes=(HERE.sparse_cloud(model),),
            work=lambda run: sparse_cloud.write_sparse_cloud(model, run.run_folder),
            result=sparse_cloud.SparseCloudResult,
        ),
        StageSpec(
            name=f"densify_{model}",
            command=DENSIFY,
            angle_model=model,
            reads=(
                *(HERE.sparse, HERE.camera_modes, HERE.pose_covariances, HERE.images),
                *(HERE.maps(model), HERE.silhouettes, track_normals, HERE.seeds),
            ),
            writes=(HERE.cloud(model), HERE.views(model)),
            decides=(TILT_AWARE, "region.light", "region.mask", "propagation", "fusion", *CROPPING),
            work=lambda run: densify.densify(
                model,
                run.run_folder,
                run.options,
                workers=run.workers,
                on_progress=run.on_progress,
            ),
            call=partial(_densify_apart, model),
            result=densify.DensifyResult,
            num_steps=lambda run: densify.num_densify_steps(run.num_views, run.options.propagation),
        ),
    ]


def _stages_from_cloud(model: AngleModel) -> list[StageSpec]:
    """The stages that use the dense cloud of an angle model."""
    cloud, views = HERE.cloud(model), HERE.views(model)
    return [
        StageSpec(
            name=f"trust_{model}",
            command=FINISH,
            angle_model=model,
            reads=(
                HERE.sfm,
                HERE.sparse,
                HERE.maps(model),
                HERE.silhouettes,
                HERE.sparse_cloud(model),
                HERE.track_normals(model),
                HERE.seeds,
                cloud,
                views,
            ),
            writes=(),
            decides=("region.light", TILT_AWARE),
            work=lambda run: trust.find_trust(model, run.run_folder, run.record, run.options),
            result=Trust,
        ),
        StageSpec(
            name=f"mesh_{model}",
            command=FINISH,
            angle_model=model,
            reads=(cloud, views),
            writes=(HERE.mesh(model),),
            work=lambda run: mesh.make_mesh(model, run.run_folder),
            result=mesh.MeshResult,
            is_wanted=lambda options: options.export.mesh,
        ),
        StageSpec(
            name=f"dense_{model}",
            command=FINISH,
            angle_model=model,
            reads=(HERE.sparse, HERE.images, cloud, views),
            writes=(HERE.dense(model),),
            decides=("fusion.workspace", "export.in_place"),
            work=partial(_write_workspace, model),
            result=dense_workspace.DenseWorkspaceResult,
            is_wanted=lambda options: options.export.colmap,
        ),
    ]


@lru_cache(maxsize=32)
def stage_table(compared: tuple[AngleModel, ...] = tuple(AngleModel)) -> tuple[StageSpec, ...]:
    """All stages, each after those whose files it reads.

    Parameters
    ----------
    compared : angle models to evaluate.
    """
    table = list(COMMON_STAGES)
    for stages in (_stages_to_cloud, _stages_from_cloud):
        for same_kind in zip(*map(stages, AngleModel), strict=True):
            table += same_kind
    return in_order([*table, SEEDS_STAGE, _evaluation_stage(compared)])


# What follows from it


def in_order(table: Sequence[StageSpec]) -> tuple[StageSpec, ...]:
    """Stages sorted so that each follows those it reads from, otherwise in their listed order."""
    written = {path for spec in table for path in spec.writes}
    waiting, done, ordered = list(table), set[Path](), list[StageSpec]()
    while waiting:
        ready = next((s for s in waiting if done.issuperset(written.intersection(s.reads))), None)
        if ready is None:
            raise ValueError(f"stages read in a circle: {[spec.name for spec in waiting]}")
        waiting.remove(ready)
        ordered.append(ready)
        done.update(ready.writes)
    return tuple(ordered)


def needed_by(spec: StageSpec, table: Sequence[StageSpec]) -> list[StageSpec]:
    """The stages whose files a stage reads, in order."""
    return [other for other in table if set(other.writes) & set(spec.reads)]


def with_needed(names: Iterable[str], table: Sequence[StageSpec]) -> list[StageSpec]:
    """Stages and all stages that they need, directly or indirectly, in order."""
    wanted = set(names)
    for spec in reversed(table):  # what is needed comes before
        if spec.name in wanted:
            wanted.update(other.name for other in needed_by(spec, table))
    return [spec for spec in table if spec.name in wanted]


def with_dependent(names: Iterable[str], table: Sequence[StageSpec]) -> list[StageSpec]:
    """Stages and all stages made from their files, directly or indirectly, in order."""
    stale = set(names)
    for spec in table:
        if any(other.name in stale for other in needed_by(spec, table)):
            stale.add(spec.name)
    return [spec for spec in table if spec.name in stale]


def result_types() -> dict[str, type]:
    """Type of the result of each stage by its name."""
    return {spec.name: spec.result for spec in stage_table()}


def written_names() -> tuple[str, ...]:
    """Names of all files and folders that a run may write in its folder, the record last."""
    names = [path.parts[0] for spec in stage_table() for path in spec.writes]
    beside = (HERE.report.name, HERE.deviation.name, LOG_FILE, RUN_FILE)
    return (*dict.fromkeys(names), *beside)
