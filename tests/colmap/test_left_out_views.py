"""Views that SfM leaves out: what contradicts the camera, and what is tried for them."""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from printed_images import INTRINSICS, write_printed_images

from polmvs.colmap import contradicting_pairs
from polmvs.colmap.contradicting_pairs import drop_contradicting
from polmvs.colmap.database import image_numbers, match_pairs, opened
from polmvs.colmap.left_out_views import (
    Step,
    Trial,
    forget_matches,
    pool_descriptors,
    try_harder,
)
from polmvs.colmap.sfm import SfmWork, run_sfm
from polmvs.config import SfmOptions

NUM_VIEWS = 5
CALIBRATED = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
UNCALIBRATED = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, list[str]]:
    """Images, COLMAP's database of them, and their names."""
    folder = tmp_path_factory.mktemp("left_out")
    (folder / "images").mkdir()
    names = [view.name for view in write_printed_images(folder / "images", NUM_VIEWS)]
    options = SfmOptions(intrinsics=INTRINSICS)
    run_sfm(folder / "images", names, folder / "work", folder / "sparse", options)
    return folder / "images", folder / "work" / "database.db", names


@pytest.fixture
def database(solved, tmp_path: Path) -> Path:
    return Path(shutil.copy(solved[1], tmp_path / "database.db"))


def pairs_of(names: list[str]) -> tuple[tuple[str, str], ...]:
    return tuple((a, b) for i, a in enumerate(names) for b in names[i + 1 :])


def work_on(images: Path, names: list[str], database: Path) -> SfmWork:
    camera = ",".join(map(repr, INTRINSICS))
    return SfmWork(
        images=images,
        names=names,
        database=database,
        reader=pycolmap.ImageReaderOptions(camera_model="PINHOLE", camera_params=camera),
        options=SfmOptions(intrinsics=INTRINSICS),
    )


def matches(database: Path, pair: tuple[str, str]) -> np.ndarray:
    numbers = image_numbers(database)
    with opened(database) as content:
        return np.asarray(content.read_matches(numbers[pair[0]], numbers[pair[1]]))


def test_views_without_matches_are_matched_again_and_no_others(solved, database, caplog) -> None:
    images, _, names = solved
    caplog.set_level("WARNING")
    last, pairs = names[-1], pairs_of(names)
    of_last = tuple(pair for pair in pairs if last in pair)
    forget_matches(database, of_last)
    before = {pair: matches(database, pair) for pair in pairs if last not in pair}

    map_once = work_on(images, names, database).map

    def never(path: Path) -> None:
        raise AssertionError("the first step is enough")

    found = map_once()
    assert found is not None
    assert found.num_reg_images() == NUM_VIEWS - 1
    trial = Trial(database=database, pairs=pairs, describe=never, map=map_once, seed=0)
    harder = try_harder(found, names, trial)
    assert harder is not None
    assert harder.num_reg_images() == NUM_VIEWS
    assert f"with one after {Step.GUIDED}: {last}" in caplog.text
    for pair, kept in before.items():
        assert np.array_equal(matches(database, pair), kept)
    # Along a known geometry more is found than by looks alone.
    guided = sum(len(matches(database, pair)) for pair in of_last)
    forget_matches(database, of_last)
    match_pairs(database, of_last)
    assert guided >= sum(len(matches(database, pair)) for pair in of_last) > 0


def test_pooling_changes_the_descriptors_of_the_same_keypoints(solved, tmp_path: Path) -> None:
    images, _, names = solved
    database = tmp_path / "database.db"
    work = work_on(images, names[:2], database)
    work.describe(database)
    with opened(database) as content:  # one is gone, as after a static background has
        keypoints, looks = content.read_keypoints(1)[1:], content.read_descriptors(1)
        looks.data = np.ascontiguousarray(looks.data[1:])
        others = content.read_keypoints(2), content.read_descriptors(2)
        content.clear_keypoints()
        content.clear_descriptors()
        for number, found in enumerate(((keypoints, looks), others), 1):
            content.write_keypoints(number, np.ascontiguousarray(found[0]))
            content.write_descriptors(number, found[1])
    describe = partial(work.describe, pooled=True)
    trial = Trial(database=database, pairs=(), describe=describe, map=lambda: None, seed=0)
    pool_descriptors(trial)
    with opened(database) as content:
        assert np.array_equal(content.read_keypoints(1), keypoints)
        now = np.asarray(content.read_descriptors(1).data, float)
    before = np.asarray(looks.data, float)
    assert now.shape == before.shape
    alike = (now * before).sum(1) / np.linalg.norm(now, axis=1) / np.linalg.norm(before, axis=1)
    assert 0.6 < np.median(alike) < 0.999  # of the same places, but not the same
    assert not list(tmp_path.glob("pooled*"))


def test_a_worse_model_is_not_taken(solved, database) -> None:
    names = solved[2]
    trial = Trial(
        database=database, pairs=(), describe=lambda path: shutil.copy(database, path),
        map=lambda: None, seed=0,
    )  # fmt: skip
    assert try_harder(None, names, trial) is None


@pytest.mark.parametrize(("share", "goes"), [(0.3, True), (0.8, False)])
def test_pairs_that_contradict_the_camera_go_unless_most_do(
    database, share, goes, monkeypatch
) -> None:
    with opened(database) as content:
        numbers = sorted(image.image_id for image in content.read_all_images())
        pairs = [(a, b) for a in numbers for b in numbers if a < b]
        verified = [p for p in pairs if content.exists_two_view_geometry(*p)
                    and len(content.read_two_view_geometry(*p).inlier_matches)]  # fmt: skip
        wrong = verified[: round(share * len(verified))]
        for pair in verified:
            geometry = content.read_two_view_geometry(*pair)
            geometry.config = UNCALIBRATED if pair in wrong else CALIBRATED
            content.delete_two_view_geometry(*pair)
            content.write_two_view_geometry(*pair, geometry)
    with monkeypatch.context() as patch:  # of many images none go
        patch.setattr(contradicting_pairs, "MAX_IMAGES", NUM_VIEWS - 1)
        assert drop_contradicting(database) == 0
    assert drop_contradicting(database) == (len(wrong) if goes else 0)
    with opened(database) as content:
        left = [pair for pair in verified if content.exists_two_view_geometry(*pair)]
    assert left == [pair for pair in verified if not (goes and pair in wrong)]
