"""Files of a COLMAP dense workspace: where they lie, and folders that appear whole."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path, PurePosixPath

from polmvs.colmap.maps import DepthNormals, write_depth_map, write_normal_map
from polmvs.errors import DataError
from polmvs.io.images import write_bytes

PathArg = str | PathLike[str]

IMAGES, SPARSE, STEREO = "images", "sparse", "stereo"
DEPTH_MAPS, NORMAL_MAPS, GRAPHS = "depth_maps", "normal_maps", "consistency_graphs"
FUSION_FILE, PATCH_MATCH_FILE = "fusion.cfg", "patch-match.cfg"
GEOMETRIC, PHOTOMETRIC = "geometric", "photometric"


def member(folder: Path, name: str) -> Path:
    """A file in a folder by an image's name, which may have sub-folders.

    Names come with a model that may be a stranger's: they must not lead out of the folder.
    """
    relative = PurePosixPath(name)
    if relative.is_absolute() or ".." in relative.parts or not relative.parts:
        raise DataError(folder, f"{name!r} is no name of an image in it. Rename it in the model.")
    return folder / relative


def map_files(stereo: Path, name: str, kind: str = GEOMETRIC) -> tuple[Path, Path]:
    """Depth and normal map of an image in a stereo folder, whether they exist or not."""
    file = f"{name}.{kind}.bin"
    return member(stereo / DEPTH_MAPS, file), member(stereo / NORMAL_MAPS, file)


def write_maps(stereo: Path, name: str, maps: DepthNormals) -> None:
    """Write the geometric maps of an image into a stereo folder."""
    depth, normals = map_files(stereo, name)
    for path in (depth, normals):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_depth_map(depth, maps.depth)
    write_normal_map(normals, maps.normals)


def write_lines(path: Path, lines: Sequence[str]) -> None:
    """Write a text file whole or not at all."""
    write_bytes(path, "".join(f"{line}\n" for line in lines).encode())


@contextmanager
def new_folder(folder: PathArg) -> Iterator[Path]:
    """A temporary folder beside a new one, which takes its name when all went well, else goes.

    Raises
    ------
    DataError
        The folder exists and is not empty, or the system refuses.
    """
    target = Path(folder)
    if target.exists() and not (target.is_dir() and not any(target.iterdir())):
        raise DataError(target, "exists already. Remove it or choose another folder.")
    temporary: Path | None = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
        # mkdtemp's folder is the owner's alone; one that mkdir makes has the usual rights.
        content = temporary / "content"
        content.mkdir()
        yield content
        if target.exists():
            target.rmdir()
        content.rename(target)
    except OSError as error:
        raise DataError(target, f"cannot be written: {error.strerror or error}.") from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
