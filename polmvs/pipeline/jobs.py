"""The jobs: reconstruct, compare, and each stage alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from polmvs.config import AngleModel, Options, RunOptions
from polmvs.errors import OptionError
from polmvs.pipeline.checks import (
    PARTS,
    POSES,
    dense_stage,
    densify_stage,
    mesh_stage,
)
from polmvs.pipeline.job_stages import (
    normal_names,
    plan_capture,
    plan_densify,
    plan_evaluation,
    plan_exports,
    plan_maps,
    plan_normals,
    plan_poses,
)
from polmvs.pipeline.run import Run, Stage, Watcher, open_run
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.stages import capture as stages

COMPARED = (AngleModel.OPA, AngleModel.PPA, AngleModel.TILTED)
MIN_SFM_IMAGES = 2
BEFORE_MAPS = ("capture", *POSES)

NO_REGION = (
    "no polarised region: no view shows a surface with polarised light. Lower --min-dolp, check "
    "--pattern and --gamma, or give the part with --mask."
)
NO_SEEDS = (
    "no seeds: no sparse point lies on the polarised surface with a normal that fits its light, "
    "and no part could be placed by its outline. Put a few printed marks or labels on the part, "
    "check --light, or give the part with --mask."
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

    workspace: RunFolder
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
    monitor: Watcher | None = None
    command_line: Sequence[str] = ()


def reconstruct(job: Job, model: AngleModel = AngleModel.PPA) -> Outcome:
    """The whole chain with one model: ``OUT/ppa.ply`` or ``OUT/opa.ply``.

    Raises
    ------
    PolmvsError
        The input is unusable or a stage fails; finished stages stay in the output folder.
    """
    job = _with_poses_of_workspace(job)
    names = (*_chain_names((model,)), mesh_stage(model), dense_stage(model))
    with _open(job, names) as run:
        for stage in (*_chain(run, (model,)), *plan_exports(run, model)):
            run.do(stage)
        return _close(run, (model,))


def compare(job: Job, models: Sequence[AngleModel] = COMPARED) -> Outcome:
    """Several models on the same poses, tracks, seeds and region, with ``OUT/metrics.json``.

    Raises
    ------
    PolmvsError
        As :func:`reconstruct`.
    """
    job = _with_poses_of_workspace(job)
    with _open(job, _chain_names(models)) as run:
        for stage in _chain(run, models):
            run.do(stage)
        run.do(plan_evaluation(run, models))
        return _close(run, models)


def find_poses(job: Job) -> Outcome:
    """SfM alone: ``OUT/images`` and ``OUT/sparse``."""
    with _open(job, BEFORE_MAPS, min_images=MIN_SFM_IMAGES) as run:
        run.do(plan_capture(run))
        run.do(plan_poses(run))
        return _close(run, ())


def solve_normals(job: Job, models: Sequence[AngleModel] = (AngleModel.PPA,)) -> Outcome:
    """Normals of the sparse points of a folder that has poses."""
    own = ("maps", PARTS, *normal_names(models))
    with _open(job, BEFORE_MAPS, own, goes_on=True) as run:
        todo = [plan_maps(run), *plan_normals(run, models)]
        _begin_again(run, todo, job.how)
        for stage in todo:
            run.do(stage)
        return _close(run, ())


def densify(job: Job, models: Sequence[AngleModel] = (AngleModel.PPA,)) -> Outcome:
    """Dense clouds of a folder that has normals."""
    before = _before_densify(models)
    with _open(job, before, [densify_stage(m) for m in models], goes_on=True) as run:
        todo = [plan_densify(run, model) for model in models]
        _begin_again(run, todo, job.how)
        for stage in todo:
            run.do(stage)
        return _close(run, models)


def export(job: Job, model: AngleModel = AngleModel.PPA) -> Outcome:
    """Mesh and COLMAP workspace of a folder that has a dense cloud."""
    before = (*_before_densify((model,)), densify_stage(model))
    own = (mesh_stage(model), dense_stage(model))
    with _open(job, before, own, goes_on=True) as run:
        todo = plan_exports(run, model)
        _begin_again(run, todo, job.how)
        for stage in todo:
            run.do(stage)
        return _close(run, (model,))


def _with_poses_of_workspace(job: Job) -> Job:
    """Poses of the given COLMAP workspace, unless others are given."""
    workspace, sfm = job.options.fusion.workspace, job.options.sfm
    if workspace is None or sfm.sparse is not None:
        return job
    sfm = replace(sfm, sparse=workspace / "sparse")
    return replace(job, options=replace(job.options, sfm=sfm))


def _before_densify(models: Sequence[AngleModel]) -> tuple[str, ...]:
    return (*BEFORE_MAPS, "maps", PARTS, *normal_names(models))


def _chain_names(models: Sequence[AngleModel]) -> tuple[str, ...]:
    return (*_before_densify(models), *map(densify_stage, models))


def _chain(run: Run, models: Sequence[AngleModel]) -> Iterator[Stage]:
    """The stages to the dense clouds; each is made when those before are done."""
    yield plan_capture(run)
    yield plan_poses(run)
    yield plan_maps(run)
    yield from plan_normals(run, models)
    for model in models:
        yield plan_densify(run, model)


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


def _close(run: Run, models: Sequence[AngleModel]) -> Outcome:
    run.save(finished=True)
    results = run.record.results
    empty = None
    if any(results.get(f"num_points_{model}") == 0 for model in models):
        empty = NO_POINTS
        if results.get("num_seeds") == 0 and not results.get("num_part_seeds"):
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
