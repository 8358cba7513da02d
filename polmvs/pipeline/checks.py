"""What must hold before a run begins, and the stages that a run may have."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from polmvs.colmap.dense_workspace import open_dense_workspace, require_same_frame
from polmvs.colmap.sfm import check_intrinsics
from polmvs.config import AngleModel, Options, ReferenceOptions, to_plain
from polmvs.errors import DataError, OptionError
from polmvs.io.ground_truth import open_ground_truth
from polmvs.io.images import read_mask
from polmvs.pipeline.record import Record
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.stages.capture import find_mask, fit_model, image_names
from polmvs.polarization.capture import Capture
from polmvs.poses.metric_frame import check_reference
from polmvs.scene import SparseModel

EVALUATE = "evaluate"
PARTS = "parts"
EXPORTS = ("mesh_", "dense_")  # how the stages begin that nothing follows
POSES = ("sfm", "sparse")  # two ways to the same files


def normals_stage(model: AngleModel) -> str:
    """Name of the stage of the track normals; PPA's is the first and selects the seeds."""
    return "normals" if model is AngleModel.PPA else f"normals_{model}"


def densify_stage(model: AngleModel) -> str:
    """Name of the stage of the dense cloud."""
    return f"densify_{model}"


def mesh_stage(model: AngleModel) -> str:
    """Name of the stage of the mesh."""
    return f"mesh_{model}"


def dense_stage(model: AngleModel) -> str:
    """Name of the stage of the COLMAP dense workspace."""
    return f"dense_{model}"


# Groups of options that decide the result of a stage, and the order in which stages follow.
STAGE_OPTIONS: dict[str, tuple[str, ...]] = {
    "capture": ("capture",),
    **{name: ("sfm", "reference") for name in POSES},
    "maps": ("region",),
    **{normals_stage(model): ("normals",) for model in AngleModel},
    PARTS: ("normals",),
    **{densify_stage(model): ("normals", "propagation", "fusion") for model in AngleModel},
    **{mesh_stage(model): () for model in AngleModel},
    **{dense_stage(model): ("fusion", "export") for model in AngleModel},
    EVALUATE: ("evaluation",),
}
STAGE_RANK = {
    "capture": 0,
    **dict.fromkeys(POSES, 1),
    "maps": 2,
    **{normals_stage(model): 5 for model in AngleModel},
    normals_stage(AngleModel.PPA): 3,
    PARTS: 4,
    **{densify_stage(model): 6 for model in AngleModel},
    **{mesh_stage(model): 7 for model in AngleModel},
    **{dense_stage(model): 8 for model in AngleModel},
    EVALUATE: 9,
}


def command_of(name: str) -> str:
    """The command that does a stage alone."""
    if STAGE_RANK[name] <= STAGE_RANK["sfm"]:
        return "sfm"
    if STAGE_RANK[name] < STAGE_RANK[densify_stage(AngleModel.PPA)]:
        return "normals"
    return "densify" if name.startswith("densify") else "export"


def alternatives(name: str) -> tuple[str, ...]:
    """The stage, or the two of which one finds the poses."""
    return POSES if name in POSES else (name,)


def followers(name: str) -> list[str]:
    """A stage, and those that read what it writes: not another model's, and nothing of exports."""
    if name.startswith(EXPORTS):
        return [name]
    model, rank = _model_of(name), STAGE_RANK[name]
    later = [other for other, its_rank in STAGE_RANK.items() if its_rank > rank]
    return [
        *alternatives(name),
        *(other for other in later if model is None or _model_of(other) in (model, None)),
    ]


def _model_of(name: str) -> str | None:
    """The model that a stage is of; None for those of all. PPA's normals select the seeds."""
    return next((str(model) for model in AngleModel if name.endswith(f"_{model}")), None)


def inputs_of(options: Options) -> list[Path]:
    """Folders that are read beside the capture."""
    paths = (
        options.sfm.sparse,
        options.reference.reference,
        options.region.mask,
        options.fusion.workspace,
        options.evaluation.gt,
    )
    return [path for path in paths if path is not None]


def identity_of(capture: Capture) -> dict[str, Any]:
    """What tells this capture from another one, as in ``run.json``."""
    return {
        "folder": str(capture.folder.absolute()),
        "width": capture.width,
        "height": capture.height,
        "bytes": {path.name: path.stat().st_size for path in capture.paths},
    }


def check_input(capture: Capture, options: Options, min_images: int) -> SparseModel | None:
    """All that can be known to be wrong before the work begins; gives the model of ``--sparse``."""
    num_images = len(image_names(capture))
    if num_images < min_images:
        raise DataError(
            capture.folder,
            f"holds {num_images} image{'s' * (num_images != 1)}; {min_images} or more are needed, "
            "better ten: views of the part from all around.",
        )
    if options.region.mask is not None:
        for image in image_names(capture):
            read_mask(find_mask(options.region.mask, image), (capture.height, capture.width))
    if options.evaluation.gt is not None:
        open_ground_truth(options.evaluation.gt)
    check_reference(options.reference)
    if options.export.in_place and options.fusion.workspace is None:
        raise OptionError("--in-place needs a --workspace to fill.")
    dense = open_dense_workspace(options.fusion.workspace) if options.fusion.workspace else None
    if options.sfm.sparse is not None:
        model = fit_model(capture, options.sfm.sparse)
        if dense is not None and options.reference == ReferenceOptions():
            require_same_frame(dense, model)
        return model
    if options.sfm.intrinsics is not None:
        check_intrinsics(options.sfm.intrinsics, capture.width, capture.height)
    return None


def require_same_capture(record: Record, identity: dict[str, Any], workspace: RunFolder) -> None:
    """Finished stages must be of this capture."""
    same = all(record.capture.get(key) == identity[key] for key in ("width", "height", "bytes"))
    if record.stages and not same:
        raise DataError(
            workspace.root,
            f"holds a run of another capture ({record.capture.get('folder')}), or its images have "
            "changed. Give another OUT, or --overwrite.",
        )


def require_same_options(
    record: Record, options: Options, uses: Collection[str], workspace: RunFolder
) -> None:
    """Finished stages that are taken over must be of these options."""
    for stage in record.stages:
        if stage.name not in uses:
            continue
        before = record.stage_options.get(stage.name, {})
        for group, now in options_of(stage.name, options).items():
            for key, value in now.items():
                earlier = before.get(group, {}).get(key)
                if earlier != value:
                    flag = "--" + key.replace("_", "-")
                    raise OptionError(
                        f"{flag} is {_text(value)} but the finished stage {stage.name!r} in "
                        f"{workspace.root} used {_text(earlier)}. Give the same value, or "
                        "--overwrite."
                    )


def options_of(stage: str, options: Options) -> dict[str, Any]:
    """Options that decide the result of a stage, by group, in terms of JSON."""
    return {group: to_plain(getattr(options, group)) for group in STAGE_OPTIONS[stage]}


def _text(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(str(item) for item in value)
    return "not set" if value is None else str(value)
