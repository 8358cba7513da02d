import numpy as np
import pytest

from polmvs.polarization.region import find_region, grow_mask

SHAPE = (120, 160)
RNG = np.random.default_rng(0)


def stokes_scene(dolp=0.6, phase=0.3):
    """A dark polarized rectangle on a bright textured unpolarized ground."""
    s0 = 0.5 + 0.3 * RNG.standard_normal(SHAPE)
    s1, s2 = np.zeros(SHAPE), np.zeros(SHAPE)
    part = np.zeros(SHAPE, bool)
    part[30:90, 40:130] = True
    s0[part] = 0.1
    s1[part], s2[part] = 0.1 * dolp * np.cos(2 * phase), 0.1 * dolp * np.sin(2 * phase)
    return s0, s1, s2, part


def find(s0, s1, s2, valid=None, **options):
    images = [np.asarray(a, np.float32) for a in (s0, s1, s2)]
    valid = np.ones(SHAPE, bool) if valid is None else valid
    return find_region(*images, valid, min_dolp=0.1, **options)


def test_the_polarized_part_is_found():
    s0, s1, s2, part = stokes_scene()
    region = find(s0, s1, s2)
    assert (region.inside & part).sum() > 0.95 * part.sum()
    assert (region.inside & part).sum() > 0.9 * region.inside.sum()


def test_no_polarization_no_region():
    s0, _, _, _ = stokes_scene()
    assert not find(s0, np.zeros(SHAPE), np.zeros(SHAPE)).inside.any()


def test_a_mark_is_inside_but_not_reliable():
    s0, s1, s2, _ = stokes_scene()
    mark = np.zeros(SHAPE, bool)
    mark[55:63, 70:78] = True
    s0[mark], s1[mark], s2[mark] = 0.6, 0, 0
    region = find(s0, s1, s2)
    assert region.inside[mark].all()
    assert not region.reliable[mark].any()


def test_a_mark_that_a_narrow_gap_joins_with_the_background_is_inside():
    s0, s1, s2, _ = stokes_scene()
    mark = np.zeros(SHAPE, bool)
    mark[50:66, 105:121] = True
    mark[56:60, 121:130] = True  # to the outline
    mark[50:66:2, 105:121:3] = False
    s0[mark], s1[mark], s2[mark] = 0.6, 0, 0
    assert find(s0, s1, s2).inside[50:66, 105:121].all()


def test_a_textureless_unpolarized_spot_belongs_to_the_region_without_being_reliable():
    s0, s1, s2, _ = stokes_scene()
    spot = np.zeros(SHAPE, bool)
    spot[40:80, 60:110] = True
    s1[spot], s2[spot] = 0, 0
    region = find(s0, s1, s2)
    assert region.inside[spot].mean() > 0.99
    assert not region.reliable[50:70, 70:100].any()


@pytest.mark.parametrize(
    ("factor", "joins"), [(1.0, True), (1.3, True), (0.77, True), (2.5, False), (0.4, False)]
)
def test_an_unpolarized_side_joins_if_it_is_as_bright(factor, joins):
    s0, s1, s2, _ = stokes_scene()
    side = np.zeros(SHAPE, bool)
    side[30:90, 95:130] = True
    s0[side] *= factor
    s1[side], s2[side] = 0, 0
    found = find(s0, s1, s2).inside[45:75, 104:116].mean()
    assert found == pytest.approx(float(joins), abs=0.05)


def test_a_textured_hole_stays_a_hole():
    s0, s1, s2, _ = stokes_scene()
    hole = np.zeros(SHAPE, bool)
    hole[38:84, 55:115] = True  # larger than any mark
    s0[hole] = 0.5 + 0.3 * RNG.standard_normal(int(hole.sum()))
    s1[hole], s2[hole] = 0, 0
    region = find(s0, s1, s2)
    assert region.inside[45:75, 65:105].mean() < 0.05


def test_saturated_pixels_are_not_reliable():
    s0, s1, s2, _ = stokes_scene()
    valid = np.ones(SHAPE, bool)
    valid[50:60, 60:70] = False
    assert not find(s0, s1, s2, valid).reliable[50:60, 60:70].any()


def test_a_crease_between_two_faces_is_an_edge():
    s0, s1, s2, part = stokes_scene()
    half = part.copy()
    half[:, :85] = False
    s1[half], s2[half] = 0.1 * 0.6 * np.cos(2 * 1.2), 0.1 * 0.6 * np.sin(2 * 1.2)
    region = find(s0, s1, s2)
    assert region.edges[35:85, 83:88].any(axis=1).all()
    assert not region.edges[40:80, 50:75].any()
    assert not region.edges[40:80, 95:120].any()


def test_the_users_mask_replaces_the_search():
    s0, s1, s2, _ = stokes_scene()
    mask = np.zeros(SHAPE, bool)
    mask[40:60, 50:100] = True
    np.testing.assert_array_equal(find(s0, s1, s2, mask=mask).inside, mask)


def patch_before_a_background(size, shade=1.0):
    """A polarized patch before a flat unpolarized background of like brightness."""
    s0 = np.full(SHAPE, 0.1 * shade)
    s1, s2 = np.zeros(SHAPE), np.zeros(SHAPE)
    patch = (slice(60 - size // 2, 60 + size // 2), slice(80 - size // 2, 80 + size // 2))
    s0[patch], s1[patch] = 0.1, 0.06
    return find(s0, s1, s2), patch


@pytest.mark.parametrize("shade", [1.0, 0.97])
def test_growth_does_not_run_into_an_open_textureless_background(shade):
    """A small patch keeps its own extent."""
    region, _ = patch_before_a_background(20, shade)
    assert region.inside[55:65, 75:85].all()
    assert region.inside.sum() < 4 * 400


def test_growth_that_meets_the_images_border_is_unbounded():
    """Beside a larger patch, nothing shows whether the background is more of the surface."""
    region, patch = patch_before_a_background(60)
    assert not region.unbounded[patch].any()
    beyond = region.inside & ~region.unbounded
    beyond[patch] = False
    assert beyond.sum() < 5 * 4 * 60  # what the smoothing adds along the patch
    assert region.unbounded[5:115, 5:30].all()


def test_growth_that_ends_within_the_image_is_bounded():
    assert not find(*stokes_scene()[:3]).unbounded.any()


def test_a_larger_image_of_a_scene_has_the_same_region():
    """Marks and frontal spots grow with the resolution, and so does what is filled."""
    rows, cols = np.mgrid[:512, :612] + 0.5
    inside = np.hypot(rows - 256, cols - 306) < 180
    mark = (np.abs(rows - 200) < 17) & (np.abs(cols - 300) < 20)  # 1,360 px of strong texture
    dolp = np.where(inside & ~mark, 0.5, 0.0)
    s0 = np.where(inside, 0.2, 0.6) + np.where(mark & (cols % 4 < 2), 0.6, 0.0)
    shares = []
    for times in (1, 2):
        images = [np.kron(a, np.ones((times, times))).astype(np.float32) for a in (s0, s0 * dolp)]
        valid = np.ones(images[0].shape, bool)
        region = find_region(images[0], images[1], 0 * images[1], valid, min_dolp=0.1)
        assert region.inside[200 * times, 300 * times]
        shares.append(region.inside.mean())
    assert abs(shares[0] - shares[1]) < 0.002


def test_grow_mask():
    mask = np.zeros((7, 7), bool)
    mask[3, 3] = True
    assert grow_mask(mask, 2).sum() == 25
    np.testing.assert_array_equal(grow_mask(mask, 0), mask)
