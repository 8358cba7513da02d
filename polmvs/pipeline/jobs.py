"""The jobs: reconstruct, compare, and single stages; the stage table says what each runs."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from itertools import groupby

from polmvs.errors import DataError, OptionError
from polmvs.evaluation.comparison import Comparison, read_comparison
from polmvs.evaluation.trust import Trust
from polmvs.parallel import Workers
from polmvs.pipeline.record import Record
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.runner import Job, Run, load_run, open_run
from polmvs.pipeline.stage_table import (
    COMPARE,
    DENSIFY,
    FINISH,
    NORMALS,
    SFM,
    StageSpec,
    sparse_figures,
    stage_table,
    with_needed,
)
from polmvs.pipeline.stages.densify import DensifyResult
from polmvs.pipeline.stages.evaluation import evaluate_models
from polmvs.pipeline.stages.maps import MapsResult
from polmvs.pipeline.stages.poses import PosesResult
from polmvs.pipeline.stages.seeds import SeedsResult
from polmvs.pipeline.stages.trust import find_trust
from polmvs.polarization.capture import open_capture
from polmvs.polarization.kinds import COMPARED_MODELS, AngleModel
from polmvs.scene import MIN_VIEWS, short_list

logger = logging.getLogger(__name__)

MIN_SFM_IMAGES = 2
MAX_REJECTIONS = 2  # rounds in which views are removed from the model

NO_REGION = (
    "no polarized region: no view shows a surface with polarized light. Lower `region.min_dolp`, "
    "check `capture.pattern` and `capture.gamma`, or give the part with `region.mask`."
)
NO_SEEDS = (
    "no seeds: no sparse point lies on the polarized surface with a normal that fits its light, "
    "and silhouettes place no surface. Put a few printed marks or labels on the part, check "
    "`region.light`, or give the part with `region.mask`."
)
TOO_MANY_VIEWS = (
    "no points: `fusion.min_views` asks for more views to confirm a point than have a pose. Give "
    "less, or better poses."
)
NO_POINTS = (
    "no points: the views agree on none. Check `sfm.intrinsics` or `sfm.sparse` and "
    "`region.light`, or record more views."
)


@dataclass(frozen=True, kw_only=True)
class JobOutcome:
    """Outcome of a job.

    Attributes
    ----------
    run_folder : folder of the results.
    record : all finished stages with their results.
    empty : why a dense cloud has no points, and the remedy; None if no cloud is empty.
    comparison : metrics of the models, of :func:`compare`.
    """

    run_folder: RunFolder
    record: Record
    empty: str | None = None
    comparison: Comparison | None = None


def reconstruct(job: Job, model: AngleModel = AngleModel.PPA) -> JobOutcome:
    """Run all stages with one model; the cloud is ``OUT/ppa.ply`` or that of another model.

    Raises
    ------
    PolmvsError
        The input is unusable or a stage fails; finished stages stay in the run folder.
    """
    job = _with_poses_of_workspace(job)
    last = _of_models((NORMALS, DENSIFY, FINISH), (model,), stage_table())
    with _open(job, last) as run:
        _do_all(run, last)
        _take_out_rejected(run, last, (model,))
        return _close(run, (model,))


def compare(job: Job, models: Sequence[AngleModel] = COMPARED_MODELS) -> JobOutcome:
    """Run several models on the same poses, tracks, seeds and region; write ``OUT/metrics.json``.

    Raises
    ------
    PolmvsError
        As :func:`reconstruct`.
    """
    job = _with_poses_of_workspace(job)
    table = stage_table(tuple(models))
    last = _of_models((NORMALS, DENSIFY, COMPARE), models, table)
    with _open(job, last, table=table) as run:
        _do_all(run, last)
        _take_out_rejected(run, last, models)
        outcome = _close(run, models)
    return replace(outcome, comparison=read_comparison(outcome.run_folder.metrics))


def find_poses(job: Job) -> JobOutcome:
    """Run SfM alone: ``OUT/images`` and ``OUT/sparse``."""
    last = _of_models((SFM,), (), stage_table())
    with _open(job, last, min_images=MIN_SFM_IMAGES) as run:
        _do_all(run, last)
        return _close(run, ())


def solve_normals(job: Job, models: Sequence[AngleModel] = (AngleModel.PPA,)) -> JobOutcome:
    """Estimate normals of the sparse points in a folder that has poses."""
    return _do_alone(job, NORMALS, models, ())


def densify(job: Job, models: Sequence[AngleModel] = (AngleModel.PPA,)) -> JobOutcome:
    """Make dense clouds in a folder that has normals."""
    return _do_alone(job, DENSIFY, models, models)


def finish(job: Job, model: AngleModel = AngleModel.PPA) -> JobOutcome:
    """Make mesh and COLMAP workspace in a folder that has a dense cloud."""
    return _do_alone(job, FINISH, (model,), (model,))


def judge(run_folder: RunFolder, model: AngleModel = AngleModel.PPA) -> Trust:
    """Quality checks of the cloud of a finished run; nothing is written.

    Raises
    ------
    DataError
        The folder holds no such run.
    """
    record, options = load_run(run_folder)
    if record.find(DensifyResult, model) is None:
        raise DataError(run_folder.cloud(model), "is not made yet; run `polmvs densify` first.")
    return find_trust(model, run_folder, record, options)


def measure(run_folder: RunFolder, models: Sequence[AngleModel]) -> Comparison:
    """Metrics of the clouds of a finished run against the ground truth of its options.

    Nothing is written.

    Raises
    ------
    DataError
        The folder holds no such run, or its capture is gone.
    """
    record, options = load_run(run_folder)
    assert record.capture is not None
    return evaluate_models(
        open_capture(record.capture.folder, options.capture),
        sparse_figures(record),
        run_folder,
        models,
        options.evaluation.gt,
        workers=Workers(),
    )


def _do_alone(
    job: Job, command: str, models: Sequence[AngleModel], dense: Sequence[AngleModel]
) -> JobOutcome:
    """Run the stages of a command in a folder where the stages that they need are finished.

    Finished stages run again only with ``overwrite``.

    Raises
    ------
    OptionError
        All are finished, and the run options ask neither for ``overwrite`` nor for ``resume``.
    """
    last = _of_models((command,), models, stage_table())
    all_needed = with_needed((spec.name for spec in last), stage_table())
    own = [spec for spec in all_needed if spec.command == command]
    wanted = [spec for spec in own if spec.is_wanted(job.options)]
    names = {spec.name for spec in own}
    again = job.run_options.overwrite
    taken_over = {spec.name for spec in all_needed if not (again and spec.name in names)}
    with _open(job, all_needed, taken_over=taken_over, continues=True) as run:
        if again:
            run.forget([spec.name for spec in wanted])
        elif wanted and not job.run_options.resume and all(map(run.is_finished, wanted)):
            raise OptionError(
                f"{run.run_folder.root}: the stage {wanted[-1].name!r} is finished. Give "
                "`run.overwrite` to do it again."
            )
        for spec in wanted:
            run.do(spec)
        return _close(run, dense)


def _of_models(
    commands: Sequence[str], models: Sequence[AngleModel], table: Sequence[StageSpec]
) -> list[StageSpec]:
    """Stages of commands that belong to these angle models or to all."""
    return [
        spec for spec in table if spec.command in commands and spec.angle_model in (None, *models)
    ]


def _with_poses_of_workspace(job: Job) -> Job:
    """Poses of the given COLMAP workspace, unless others are given."""
    workspace, sfm = job.options.fusion.workspace, job.options.sfm
    if workspace is None or sfm.sparse is not None:
        return job
    sfm = replace(sfm, sparse=workspace / "sparse")
    return replace(job, options=replace(job.options, sfm=sfm))


def _open(
    job: Job,
    last: Sequence[StageSpec],
    *,
    table: Sequence[StageSpec] | None = None,
    taken_over: set[str] | None = None,
    min_images: int = MIN_VIEWS,
    continues: bool = False,
) -> AbstractContextManager[Run]:
    """Open the run; finished stages that it needs are taken over."""
    table = table or stage_table()
    if taken_over is None:
        taken_over = {spec.name for spec in with_needed((s.name for s in last), table)}
    return open_run(
        job, table=table, min_images=min_images, taken_over=taken_over, continues=continues
    )


def _do_all(run: Run, last: Sequence[StageSpec]) -> None:
    """Run the stages that the options select, and all that they need."""
    wanted = [spec.name for spec in last if spec.is_wanted(run.options)]
    for _, same in groupby(with_needed(wanted, run.table), key=lambda spec: spec.result):
        run.do_all(list(same))


def _take_out_rejected(run: Run, last: Sequence[StageSpec], models: Sequence[AngleModel]) -> None:
    """Remove views whose pose the surface contradicts from the model, and run all stages again.

    PPA's surface decides, else that of the tilted model: OPA also leaves out correct views.
    """
    judge = next((m for m in (AngleModel.PPA, AngleModel.TILTED) if m in models), None)
    for _ in range(MAX_REJECTIONS):
        if judge is None or not run.is_finished(_densify_of(run, judge)):
            return
        rejected = run.record.result(DensifyResult, judge).left_out
        if not rejected or run.num_views - len(rejected) < MIN_VIEWS:
            return
        said = run.record.stage(_densify_of(run, judge).name)
        assert said is not None
        reasons = [text for text in said.warnings if any(name in text for name in rejected)]
        run.take_out(rejected, reasons)
        logger.warning(
            "%s: taken out of the model, and all that follows is done again without.",
            short_list(rejected),
        )
        _do_all(run, last)


def _densify_of(run: Run, model: AngleModel) -> StageSpec:
    return next(s for s in run.table if s.command == DENSIFY and s.angle_model is model)


def _close(run: Run, models: Sequence[AngleModel]) -> JobOutcome:
    run.save(finished=True)
    record, empty = run.record, None
    if any(record.result(DensifyResult, model).num_points == 0 for model in models):
        empty = NO_POINTS
        if record.result(SeedsResult).num_seeds == 0:
            empty = NO_SEEDS
        if record.result(MapsResult).num_region_px == 0:
            empty = NO_REGION
        elif run.options.fusion.min_views > record.result(PosesResult).num_views:
            empty = TOO_MANY_VIEWS
    return JobOutcome(run_folder=run.run_folder, record=record, empty=empty)
