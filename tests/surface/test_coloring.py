"""Colours of a surface: those of its paint, whatever shines on it or stands before it."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.scene import View
from polmvs.surface.coloring import paint_texture, surface_colors, texture_size
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh
from polmvs.synthetic.captures import ring_of_views

CAMERA = PinholeCamera(width=200, height=160, fx=300.0, fy=300.0, cx=100.0, cy=80.0)
RADIUS = 0.05


def paint(points: np.ndarray) -> np.ndarray:
    """Linear colours (N, 3) that change over the size of the part."""
    return 0.3 + 0.2 * np.sin(points[..., [0, 1, 2]] / RADIUS + [0, 1, 2])


def ball() -> TriangleMesh:
    made = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    return TriangleMesh(np.asarray(made.vertices), np.asarray(made.faces, np.int64))


@pytest.fixture(scope="module")
def views() -> list[View]:
    return list(ring_of_views(8, CAMERA, distance=0.3, elevation_deg=30))


def shown(view: View, scene: RayScene) -> np.ndarray:
    rays = view.rays_in_world(pixel_centers(CAMERA.width, CAMERA.height).reshape(-1, 2))
    hits = scene.cast(view.center_in_world, rays)
    image = np.full((len(rays), 3), 0.9)  # a bright ground
    points = view.center_in_world + hits.distance[:, None] * rays
    hit = hits.face >= 0
    image[hit] = paint(points[hit])
    return image.reshape(CAMERA.height, CAMERA.width, 3).astype(np.float32)


def display(linear: np.ndarray) -> np.ndarray:
    return np.rint(255 * np.clip(linear, 0, 1) ** (1 / 2.2))


def seen_well(mesh: TriangleMesh, views: list[View]) -> np.ndarray:
    """Vertices that four views see at less than 70 degrees."""
    count = sum(
        (view.facing_cosines(mesh.vertices, mesh.vertex_normals) > 0.35).astype(int)
        for view in views
    )
    return count >= 4


def test_colours_are_the_paint_s_under_highlights(views) -> None:
    mesh = ball()
    scene = RayScene(mesh)
    images = {view.name: shown(view, scene) for view in views}
    images[views[0].name][60:90, 90:120] = 1.0  # a lamp's reflection in one view
    images[views[3].name][40:80, 80:110] = np.nan  # and one that clips in another
    found = surface_colors(
        mesh.vertices, mesh.vertex_normals, views, lambda view: images[view.name], scene, white=1.0
    )
    chosen = seen_well(mesh, views)
    assert chosen.sum() > 300
    off = np.abs(found[chosen] - display(paint(mesh.vertices[chosen])))
    assert np.quantile(off, 0.99) <= 3  # a pixel is 1 mm, over which the paint changes by 2 of 255


def test_what_stands_before_a_place_does_not_colour_it(views) -> None:
    wall = trimesh.creation.box((0.2, 0.2, 0.002))
    wall.apply_translation([0, 0, 0.08])  # above, between the ball and most of the views
    both = trimesh.util.concatenate(
        [trimesh.creation.icosphere(subdivisions=4, radius=RADIUS), wall]
    )
    mesh = TriangleMesh(np.asarray(both.vertices), np.asarray(both.faces, np.int64))
    scene = RayScene(mesh)
    num = len(ball().vertices)

    def load(view: View) -> np.ndarray:
        rays = view.rays_in_world(pixel_centers(CAMERA.width, CAMERA.height).reshape(-1, 2))
        face = scene.cast(view.center_in_world, rays).face
        values = np.where(face >= len(ball().faces), 1.0, 0.1)  # the wall is bright
        return values.reshape(CAMERA.height, CAMERA.width).astype(np.float32)

    found = surface_colors(
        mesh.vertices[:num], mesh.vertex_normals[:num], views, load, scene, white=1.0
    )
    dark = display(np.array(0.1))
    assert (found[:, 0] == found[:, 2]).all()
    assert np.mean(np.abs(found[:, 0] - dark) <= 1) > 0.97  # but at the wall's outline


def test_no_view_at_all() -> None:
    mesh = ball()
    found = surface_colors(mesh.vertices, mesh.vertex_normals, [], paint, RayScene(mesh), white=1.0)
    assert len(np.unique(found)) == 1


def test_a_texture_holds_the_colour_of_every_place() -> None:
    """A quad in a part of the texture, which is painted there and somewhat about it."""
    mesh = TriangleMesh(
        np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
    )
    uv = np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]])

    def colors_of(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        np.testing.assert_allclose(normals, np.tile([0, 0, 1.0], (len(points), 1)), atol=1e-6)
        return np.rint(255 * np.column_stack([points[:, :2], points[:, 0] > 2])).astype(np.uint8)

    texture = paint_texture(mesh, uv, colors_of, 64)
    for u, v in ((0.3, 0.3), (0.7, 0.3), (0.5, 0.7)):
        row, col = int((1 - v) * 64), int(u * 64)
        expected = 255 * np.array([2 * u - 0.5, 2 * v - 0.5, 0])
        np.testing.assert_allclose(texture.image[row, col], expected, atol=6)
    np.testing.assert_array_equal(texture.image[32, 48], texture.image[32, 50])  # the gutter
    assert texture_size(mesh, 0.01) == 256
    assert texture_size(mesh, 1e-9) == 8192
