"""Stage ``trust_MODEL``: the quality checks of a reconstruction, and its verdict."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.colmap.models import read_model
from polmvs.config import Options
from polmvs.evaluation.trust import Trust, measure_trust
from polmvs.io.clouds import Cloud, read_cloud, read_mesh
from polmvs.normals.camera_check import PhaseRows, fit_camera
from polmvs.normals.tracks import evenly_chosen
from polmvs.pipeline.record import Record
from polmvs.pipeline.run_folder import SURFACE_MESH, RunFolder, surface_levels
from polmvs.pipeline.stages.densify import DensifyResult, open_outside
from polmvs.pipeline.stages.maps import MapsResult, open_maps
from polmvs.pipeline.stages.poses import PosesResult
from polmvs.pipeline.stages.seeds import load_points, load_seeds
from polmvs.pipeline.stages.sfm import SfmResult
from polmvs.pipeline.stages.silhouettes import open_surface_views
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import PointKind, evenly_spread
from polmvs.surface.ground import supporting_plane
from polmvs.surface.held_out import HeldOutTolerances, WholeSurface, predict, predict_left_out
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh
from polmvs.surface.observations import (
    DIFFUSE,
    SPECULAR,
    Looking,
    level_image,
    observe,
    reflects_itself,
)
from polmvs.surface.open_scene import open_scene
from polmvs.surface.soundness import find_soundness
from polmvs.surface.surface_quality import share_off
from polmvs.surface.surface_view import SurfaceView
from polmvs.surface.surroundings import sparse_surroundings
from polmvs.surface.terms import KnownPoints, TermTolerances

logger = logging.getLogger(__name__)

# Number of views compared with the surface, spread evenly among more: it bounds the time.
MAX_TRIED_VIEWS = 24
MAX_CAMERA_POINTS = 2000  # that check the camera: errors are common to views, more narrow nothing


def find_trust(model: AngleModel, folder: RunFolder, record: Record, options: Options) -> Trust:
    """Compare a dense cloud with its capture, and warn if it is not to be trusted.

    Parameters
    ----------
    model : angle model.
    folder, record, options : of the run; nothing is written.
    """
    made, sfm = record.result(DensifyResult, model), record.find(SfmResult)
    mapped = record.find(MapsResult)
    unregistered = record.result(PosesResult).unregistered
    gone = {*unregistered, *made.left_out}
    cameras = () if sfm is None else sfm.complaints
    dense = read_cloud(folder.cloud(model))
    phase_maps = open_maps(folder, model)
    outside = open_outside(folder, model)
    trust = measure_trust(model, dense, read_cloud(folder.sparse_cloud(model)), phase_maps, outside)
    trust = replace(
        trust,
        num_views=len(phase_maps) + len(unregistered),
        left_out=len(made.left_out) + len(unregistered),
        complaints=(
            *(one.text for one in cameras if one.view not in gone),
            *(mapped.complaints if mapped is not None else ()),
        ),
        cut_share=None if mapped is None else mapped.cut_share,
        contradicted_share=made.contradicted_share,
        is_bounded=made.is_bounded,
    )
    if made.tilt_share is not None and (folder.views(model) / SURFACE_MESH).is_file():
        trust = _contradicted(trust, model, made, dense, phase_maps, folder, options)
    trust = trust.judged()
    if (dense.scalars["kind"] == PointKind.SURFACE).any():  # else the job says what is missing
        if not trust.is_trusted:
            logger.warning("%s: %s", model, trust.verdict)
        for doubt in trust.doubts():
            logger.info("%s: not normal: %s.", model, doubt)
    return trust


def _contradicted(
    trust: Trust,
    model: AngleModel,
    made: DensifyResult,
    cloud: Cloud,
    maps: Sequence[PhaseMap],
    folder: RunFolder,
    options: Options,
) -> Trust:
    """The checks with those of a surface of all views against held-out views."""
    views = folder.views(model)
    assert made.tilt_share is not None
    tracks, every_view = read_model(folder.sparse).tracks, [one.view for one in maps]
    around = sparse_surroundings(tracks, maps).points
    plane = supporting_plane(around, np.array([view.center_in_world for view in every_view]))
    maps = [one for one in maps if one.view.name not in made.left_out]
    maps = [maps[index] for index in evenly_spread(len(maps), MAX_TRIED_VIEWS)]
    seeds = load_seeds(folder, model)
    known = KnownPoints(seeds.points_in_world, seeds.sigma)
    outside = open_outside(folder, model)
    looking = Looking(
        angle_model=model,
        tilt_aware=options.normals.tilt_aware_weights,
        tilt_share=made.tilt_share,
        light=options.region.light,
    )
    seen: Sequence[SurfaceView] = open_surface_views(folder, maps)
    scene = None
    if not made.is_bounded:
        scene = open_scene(load_points(folder, model, tracks, every_view), seen)
    if scene is not None:
        seen, known = scene.views, scene.known
    mesh = TriangleMesh.of(read_mesh(views / SURFACE_MESH))
    kind = cloud.scalars["kind"][cKDTree(cloud.points).query(mesh.centers)[1]]
    measured = kind != PointKind.INFERRED
    refined = TriangleMesh.of(read_mesh([views / SURFACE_MESH, *surface_levels(views)][-1]))
    whole = None
    if made.is_bounded:
        of_measured = TriangleMesh(mesh.vertices, mesh.faces[measured])
        whole = WholeSurface(mesh=of_measured, refined=refined, is_vessel=made.is_vessel)
    wrong_camera = _camera_complaint(mesh, kind == PointKind.SURFACE, seen, looking)
    return replace(
        trust,
        complaints=(*trust.complaints, *(() if wrong_camera is None else (wrong_camera,))),
        off_points=share_off(mesh, known, seen, outside) if made.is_bounded else None,
        predicted=predict_left_out(
            seen, plane, looking, known, scene=scene, whole=whole, outside=outside
        ),
        fitted=predict(mesh, seen, looking, outside=outside, measured=measured),
        # Of the last closed mesh: the surface has holes where nothing is known.
        soundness=find_soundness(
            refined,
            [phase_map.view for phase_map in maps],
            outside,
        ),
    )


def _camera_complaint(
    mesh: TriangleMesh,
    shown: NDArray[np.bool_],
    views: Sequence[SurfaceView],
    looking: Looking,
) -> str | None:
    """Message about the given camera if it does not fit the phases of the surface.

    ``shown`` (F,) are the faces whose phases count, without inferred ones.
    """
    camera = views[0].view.camera
    if looking.angle_model.formula is AngleModel.OPA or any(
        one.view.camera != camera for one in views
    ):
        return None  # OPA has no rays, and cameras are checked together only if they are one
    images = [level_image(view, HeldOutTolerances.width_px) for view in views]
    counted = np.flatnonzero(shown)
    some = TriangleMesh(
        mesh.vertices, mesh.faces[counted[evenly_chosen(len(counted), MAX_CAMERA_POINTS)]]
    )
    scene = RayScene(mesh)
    found = observe(some, scene, views, images, looking)
    found = found.only(~reflects_itself(some, scene, found))
    residuals = np.abs(found.residuals(some.face_normals))
    if looking.light is None:
        kind = residuals.argmin(axis=0)
    else:
        kind = np.full(len(found.face), SPECULAR if looking.light is Light.SPECULAR else DIFFUSE)
    index = np.arange(len(kind))
    sigma = np.array([TermTolerances().row_sigma])
    fit = fit_camera(
        PhaseRows(
            rows=found.rows[kind, index],
            rays=found.rays,
            variance=found.variances(some.face_normals, sigma)[kind, index],
            point=found.face,
            view=found.view,
        ),
        some.face_normals,
        np.array([one.view.cam_from_world.rotation for one in views]),
    )
    if fit is None:
        return None
    logger.info("%s", fit.message(camera))
    return None if fit.agrees else fit.message(camera)
