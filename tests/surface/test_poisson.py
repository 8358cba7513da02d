import numpy as np
import pytest

from polmvs.errors import DataError
from polmvs.io.clouds import Cloud, Mesh, read_mesh, write_mesh
from polmvs.neighbors import point_spacings
from polmvs.scene import PointKind
from polmvs.surface.mesh_geometry import TriangleMesh
from polmvs.surface.poisson import MeshTolerances, octree_depth, poisson_mesh

SPACING = 0.01
NUM = 80  # points along a side


def plane_patch(num=NUM, noise=0.0, hole=0.0):
    """A tilted square patch, its unit normal, and coordinates in it; points scattered a little."""
    rng = np.random.default_rng(0)
    uv = np.stack(np.meshgrid(np.arange(num), np.arange(num)), -1).reshape(-1, 2) + 0.5
    uv = (uv + rng.uniform(-0.2, 0.2, size=uv.shape)) * SPACING
    center = 0.5 * num * SPACING
    uv = uv[np.linalg.norm(uv - center, axis=1) >= hole]
    axes = np.linalg.qr(np.array([[1.0, 0.2, 0.1], [0, 1.0, -0.3], [0.2, 0, 1.0]]).T)[0].T
    points = uv @ axes[:2] + rng.normal(scale=noise, size=(len(uv), 1)) * axes[2]
    normals = np.broadcast_to(axes[2], points.shape).copy()
    colors = np.full(points.shape, 90, np.uint8)
    return Cloud(points, normals, colors), axes


def sphere_cap(radius=0.3, height=0.2, num=12000):
    """Points of a cap of a sphere about the origin, evenly spread, and its area."""
    index = np.arange(num) + 0.5
    z = radius - height * index / num
    angle = np.pi * (1 + np.sqrt(5)) * index
    r = np.sqrt(radius**2 - z**2)
    points = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1)
    return Cloud(points, points / radius), 2 * np.pi * radius * height


def area_of(mesh):
    return float(TriangleMesh(mesh.vertices, mesh.triangles).face_areas.sum())


def boundary_edges(triangles):
    """Edges that belong to one triangle only, lower vertex first."""
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    return unique[count == 1]


def num_loops(mesh):
    """Closed outlines of a mesh: one for a patch without holes."""
    left = {tuple(e) for e in boundary_edges(mesh.triangles).tolist()}
    loops = 0
    while left:
        front, loops = set(left.pop()), loops + 1
        while met := {e for e in left if front & set(e)}:
            left -= met
            front = {v for e in met for v in e}
    return loops


def test_a_plane_patch_ends_where_its_points_end():
    cloud, axes = plane_patch()
    mesh = poisson_mesh(cloud)
    # Poisson surfaces bend where they end; inside there is no error to make.
    height = np.abs(mesh.vertices @ axes[2])
    assert height.max() < 0.25 * SPACING
    assert np.median(height) < 0.02 * SPACING
    uv, side = mesh.vertices @ axes[:2].T, NUM * SPACING
    # Half a spacing beyond the points, and a cell of the octree, up to two spacings wide.
    assert uv.min() > -2 * SPACING
    assert uv.max() < side + 2 * SPACING
    assert area_of(mesh) == pytest.approx(side**2, rel=0.03)
    assert num_loops(mesh) == 1
    np.testing.assert_allclose(np.abs(mesh.normals @ axes[2]), 1, atol=1e-6)
    assert (mesh.colors == 90).all()


def test_a_sphere_cap_faces_outwards():
    cloud, area = sphere_cap()
    mesh = poisson_mesh(cloud)
    spacing = np.sqrt(area / len(cloud.points))
    error = np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.3)
    assert error.max() < 0.5 * spacing
    assert np.median(error) < 0.02 * spacing
    assert mesh.vertices[:, 2].min() > 0.1 - 2.5 * spacing
    assert area_of(mesh) == pytest.approx(area, rel=0.03)
    assert num_loops(mesh) == 1
    assert (mesh.normals * mesh.vertices).sum(axis=1).min() > 0.29
    assert (TriangleMesh(mesh.vertices, mesh.triangles).vertex_normals * mesh.normals).sum(
        axis=1
    ).min() > 0.9


def test_a_wide_hole_stays_and_a_narrow_one_is_closed():
    full = NUM**2 * SPACING**2
    cloud, axes = plane_patch(hole=12 * SPACING)
    mesh = poisson_mesh(cloud)
    assert num_loops(mesh) == 2
    uv = mesh.vertices @ axes[:2].T - 0.5 * NUM * SPACING
    assert np.linalg.norm(uv, axis=1).min() > 10 * SPACING
    assert area_of(mesh) == pytest.approx(full - np.pi * (12 * SPACING) ** 2, rel=0.03)
    closed = poisson_mesh(plane_patch(hole=2 * SPACING)[0])
    assert num_loops(closed) == 1
    assert area_of(closed) == pytest.approx(full, rel=0.03)


def test_the_same_cloud_gives_the_same_mesh_in_any_unit():
    cloud, _ = plane_patch(num=40, noise=0.2 * SPACING)
    first, again = poisson_mesh(cloud), poisson_mesh(cloud)
    np.testing.assert_array_equal(first.vertices, again.vertices)
    np.testing.assert_array_equal(first.triangles, again.triangles)
    large = poisson_mesh(Cloud(1024 * cloud.points, cloud.normals))
    assert len(large.triangles) == pytest.approx(len(first.triangles), rel=0.01)
    assert large.colors is None


def test_only_the_kinds_asked_for_count():
    cloud, axes = plane_patch(num=40)
    other = Cloud(cloud.points + 0.2 * axes[2], cloud.normals)
    both = Cloud(
        np.concatenate([cloud.points, other.points]),
        np.concatenate([cloud.normals, other.normals]),
        scalars={"kind": np.repeat([PointKind.SURFACE, PointKind.STEREO], len(cloud.points))},
    )
    assert np.abs(poisson_mesh(both).vertices @ axes[2]).max() < SPACING
    assert (poisson_mesh(both, kinds=[PointKind.STEREO]).vertices @ axes[2]).min() > 0.19
    assert np.ptp(poisson_mesh(both, kinds=list(PointKind)).vertices @ axes[2]) > 0.19


def test_outliers_and_islands_go():
    cloud, axes = plane_patch(num=40)
    far = np.random.default_rng(1).uniform(5, 50, size=(20, 3))
    island = plane_patch(num=8)[0].points + 0.3 * axes[2]
    extra = np.concatenate([far, island])
    normals = np.broadcast_to(axes[2], extra.shape)
    mesh = poisson_mesh(
        Cloud(np.concatenate([cloud.points, extra]), np.concatenate([cloud.normals, normals]))
    )
    assert np.abs(mesh.vertices @ axes[2]).max() < SPACING
    # One spacing along the sides is 10 %; the island makes the octree's cells 1.5 spacings wide.
    assert area_of(mesh) == pytest.approx((40 * SPACING) ** 2, rel=0.1)


def test_spacing_depth_and_edges_of_known_sets():
    grid = np.stack(np.meshgrid(np.arange(50), np.arange(50), [0]), -1).reshape(-1, 3) * 0.2
    # Near exact for scattered points; a grid's eighth neighbour is nearer than the mean.
    assert np.median(point_spacings(grid)) == pytest.approx(0.2, rel=0.15)
    scattered = np.random.default_rng(0).uniform(size=(20000, 3)) * [1, 1, 0]
    assert np.median(point_spacings(scattered)) == pytest.approx(20000**-0.5, rel=0.06)
    assert octree_depth(grid, 0.2) == 5  # 1.1 x 9.8 over 32 cells is 0.34, over 64 less than 0.2
    assert octree_depth(grid, 1e-9) == MeshTolerances().max_depth
    assert octree_depth(grid, 1e9) == MeshTolerances().min_depth
    square = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    np.testing.assert_array_equal(boundary_edges(square), [[0, 1], [0, 3], [1, 2], [2, 3]])
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    mesh = TriangleMesh(corners, square)
    np.testing.assert_allclose(mesh.face_areas, 0.5)
    np.testing.assert_allclose(mesh.vertex_normals, [[0, 0, 1]] * 4)


def test_clouds_that_make_no_mesh_are_named():
    cloud, _ = plane_patch(num=40)
    with pytest.raises(DataError, match=r"a\.ply: has no normals"):
        poisson_mesh(Cloud(cloud.points), source="a.ply")
    few = Cloud(cloud.points[:99], cloud.normals[:99])
    with pytest.raises(DataError, match="99 points"):
        poisson_mesh(few)
    unknown = Cloud(cloud.points, np.full_like(cloud.points, np.nan))
    with pytest.raises(DataError, match="has 0 points"):
        poisson_mesh(unknown)
    sparse = Cloud(cloud.points, cloud.normals, scalars={"kind": np.ones(len(cloud.points))})
    with pytest.raises(DataError, match="has 0 points"):
        poisson_mesh(sparse)


def test_points_in_one_place_are_named():
    cloud = Cloud(np.zeros((200, 3)), np.tile([0.0, 0, 1], (200, 1)))
    with pytest.raises(DataError, match="same places"):
        poisson_mesh(cloud)


def small_mesh(colors=True):
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(30, 3))
    normals = rng.normal(size=(30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    triangles = np.stack([rng.permutation(30)[:3] for _ in range(40)]).astype(np.int32)
    return Mesh(
        vertices,
        normals,
        triangles,
        rng.integers(0, 255, size=(30, 3)).astype(np.uint8) if colors else None,
    )


@pytest.mark.parametrize("colors", [True, False])
def test_a_mesh_comes_back(tmp_path, colors):
    mesh = small_mesh(colors)
    write_mesh(tmp_path / "folder" / "m.ply", mesh)
    again = read_mesh(tmp_path / "folder" / "m.ply")
    np.testing.assert_allclose(again.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_allclose(again.normals, mesh.normals, atol=1e-6)
    np.testing.assert_array_equal(again.triangles, mesh.triangles)
    if colors:
        np.testing.assert_array_equal(again.colors, mesh.colors)
    else:
        assert again.colors is None
    assert [p.name for p in (tmp_path / "folder").iterdir()] == ["m.ply"]


def test_an_empty_mesh(tmp_path):
    none = Mesh(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    write_mesh(tmp_path / "e.ply", none)
    assert read_mesh(tmp_path / "e.ply").triangles.shape == (0, 3)


@pytest.mark.parametrize("missing", [5, 300, 700])
def test_a_truncated_mesh_is_named(tmp_path, missing):
    path = tmp_path / "short.ply"
    write_mesh(path, small_mesh())
    path.write_bytes(path.read_bytes()[:-missing])
    with pytest.raises(DataError, match=r"short\.ply"):
        read_mesh(path)


def test_a_cloud_is_no_mesh(tmp_path):
    path = tmp_path / "c.ply"
    path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n")
    with pytest.raises(DataError, match="no faces"):
        read_mesh(path)
    with pytest.raises(DataError, match=r"nothing\.ply"):
        read_mesh(tmp_path / "nothing.ply")


def test_a_mesh_that_cannot_be_written_leaves_nothing(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="file"):
        write_mesh(tmp_path / "file" / "m.ply", small_mesh())
    (tmp_path / "m.ply").mkdir()
    with pytest.raises(DataError, match=r"m\.ply"):
        write_mesh(tmp_path / "m.ply", small_mesh())
    assert {p.name for p in tmp_path.iterdir()} == {"file", "m.ply"}
