"""The stages of a job as a run does them: their work, what they follow and what they report."""

from __future__ import annotations

from collections.abc import Sequence

from polmvs.config import AngleModel
from polmvs.evaluation.comparison import write_comparison
from polmvs.io.clouds import preload
from polmvs.pipeline.checks import (
    EVALUATE,
    PARTS,
    dense_stage,
    densify_stage,
    mesh_stage,
    normals_stage,
    options_of,
)
from polmvs.pipeline.run import Report, Run, Stage
from polmvs.pipeline.stages import capture as stages
from polmvs.pipeline.stages import clouds as cloud_stages
from polmvs.pipeline.stages import exports as export_stages


def plan_capture(run: Run) -> Stage:
    """Write the images."""

    def work(report: Report) -> stages.Facts:
        return stages.write_images(run.capture, run.workspace, workers=run.workers, report=report)

    return Stage(name="capture", work=work, total=len(run.capture.names))


def plan_poses(run: Run) -> Stage:
    """Find the poses, or take those of an existing model."""
    given, source = run.given_model, run.options.sfm.sparse

    def take(report: Report) -> stages.Facts:
        assert given is not None
        assert source is not None
        return stages.take_poses(given, run.workspace, source, run.options.reference)

    def find(report: Report) -> stages.Facts:
        def step(name: str) -> None:
            if name == "mapping":  # on one core: the other can load what the next stages need
                preload()
            report(1)

        options = run.options
        return stages.find_poses(
            run.record.images, run.workspace, options.sfm, options.reference, report=step
        )

    if given is not None:
        return Stage(name="sparse", work=take, after=("capture",))
    return Stage(name="sfm", work=find, after=("capture",), total=stages.SFM_STEPS)


def plan_maps(run: Run) -> Stage:
    """Find the regions and their phase."""

    def work(report: Report) -> stages.Facts:
        return stages.build_maps(
            run.capture, run.workspace, run.options.region, workers=run.workers, report=report
        )

    return Stage(name="maps", work=work, after=("sfm",), total=_num_views(run))


def _normal_models(models: Sequence[AngleModel]) -> list[AngleModel]:
    """PPA first: it selects the seeds, which are the same for all models."""
    return list(dict.fromkeys((AngleModel.PPA, *models)))


def normal_names(models: Sequence[AngleModel]) -> list[str]:
    """Names of the stages of the normals."""
    return [normals_stage(model) for model in _normal_models(models)]


def plan_normals(run: Run, models: Sequence[AngleModel]) -> list[Stage]:
    """Normals of the sparse points under each model, and the parts that have none."""
    first, *others = [_normal_stage(run, model) for model in _normal_models(models)]
    return [first, _part_stage(run), *others]


def _part_stage(run: Run) -> Stage:
    def work(report: Report) -> stages.Facts:
        return cloud_stages.place_parts(
            run.workspace,
            run.options.normals,
            max_neighbors=run.options.propagation.max_neighbors,
            workers=run.workers,
        )

    return Stage(name=PARTS, work=work, after=(normals_stage(AngleModel.PPA),))


def _normal_stage(run: Run, model: AngleModel) -> Stage:
    def work(report: Report) -> stages.Facts:
        return cloud_stages.solve_tracks(
            model, run.workspace, run.options.normals, workers=run.workers
        )

    first = normals_stage(AngleModel.PPA)
    after = "maps" if model is AngleModel.PPA else first
    return Stage(name=normals_stage(model), work=work, after=(after,))


def plan_densify(run: Run, model: AngleModel) -> Stage:
    """Dense cloud of a model."""
    propagation, fusion = run.options.propagation, run.options.fusion

    def work(report: Report) -> stages.Facts:
        return cloud_stages.densify(
            model, run.workspace, propagation, fusion, workers=run.workers, report=report
        )

    return Stage(
        name=densify_stage(model),
        work=work,
        after=(normals_stage(AngleModel.PPA), PARTS, normals_stage(model)),
        total=cloud_stages.densify_steps(_num_views(run), propagation),
    )


def plan_exports(run: Run, model: AngleModel) -> list[Stage]:
    """What the options ask for, of a cloud that has points."""
    options, given = run.options.export, run.options.fusion.workspace
    after = (densify_stage(model),)

    def mesh(report: Report) -> stages.Facts:
        return export_stages.make_mesh(model, run.workspace)

    def dense(report: Report) -> stages.Facts:
        if not run.record.results.get(f"num_points_{model}"):
            return {}
        if given is not None:
            return export_stages.fill_given(model, run.workspace, given, in_place=options.in_place)
        return export_stages.write_workspace(model, run.workspace)

    todo = []
    if options.mesh:
        todo.append(Stage(name=mesh_stage(model), work=mesh, after=after))
    if options.colmap:
        todo.append(Stage(name=dense_stage(model), work=dense, after=after))
    return todo


def plan_evaluation(run: Run, models: Sequence[AngleModel]) -> Stage:
    """Figures of several models."""

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
    return int(run.record.results.get("num_views", len(run.capture.names)))
