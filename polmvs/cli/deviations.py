"""The command that compares a part with its reference."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from polmvs.cli.call import Call
from polmvs.cli.commands import DeviationArguments
from polmvs.cli.exit_status import OUT_OF_TOLERANCE
from polmvs.cli.flags import in_flags
from polmvs.cli.pages import make_report
from polmvs.cli.terminal import Terminal
from polmvs.errors import DataError, OptionError
from polmvs.evaluation.deviation import Deviation, MeasuredPart, measure_deviation
from polmvs.evaluation.registration import CloudReference, MeshReference, Reference
from polmvs.io.clouds import Cloud, has_triangles, read_any_mesh, read_cloud, read_mesh
from polmvs.io.folders import new_folder
from polmvs.pipeline.checks import digest_of
from polmvs.pipeline.export import part_of, surface_of
from polmvs.pipeline.run_folder import RunFolder, replacing
from polmvs.pipeline.runner import dense_models, load_record
from polmvs.pipeline.stages.poses import PosesResult
from polmvs.polarization.kinds import AngleModel
from polmvs.report.deviation_files import write_deviation
from polmvs.surface.mesh_geometry import TriangleMesh

MIN_POINTS = 100


def deviation(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs deviation``."""
    given = call.get(DeviationArguments)
    if given.out is not None and given.out.exists():
        raise OptionError(f"{given.out}: exists. Give another folder.")
    if given.report and not given.result.is_dir():
        raise OptionError("is of a finished run.", field="arguments.report")
    cloud_file, cloud, is_metric = _cloud(given.result, given.model)
    if len(cloud.points) < MIN_POINTS:
        raise DataError(
            given.result, f"has {len(cloud.points)} points; {MIN_POINTS} or more are needed."
        )
    reference, unit, other_run = _reference(given.reference, given.model)
    with terminal.stage("registration", None):
        found = measure_deviation(
            MeasuredPart(
                points=cloud.points,
                normals=_usable(cloud.normals),
                sigma=cloud.scalars.get("sigma"),
                is_metric=is_metric or given.metric,
            ),
            reference,
            unit=given.unit or unit,
            aligned=given.aligned,
            tolerance_mm=given.tolerance,
            least_share=given.least_share,
            other_run=other_run,
        )
    figures = replace(
        found.figures,
        result=str(given.result),
        reference=str(given.reference),
        result_digest=digest_of(cloud_file),
    )
    found = replace(found, figures=figures)
    lines = deviation_lines(found)
    if given.out is not None:
        with new_folder(given.out) as folder:
            write_deviation(folder, found)
        lines.append(f"{given.out}: deviation.ply, .png, .svg, .json")
    if given.report:
        run_folder = RunFolder(given.result)
        with replacing(run_folder.deviation) as folder:
            write_deviation(folder, found)
        lines.append(make_report(run_folder, terminal))
    terminal.show([in_flags(line) for line in lines], found.figures)
    return OUT_OF_TOLERANCE if found.figures.passed is False else 0


def deviation_lines(found: Deviation) -> list[str]:
    """The results as lines of text."""
    f = found.figures
    told = "inferred from the sizes" if f.unit_inferred else "given"
    lines = [f"reference in {f.unit} ({told}); {f.num_points:,} points compared"]
    if f.num_far:
        lines.append(f"{f.num_far:,} points are none of the part and are left out")
    if f.scale != 1:
        lines.append(
            f"the result has no metric scale: {f.scale:.6g} was fitted, so that its size is not "
            "tested"
        )
    if f.ambiguous:
        lines.append(
            "the part fits about as well when it is turned: bring it to its place and give "
            "`arguments.aligned`"
        )
    lines += [
        f"mean {f.mean:+.4f} mm, standard deviation {f.standard_deviation:.4f} mm, RMS "
        f"{f.rms:.4f} mm",
        "percentiles: " + ", ".join(f"{p} % {v:+.3f}" for p, v in f.percentiles.items()) + " mm",
    ]
    if np.isfinite(f.median_sigma):
        lines.append(
            f"uncertainty (1 sigma) of a distance {f.median_sigma:.4f} mm (median); "
            f"{100 * f.significant_share:.1f} % of the points are farther off than three of theirs"
        )
    if f.repeatability is not None:
        lines.append(f"repeatability: one run has a standard deviation of {f.repeatability:.4f} mm")
    if f.tolerance is not None and f.share_within is not None:
        lines.append(
            f"{100 * f.share_within:.2f} % within {f.tolerance:g} mm, "
            f"{100 * f.least_share:g} % are asked for: {'pass' if f.passed else 'FAIL'}"
        )
    return lines


def _usable(normals: np.ndarray | None) -> np.ndarray | None:
    """Normals of a cloud of which all have one."""
    if normals is None or not np.isfinite(normals).all():
        return None
    return normals if (np.linalg.norm(normals, axis=1) > 0.5).all() else None


def _cloud(path: Path, model: AngleModel | None) -> tuple[Path, Cloud, bool]:
    """The file of a cloud or of a run's, its points to compare, whether they are in metres."""
    file, is_metric = path, False
    if path.is_dir():
        run_folder = RunFolder(path)
        record = load_record(run_folder)
        file = run_folder.cloud(surface_of(run_folder, dense_models(record), model))
        is_metric = record.result(PosesResult).is_metric
    return file, part_of(read_cloud(file)), is_metric


def _reference(
    path: Path, model: AngleModel | None
) -> tuple[Reference, str | None, tuple[np.ndarray, np.ndarray] | None]:
    """The reference, its unit where that is known, and of a run its points and their deviations."""
    if path.is_dir():
        file, cloud, is_metric = _cloud(path, model)
        mesh_file = RunFolder(path).mesh(AngleModel(file.stem))
        unit = "m" if is_metric else None
        sigma = cloud.scalars.get("sigma", np.full(len(cloud.points), np.nan))
        own = (cloud.points, np.nan_to_num(sigma))
        if mesh_file.is_file():
            return MeshReference(TriangleMesh.of(read_mesh(mesh_file))), unit, own
        return _of_cloud(path, cloud), unit, own
    if path.suffix.lower() == ".ply" and not has_triangles(path):
        return _of_cloud(path, read_cloud(path)), None, None
    return MeshReference(TriangleMesh.of(read_any_mesh(path))), None, None


def _of_cloud(path: Path, cloud: Cloud) -> CloudReference:
    normals = _usable(cloud.normals)
    if normals is None or len(cloud.points) < MIN_POINTS:
        raise DataError(path, "is no scan to compare with: it needs points that all have normals.")
    return CloudReference(cloud.points, normals)
