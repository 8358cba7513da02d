import numpy as np
import pytest
from analytic_objects import box, euler_number, extracted, side_by_side, sphere, torus, union

from polmvs.surface.mesh_geometry import (
    DistanceGrid,
    RayScene,
    TriangleMesh,
    mesh_from_grid,
    relaxed,
    remeshed,
    sample_surface,
    thickened,
    visible_points,
)


def enclosed_volume(mesh: TriangleMesh) -> float:
    a, b, c = np.moveaxis(mesh.corners, 1, 0)
    return float((np.cross(a, b) * c).sum() / 6)


def test_extraction_of_a_sphere_is_closed_outward_and_accurate():
    mesh = extracted(sphere())
    assert euler_number(mesh) == 2
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 0.05 * 0.08
    assert ((mesh.face_normals * mesh.centers).sum(axis=1) > 0.98).all()
    assert enclosed_volume(mesh) == pytest.approx(4 / 3 * np.pi, rel=0.01)
    assert mesh.face_areas.sum() == pytest.approx(4 * np.pi, rel=0.01)


def test_extraction_keeps_a_hole_and_two_pieces():
    assert euler_number(extracted(torus())) == 0
    pair = extracted(union(sphere(0.5, (-0.8, 0, 0)), sphere(0.5, (0.8, 0, 0))))
    assert euler_number(pair) == 4
    assert set(pair.face_components) == {0, 1}


def test_what_is_thinner_than_the_grid_is_widened_to_it():
    """A ring 0.12 wide and a grid of 0.1; a ball stays as it is."""
    thin, step = extracted(torus(1.0, 0.06), half=1.2, step=0.03), 0.1
    none = RayScene(remeshed(RayScene(thin), step))
    assert len(none.mesh.faces) == 0
    wide = thickened(RayScene(thin), none, step)
    around = np.hypot(np.linalg.norm(wide.vertices[:, :2], axis=1) - 1, wide.vertices[:, 2])
    np.testing.assert_allclose(around, step, atol=0.01)
    for shift in np.linspace(0, step, 4):
        kept = remeshed(RayScene(wide.moved(np.full(3, shift))), step)
        assert len(kept.faces) > 0
        assert euler_number(kept) == 0
    ball = RayScene(extracted(sphere()))
    same = thickened(ball, RayScene(remeshed(ball, step)), step)
    np.testing.assert_array_equal(same.vertices, ball.mesh.vertices)


def test_a_thin_plate_that_is_kept_is_not_widened():
    """One 0.15 thick and a grid of 0.1: only its border is rounded. The rod on it is lost."""
    step = 0.1
    plate, rod = box((1.0, 1.0, 0.075)), box((0.03, 0.03, 0.5))
    mesh = extracted(union(plate, lambda p: rod(p - np.array([0, 0, 0.5]))), half=1.3, step=0.02)
    coarse = RayScene(remeshed(RayScene(mesh), step))
    assert coarse.mesh.vertices[:, 2].max() < 0.3
    moved = thickened(RayScene(mesh), coarse, step).vertices - mesh.vertices
    across = np.abs(mesh.vertices[:, :2])
    on_sides = (across.max(axis=1) > 0.5) & (across.min(axis=1) < 0.5)  # not on the corners
    assert not moved[on_sides].any()
    along = mesh.vertices[:, 2]
    sides = (across.max(axis=1) < 0.05) & (along > 0.3) & (along < 0.9)
    assert (np.linalg.norm(moved[sides], axis=1) > 0.03).all()


def test_cut_triangles_are_the_same_surface_with_half_the_edges():
    mesh = extracted(torus())
    cut = mesh.halved()
    assert euler_number(cut) == 0
    assert len(cut.faces) == 4 * len(mesh.faces)
    assert cut.mean_edge == pytest.approx(0.5 * mesh.mean_edge)
    np.testing.assert_array_equal(cut.vertices[: len(mesh.vertices)], mesh.vertices)
    assert cut.face_areas.sum() == pytest.approx(mesh.face_areas.sum())
    of_corners = np.repeat(mesh.face_normals, 3, axis=0)
    normals = np.concatenate([of_corners, mesh.face_normals])
    np.testing.assert_allclose(cut.face_normals, normals, atol=1e-9)


def test_extraction_of_nothing_is_empty():
    mesh = mesh_from_grid(np.ones((4, 4, 4), np.float32), np.zeros(3), 1.0)
    assert len(mesh.vertices) == len(mesh.faces) == 0
    assert len(remeshed(RayScene(thickened(RayScene(mesh), RayScene(mesh), 0.1)), 0.1).faces) == 0


def test_triangles_are_even():
    mesh = relaxed(extracted(sphere()))
    assert mesh.face_areas.min() > 0.2 * np.median(mesh.face_areas)


@pytest.mark.parametrize("step", [0.05, 0.12])
def test_remeshing_keeps_shape_and_topology(step):
    mesh = remeshed(RayScene(extracted(torus())), step)
    assert euler_number(mesh) == 0
    assert np.abs(torus()(mesh.vertices)).max() < 0.25 * step
    assert 0.6 * step < mesh.mean_edge < 1.2 * step


def test_remeshing_joins_pieces_that_met_and_drops_specks():
    first = extracted(sphere(0.6, (-0.4, 0, 0)))
    second = extracted(sphere(0.6, (0.4, 0, 0)))
    speck = extracted(sphere(0.09, (0, 0, 1.4)))
    mesh = remeshed(RayScene(side_by_side(first, second, speck)), 0.08)
    assert euler_number(mesh) == 2
    assert mesh.vertices[:, 2].max() < 1.0


def test_a_grid_about_a_box_holds_the_part_in_it_with_space_carved():
    """The part is open where the box cuts it; the bore through the whole ball crosses the part."""
    scene, step = RayScene(extracted(sphere())), 0.06
    box = ((-2.0, -0.3, 0.2), (2.0, 0.3, 2.0))
    part = DistanceGrid.of(scene, step, box).mesh(
        free=[lambda points: 0.2 - np.hypot(points[:, 0], points[:, 1])], smoothing=0
    )
    away = np.linalg.norm(part.vertices, axis=1)
    axis = np.hypot(part.vertices[:, 0], part.vertices[:, 1])
    assert (np.minimum(np.abs(away - 1), np.abs(axis - 0.2)) < 0.5 * step).all()
    assert (axis < 0.2 + 0.5 * step).any()
    assert axis.min() > 0.1
    margin = 5 * step
    assert (part.vertices > np.array(box[0]) - margin).all()
    assert (part.vertices < np.array(box[1]) + margin).all()
    inside = ((scene.mesh.centers > box[0]) & (scene.mesh.centers < box[1])).all(axis=1)
    inside &= np.hypot(*scene.mesh.centers[:, :2].T) > 0.3
    assert RayScene(part).distance(scene.mesh.centers[inside]).max() < 0.5 * step


def test_a_grid_inside_a_solid_is_solid():
    """Its points are farther from the surface than the band in which distances are computed."""
    scene = RayScene(extracted(sphere()))
    inner = DistanceGrid.of(scene, 0.02, ((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2)))
    assert (inner.values < 0).all()
    beside = DistanceGrid.of(scene, 0.02, ((-0.2, -0.2, 0.5), (0.2, 0.2, 0.9)))
    heights = beside.origin[2] + 0.02 * np.arange(beside.values.shape[2])
    middle = tuple(num // 2 for num in beside.values.shape[:2])
    assert ((beside.values[middle] < 0) == (heights < 1 - 1e-3)).all()


def test_distances_and_hits_far_from_the_origin():
    far = np.array([1e4, -2e4, 500.0])
    mesh = extracted(sphere())
    scene = RayScene(TriangleMesh(mesh.vertices + far, mesh.faces))
    points = far + np.array([[0.0, 0, 0.5], [0, 0, 2.0]])
    assert scene.signed_distance(points) == pytest.approx([-0.5, 1.0], abs=0.01)
    assert scene.signed_distance(points[:0]).shape == (0,)  # on which Open3D crashes
    hits = scene.cast(far + np.array([0, 0, 5.0]), np.array([[0, 0, -1.0], [0, 0, 1.0]]))
    assert hits.distance[0] == pytest.approx(4.0, abs=0.01)
    assert hits.face[1] == -1


def test_what_lies_inside_along_rays_is_what_their_crossings_enclose():
    # Two balls behind each other, the second overlapping a third.
    mesh = side_by_side(
        extracted(sphere(0.3, (0, 0, 1.0))),
        extracted(sphere(0.3, (0, 0, -1.0))),
        extracted(sphere(0.3, (0, 0, -1.2))),
    )
    origins = np.array([[0.01, 0.02, 5.0], [0.29, 0, 5.0], [2.0, 0, 5.0]])
    distances = np.linspace(3, 7, 41)
    inside = RayScene(mesh).inside_along(origins, np.array([0.0, 0, -1]), distances)
    points = origins + distances[:, None, None] * np.array([0.0, 0, -1])
    depth = np.min(
        [np.linalg.norm(points - [0, 0, z], axis=-1) - 0.3 for z in (1.0, -1.0, -1.2)], axis=0
    )
    clear = np.abs(depth) > 0.02
    assert (inside == (depth < 0))[clear].all()
    assert inside[:, 0].sum() > 10
    assert not inside[:, 2].any()


def test_sheets_that_have_crossed_are_found():
    shift = np.array([1.2, 0, 0])
    sphere_mesh = extracted(sphere())
    beside = TriangleMesh(sphere_mesh.vertices + 2 * shift, sphere_mesh.faces)
    assert not len(RayScene(side_by_side(sphere_mesh, beside)).crossed_faces(0.004))
    crossed = TriangleMesh(sphere_mesh.vertices + shift, sphere_mesh.faces)
    both = side_by_side(sphere_mesh, crossed)
    found = np.isin(np.arange(len(both.faces)), RayScene(both).crossed_faces(0.004))
    other = np.repeat([shift, 0 * shift], len(sphere_mesh.faces), axis=0)
    depth = 1 - np.linalg.norm(both.centers - other, axis=1)  # in the other sphere
    assert found[depth > 0.02].all()
    assert not found[depth < -0.02].any()
    inside_out = TriangleMesh(sphere_mesh.vertices, sphere_mesh.faces[:, ::-1])
    assert len(RayScene(inside_out).crossed_faces(0.004)) == len(sphere_mesh.faces)


def test_a_camera_sees_the_near_side_only():
    mesh = extracted(union(sphere(0.5), sphere(0.5, (-1.05, 0, 0))))
    center = np.array([4.0, 0, 0])
    index, rays, cosine = visible_points(
        RayScene(mesh), center, mesh.centers, mesh.face_normals, min_cosine=0.1
    )
    assert (mesh.centers[index, 0] > 0).all()  # the second sphere hides behind the first
    assert (cosine > 0.1).all()
    assert np.linalg.norm(rays, axis=1) == pytest.approx(1)
    near = (mesh.centers[:, 0] > -0.5) & (
        ((center - mesh.centers) * mesh.face_normals).sum(axis=1) > 0.5
    )
    assert np.isin(np.flatnonzero(near), index).mean() > 0.99


def test_samples_lie_on_the_wanted_faces_evenly():
    mesh = extracted(sphere())
    upper = (mesh.centers[:, 2] > 0).astype(float)
    face, barycentric = sample_surface(mesh, upper, 20_000, np.random.default_rng(0))
    points = mesh.points_at(face, barycentric)
    assert abs(len(points) - 20_000) <= 1
    assert (points[:, 2] > -0.05).all()
    # Archimedes: heights on a sphere are uniform.
    assert np.mean(points[:, 2] < 0.5) == pytest.approx(0.5, abs=0.02)
    none = sample_surface(mesh, 0 * upper, 100, np.random.default_rng(0))
    assert len(none[0]) == 0
