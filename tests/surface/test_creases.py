"""Sharp edges: which normals carved walls have."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from polmvs.surface.creases import sharpened, sided_normals, sides_known, wall_normals
from polmvs.surface.mesh_geometry import RayScene, mesh_from_grid, remeshed

STEP, HALF = 0.08, 1.9
TURN = Rotation.from_rotvec([0.3, 0.5, 0.2]).as_matrix()  # the grid's axes are not the object's


def box(points) -> np.ndarray:
    """Signed distance of points to a box of half sides 1."""
    return np.abs(points @ TURN).max(axis=-1) - 1


def beside_the_wall(points) -> np.ndarray:
    """Free space above z = 0 where x > 0: a step with a wall at x = 0."""
    local = points @ TURN
    return np.minimum(local[..., 0], local[..., 2])


@pytest.fixture(scope="module")
def meshes():
    """The box, and what is left of it."""
    axis = np.arange(-HALF, HALF + STEP, STEP)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    whole = mesh_from_grid(box(grid).astype(np.float32), np.full(3, -HALF), STEP)
    return whole, remeshed(RayScene(whole), 1.5 * STEP, free=[beside_the_wall], smoothing=0)


def true_normals(mesh) -> np.ndarray:
    """Outward ones of the carved box, of the side that is nearest to a face's centre."""
    x, y, z = (mesh.centers @ TURN).T
    far = np.full(len(x), np.inf)
    wall = np.where((z > 0) & (np.abs(y) < 1), np.abs(x), far)
    tread = np.where((x > 0) & (np.abs(y) < 1), np.abs(z), far)
    right = np.where(z < 0, np.abs(x - 1), far)
    top = np.where(x < 0, np.abs(z - 1), far)
    rest = [np.abs(x + 1), np.abs(y - 1), np.abs(y + 1), np.abs(z + 1)]
    axes = np.array(
        [[1, 0, 0], [0, 0, 1], [1, 0, 0], [0, 0, 1], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, -1]]
    )
    return axes[np.argmin([wall, tread, right, top, *rest], axis=0)] @ TURN.T


def on_the_wall(mesh) -> np.ndarray:
    x, y, z = (mesh.centers @ TURN).T
    return (np.abs(x) < 0.05) & (z > 0.1) & (z < 0.9) & (np.abs(y) < 0.9)


def degrees_apart(a, b) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=-1), -1, 1)))


def of_walls(meshes, normals, is_fitted):
    whole, mesh = meshes
    to_whole = np.abs(RayScene(whole).signed_distance(mesh.centers))
    return wall_normals(mesh, normals, is_fitted, [beside_the_wall], to_whole)


def test_a_carved_wall_that_mirrors_its_floor_is_made_sharp(meshes):
    _, mesh = meshes
    is_fitted = degrees_apart(mesh.face_normals, true_normals(mesh)) < 5
    seen = np.where(is_fitted[:, None], true_normals(mesh), mesh.face_normals)
    mirrored = on_the_wall(mesh) & is_fitted
    assert mirrored.sum() > 100
    seen[mirrored] = TURN @ [np.sqrt(0.5), 0, np.sqrt(0.5)]
    normals, is_wall = of_walls(meshes, seen, is_fitted)
    assert is_wall[mirrored].all()
    assert degrees_apart(normals[mirrored], TURN[:, 0]).max() < 1

    def error(given, known) -> float:
        sharp = sharpened(mesh, sided_normals(mesh, given, known)[0])
        x, y, z = (sharp.centers @ TURN).T
        about = (np.hypot(x, np.minimum(z, 0)) < 0.2) & (z < 0.8) & (np.abs(y) < 0.8)
        off = degrees_apart(sharp.face_normals, true_normals(sharp))
        return float(np.average(off[about], weights=sharp.face_areas[about]))

    assert error(normals, is_fitted | is_wall) < min(6, 0.7 * error(seen, is_fitted))


def test_faces_that_the_grid_rounds_get_the_side_that_was_carved_there(meshes):
    _, mesh = meshes
    normals, is_wall = of_walls(meshes, mesh.face_normals, np.zeros(len(mesh.faces), bool))
    truth = true_normals(mesh)
    rounded = is_wall & (degrees_apart(mesh.face_normals, truth) > 25)
    assert rounded.sum() > 30
    assert np.median(degrees_apart(normals, truth)[rounded]) < 2


def test_a_wall_without_phases_is_as_it_was_carved_though_the_mesh_wobbles(meshes):
    _, mesh = meshes
    wall = on_the_wall(mesh)
    bent = TURN @ [np.cos(np.radians(8)), 0, np.sin(np.radians(8))]
    own = np.where(wall[:, None], bent, mesh.face_normals)
    normals, is_wall = of_walls(meshes, own, ~wall)
    assert is_wall[wall].mean() > 0.9
    assert degrees_apart(normals, TURN[:, 0])[wall & is_wall].max() < 0.5


def test_faces_across_an_edge_go_to_one_of_its_sides(meshes):
    _, mesh = meshes
    truth = true_normals(mesh)
    is_fitted = degrees_apart(mesh.face_normals, truth) < 5
    across = ~is_fitted & (degrees_apart(mesh.face_normals, truth) < 44)
    assert across.sum() > 300
    seen = np.where(is_fitted[:, None], truth, mesh.face_normals)
    assert degrees_apart(seen, truth)[across].mean() > 15
    off = degrees_apart(sided_normals(mesh, seen, is_fitted)[0], truth)[across]
    assert np.mean(np.minimum(off, np.abs(90 - off)) > 10) < 0.05  # of either side
    assert np.mean(off < 10) > 0.8


def test_sides_that_were_not_carved_keep_their_normals(meshes):
    _, mesh = meshes
    normals = true_normals(mesh)
    x, _, z = (mesh.centers @ TURN).T
    off_the_foot = np.hypot(x, z) > 0.1  # in which the two sides are as near
    found, is_wall = of_walls(meshes, normals, np.ones(len(normals), bool))
    assert not is_wall[off_the_foot].any()
    assert np.array_equal(found[~is_wall], normals[~is_wall])
    # The wall's plane goes on through the solid: what lies on it by chance is no wall.
    tilted = normals + 0.3 * TURN[:, 1]
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    beside = ((x > 0.99) & (z < -0.2)) | ((z > 0.99) & (x < -0.2))
    assert not of_walls(meshes, tilted, np.ones(len(normals), bool))[1][beside].any()


def test_a_side_is_known_up_to_its_edges_and_no_farther(meshes):
    _, mesh = meshes
    normals = true_normals(mesh)
    local = mesh.centers @ TURN
    top = (local[:, 2] > 0.98) & (normals @ TURN[:, 2] > 0.5)
    inside = 1 - np.maximum(np.abs(local[:, 1]), -local[:, 0])  # of the nearest edge of the top
    fitted = top & (inside > 1.5 * mesh.mean_edge)
    known = sides_known(mesh, normals, fitted)
    assert not known[normals @ TURN[:, 2] < 0.5].any()
    beside = top & (inside < 1.5 * mesh.mean_edge) & (local[:, 0] < -0.2)
    assert beside.sum() > 20
    assert known[beside].mean() > 0.9
    assert not sides_known(mesh, normals, np.zeros(len(normals), bool)).any()
