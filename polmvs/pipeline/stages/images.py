"""Stage ``images``: the 8-bit intensity images for COLMAP."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from polmvs.errors import DataError
from polmvs.io.images import write_png
from polmvs.parallel import OnProgress, Workers, no_progress
from polmvs.pipeline.run_folder import replacing
from polmvs.polarization.capture import Capture, intensity_image_8bit


@dataclass(frozen=True, kw_only=True)
class ImagesResult:
    """Result of the stage.

    Attributes
    ----------
    num_images : number of written images.
    """

    num_images: int

    def __str__(self) -> str:
        return f"{self.num_images} images"


def write_images(
    capture: Capture,
    target: Path,
    *,
    workers: Workers,
    on_progress: OnProgress = no_progress,
) -> ImagesResult:
    """Write the intensity images of a capture, all with one exposure, named after the mosaics.

    Parameters
    ----------
    target : folder, written whole or not at all.

    Raises
    ------
    DataError
        A mosaic is unusable, or two have the same name.
    """
    names = image_names(capture)
    white = capture.exposure()
    with replacing(target) as folder, workers.stopped_on_error():
        write = partial(_write_image, capture, white, folder)
        for _ in workers.map(write, names.values(), names):
            on_progress(1)
    return ImagesResult(num_images=len(names))


def image_names(capture: Capture) -> dict[str, str]:
    """File name of each mosaic by the name of its image: the stem with ``.png``.

    Raises
    ------
    DataError
        Two mosaics differ only in their suffix.
    """
    names: dict[str, str] = {}
    for name in capture.names:
        image = f"{Path(name).stem}.png"
        if image in names:
            raise DataError(
                capture.folder, f"{names[image]} and {name} are of one name; rename one of them."
            )
        names[image] = name
    return names


def _write_image(capture: Capture, white: float, folder: Path, name: str, image: str) -> None:
    write_png(folder / image, intensity_image_8bit(capture.load(name), white))
