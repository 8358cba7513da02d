"""COLMAP databases: a user's is checked and copied, never opened for writing.

A faulty database makes COLMAP stop the process, so that it is read with SQLite itself first.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pycolmap
from numpy.typing import NDArray

from polmvs.colmap.pairs import Pairs
from polmvs.errors import DataError, PolmvsError
from polmvs.scene import match_names

FLOAT_BYTES = 4
TABLES = ("cameras", "images", "keypoints", "descriptors", "matches", "two_view_geometries")
REMEDY = "Make it again with COLMAP, or leave `sfm.database` out."


@dataclass(frozen=True, kw_only=True)
class GivenDatabase:
    """What a user's database holds of a capture.

    Attributes
    ----------
    path : of the database.
    ids : its number of each image that it has, by the capture's name.
    num_cameras : that these images have.
    has_matches : whether any two images are matched and verified.
    """

    path: Path
    ids: Mapping[str, int]
    num_cameras: int
    has_matches: bool


class NoRoomError(PolmvsError):
    """A database cannot be written where there should be room for it."""


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
        It is missing, damaged, no database of COLMAP, of other images or of another size.
    """
    if not path.is_file():
        raise DataError(path, "no such file. `sfm.database` takes a COLMAP database.")
    with sound(path), closing(_open_read_only(path)) as connection:
        return _checked(connection, path, names, width, height)


@contextmanager
def sound(path: Path) -> Iterator[None]:
    """Faults that SQLite and COLMAP find in a database meanwhile are errors that name it."""
    try:
        yield
    except (sqlite3.Error, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise DataError(path, f"is no sound COLMAP database ({reason}). {REMEDY}") from error


@contextmanager
def _room() -> Iterator[None]:
    """What SQLite cannot write meanwhile is no fault of a database."""
    try:
        yield
    except sqlite3.OperationalError as error:
        if error.sqlite_errorcode & 0xFF in (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR):
            raise NoRoomError(str(error)) from error
        raise


def copy_database(given: GivenDatabase, target: Path) -> None:
    """A copy in a new file, whose images carry the capture's names.

    Images that are none of the capture's stay in it, named by their numbers.

    Raises
    ------
    NoRoomError
        The copy cannot be written.
    DataError
        The database is damaged.
    """
    with sound(given.path), _room():
        with closing(_open_read_only(given.path)) as source, closing(sqlite3.connect(target)) as to:
            source.backup(to)
        with _renamed(target, {number: name for name, number in given.ids.items()}, keep=True):
            pass
        with opened(target):
            pass


def match_pairs(
    database: Path, pairs: Pairs, verification: pycolmap.TwoViewGeometryOptions
) -> None:
    """Match pairs of images and verify them; those that the database has matched already stay."""
    # COLMAP's lists of pairs are split at blanks, which names may have.
    numbers = image_numbers(database)
    with _renamed(database, {}):
        listed = database.with_name("pairs.txt")
        lines = [f"id{numbers[first]} id{numbers[second]}\n" for first, second in pairs]
        listed.write_text("".join(lines), encoding="utf-8")
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = listed
        pycolmap.match_image_pairs(
            database,
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
        listed.unlink()


def image_numbers(database: Path) -> dict[str, int]:
    """Numbers of a database's images by their names."""
    with closing(_open_read_only(database)) as connection:
        return dict(connection.execute("SELECT name, image_id FROM images"))


@contextmanager
def opened(database: Path) -> Iterator[pycolmap.Database]:
    """COLMAP's own access to a database, closed at the end."""
    opened_database = pycolmap.Database.open(database)
    try:
        yield opened_database
    finally:
        opened_database.close()


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
    """Name images ``idNUMBER`` meanwhile; afterwards, or at once, as given, else as before."""
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
