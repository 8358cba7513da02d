"""A part of two colours before a colour camera: it is rendered, and its mesh gets its colours."""

import numpy as np
import pytest
import trimesh

import polmvs
from polmvs.cli.call import read_config
from polmvs.config import CaptureOptions
from polmvs.io.clouds import read_mesh
from polmvs.io.ground_truth import open_ground_truth
from polmvs.pipeline.export import unpolarized_image
from polmvs.polarization.capture import open_capture
from polmvs.surface.coloring import surface_colors
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh

RED, BLUE = (200, 40, 40), (40, 60, 200)


@pytest.fixture(scope="module")
def coloured(renderer, tmp_path_factory):
    """Capture of a ball, red where x is positive, and blue."""
    folder = tmp_path_factory.mktemp("coloured")
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    ball.visual.vertex_colors = np.where(ball.vertices[:, :1] > 0, RED, BLUE)
    ball.export(folder / "ball.ply")
    polmvs.simulate(
        str(folder / "ball.ply"),
        folder / "capture",
        material="black-plastic",
        light="even",
        colour="rggb",
        marks=0,
        views=4,
        image_size=(192, 160),
        max_samples=16,
        directions=16,
    )
    return folder / "capture"


def options_of(folder, **changes) -> CaptureOptions:
    table = read_config(folder / "capture.toml", (CaptureOptions,))["capture"]
    return CaptureOptions(**(dict(table) | changes))


def test_a_colour_camera_gives_colours_of_the_size_of_its_views(coloured) -> None:
    capture, truth = open_capture(coloured, options_of(coloured)), open_ground_truth(coloured)
    image = unpolarized_image(capture, "000.png")
    assert image.shape == (*truth.mask("000.png").shape, 3)
    one = open_capture(coloured, options_of(coloured, channel="green"))
    assert unpolarized_image(one, "000.png").shape == image.shape[:2]


def test_the_mesh_has_the_colours_of_the_part(coloured) -> None:
    capture, truth = open_capture(coloured, options_of(coloured)), open_ground_truth(coloured)
    mesh = read_mesh(coloured / "gt" / "mesh.ply")
    scene = RayScene(TriangleMesh(mesh.vertices, mesh.triangles.astype(np.int64)))
    views = [truth.views[name] for name in capture.names]
    colors = surface_colors(
        mesh.vertices,
        mesh.normals,
        views,
        lambda view: unpolarized_image(capture, view.name),
        scene,
        white=capture.exposure(),
    ).astype(float)
    seen = mesh.normals[:, 2] > 0.2  # views stand above the table
    red = colors[seen & (mesh.vertices[:, 0] > 0.02)]
    blue = colors[seen & (mesh.vertices[:, 0] < -0.02)]
    # One colour camera sees each paint through its filters, which overlap: what dominates stays.
    assert (np.median(red, axis=0)[0] > 1.5 * np.median(red, axis=0)[1:]).all()
    assert (np.median(blue, axis=0)[2] > 1.3 * np.median(blue, axis=0)[:2]).all()
    assert (red[:, 0] > red[:, 2]).mean() > 0.97
    assert (blue[:, 2] > blue[:, 0]).mean() > 0.97
