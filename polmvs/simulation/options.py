"""Options of a simulated capture: object, light, scenery, path, sensor."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path

from polmvs.config import BayerOrder, CaptureOptions, OptionGroup, option

PREVIEW_VIEWS, PREVIEW_SCALE = 2, 4


class MaterialName(StrEnum):
    """Presets of materials."""

    BLACK_PLASTIC = "black-plastic"
    GREY_PLASTIC = "grey-plastic"
    WHITE_PLASTIC = "white-plastic"
    CAR_PAINT = "car-paint"
    GLAZED_CERAMIC = "glazed-ceramic"
    POLISHED_METAL = "polished-metal"
    BRUSHED_METAL = "brushed-metal"


class Metal(StrEnum):
    """Metals whose complex refractive index is known."""

    ALUMINIUM = "aluminium"
    CHROMIUM = "chromium"
    COPPER = "copper"
    GOLD = "gold"
    SILVER = "silver"


class Facets(StrEnum):
    """Surface between a mesh's vertices."""

    FLAT = "flat"
    SMOOTH = "smooth"


class LightName(StrEnum):
    """Presets of light."""

    EVEN = "even"
    OVERCAST = "overcast"
    STUDIO = "studio"
    SOFTBOX = "softbox"
    RING = "ring"
    FILE = "file"


class Scenery(StrEnum):
    """What lies about the object."""

    TABLE = "table"
    BOARD = "board"
    NOTHING = "nothing"


class PathName(StrEnum):
    """Path of the camera about the object."""

    RING = "ring"
    DOME = "dome"
    SPIRAL = "spiral"
    ARC = "arc"
    RANDOM = "random"


class Optics(StrEnum):
    """Angle at which rays meet the polarizers."""

    TILTED = "tilted"
    TELECENTRIC = "telecentric"


class SensorKind(StrEnum):
    """Device that makes the polarization images."""

    MOSAIC = "mosaic"
    FILTER = "filter"


@dataclass(frozen=True, kw_only=True)
class ObjectOptions(OptionGroup, group="object"):
    """The object and its material."""

    material: MaterialName = option(MaterialName.GREY_PLASTIC, "preset of the material")
    size: float | None = option(
        None,
        "largest side of the object, metres; by default 0.2 of a built-in shape, and a file's own "
        "size in its unit",
        above=0,
        most=100,
    )
    unit: float | None = option(
        None,
        "length of a mesh file's unit in metres, such as 0.001; by default told by the file",
        above=0,
    )
    facets: Facets = option(
        Facets.FLAT,
        "surface between the vertices of a mesh file: 'flat', its triangles as they are; 'smooth', "
        "a subdivision surface of them. The truth is what is rendered",
    )
    albedo: float | None = option(
        None, "of the diffuse base, instead of the preset's and the mesh's colours", least=0, most=1
    )
    roughness: float | None = option(
        None,
        "of the outer surface (alpha of Beckmann's slopes), instead of the preset's",
        above=0,
        most=1,
    )
    ior: float | None = option(
        None, "refractive index of a dielectric, instead of the preset's", above=1, most=3
    )
    metal: Metal | None = option(None, "of a conductor, instead of the preset's")
    marks: int = option(9, "number of printed marks on the object", least=0, most=64)
    mark_size: float = option(
        0.06, "diameter of a mark as a share of the object's size", above=0, most=0.5
    )
    mark_places: Path | None = option(
        None,
        "text file of the marks' places, lines 'x y z' in metres, in the object's frame, instead "
        "of `object.marks` evenly spread ones",
    )


@dataclass(frozen=True, kw_only=True)
class LightingOptions(OptionGroup, group="lighting"):
    """The light, which is unpolarized."""

    light: LightName = option(
        LightName.STUDIO, "preset of the light; 'file' is `lighting.environment`"
    )
    environment: Path | None = option(
        None, "environment as an equirectangular HDR image (.exr, .hdr), its top is up"
    )
    contrast: float | None = option(
        None,
        "ratio of the brightest to the darkest part of the light, instead of the preset's",
        least=1,
        most=1e6,
    )
    bounces: int = option(
        8,
        "reflections that light is followed over, the diffuse ones of the surroundings included",
        least=1,
        most=32,
    )


@dataclass(frozen=True, kw_only=True)
class SceneryOptions(OptionGroup, group="scenery"):
    """What lies about the object."""

    surroundings: Scenery = option(
        Scenery.TABLE, "a textured table with clutter, a calibration board, or nothing"
    )
    varnish: float | None = option(
        None,
        "roughness of a varnish over the surroundings (alpha of Beckmann's slopes), as on a desk: "
        "they mirror and polarize. Without it they are matte",
        above=0,
        most=1,
    )
    relief: float = option(
        0.0,
        "root mean square height of the table's waves, as of a cloth, as a share of the object's "
        "size; under the object it is flat",
        least=0,
        most=0.1,
    )
    turntable: bool = option(
        False, "object and surroundings turn, light, background and camera stand still"
    )


@dataclass(frozen=True, kw_only=True)
class PathOptions(OptionGroup, group="path"):
    """Where the pictures are taken from."""

    path: PathName = option(PathName.DOME, "how the camera goes about the object")
    views: int = option(12, "number of views", least=1, most=10_000)
    distance: float | None = option(
        None,
        "from the object's centre, metres; by default so that it fills two thirds of the "
        "image's height",
        above=0,
    )
    elevation: tuple[float, float] = option(
        (25.0, 60.0),
        "range of the elevations over the table, degrees",
        least=-90,
        most=90,
        metavar="LOW,HIGH",
    )
    azimuth: tuple[float, float] = option(
        (0.0, 120.0),
        "range of the azimuths of an arc, degrees",
        least=-720,
        most=720,
        metavar="FROM,TO",
    )
    roll: float = option(0.0, "standard deviation of the camera's roll, degrees", least=0, most=180)
    cameras: Path | None = option(
        None,
        "poses in metres instead of a path: a COLMAP model, or a text file with lines 'name qw qx "
        "qy qz tx ty tz' (camera from world, as COLMAP's images.txt)",
    )

    def check(self) -> None:
        """Low before high."""
        low, high = self.elevation
        self.require(low <= high, "elevation", "must go from low to high", self.elevation)


@dataclass(frozen=True, kw_only=True)
class SensorOptions(OptionGroup, group="sensor"):
    """Camera and sensor."""

    sensor: SensorKind = option(
        SensorKind.MOSAIC, "'mosaic' of polarizers, or four images behind a rotating 'filter'"
    )
    image_size: tuple[int, int] = option(
        (1224, 1024),
        "of the files, px; of a mosaic even",
        least=16,
        most=16384,
        metavar="WIDTH,HEIGHT",
    )
    field_of_view: float = option(60.0, "horizontal, degrees", least=1, most=150)
    lens: tuple[float, ...] | None = option(
        None, "distortion k1,k2,p1,p2 of COLMAP's OPENCV model", metavar="K1,K2,P1,P2"
    )
    camera_file: Path | None = option(
        None,
        "calibrated camera instead of the above, in any of COLMAP's models",
    )
    pattern: tuple[int, int, int, int] = option(
        CaptureOptions.pattern, "polarizer angles of a 2x2 cell in degrees, row by row"
    )
    colour: BayerOrder | None = option(None, "a colour sensor: Bayer order of its 2x2 blocks")
    bits: int = option(8, "of a sample: 8, 10, 12 or 16", least=8, most=16)
    exposure: float | None = option(
        None,
        "level of a white surface in the light, full scales; by default so that 2 % of the "
        "samples of the object would saturate at most",
        above=0,
    )
    gain: float = option(1.0, "of the amplifier: full scale is full well / gain", above=0, most=100)
    full_well: float = option(10_000.0, "electrons", least=100, most=1e7)
    read_noise: float = option(2.5, "standard deviation, electrons", least=0, most=1e4)
    black_level: float = option(0.0, "level without light, full scales", least=0, below=0.5)
    f_number: float | None = option(
        None,
        "defocus: f-number of a lens of 8 mm that focuses on the object's centre; without "
        "it all is sharp",
        least=0.5,
        most=64,
    )
    motion_blur: float = option(
        0.0, "of the object's centre by the camera's motion, px of the file", least=0, most=100
    )
    vignetting: float = option(0.0, "share of the light lost in the corners", least=0, below=1)
    optics: Optics = option(
        Optics.TILTED, "polarizers tilted for oblique rays, or a lens telecentric on its image side"
    )
    extinction: float | None = option(
        None, "extinction ratio of the polarizers, such as 300; without it they are ideal", above=1
    )
    angle_errors: float = option(
        0.0, "standard deviation of the polarizers' angles by channel, degrees", least=0, most=20
    )
    gain_errors: float = option(
        0.0, "standard deviation of the channels' gains, shares", least=0, most=0.5
    )
    drift: float = option(
        0.0,
        "filter: standard deviation of the exposure from image to image, share",
        least=0,
        most=0.5,
    )

    def check(self) -> None:
        """Sizes and patterns are valid, and no options contradict each other."""
        self.require(self.bits in (8, 10, 12, 16), "bits", "must be 8, 10, 12 or 16", self.bits)
        width, height = self.image_size
        cell = 4 if self.colour is not None else 2
        whole = width % cell == 0 and height % cell == 0
        mosaic = self.sensor is SensorKind.MOSAIC
        self.require(
            whole or not mosaic, "image_size", f"must be multiples of {cell}", self.image_size
        )
        needed = sorted(self.pattern) == [0, 45, 90, 135]
        self.require(needed, "pattern", "needs each of 0, 45, 90, 135 once", self.pattern)
        four = self.lens is None or len(self.lens) == 4
        self.require(four, "lens", "needs four numbers k1,k2,p1,p2", self.lens)
        one = self.lens is None or self.camera_file is None
        self.require(one, "lens", "and `sensor.camera_file` exclude each other")
        self.require(mosaic or self.colour is None, "colour", "is of a mosaic, not of a filter")
        self.require(not mosaic or self.drift == 0, "drift", "is of a rotating filter")


@dataclass(frozen=True, kw_only=True)
class RenderingOptions(OptionGroup, group="rendering"):
    """How the pictures are computed."""

    noise: float = option(
        0.5, "of the rendering itself, at most this share of the sensor's own", above=0, most=10
    )
    max_samples: int = option(128, "rays of a sample of the file at most", least=1, most=65536)
    directions: int = option(
        512,
        "in which light is gathered at each place of a diffuse surface; a quarter of it for each "
        "view where the light moves",
        least=4,
        most=1 << 20,
    )
    seed: int = option(0, "of paths, marks, textures and noise", least=0)
    preview: bool = option(False, "two views at a quarter of the size")
    masks: bool = option(False, "write OUT/masks as well, for reconstruct's masks")
    variant: str | None = option(
        None, "Mitsuba's variant; by default the fastest that runs here", metavar="NAME"
    )


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """All options of a simulated capture."""

    object: ObjectOptions = field(default_factory=ObjectOptions)
    lighting: LightingOptions = field(default_factory=LightingOptions)
    scenery: SceneryOptions = field(default_factory=SceneryOptions)
    path: PathOptions = field(default_factory=PathOptions)
    sensor: SensorOptions = field(default_factory=SensorOptions)
    rendering: RenderingOptions = field(default_factory=RenderingOptions)

    def for_preview(self) -> Simulation:
        """Two views at a quarter of the size."""
        cell = 4 if self.sensor.colour is not None else 2
        width, height = (
            max(16, side // PREVIEW_SCALE // cell * cell) for side in self.sensor.image_size
        )
        return replace(
            self,
            path=replace(self.path, views=min(self.path.views, PREVIEW_VIEWS)),
            sensor=replace(self.sensor, image_size=(width, height)),
        )


@dataclass(frozen=True, kw_only=True)
class PlanOptions(OptionGroup, group="plan"):
    """What is tried."""

    view_counts: tuple[int, ...] = option((8, 12, 20), "numbers of views", least=3, most=1000)
    lights: tuple[LightName, ...] = option(
        (LightName.OVERCAST, LightName.STUDIO), "presets of light", metavar="LIGHT,..."
    )
    plan_size: tuple[int, int] = option(
        (612, 512), "of the files, px", least=64, most=16384, metavar="WIDTH,HEIGHT"
    )
    keep: bool = option(False, "keep the captures and runs")

    def check(self) -> None:
        """Presets alone."""
        presets = bool(self.lights) and LightName.FILE not in self.lights
        self.require(presets, "lights", "must be presets", self.lights)
        self.require(bool(self.view_counts), "view_counts", "needs a number")


@dataclass(frozen=True, kw_only=True)
class SimulationRun(OptionGroup, group="run", in_files=False):
    """How it is carried out; nothing here changes its result."""

    overwrite: bool = option(False, "replace an earlier simulated capture in OUT")
    resume: bool = option(False, "go on with the capture in OUT after its last finished view")

    def check(self) -> None:
        """Not both."""
        both = self.overwrite and self.resume
        self.require(not both, "overwrite", "and `run.resume` exclude each other")
