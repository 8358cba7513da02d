"""Structure from motion with COLMAP on the intensity images of a capture.

Three settings differ from COLMAP's defaults: affine-adapted features, a threshold of 2 px instead
of 4 on the reprojection error, and a final bundle adjustment with a robust loss. Measured: median
error of the camera centres of board, dome and demo, 0.18 instead of 0.31 mm, 0.11 instead of 0.31
mm and 0.19 instead of 0.57 mm. Without intrinsics the final adjustment also frees the principal
point, which COLMAP leaves at the image's centre. A principal point 6 px off turns every camera by
0.8 degrees (with it free 0.19 instead of 1.5 mm, 0.13 instead of 1.7 mm and 0.22 instead of 1.8
mm).
"""

from __future__ import annotations

import copy
import logging
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median

import pycolmap

from polmvs.camera import PinholeCamera
from polmvs.colmap.cameras import camera_to_colmap, quiet_colmap
from polmvs.colmap.contradicting_pairs import drop_contradicting
from polmvs.colmap.database import (
    GivenDatabase,
    check_database,
    copy_database,
    image_numbers,
    match_pairs,
    opened,
    read_descriptors,
    replace_cameras,
    sound,
)
from polmvs.colmap.learned_features import learned_features
from polmvs.colmap.left_out_views import MAX_IMAGES, Trial, try_harder
from polmvs.colmap.masked_features import keep_inside
from polmvs.colmap.models import (
    model_from_reconstruction,
    reconstruction_of_views,
    write_reconstruction,
)
from polmvs.colmap.pairs import Pairs, choose_pairs, read_pairs
from polmvs.colmap.static_features import take_out_static
from polmvs.colmap.thinning import thin_database
from polmvs.config import Mapper, SfmOptions
from polmvs.errors import DataError, OptionError
from polmvs.io.images import read_gray, read_mask
from polmvs.io.intrinsics import Intrinsics, read_intrinsics
from polmvs.parallel import OnStep, no_step
from polmvs.scene import KEYPOINT_SIGMA_PX, SparseModel, View, short_list

logger = logging.getLogger(__name__)

NO_MODEL_REMEDY = (
    "The surroundings of the part need texture and neighbouring views more overlap; give "
    "`sfm.intrinsics` where they are known, or a COLMAP model as `sfm.sparse`."
)

COLMAP_DEFAULTS = pycolmap.IncrementalMapperOptions()


class NoModelError(DataError):
    """SfM finds no model; the database in its work folder shows the reason."""


@dataclass(frozen=True, kw_only=True)
class SfmTolerances:
    """Tolerances of features, tracks and the camera, in addition to COLMAP's defaults.

    Measured: by the median error of the camera centres of board, dome and demo, as in the module's
    docstring. Errors in px are those of keypoints, which do not scale with the focal length.

    Attributes
    ----------
    max_reproj_error_px : of a kept observation; measured, of 1, 2 and 4.
    loss_scale_px : of the last adjustment's Cauchy loss. Derived: the deviation of a keypoint,
        about twice the error of a good one; measured.
    max_cost_change : relative change of the cost at which an adjustment ends. Measured: with 40
        views a hundredth of this takes three times the steps, for 0.5 % of the cameras' errors;
        COLMAP's default 0 continues to the last allowed step.
    max_refinements : consecutive adjustments, of the model or about a new view, in the mapper.
        Measured: COLMAP's defaults 5 and 2 take twice the mapper's time, and have no effect after
        the final adjustment.
    model_growth : factor in images or points at which the incremental mapper adjusts all again;
        measured: at COLMAP's default 1.1 this takes most of the mapper's time.
    min_views_principal_point : number of views from which the principal point is free; measured:
        with three views two captures of three are worse, with four none.
    max_principal_point_shift : of a principal point, in sides of the image; a guess. An estimate
        farther from the centre is wrong. Given intrinsics as near to the lower right corner are
        those of the full mosaic.
    min_pair_matches : matches that each pair keeps if the mapper gets fewer. Derived: what COLMAP
        requires of the initial pair. Measured: docs/records/scale.md.
    max_images_dense : number of images up to which the final adjustment is solved as a dense
        matrix. Measured: with 100 and 282 images faster than sparse, 8.2 of 9.6 and 19 of 32 s; the
        limit is a guess, as the time grows with the cube of the images.
    max_images_two_view_tracks : number of images up to which tracks of two views are used; a guess:
        with few images most tracks have only two views, with more those are mostly mismatches.
    few_features, low_contrast : median number of SIFT features of an image below which those of a
        lower contrast are described too (guess), and that contrast, as a share of the image's
        range. Measured: in an image that a highlight leaves dark, COLMAP's least contrast, 0.0067,
        finds 750 features, 0.002 8,400. In well exposed images these are 1 to 40 % more, and some
        are of noise.
    focal_range : plausible focal lengths, in widths of the image: 136 to 6 degrees.
    """

    max_reproj_error_px: float = 2.0
    loss_scale_px: float = KEYPOINT_SIGMA_PX
    max_cost_change: float = 1e-4
    max_refinements: int = 1
    model_growth: float = 1.3
    min_views_principal_point: int = 4
    max_principal_point_shift: float = 0.1
    min_pair_matches: int = COLMAP_DEFAULTS.init_min_num_inliers
    max_images_dense: int = 400
    max_images_two_view_tracks: int = 5
    few_features: int = 1500
    low_contrast: float = 0.002
    focal_range: tuple[float, float] = (0.2, 10.0)


@dataclass(frozen=True, kw_only=True)
class SfmWork:
    """Input of SfM: images, options and database.

    Attributes
    ----------
    images : folder of 8-bit intensity images.
    names : names of the images to use, in order; a given database may have more.
    database : COLMAP's. The mapper's files are beside it while it runs.
    reader : COLMAP's initial camera.
    """

    images: Path
    names: Sequence[str]
    database: Path
    reader: pycolmap.ImageReaderOptions
    options: SfmOptions
    tolerances: SfmTolerances = SfmTolerances()

    def describe(self, database: Path, *, pooled: bool = False) -> None:
        """Extract affine-adapted SIFT, or the features of the options, into a new database.

        ``pooled``: descriptors are means over domain sizes (DSP-SIFT), which takes three times as
        long.
        """
        learned = learned_features(self.options)
        if learned is not None:
            self._extract(database, learned.extraction())
            return
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.sift.estimate_affine_shape = True
        extraction.sift.domain_size_pooling = pooled
        self._extract(database, extraction)
        if _median_features(database) < self.tolerances.few_features:
            logger.info("SfM: few features; those of a lower contrast are described as well.")
            database.unlink()
            extraction.sift.peak_threshold = self.tolerances.low_contrast
            self._extract(database, extraction)

    def _extract(self, database: Path, extraction: pycolmap.FeatureExtractionOptions) -> None:
        """Extract features into a new database."""
        single, each = pycolmap.CameraMode.SINGLE, pycolmap.CameraMode.PER_IMAGE
        mode = single if self.options.single_camera else each
        names = list(self.names)
        # Images first, in order: left to the extractor's threads their ids change from run to run,
        # and with them the order of everything after.
        pycolmap.Database.open(database).close()  # creates the file
        pycolmap.import_images(database, self.images, mode, names, self.reader)
        pycolmap.extract_features(
            database, self.images, names, mode, self.reader, extraction, pycolmap.Device.cpu
        )

    def pairs(self) -> Pairs:
        """The pairs of images of the options, or those that probably overlap."""
        numbers = image_numbers(self.database)
        with opened(self.database) as content:
            return choose_pairs(
                sorted(self.names),
                self.options.pairs,
                lambda name: read_descriptors(content, numbers[name]),
                seed=self.options.seed,
            )

    def match(self) -> None:
        """Match these pairs."""
        learned = learned_features(self.options)
        match_pairs(self.database, self.pairs(), seed=self.options.seed, learned=learned)

    def map_all(self) -> pycolmap.Reconstruction:
        """The largest model of the images, after harder matching if some have no pose."""
        unable: list[NoModelError] = []

        def map_once() -> pycolmap.Reconstruction | None:
            if self.options.known_camera and (num := drop_contradicting(self.database)):
                logger.info("SfM: %d pairs match as no pair of this camera can; not used.", num)
            try:
                return self.map()
            except NoModelError as error:
                unable.append(error)
                return None

        found = map_once()
        # The steps are SIFT's; a given database's features may be of another kind.
        is_sift = self.options.database is None and self.options.aliked is None
        if is_sift and len(self.names) <= MAX_IMAGES:
            trial = Trial(
                database=self.database,
                pairs=self.pairs(),
                describe=partial(self.describe, pooled=True),
                map=map_once,
                seed=self.options.seed,
            )
            found = try_harder(found, self.names, trial)
        if found is None:
            raise unable[0]
        return found

    def map(self) -> pycolmap.Reconstruction:
        """The largest model of the mapper.

        With very many matches it finds the poses from a part of them, if that registers every
        image.
        """
        thinned = self.database.with_name("mapping.db")
        thinned.unlink(missing_ok=True)
        least = self.tolerances.min_pair_matches
        if thin_database(self.database, thinned, least, seed=self.options.seed):
            found = self._models(thinned)
            thinned.unlink()
            if found and found[0].num_reg_images() == len(self.names):
                return self.triangulate(found[0])
        found = self._models(self.database)
        if not found:
            raise NoModelError(
                self.images, f"SfM finds no model of these images. {NO_MODEL_REMEDY}"
            )
        largest = found[0]
        if largest.num_reg_images() < 2:
            raise NoModelError(self.images, f"SfM registers one image only. {NO_MODEL_REMEDY}")
        if len(found) > 1 and largest.num_reg_images() < len(self.names):
            logger.warning(
                "SfM: the images fall into %d models; the largest is used and has %d of %d images.",
                len(found),
                largest.num_reg_images(),
                len(self.names),
            )
        return largest

    def triangulate(self, known: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
        """A model with known poses and the points of all matches."""
        with self._place_for_models() as models:
            return pycolmap.triangulate_points(
                known, self.database, self.images, models, options=self._incremental()
            )

    def _models(self, database: Path) -> list[pycolmap.Reconstruction]:
        """The mapper's models of a database, the largest first."""
        with self._place_for_models() as models:
            if self.options.mapper is Mapper.GLOBAL:
                found = pycolmap.global_mapping(database, self.images, models, self._global())
            else:
                found = pycolmap.incremental_mapping(
                    database, self.images, models, self._incremental()
                )
        return sorted(
            found.values(), key=lambda one: (one.num_reg_images(), one.num_points3D()), reverse=True
        )

    @contextmanager
    def _place_for_models(self) -> Iterator[Path]:
        """An empty folder where COLMAP leaves models, which are not read again."""
        models = self.database.with_name("models")
        shutil.rmtree(models, ignore_errors=True)
        models.mkdir()
        yield models
        shutil.rmtree(models)

    def _incremental(self) -> pycolmap.IncrementalPipelineOptions:
        """Options of the incremental mapper."""
        num_images = len(self.names)
        pipeline = pycolmap.IncrementalPipelineOptions()
        pipeline.image_names = list(self.names)  # a given database may have more
        pipeline.min_model_size = min(3, num_images)
        pipeline.random_seed = self.options.seed
        pipeline.mapper.random_seed = self.options.seed
        pipeline.triangulation.random_seed = self.options.seed
        # With more threads one capture's model changes from run to run, and nothing is won: 0.6 s
        # for ten views either way. Extraction and matching are the larger part and use all cores.
        pipeline.num_threads = 1
        pipeline.mapper.num_threads = 1
        pipeline.ba_global_frames_ratio = pipeline.ba_global_points_ratio = (
            self.tolerances.model_growth
        )
        pipeline.ba_global_function_tolerance = self.tolerances.max_cost_change
        pipeline.ba_local_function_tolerance = self.tolerances.max_cost_change
        pipeline.ba_global_max_refinements = self.tolerances.max_refinements
        pipeline.ba_local_max_refinements = self.tolerances.max_refinements
        two_view_tracks = num_images <= self.tolerances.max_images_two_view_tracks
        pipeline.triangulation.ignore_two_view_tracks = not two_view_tracks
        if self.options.known_camera:
            pipeline.ba_refine_focal_length = False
            pipeline.ba_refine_extra_params = False
            pipeline.mapper.abs_pose_refine_focal_length = False
            pipeline.mapper.abs_pose_refine_extra_params = False
            # With an unknown camera the errors are larger at first, so COLMAP's 4 px are kept.
            error_px = self.tolerances.max_reproj_error_px
            pipeline.mapper.filter_max_reproj_error = error_px
            pipeline.triangulation.complete_max_reproj_error = error_px
            pipeline.triangulation.merge_max_reproj_error = error_px
        return pipeline

    def _global(self) -> pycolmap.GlobalPipelineOptions:
        """Options of the global mapper.

        Raises
        ------
        OptionError
            This version of pycolmap has none.
        """
        if not hasattr(pycolmap, "global_mapping"):
            raise OptionError(
                f"global needs pycolmap 4.1 or newer; this is {pycolmap.__version__}.",
                field="sfm.mapper",
            )
        pipeline = pycolmap.GlobalPipelineOptions()
        pipeline.image_names = list(self.names)
        pipeline.min_model_size = min(3, len(self.names))
        pipeline.num_threads = pipeline.mapper.num_threads = 1  # as of the incremental mapper
        mapper = pipeline.mapper
        for seeded in (
            pipeline,
            mapper,
            mapper.rotation_averaging,
            mapper.global_positioning,
            mapper.retriangulation,
        ):
            seeded.random_seed = self.options.seed
        solver = mapper.bundle_adjustment.ceres.solver_options
        solver.num_threads = 1
        solver.function_tolerance = self.tolerances.max_cost_change
        if self.options.known_camera:
            mapper.bundle_adjustment.refine_focal_length = False
            mapper.bundle_adjustment.refine_extra_params = False
            error_px = self.tolerances.max_reproj_error_px
            mapper.retriangulation.complete_max_reproj_error = error_px
            mapper.retriangulation.merge_max_reproj_error = error_px
        return pipeline


def run_sfm(
    image_folder: Path,
    image_names: Sequence[str],
    work_folder: Path,
    sparse_folder: Path,
    options: SfmOptions,
    on_step: OnStep = no_step,
    *,
    masks: Mapping[str, Path] | None = None,
    tolerances: SfmTolerances = SfmTolerances(),
) -> SparseModel:
    """Find the poses of the images and their sparse points.

    The same images and options give the same model.

    Parameters
    ----------
    image_folder : 8-bit intensity images, one size.
    image_names : names of the images in it.
    work_folder : for COLMAP's database, or the copy of a given one; files of an earlier run are
        replaced.
    sparse_folder : for the model as COLMAP binary, written whole or not at all.
    options : see :class:`polmvs.config.SfmOptions`; ``sparse`` is not used here.
    on_step : called with the name of each step when it starts.
    masks : file of each image by its name, not 0 where features are used; None: everywhere.

    Raises
    ------
    OptionError
        The intrinsics do not fit the images, or the camera model or the mapper is unknown.
    DataError
        An image is missing, the list of pairs or the database is unusable, or there is no model.
    """
    names = sorted(image_names)
    width, height = _image_size(image_folder, names)
    reader = _reader_options(options, width, height, tolerances)
    given = None
    if options.database is not None:
        given = check_database(options.database, names, width, height)
    to_match = names if given is None else list(given.ids)
    if options.pairs_file is not None:  # before the features, which take longer
        read_pairs(options.pairs_file, to_match)
    work = SfmWork(
        images=image_folder,
        names=to_match,
        database=_place_of_database(work_folder),
        reader=reader,
        options=options,
        tolerances=tolerances,
    )
    pycolmap.set_random_seed(options.seed)
    with quiet_colmap(), nullcontext() if given is None else sound(given.path):
        on_step("features")
        if given is None:
            work.describe(work.database)
            if masks is not None:
                inside = {name: read_mask(masks[name], (height, width)) for name in names}
                num_inside = keep_inside(work.database, inside)
                logger.info("SfM: %d features inside the masks.", num_inside)
            if options.static_background:
                _leave_out_static(work.database)
        else:
            _take_database(given, work, width, height)
        on_step("matching")
        if given is None or not given.has_matches or options.pairs is not None:
            work.match()
        on_step("mapping")
        reconstruction = work.map_all()
        on_step("bundle adjustment")
        single = options.single_camera if given is None else given.num_cameras == 1
        reconstruction = _refine(
            reconstruction,
            tolerances,
            free_intrinsics=options.known_camera is None,
            single_camera=single,
        )
    return _written(reconstruction, names, sparse_folder)


def triangulate_views(
    image_folder: Path,
    views: Sequence[View],
    work_folder: Path,
    sparse_folder: Path,
) -> SparseModel:
    """A model with known cameras: features are matched and triangulated, poses do not change.

    Parameters
    ----------
    image_folder : 8-bit intensity images, one size.
    views : known cameras, named as the images.
    work_folder, sparse_folder : see :func:`run_sfm`.

    Raises
    ------
    DataError
        An image is missing.
    """
    ordered = sorted(views, key=lambda view: view.name)
    names = [view.name for view in ordered]
    width, height = _image_size(image_folder, names)
    for view in ordered:
        if (view.camera.width, view.camera.height) != (width, height):
            raise DataError(image_folder / view.name, "is of another size than its known camera.")
    single = all(view.camera == ordered[0].camera for view in ordered)
    options = SfmOptions(single_camera=single)
    reader = pycolmap.ImageReaderOptions()
    camera = camera_to_colmap(ordered[0].camera)
    reader.camera_model = camera.model.name
    reader.camera_params = camera.params_to_string()
    work = SfmWork(
        images=image_folder,
        names=names,
        database=_place_of_database(work_folder),
        reader=reader,
        options=options,
        tolerances=SfmTolerances(few_features=0),  # known poses need no more features
    )
    pycolmap.set_random_seed(options.seed)
    with quiet_colmap():
        work.describe(work.database)
        work.match()
        # Images were imported in the order of names, so their ids are those of the views here.
        found = work.triangulate(reconstruction_of_views(ordered, single_camera=single))
    return _written(found, names, sparse_folder)


def _place_of_database(work_folder: Path) -> Path:
    """Path for COLMAP's database; files of an earlier run are removed."""
    work_folder.mkdir(parents=True, exist_ok=True)
    for left_over in work_folder.glob("database.db*"):
        left_over.unlink()
    return work_folder / "database.db"


def check_intrinsics(
    intrinsics: Sequence[float],
    width: int,
    height: int,
    *,
    tolerances: SfmTolerances = SfmTolerances(),
) -> PinholeCamera:
    """The camera of ``fx, fy, cx, cy``, px, if it is plausible for images of this size.

    Raises
    ------
    OptionError
        The principal point or a focal length is out of range; the message names the remedy.
    """
    fx, fy, cx, cy = intrinsics
    from_corner = max(abs(cx / width - 1), abs(cy / height - 1))
    if from_corner < tolerances.max_principal_point_shift:
        half = ",".join(f"{value / 2:.10g}" for value in intrinsics)
        raise OptionError(
            f"has the principal point {cx:g},{cy:g} in the corner of the {width}x{height} px "
            "polarization images. For the intrinsics of the full mosaic give half of each: "
            f"{half}.",
            field="sfm.intrinsics",
        )
    if not (0 < cx < width and 0 < cy < height):
        raise OptionError(
            f"has the principal point {cx:g},{cy:g} outside the {width}x{height} px "
            "polarization images. Give fx,fy,cx,cy in pixels of that size.",
            field="sfm.intrinsics",
        )
    least, most = tolerances.focal_range
    if not all(least * width <= focal <= most * width for focal in (fx, fy)):
        raise OptionError(
            f"has focal lengths {fx:g},{fy:g}, not within {least:g} to {most:g} "
            f"times the image's width of {width} px. Give them in pixels of the half-size images.",
            field="sfm.intrinsics",
        )
    return PinholeCamera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def check_camera(path: Path, width: int, height: int) -> Intrinsics:
    """The camera of a calibration file, scaled to images of this size.

    Raises
    ------
    DataError
        The file cannot be read, or is for images of another aspect ratio.
    """
    try:
        return read_intrinsics(path).scaled_to(width, height)
    except ValueError as error:
        raise DataError(path, f"{error}. Calibrate at the capture's region of interest.") from error


def _image_size(folder: Path, names: Sequence[str]) -> tuple[int, int]:
    """Width and height of the images, px; all must exist and be alike."""
    if len(names) < 2:
        raise DataError(folder, f"has {len(names)} images; SfM needs two or more, better ten.")
    sizes = {}
    for name in names:
        image = read_gray(folder / name)
        sizes[image.shape[1], image.shape[0]] = name
    if len(sizes) > 1:
        raise DataError(folder, f"images differ in size: {', '.join(sorted(sizes.values()))}.")
    return next(iter(sizes))


def _reader_options(
    options: SfmOptions, width: int, height: int, tolerances: SfmTolerances
) -> pycolmap.ImageReaderOptions:
    """The camera that COLMAP starts from."""
    reader = pycolmap.ImageReaderOptions()
    if options.intrinsics is not None:
        check_intrinsics(options.intrinsics, width, height, tolerances=tolerances)
        reader.camera_model = "PINHOLE"
        reader.camera_params = ",".join(repr(float(value)) for value in options.intrinsics)
        return reader
    if options.camera is not None:
        camera = check_camera(options.camera, width, height)
        reader.camera_model = camera.model
        reader.camera_params = ",".join(repr(value) for value in camera.params)
        return reader
    known = set(pycolmap.CameraModelId.__members__) - {"INVALID", "EQUIRECTANGULAR"}
    if options.camera_model not in known:
        raise OptionError(
            f"{options.camera_model} is unknown to COLMAP. Choose one of "
            f"{', '.join(sorted(known))}.",
            field="sfm.camera_model",
        )
    reader.camera_model = options.camera_model
    return reader


def _take_database(given: GivenDatabase, work: SfmWork, width: int, height: int) -> None:
    """Copy a given database, with the given camera if there is one."""
    copy_database(given, work.database)
    if work.options.known_camera:
        model = work.reader.camera_model
        params = [float(value) for value in work.reader.camera_params.split(",")]
        camera = pycolmap.Camera(model=model, width=width, height=height, params=params)
        replace_cameras(work.database, camera)


def _leave_out_static(database: Path) -> None:
    """Take out the features of a background that stands still while the part turns."""
    static = take_out_static(database)
    if static is not None:
        logger.warning(
            "a background stands still while the part turns: its features, %.0f %% of all, "
            "are left out. The poses are those of a camera that moves about the part; with "
            "`sfm.static_background` off all features are used, with "
            "`sfm.feature_masks` those inside masks.",
            100 * static,
        )


def _refine(
    reconstruction: pycolmap.Reconstruction,
    tolerances: SfmTolerances,
    *,
    free_intrinsics: bool,
    single_camera: bool,
) -> pycolmap.Reconstruction:
    """The final bundle adjustment, more careful than those of the mapper; then filter the points.

    Parameters
    ----------
    reconstruction : from the mapper; adjusted in place, or replaced by the result.
    free_intrinsics : also estimate the cameras.
    single_camera : all images share one; its principal point is then also free if there are enough
        views, and is kept at the centre if the estimate is implausible.
    """
    num_views = reconstruction.num_reg_images()
    if free_intrinsics and single_camera and num_views >= tolerances.min_views_principal_point:
        with_point = copy.deepcopy(reconstruction)
        _adjust(with_point, tolerances, free_intrinsics=True, free_principal_point=True)
        if _principal_points_plausible(with_point, tolerances):
            return with_point
        logger.warning("SfM: the principal point cannot be estimated; the centre is kept.")
    _adjust(reconstruction, tolerances, free_intrinsics=free_intrinsics, free_principal_point=False)
    return reconstruction


def _adjust(
    reconstruction: pycolmap.Reconstruction,
    tolerances: SfmTolerances,
    *,
    free_intrinsics: bool,
    free_principal_point: bool,
) -> None:
    """Bundle-adjust in place on one thread, then drop points beyond the thresholds."""
    bundle, config = bundle_of(
        reconstruction,
        tolerances.loss_scale_px,
        free_intrinsics=free_intrinsics,
        free_principal_point=free_principal_point,
    )
    bundle.ceres.solver_options.function_tolerance = tolerances.max_cost_change
    bundle.ceres.max_num_images_direct_dense_cpu_solver = tolerances.max_images_dense
    # Not pycolmap.bundle_adjustment: release 4.2 turns the log level back to INFO in it.
    pycolmap.create_default_bundle_adjuster(bundle, config, reconstruction).solve()
    observations = pycolmap.ObservationManager(reconstruction)
    observations.filter_all_points3D(
        tolerances.max_reproj_error_px, COLMAP_DEFAULTS.filter_min_tri_angle
    )
    reconstruction.update_point_3d_errors()


def bundle_of(
    reconstruction: pycolmap.Reconstruction,
    loss_scale_px: float,
    *,
    free_intrinsics: bool,
    free_principal_point: bool,
) -> tuple[pycolmap.BundleAdjustmentOptions, pycolmap.BundleAdjustmentConfig]:
    """An adjustment of all registered images on one thread; two images fix the frame."""
    bundle = pycolmap.BundleAdjustmentOptions()
    bundle.refine_focal_length = bundle.refine_extra_params = free_intrinsics
    bundle.refine_principal_point = free_principal_point
    bundle.print_summary = False
    bundle.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    bundle.ceres.loss_function_scale = loss_scale_px
    bundle.ceres.solver_options.num_threads = 1  # sums over threads depend on their timing
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return bundle, config


def _median_features(database: Path) -> float:
    """Median number of an image's features."""
    with opened(database) as content:
        numbers = [image.image_id for image in content.read_all_images()]
        return median(content.num_keypoints_for_image(number) for number in numbers)


def _principal_points_plausible(
    reconstruction: pycolmap.Reconstruction, tolerances: SfmTolerances
) -> bool:
    """Whether every camera's principal point stayed near the centre of its image."""
    return all(
        max(abs(c.principal_point_x - c.width / 2), abs(c.principal_point_y - c.height / 2))
        < tolerances.max_principal_point_shift * c.width
        for c in reconstruction.cameras.values()
    )


def _written(
    reconstruction: pycolmap.Reconstruction, names: Sequence[str], folder: Path
) -> SparseModel:
    """The model, written; headline numbers and the views that are missing go to the log."""
    write_reconstruction(reconstruction, folder)
    model = model_from_reconstruction(reconstruction, names)
    logger.info(
        "SfM: %d views, %d points, reprojection error %.2f px.",
        len(model.views),
        len(model.tracks.point3D_ids),
        reconstruction.compute_mean_reprojection_error(),
    )
    if model.unregistered:
        logger.warning(
            "SfM: %d views have no pose and are left out: %s.",
            len(model.unregistered),
            short_list(model.unregistered),
        )
    return model
