"""Both camera models on exact cases, where they agree, and where they have nothing to say."""

import numpy as np
import pytest
from scenes import normal_from_angles
from scipy.linalg import expm

from polmvs.polarization.angle_models import (
    model_rays,
    phase_direction,
    phase_from_normal,
    rows_from_axial,
    rows_from_phase,
)
from polmvs.polarization.kinds import FORMULAS, AngleModel

SHAPES = [(1,), (7,), (2, 3)]


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_rays(shape, rng, spread=0.6):
    """Unit rays up to some 40 degrees off the axis."""
    xy = rng.uniform(-spread, spread, (*shape, 2))
    return unit(np.concatenate([xy, np.ones((*shape, 1))], axis=-1))


def random_normals(rays, rng):
    """Visible normals, 5 to 80 degrees from the direction to the camera."""
    zenith = np.radians(rng.uniform(5, 80, rays.shape[:-1]))
    phase = rng.uniform(0, np.pi, rays.shape[:-1])
    return normal_from_angles(AngleModel.PPA, phase, zenith, rays)


def assert_axial_close(actual, expected, atol=1e-9):
    difference = np.mod(actual - expected + np.pi / 2, np.pi) - np.pi / 2
    np.testing.assert_allclose(difference, 0, atol=atol)


def assert_same_up_to_sign(actual, expected, atol=1e-9):
    sign = np.sign((actual * expected).sum(axis=-1, keepdims=True))
    np.testing.assert_allclose(actual, sign * expected, atol=atol)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("model", FORMULAS)
def test_rows_are_unit_and_perpendicular_to_normal_and_ray(model, shape):
    rng = np.random.default_rng(0)
    rays = random_rays(shape, rng)
    normals = random_normals(rays, rng)
    phase = phase_from_normal(model, normals, rays)
    rows = rows_from_phase(model, phase, rays)
    assert phase.shape == shape
    assert rows.shape == (*shape, 3)
    assert ((phase >= 0) & (phase < np.pi)).all()
    np.testing.assert_allclose(np.linalg.norm(rows, axis=-1), 1, rtol=1e-12)
    np.testing.assert_allclose((rows * normals).sum(axis=-1), 0, atol=1e-12)
    np.testing.assert_allclose((rows * model_rays(model, rays)).sum(axis=-1), 0, atol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("model", FORMULAS)
def test_the_row_is_the_papers(model, shape):
    rng = np.random.default_rng(1)
    rays = random_rays(shape, rng)
    phase = rng.uniform(0, np.pi, shape)
    sin, cos = np.sin(phase), np.cos(phase)
    x, y, z = np.moveaxis(model_rays(model, rays), -1, 0)
    paper = np.stack([sin, cos, -(y * cos + x * sin) / z], axis=-1)  # eqs. con_ortho, con_persp
    assert_same_up_to_sign(rows_from_phase(model, phase, rays), unit(paper))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("model", FORMULAS)
def test_phase_is_the_papers(model, shape):
    rng = np.random.default_rng(2)
    rays = random_rays(shape, rng)
    normals = random_normals(rays, rng)
    v, n = np.moveaxis(model_rays(model, rays), -1, 0), np.moveaxis(normals, -1, 0)
    paper = -np.arctan2(-v[2] * n[1] + v[1] * n[2], -v[2] * n[0] + v[0] * n[2])  # eq. phi_persp
    assert_axial_close(phase_from_normal(model, normals, rays), paper)
    assert_axial_close(phase_from_normal(model, -normals, rays), paper)


def test_phase_is_where_the_plane_of_incidence_cuts_the_image():
    rng = np.random.default_rng(3)
    rays = random_rays((50,), rng)
    normals = random_normals(rays, rng)
    direction = phase_direction(phase_from_normal(AngleModel.PPA, normals, rays))
    assert (direction[:, 2] == 0).all()
    volume = np.linalg.det(np.stack([direction, rays, normals], axis=-1))
    np.testing.assert_allclose(volume, 0, atol=1e-12)


def test_a_floor_ahead_has_an_upright_phase_and_a_wall_beside_a_level_one():
    ray = np.array([0.0, 0.0, 1.0])
    floor, wall = unit(np.array([0.0, -1.0, -1.0])), unit(np.array([1.0, 0.0, -1.0]))
    for model in FORMULAS:
        assert_axial_close(phase_from_normal(model, floor, ray), np.pi / 2)
        assert_axial_close(phase_from_normal(model, wall, ray), 0)
    # A quarter to the upper right as displayed: y is down.
    leaning = unit(np.array([1.0, -1.0, -1.0]))
    assert_axial_close(phase_from_normal(AngleModel.PPA, leaning, ray), np.pi / 4)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("model", FORMULAS)
def test_normals_from_angles_return_their_phase_and_zenith(model, shape):
    rng = np.random.default_rng(4)
    rays = random_rays(shape, rng)
    phase = rng.uniform(0, np.pi, shape)
    zenith = np.radians(rng.uniform(-85, 85, shape))
    normals = normal_from_angles(model, phase, zenith, rays)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, rtol=1e-12)
    cosine = -(normals * model_rays(model, rays)).sum(axis=-1)
    np.testing.assert_allclose(cosine, np.cos(zenith), atol=1e-12)
    assert_axial_close(phase_from_normal(model, normals, rays), phase)


def test_normal_from_angles_is_the_matrix_exponential_of_the_paper():
    rng = np.random.default_rng(5)
    ray = random_rays((), rng)
    phase, zenith = 0.7, 0.5
    axis = unit(np.cross(phase_direction(np.array(phase)), ray))
    skew = np.cross(axis, np.eye(3)).T
    expected = -expm(zenith * skew) @ ray
    actual = normal_from_angles(AngleModel.PPA, np.array(phase), np.array(zenith), ray)
    np.testing.assert_allclose(actual, expected, atol=1e-12)


# The four cases of the paper's section "Relations with the OPA AngleModel".


def assert_models_agree(normals, rays, atol=1e-9):
    phase = {m: phase_from_normal(m, normals, rays) for m in (AngleModel.OPA, AngleModel.PPA)}
    assert_axial_close(phase[AngleModel.OPA], phase[AngleModel.PPA], atol)
    rows = {m: rows_from_phase(m, p, rays) for m, p in phase.items()}
    assert_same_up_to_sign(rows[AngleModel.OPA], rows[AngleModel.PPA], atol)


def test_models_agree_on_the_optical_axis():
    rng = np.random.default_rng(6)
    rays = np.tile([0.0, 0.0, 1.0], (20, 1))
    assert_models_agree(random_normals(rays, rng), rays)


def test_models_agree_where_the_plane_of_incidence_is_upright_on_the_image():
    rng = np.random.default_rng(7)
    rays = random_rays((20,), rng)
    azimuth = rays[:, :2] / np.linalg.norm(rays[:, :2], axis=-1, keepdims=True)
    zenith = rng.uniform(0.2, 1.3, 20)
    side = rng.choice([-1, 1], 20)
    normals = np.concatenate(
        [side[:, None] * azimuth * np.sin(zenith)[:, None], -np.cos(zenith)[:, None]], axis=-1
    )
    assert_models_agree(normals, rays)


def test_models_agree_on_normals_in_the_image_plane():
    rng = np.random.default_rng(8)
    rays = random_rays((20,), rng)
    azimuth = rng.uniform(0, 2 * np.pi, 20)
    normals = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(20)], axis=-1)
    phase = {m: phase_from_normal(m, normals, rays) for m in (AngleModel.OPA, AngleModel.PPA)}
    # n_z = 0 makes the phases agree; rows differ, as the planes of incidence do.
    assert_axial_close(phase[AngleModel.OPA], phase[AngleModel.PPA])
    row = rows_from_phase(AngleModel.PPA, phase[AngleModel.PPA], rays)
    np.testing.assert_allclose((row * normals).sum(axis=-1), 0, atol=1e-12)


def test_with_a_normal_along_the_axis_opa_degenerates_and_ppa_tells_the_azimuth_of_the_ray():
    rng = np.random.default_rng(9)
    rays = random_rays((20,), rng)
    normals = np.tile([0.0, 0.0, -1.0], (20, 1))
    assert np.isnan(phase_from_normal(AngleModel.OPA, normals, rays)).all()
    phase = phase_from_normal(AngleModel.PPA, normals, rays)
    assert_axial_close(phase, np.arctan2(-rays[:, 1], rays[:, 0]))
    # In the limit n_z -> 1 the plane of incidence is upright: the PPA row has no z component, as
    # an OPA row of the same phase.
    assert_same_up_to_sign(
        rows_from_phase(AngleModel.PPA, phase, rays), rows_from_phase(AngleModel.OPA, phase, rays)
    )


def test_models_disagree_elsewhere():
    ray = unit(np.array([0.5, 0.0, 1.0]))
    normal = unit(np.array([0.0, -1.0, -1.0]))
    phase = [phase_from_normal(m, normal, ray) for m in (AngleModel.OPA, AngleModel.PPA)]
    # tan = v_z n_y / (v_z n_x - v_x n_z) = 2 by hand
    assert_axial_close(phase[0], np.pi / 2)
    assert_axial_close(phase[1], np.arctan(2.0))


@pytest.mark.parametrize("model", FORMULAS)
def test_a_normal_along_the_ray_has_no_phase(model):
    rays = random_rays((5,), np.random.default_rng(10))
    normals = -model_rays(model, rays)
    assert np.isnan(phase_from_normal(model, normals, rays)).all()


def test_tilted_geometry_is_that_of_ppa():
    rng = np.random.default_rng(11)
    rays = random_rays((9,), rng)
    phase = rng.uniform(0, np.pi, 9)
    np.testing.assert_array_equal(
        rows_from_phase(AngleModel.TILTED, phase, rays),
        rows_from_phase(AngleModel.PPA, phase, rays),
    )


def test_half_angles_are_exact_near_the_axes():
    ray = unit(np.array([0.3, -0.2, 1.0]))
    for phase in (0.0, 1e-9, np.pi / 2 - 1e-9, np.pi / 2, np.pi / 2 + 1e-9, np.pi - 1e-9):
        expected = unit(np.cross(ray, phase_direction(np.array(phase))))
        assert_same_up_to_sign(
            rows_from_phase(AngleModel.PPA, np.array(phase), ray), expected, 1e-15
        )


def test_rows_from_axial_take_any_length_and_keep_float32():
    rays = random_rays((4,), np.random.default_rng(12)).astype(np.float32)
    cos2, sin2 = np.array([[0.3, -2, 0, 5], [0.1, 0, 1e-3, 0]], np.float32)
    rows = rows_from_axial(AngleModel.PPA, cos2, sin2, rays)
    assert rows.dtype == np.float32
    expected = rows_from_phase(AngleModel.PPA, 0.5 * np.arctan2(sin2, cos2), rays)
    assert_same_up_to_sign(rows, expected, 1e-6)


def test_no_polarization_gives_a_nan_row():
    zero = np.zeros(1)
    assert np.isnan(rows_from_axial(AngleModel.PPA, zero, zero, np.array([[0.0, 0.0, 1.0]]))).all()


@pytest.mark.parametrize("model", FORMULAS)
def test_rolling_the_camera_turns_phase_and_rows_with_it(model):
    rng = np.random.default_rng(13)
    rays = random_rays((9,), rng)
    normals = random_normals(rays, rng)
    angle = 0.4
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])  # anticlockwise as displayed
    phase = phase_from_normal(model, normals, rays)
    turned = phase_from_normal(model, normals @ turn.T, rays @ turn.T)
    assert_axial_close(turned, phase + angle)
    assert_same_up_to_sign(
        rows_from_phase(model, turned, rays @ turn.T),
        rows_from_phase(model, phase, rays) @ turn.T,
    )


def test_textbook_models_are_the_published_relations() -> None:
    assert [model.formula for model in AngleModel if model.is_textbook] == [
        AngleModel.OPA,
        AngleModel.PPA,
    ]
    normal, ray = unit(np.array([0.2, -0.4, -0.9])), unit(np.array([0.5, 0.3, 1.0]))
    phases = {model: phase_from_normal(model, normal, ray) for model in AngleModel}
    for model in AngleModel:
        assert phases[model] == phases[model.formula]
    assert phases[AngleModel.TEXTBOOK_OPA] != phases[AngleModel.TEXTBOOK_PPA]
