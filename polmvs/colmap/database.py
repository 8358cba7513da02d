"""COLMAP databases: a user's database is checked and copied, never opened for writing.

A faulty database makes COLMAP end the process, so it is read with SQLite first.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import pycolmap
from numpy.typing import NDArray

from polmvs.colmap.cameras import quiet_colmap
from polmvs.colmap.learned_features import LearnedFeatures
from polmvs.colmap.pairs import Pairs
from polmvs.config import default_num_workers
from polmvs.errors import DataError, PolmvsError
from polmvs.scene import match_names
from polmvs.separate import run_separately

FLOAT_BYTES = 4
TABLES = ("cameras", "images", "keypoints", "descriptors", "matches", "two_view_geometries")
MIN_SHARE = 50  # pairs that take as long as a process for them takes to start, 0.5 s
REMEDY = "Make it again with COLMAP, or leave `sfm.database` out."


@dataclass(frozen=True, kw_only=True)
class GivenDatabase:
    """Content of a user's database for a capture.

    Attributes
    ----------
    path : of the database.
    ids : its ids of the images that it has, by the capture's name.
    num_cameras : number of cameras of these images.
    has_matches : whether any two images are matched and verified.
    """

    path: Path
    ids: Mapping[str, int]
    num_cameras: int
    has_matches: bool


class NoRoomError(PolmvsError):
    """A database cannot be written, such as on a full disk."""


def check_database(path: Path, names: Sequence[str], width: int, height: int) -> GivenDatabase:
    """A COLMAP database with features of a capture's images.

    Parameters
    ----------
    path : the file; it is not changed.
    names : of the capture's images; the database may name them with another suffix.
    width, height : of the polarization images, px.

    Raises
    ------
    DataError
        It is missing, damaged, not a COLMAP database, of other images or of another size.
    """
    if not path.is_file():
        raise DataError(path, "no such file. `sfm.database` takes a COLMAP database.")
    with sound(path), closing(_open_read_only(path)) as connection:
        return _checked(connection, path, names, width, height)


@contextmanager
def sound(path: Path) -> Iterator[None]:
    """Turn errors of SQLite and COLMAP in this block into errors that name the database."""
    try:
        yield
    except (sqlite3.Error, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise DataError(path, f"is no sound COLMAP database ({reason}). {REMEDY}") from error


@contextmanager
def _room() -> Iterator[None]:
    """Turn SQLite's write errors in this block into :class:`NoRoomError`."""
    try:
        yield
    except sqlite3.OperationalError as error:
        if error.sqlite_errorcode & 0xFF in (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR):
            raise NoRoomError(str(error)) from error
        raise


def copy_database(given: GivenDatabase, target: Path) -> None:
    """A copy in a new file, with the capture's names of the images.

    Images that are not of the capture stay in it, named by their ids.

    Raises
    ------
    NoRoomError
        The copy cannot be written.
    DataError
        The database is damaged.
    """
    with sound(given.path), _room():
        _copy(given.path, target)
        with _renamed(target, {number: name for name, number in given.ids.items()}, keep=True):
            pass
        with opened(target):
            pass


def match_pairs(
    database: Path,
    pairs: Pairs,
    *,
    seed: int = 0,
    guided: bool = False,
    learned: LearnedFeatures | None = None,
) -> None:
    """Match pairs of images and verify them; existing matches of the database are kept.

    Each core has a process with a copy of the database. Two threads that search COLMAP's indices of
    descriptors disturb each other. Measured: about once in 600 times, ten images matched in pairs
    have other matches, for any number of threads of OpenMP and OpenBLAS; with one thread never in
    3,000.

    Parameters
    ----------
    pairs : of names of images.
    seed : of the verification.
    guided : find more matches along the geometry of the first ones.
    learned : extractor of the features; None: SIFT.

    Raises
    ------
    NoRoomError
        A copy cannot be written.
    CrashError
        COLMAP ends a process, such as when its database cannot be written.
    """
    # COLMAP's lists of pairs are split at blanks, which names may have.
    numbers = image_numbers(database)
    lines = [f"id{numbers[first]} id{numbers[second]}\n" for first, second in pairs]
    num_shares = min(default_num_workers(), max(len(pairs) // MIN_SHARE, 1))
    ends = [len(lines) * k // num_shares for k in range(num_shares + 1)]
    with _renamed(database, {}):
        if num_shares == 1:
            _match_share(database, "".join(lines), seed, guided, learned)
            return
        copies = [database.with_name(f"share{k}.db") for k in range(num_shares)]
        with _room():
            for copy in copies:
                _copy(database, copy)
        shares = ["".join(lines[begin:end]) for begin, end in pairwise(ends)]
        with ThreadPoolExecutor(num_shares) as pool:  # each waits for its process
            match = partial(run_separately, _match_share)
            list(pool.map(lambda *own: match(*own, seed, guided, learned), copies, shares))
        with _room():
            for copy in copies:
                _take_matches(database, copy)
        for path in database.parent.glob("share*.db*"):
            path.unlink()


def _match_share(
    database: Path,
    lines: str,
    seed: int,
    guided: bool,
    learned: LearnedFeatures | None,
    *_: object,
) -> None:
    """Match pairs of images that are named by their numbers, on one thread."""
    listed = database.with_suffix(".txt")
    listed.write_text(lines, encoding="utf-8")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listed
    matching = pycolmap.FeatureMatchingOptions() if learned is None else learned.matching()
    matching.num_threads = 1
    matching.guided_matching = guided
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pycolmap.set_random_seed(seed)
    with quiet_colmap():
        pycolmap.match_image_pairs(
            database,
            matching_options=matching,
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
    listed.unlink()


def _copy(database: Path, target: Path) -> None:
    with closing(_open_read_only(database)) as source, closing(sqlite3.connect(target)) as to:
        source.backup(to)


def _take_matches(database: Path, other: Path) -> None:
    """Take over what a copy of a database has of pairs."""
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("ATTACH ? AS other", (str(other),))
        with connection:
            for table in ("matches", "two_view_geometries"):
                connection.execute(f"INSERT OR REPLACE INTO {table} SELECT * FROM other.{table}")


def image_numbers(database: Path) -> dict[str, int]:
    """Numbers of a database's images by their names."""
    with closing(_open_read_only(database)) as connection:
        return dict(connection.execute("SELECT name, image_id FROM images"))


def opened(database: Path) -> closing[pycolmap.Database]:
    """COLMAP's own access to a database, closed at the end."""
    return closing(pycolmap.Database.open(database))


def replace_cameras(database: Path, camera: pycolmap.Camera) -> None:
    """Give all cameras of a database the model and parameters of one."""
    with opened(database) as content:
        for old in content.read_all_cameras():
            old.model, old.params = camera.model, camera.params.tolist()
            old.has_prior_focal_length = True
            content.update_camera(old)


def read_descriptors(content: pycolmap.Database, number: int) -> NDArray[Any]:
    """Descriptors (N, D) of an image, as they are stored."""
    return content.read_descriptors(number).to_float().data


@contextmanager
def _renamed(database: Path, names: Mapping[int, str], *, keep: bool = False) -> Iterator[None]:
    """Name images ``idNUMBER`` in the context; then by ``names`` with ``keep``, else as before."""
    with closing(sqlite3.connect(database)) as connection, connection:
        before = dict(connection.execute("SELECT image_id, name FROM images"))
        connection.execute("UPDATE images SET name = 'id' || image_id")
    try:
        yield
    finally:
        after = names if keep else before
        with closing(sqlite3.connect(database)) as connection, connection:
            rows = [(name, number) for number, name in after.items()]
            connection.executemany("UPDATE images SET name = ? WHERE image_id = ?", rows)


def _open_read_only(path: Path) -> sqlite3.Connection:
    """A connection that leaves nothing beside the file.

    Reading a database whose last changes lie in its log needs SQLite's files beside it; they are
    there then.
    """
    log = path.with_name(f"{path.name}-wal")
    mode = "mode=ro" if log.exists() and log.stat().st_size else "immutable=1"
    return sqlite3.connect(f"{path.absolute().as_uri()}?{mode}", uri=True)


def _checked(
    connection: sqlite3.Connection, path: Path, names: Sequence[str], width: int, height: int
) -> GivenDatabase:
    found = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
    if found != "ok":
        raise DataError(path, f"is damaged ({' '.join(str(found).split())}). {REMEDY}")
    tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
    missing = [table for table in TABLES if table not in tables]
    if missing:
        raise DataError(path, f"is no COLMAP database (no table {missing[0]}). {REMEDY}")
    numbers: dict[str, int] = dict(connection.execute("SELECT name, image_id FROM images"))
    matched = match_names(names, numbers)
    if len(matched) < 2:
        raise DataError(
            path,
            f"names {len(matched)} of the capture's {len(names)} images; two or more are needed, "
            "named as the capture's files, whatever their suffix.",
        )
    sizes = dict[int, tuple[int, int, int]](
        (row[0], row[1:])
        for row in connection.execute(
            "SELECT image_id, width, height, camera_id FROM images JOIN cameras USING (camera_id)"
        )
    )
    features = dict[int, tuple[int, int]](
        (row[0], row[1:])
        for row in connection.execute(
            "SELECT image_id, k.rows, d.rows, length(k.data) = k.rows * k.cols * ? "
            "AND length(d.data) >= d.rows * d.cols "
            "FROM keypoints k JOIN descriptors d USING (image_id)",
            (FLOAT_BYTES,),
        )
    )
    for known in matched.values():
        number = numbers[known]
        if sizes.get(number, ())[:2] != (width, height):
            size = "x".join(map(str, sizes[number][:2])) if number in sizes else "unknown"
            raise DataError(
                path,
                f"is of images of another size: {known} has {size} px, the capture's polarization "
                f"images {width}x{height} px. Extract features from those ('polmvs sfm' writes "
                "them to OUT/images).",
            )
        num_keypoints, num_descriptors, whole = features.get(number, (0, 0, 1))
        if not whole or num_keypoints != num_descriptors:
            raise DataError(path, f"has damaged features of {known}. {REMEDY}")
    if not any(features.get(numbers[known], (0,))[0] for known in matched.values()):
        raise DataError(path, "has no features of the capture's images. Extract them with COLMAP.")
    verified = connection.execute("SELECT count(*) FROM two_view_geometries WHERE rows > 0")
    ids = {name: numbers[known] for name, known in sorted(matched.items())}
    return GivenDatabase(
        path=path,
        ids=ids,
        num_cameras=len({sizes[number][2] for number in ids.values()}),
        has_matches=bool(verified.fetchone()[0]),
    )
