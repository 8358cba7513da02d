"""The jobs: reconstruct, compare, and each stage alone."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from polmvs import cloud_stages, stages
from polmvs.cloud_io import preload
from polmvs.comparison import write_comparison
from polmvs.config import Model, Options, RunOptions
from polmvs.errors import OptionError
from polmvs.run import Monitor, Report, Run, Stage, open_run
from polmvs.run_checks import EVALUATE, POSES, densify_stage, normals_stage, options_of
from polmvs.workspace import Workspace

COMPARED = (Model.OPA, Model.PPA, Model.TILTED)
MIN_SFM_IMAGES = 2
BEFORE_MAPS = ("capture", *POSES)

NO_REGION = (
    "no polarised region: no view shows a surface with polarised light. Lower --min-dolp, check "
    "--pattern and --gamma, or give the part with --mask."
)
NO_SEEDS = (
    "no seeds: no sparse point lies on the polarised surface with a normal that fits its light. "
    "Put a few printed marks or labels on the part, check --light, or give the part with --mask."
)
NO_POINTS = (
    "no points: the views agree on none. Check --intrinsics or --sparse and --light, or record "
    "more views."
)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a run came to.

    Attributes
    ----------
    workspace : where the results lie.
    results : numbers of views, points and seeds, and the names of unregistered views.
    empty : why a dense cloud has no points, and what to do; None where none is empty.
    """

    workspace: Workspace
    results: dict[str, Any]
    empty: str | None


@dataclass(frozen=True, kw_only=True)
class Job:
    """What every job is called with.

    Attributes
    ----------
    capture : folder of raw mosaics.
    out : output folder.
    options : of all stages.
    how : workers, overwrite and resume.
    monitor : who watches, if anybody.
    command_line : for the record.
    """

    capture: Path
    out: Path
    options: Options = Options()
    how: RunOptions = RunOptions()
    monitor: Monitor | None = None
    command_line: Sequence[str] = ()


def reconstruct(job: Job, model: Model = Model.PPA) -> Outcome:
    """The whole chain with one model: ``OUT/ppa.ply`` or ``OUT/opa.ply``.

    Raises
    ------
    PolmvsError
        The input is unusable or a stage fails; finished stages stay in the output folder.
    """
    return _whole_chain(job, (model,), evaluated=False)


def compare(job: Job, models: Sequence[Model] = COMPARED) -> Outcome:
    """Several models on the same poses, tracks, seeds and region, with ``OUT/metrics.json``.

    Raises
    ------
    PolmvsError
        As :func:`reconstruct`.
    """
    return _whole_chain(job, models, evaluated=True)


def find_poses(job: Job) -> Outcome:
    """SfM alone: ``OUT/images`` and ``OUT/sparse``."""
    with _open(job, BEFORE_MAPS, min_images=MIN_SFM_IMAGES) as run:
        run.do(_capture_stage(run))
        run.do(_pose_stage(run))
        return _close(run, ())


def solve_normals(job: Job, models: Sequence[Model] = (Model.PPA,)) -> Outcome:
    """Normals of the sparse points of a folder that has poses."""
    own = ("maps", *_normal_names(models))
    with _open(job, BEFORE_MAPS, own, goes_on=True) as run:
        todo = [_map_stage(run), *_normal_stages(run, models)]
        _begin_again(run, todo, job.how)
        for stage in todo:
            run.do(stage)
        return _close(run, ())


def densify(job: Job, models: Sequence[Model] = (Model.PPA,)) -> Outcome:
    """Dense clouds of a folder that has normals."""
    before = (*BEFORE_MAPS, "maps", *_normal_names(models))
    with _open(job, before, [densify_stage(m) for m in models], goes_on=True) as run:
        todo = [_densify_stage(run, model) for model in models]
        _begin_again(run, todo, job.how)
        for stage in todo:
            run.do(stage)
        return _close(run, models)


def _whole_chain(job: Job, models: Sequence[Model], *, evaluated: bool) -> Outcome:
    names = (*BEFORE_MAPS, "maps", *_normal_names(models), *map(densify_stage, models))
    with _open(job, names) as run:
        run.do(_capture_stage(run))
        run.do(_pose_stage(run))
        run.do(_map_stage(run))
        for stage in _normal_stages(run, models):
            run.do(stage)
        for model in models:
            run.do(_densify_stage(run, model))
        if evaluated:
            run.do(_evaluate_stage(run, models))
        return _close(run, models)


def _open(
    job: Job,
    uses: Sequence[str],
    own: Sequence[str] = (),
    *,
    min_images: int = stages.MIN_VIEWS,
    goes_on: bool = False,
) -> AbstractContextManager[Run]:
    """Open the run; ``own`` stages of one that goes on are done again if that is asked for."""
    return open_run(
        job.capture,
        job.out,
        job.options,
        job.how,
        min_images=min_images,
        uses=uses if job.how.overwrite else (*uses, *own),
        goes_on=goes_on,
        monitor=job.monitor,
        command_line=job.command_line,
    )


def _close(run: Run, models: Sequence[Model]) -> Outcome:
    run.save(finished=True)
    results = run.record.results
    empty = None
    if any(results.get(f"num_points_{model}") == 0 for model in models):
        empty = NO_POINTS
        if results.get("num_seeds") == 0:
            empty = NO_SEEDS
        if results.get("num_region_px") == 0:
            empty = NO_REGION
    return Outcome(workspace=run.workspace, results=results, empty=empty)


def _begin_again(run: Run, todo: Sequence[Stage], how: RunOptions) -> None:
    """A stage called alone that is finished: to be done again only if that is asked for."""
    if how.overwrite:
        for stage in todo:
            run.forget(stage.name)
    elif not how.resume and all(run.record.is_done(stage.name) for stage in todo):
        raise OptionError(
            f"{run.workspace.root}: the stage {todo[-1].name!r} is finished. Give --overwrite to "
            "do it again."
        )


def _capture_stage(run: Run) -> Stage:
    def work(report: Report) -> stages.Facts:
        return stages.write_images(run.capture, run.workspace, workers=run.workers, report=report)

    return Stage(name="capture", work=work, total=len(run.capture.paths))


def _pose_stage(run: Run) -> Stage:
    given, source = run.given_model, run.options.sfm.sparse

    def take(report: Report) -> stages.Facts:
        assert given is not None
        assert source is not None
        return stages.take_poses(given, run.workspace, source)

    def find(report: Report) -> stages.Facts:
        def step(name: str) -> None:
            if name == "mapping":  # on one core: the other can load what the next stages need
                preload()
            report(1)

        return stages.find_poses(run.record.images, run.workspace, run.options.sfm, report=step)

    if given is not None:
        return Stage(name="sparse", work=take, after=("capture",))
    return Stage(name="sfm", work=find, after=("capture",), total=stages.SFM_STEPS)


def _map_stage(run: Run) -> Stage:
    def work(report: Report) -> stages.Facts:
        return stages.build_maps(
            run.capture, run.workspace, run.options.region, workers=run.workers, report=report
        )

    return Stage(name="maps", work=work, after=("sfm",), total=_num_views(run))


def _normal_models(models: Sequence[Model]) -> list[Model]:
    """PPA first: it selects the seeds, which are the same for all models."""
    return list(dict.fromkeys((Model.PPA, *models)))


def _normal_names(models: Sequence[Model]) -> list[str]:
    return [normals_stage(model) for model in _normal_models(models)]


def _normal_stages(run: Run, models: Sequence[Model]) -> list[Stage]:
    return [_normal_stage(run, model) for model in _normal_models(models)]


def _normal_stage(run: Run, model: Model) -> Stage:
    def work(report: Report) -> stages.Facts:
        return cloud_stages.solve_tracks(
            model, run.workspace, run.options.normals, workers=run.workers
        )

    first = normals_stage(Model.PPA)
    after = "maps" if model is Model.PPA else first
    return Stage(name=normals_stage(model), work=work, after=(after,))


def _densify_stage(run: Run, model: Model) -> Stage:
    propagation, fusion = run.options.propagation, run.options.fusion

    def work(report: Report) -> stages.Facts:
        return cloud_stages.densify(
            model, run.workspace, propagation, fusion, workers=run.workers, report=report
        )

    return Stage(
        name=densify_stage(model),
        work=work,
        after=(normals_stage(Model.PPA), normals_stage(model)),
        total=cloud_stages.densify_steps(_num_views(run), propagation),
    )


def _evaluate_stage(run: Run, models: Sequence[Model]) -> Stage:
    def work(report: Report) -> stages.Facts:
        write_comparison(
            run.capture,
            run.workspace,
            run.options,
            models,
            run.record.results,
            workers=run.workers,
        )
        return {}

    stage = Stage(name=EVALUATE, work=work, after=tuple(densify_stage(m) for m in models))
    if run.record.stage_options.get(EVALUATE) != options_of(EVALUATE, run.options):
        run.record.forget([EVALUATE])
    return stage


def _num_views(run: Run) -> int:
    return int(run.record.results.get("num_views", len(run.capture.paths)))
