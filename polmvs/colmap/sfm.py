"""Structure from motion with COLMAP on the intensity images of a capture.

What differs from COLMAP's defaults was chosen on the captures board, dome and demo, by the median
error of the cameras' centres: affine-adapted features, a threshold of 2 px instead of 4 on the
reprojection error, and a last bundle adjustment with a robust loss; together 0.31 to 0.18 mm,
0.31 to 0.11 mm and 0.57 to 0.19 mm. Without intrinsics the last adjustment also frees the
principal point, which COLMAP leaves at the image's centre: 6 px off, there, turned every camera by
0.8 degrees (1.5 to 0.19 mm, 1.7 to 0.13 mm and 1.8 to 0.22 mm).
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2

from polmvs.camera import PinholeCamera
from polmvs.colmap.bundle import MAX_REPROJ_ERROR_PX, refine
from polmvs.colmap.models import model_from_reconstruction, pycolmap
from polmvs.colmap.sparse_model import short_list, write_reconstruction
from polmvs.config import SfmOptions
from polmvs.errors import DataError, OptionError
from polmvs.scene import SparseModel

logger = logging.getLogger(__name__)

MAX_EXHAUSTIVE_IMAGES = 200  # 20,000 pairs, some minutes on two cores
SEQUENTIAL_OVERLAP = 20
# With few images most tracks have two views only; with more those are mostly mismatches.
MAX_IMAGES_TWO_VIEW_TRACKS = 5
MIN_FOCAL, MAX_FOCAL = 0.2, 10.0  # of the image's width
MOSAIC_TOLERANCE = 0.15  # a full mosaic's centre lies in the corner of the half-size image
NO_MODEL_REMEDY = (
    "The surroundings of the part need texture and neighbouring views more overlap; give "
    "--intrinsics where they are known, or a COLMAP model with --sparse."
)

Progress = Callable[[str], None]


def run_sfm(
    image_folder: Path,
    image_names: Sequence[str],
    work_folder: Path,
    sparse_folder: Path,
    options: SfmOptions,
    on_progress: Progress | None = None,
) -> SparseModel:
    """Find the poses of the images and their sparse points.

    The same images and options give the same model.

    Parameters
    ----------
    image_folder : 8-bit intensity images, one size.
    image_names : names of the images in it.
    work_folder : gets COLMAP's database; what an earlier run left there is replaced.
    sparse_folder : gets the model as COLMAP binary, whole or not at all.
    options : see :class:`polmvs.config.SfmOptions`; ``sparse`` is not used here.
    on_progress : called with the name of each stage when it starts.

    Raises
    ------
    OptionError
        The intrinsics do not fit the images, or the camera model is unknown.
    DataError
        An image is missing, or no model comes out.
    """
    names = sorted(image_names)
    width, height = _image_size(image_folder, names)
    reader = _reader_options(options, width, height)
    report = on_progress if on_progress is not None else logger.debug
    work_folder.mkdir(parents=True, exist_ok=True)
    database = work_folder / "database.db"
    for left_over in work_folder.glob("database.db*"):
        left_over.unlink()
    pycolmap.set_random_seed(options.seed)
    report("features")
    _extract_features(database, image_folder, names, reader, options)
    report("matching")
    _match(database, len(names), options.seed)
    report("mapping")
    reconstruction = _map(database, image_folder, work_folder / "models", len(names), options)
    report("bundle adjustment")
    reconstruction = refine(
        reconstruction,
        free_intrinsics=options.intrinsics is None,
        single_camera=options.single_camera,
    )
    write_reconstruction(reconstruction, sparse_folder)
    model = model_from_reconstruction(reconstruction, names)
    _log_result(model, reconstruction.compute_mean_reprojection_error())
    return model


def check_intrinsics(intrinsics: Sequence[float], width: int, height: int) -> PinholeCamera:
    """The camera of ``fx, fy, cx, cy``, px, if it can be that of images of this size.

    Raises
    ------
    OptionError
        The principal point or a focal length is out of range; the message names the remedy.
    """
    fx, fy, cx, cy = intrinsics
    if max(abs(cx / width - 1), abs(cy / height - 1)) < MOSAIC_TOLERANCE:
        half = ",".join(f"{value / 2:.10g}" for value in intrinsics)
        raise OptionError(
            f"--intrinsics: the principal point {cx:g},{cy:g} lies in the corner of the "
            f"{width}x{height} px polarization images. For the intrinsics of the full mosaic "
            f"give half of each: --intrinsics {half}."
        )
    if not (0 < cx < width and 0 < cy < height):
        raise OptionError(
            f"--intrinsics: the principal point {cx:g},{cy:g} lies outside the {width}x{height} "
            "px polarization images. Give fx,fy,cx,cy in pixels of that size."
        )
    if not all(MIN_FOCAL * width <= focal <= MAX_FOCAL * width for focal in (fx, fy)):
        raise OptionError(
            f"--intrinsics: focal lengths {fx:g},{fy:g} are not within {MIN_FOCAL:g} to "
            f"{MAX_FOCAL:g} times the image's width of {width} px. Give them in pixels of the "
            "half-size images."
        )
    return PinholeCamera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def _image_size(folder: Path, names: Sequence[str]) -> tuple[int, int]:
    """Width and height of the images, px; all must exist and be alike."""
    if len(names) < 2:
        raise DataError(folder, f"has {len(names)} images; SfM needs two or more, better ten.")
    sizes = {}
    for name in names:
        image = cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise DataError(folder / name, "is no image that can be read.")
        sizes[image.shape[1], image.shape[0]] = name
    if len(sizes) > 1:
        raise DataError(folder, f"images differ in size: {', '.join(sorted(sizes.values()))}.")
    return next(iter(sizes))


def _reader_options(options: SfmOptions, width: int, height: int) -> pycolmap.ImageReaderOptions:
    """The camera that COLMAP starts from."""
    reader = pycolmap.ImageReaderOptions()
    if options.intrinsics is not None:
        check_intrinsics(options.intrinsics, width, height)
        reader.camera_model = "PINHOLE"
        reader.camera_params = ",".join(repr(float(value)) for value in options.intrinsics)
        return reader
    known = set(pycolmap.CameraModelId.__members__) - {"INVALID", "EQUIRECTANGULAR"}
    if options.camera_model not in known:
        raise OptionError(
            f"--camera-model {options.camera_model} is unknown to COLMAP. Choose one of "
            f"{', '.join(sorted(known))}."
        )
    reader.camera_model = options.camera_model
    return reader


def _extract_features(
    database: Path,
    image_folder: Path,
    names: list[str],
    reader: pycolmap.ImageReaderOptions,
    options: SfmOptions,
) -> None:
    """Affine-adapted SIFT of all images into a new database."""
    single, each = pycolmap.CameraMode.SINGLE, pycolmap.CameraMode.PER_IMAGE
    mode = single if options.single_camera else each
    # Images first, in order: left to the extractor's threads their ids change from run to run,
    # and with them the order of everything after.
    pycolmap.Database.open(database).close()  # creates the file
    pycolmap.import_images(database, image_folder, mode, names, reader)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.estimate_affine_shape = True
    pycolmap.extract_features(
        database, image_folder, names, mode, reader, extraction, pycolmap.Device.cpu
    )


def _match(database: Path, num_images: int, seed: int) -> None:
    """Match all pairs, or neighbours in the order of names where there are too many."""
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    cpu = pycolmap.Device.cpu
    if num_images <= MAX_EXHAUSTIVE_IMAGES:
        logger.info("SfM: %d images, all pairs are matched.", num_images)
        pycolmap.match_exhaustive(database, verification_options=verification, device=cpu)
        return
    logger.warning(
        "SfM: %d images are too many for all pairs: each is matched with its %d neighbours. "
        "Their names must be in the order of recording.",
        num_images,
        SEQUENTIAL_OVERLAP,
    )
    pairing = pycolmap.SequentialPairingOptions()
    pairing.overlap = SEQUENTIAL_OVERLAP
    pycolmap.match_sequential(
        database, pairing_options=pairing, verification_options=verification, device=cpu
    )


def _mapper_options(num_images: int, options: SfmOptions) -> pycolmap.IncrementalPipelineOptions:
    """Options of the incremental mapper."""
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.min_model_size = min(3, num_images)
    pipeline.random_seed = options.seed
    pipeline.mapper.random_seed = options.seed
    pipeline.triangulation.random_seed = options.seed
    # With more threads one capture's model changes from run to run, and nothing is won: 0.6 s for
    # ten views either way. Extraction and matching are the larger part and use all cores.
    pipeline.num_threads = 1
    pipeline.mapper.num_threads = 1
    two_view_tracks = num_images <= MAX_IMAGES_TWO_VIEW_TRACKS
    pipeline.triangulation.ignore_two_view_tracks = not two_view_tracks
    if options.intrinsics is not None:
        pipeline.ba_refine_focal_length = False
        pipeline.ba_refine_extra_params = False
        pipeline.mapper.abs_pose_refine_focal_length = False
        pipeline.mapper.abs_pose_refine_extra_params = False
        # With a camera still to be found the errors are larger at first: COLMAP's 4 px stay.
        pipeline.mapper.filter_max_reproj_error = MAX_REPROJ_ERROR_PX
        pipeline.triangulation.complete_max_reproj_error = MAX_REPROJ_ERROR_PX
        pipeline.triangulation.merge_max_reproj_error = MAX_REPROJ_ERROR_PX
    return pipeline


def _map(
    database: Path, image_folder: Path, models: Path, num_images: int, options: SfmOptions
) -> pycolmap.Reconstruction:
    """The largest model that the incremental mapper makes."""
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir()
    found = pycolmap.incremental_mapping(
        database, image_folder, models, _mapper_options(num_images, options)
    )
    shutil.rmtree(models)
    if not found:
        raise DataError(image_folder, f"SfM finds no model of these images. {NO_MODEL_REMEDY}")
    largest: pycolmap.Reconstruction = max(
        found.values(), key=lambda model: (model.num_reg_images(), model.num_points3D())
    )
    if largest.num_reg_images() < 2:
        raise DataError(image_folder, f"SfM registers one image only. {NO_MODEL_REMEDY}")
    if len(found) > 1:
        logger.warning("SfM: the images fall into %d models; the largest is used.", len(found))
    return largest


def _log_result(model: SparseModel, error_px: float) -> None:
    """Headline numbers, and the views that are missing."""
    num_points = len(model.tracks.point3D_ids)
    logger.info(
        "SfM: %d views, %d points, reprojection error %.2f px.",
        len(model.views),
        num_points,
        error_px,
    )
    if model.unregistered:
        logger.warning(
            "SfM: %d views have no pose and are left out: %s.",
            len(model.unregistered),
            short_list(model.unregistered),
        )
