"""The files of each view of a capture, recognized by their names; no file is opened.

Images directly in the folder, or in its ``raw`` if it has none, are raw mosaics, one for each view,
unless *all* their names end in

- polarizer angles, the same set for every view: ``a_000 a_045 a_090 a_135``, ``a_0 a_60 a_120``,
  ``a-POL45deg``, ``a_I90``;
- ``_s0 _s1 _s2``: Stokes images;
- ``_aolp _dolp`` (``_aop _dop``) and ``_intensity`` (``_s0``): the three maps;
- and before the suffix an exposure time, ``a_8ms`` or ``a_045_500us``: exposures of one view.

A folder without images may hold them in folders by angle (``pol000 pol045``, ``I0 I45``), by
Stokes parameter (``s0 s1 s2``), by map (``aolp dolp image``), or by view (``left/I0.png``). Other
names are given as a template (```capture.naming```).

Files with all three Stokes images, arrays (H, W, 3), look like mosaics and need ```capture.kind```.
Numbers of frames look like angles. So an ending counts as an angle only if the whole set is a usual
one of polarizers (``ANGLE_SETS``); any other set needs the template or ```capture.kind```.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from polmvs.config import CaptureKind
from polmvs.errors import DataError, OptionError, as_data_error
from polmvs.io.folders import require_unicode
from polmvs.io.raw_formats import DUMP_SUFFIXES, FLOAT_SUFFIXES, LOSSY_SUFFIXES, SUFFIXES

# The first of these groups with files in a folder is used, so that a preview or an array beside the
# images does not count as an image.
SUFFIX_GROUPS = (
    frozenset({".png", ".tif", ".tiff", ".bmp", ".pgm"}),
    frozenset({".npy"}),
    DUMP_SUFFIXES,
    FLOAT_SUFFIXES,
    LOSSY_SUFFIXES,
)
ANGLE_SETS = (
    (0, 45, 90, 135),
    (0, 45, 90),
    (0, 60, 120),
    (0, 30, 60, 90, 120, 150),
    (0, 22.5, 45, 67.5, 90, 112.5, 135, 157.5),
    tuple(range(0, 180, 20)),
    tuple(range(0, 180, 15)),
    tuple(range(0, 180, 10)),
)
STOKES_ROLES = ("s0", "s1", "s2")
MAP_ROLES = ("intensity", "aolp", "dolp")
UNITS_S = {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6}
MAX_FILES = 200_000
MAX_NAME_BYTES = 255 - 24  # the limit of file systems, less room for the endings of results
NOT_VIEWS = frozenset({"gt", "mask", "masks", "sparse", "cams", "stereo"})  # folders beside views

_OF_ANGLE = r"(?i:I|P|pol|polarizer|angle)?[_-]?"  # words before an angle
_END = r"\.(?P<suffix>[A-Za-z0-9]+)"
_ANGLE = r"(?P<angle>\d{1,3}(?:\.\d+)?)"
_EXPOSURE = r"(?:[_-](?:exp|t)?(?P<exposure>\d+(?:\.\d+)?)(?P<unit>us|ms|s))?"
_VIEW = r"(?P<view>[^/]+?)"
_MAP = r"(?P<map>aolp|aop|dolp|dop|intensity|image|s0)"
# Names within one folder, most specific first. That of mosaics fits every name.
_FLAT = (
    (CaptureKind.ANGLES, rf"{_VIEW}[_-]{_OF_ANGLE}{_ANGLE}(?i:deg)?{_EXPOSURE}{_END}"),
    (CaptureKind.STOKES, rf"{_VIEW}[_-](?P<stokes>[sS][012]){_END}"),
    (CaptureKind.AOLP, rf"{_VIEW}[_-]{_MAP}{_END}"),
    (CaptureKind.MOSAIC, rf"{_VIEW}{_EXPOSURE}{_END}"),
    (CaptureKind.MOSAIC, rf"{_VIEW}{_END}"),
)
_FOLDERS = (
    (CaptureKind.STOKES, rf"(?:images_)?(?P<stokes>[sS][012])/{_VIEW}{_END}"),
    (CaptureKind.AOLP, rf"{_MAP}/{_VIEW}{_END}"),
    (CaptureKind.ANGLES, rf"{_OF_ANGLE}{_ANGLE}(?i:deg)?/{_VIEW}{_EXPOSURE}{_END}"),
    (CaptureKind.ANGLES, rf"{_VIEW}/{_OF_ANGLE}{_ANGLE}(?i:deg)?{_EXPOSURE}{_END}"),
)
_TOKENS = {
    "view": r"(?P<view>.+?)",
    "angle": _ANGLE,
    "index": r"(?P<index>\d+)",
    "stokes": r"(?P<stokes>[sS][012])",
    "map": _MAP,
    "exposure": r"(?P<exposure>\d+(?:\.\d+)?)(?P<unit>us|ms|s)?",
    "any": r"[^/]*?",
}
_MAP_NAMES = {"aop": "aolp", "dop": "dolp", "image": "intensity", "s0": "intensity"}


@dataclass(frozen=True, kw_only=True)
class ViewFiles:
    """The files of one view.

    Attributes
    ----------
    name : of the view: the mosaic's file name, else the common part of its file names, with a
        suffix.
    files : by role, then by exposure; the roles are those of :class:`CaptureFiles`.
    """

    name: str
    files: tuple[tuple[Path, ...], ...]

    @property
    def paths(self) -> tuple[Path, ...]:
        """All of them."""
        return tuple(path for role in self.files for path in role)


@dataclass(frozen=True, kw_only=True)
class CaptureFiles:
    """A capture's views and the content of their files.

    Attributes
    ----------
    folder : as given by the user.
    kind : of the files.
    angles_deg : angles of the roles of an ``ANGLES`` capture, from the names; empty for others.
    exposures_s : exposure times, longest first; one entry, 1, if each view has one exposure.
    views : sorted by name. Roles are one mosaic; an image for each of ``angles_deg``;
        ``STOKES_ROLES``, or one file with all three; ``MAP_ROLES``, of which intensity or DoLP may
        be missing (no file).
    """

    folder: Path
    kind: CaptureKind
    angles_deg: tuple[float, ...]
    exposures_s: tuple[float, ...]
    views: tuple[ViewFiles, ...]

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files, view by view."""
        return tuple(path for view in self.views for path in view.paths)


class _Named(NamedTuple):
    """A file and the information of its name."""

    path: Path
    view: str
    role: str
    exposure_s: float


def find_capture(
    folder: Path,
    *,
    kind: CaptureKind | None = None,
    naming: str | None = None,
    angles: Sequence[float] | None = None,
) -> CaptureFiles:
    """Find the views of a capture and their files by name; see the module's docstring.

    Parameters
    ----------
    kind : the only kind to look for; None: all.
    naming : template of the files' paths below the folder; None: the usual names.
    angles : of the files of a view in the order of ``{index}``, degrees.

    Raises
    ------
    DataError
        The folder is missing or has no images, or a view lacks a file that others have.
    OptionError
        The template is malformed.
    """
    if not folder.is_dir():
        raise DataError(folder, "is no folder." if folder.exists() else "no such folder.")
    if naming is not None:
        return _by_template(folder, naming, kind, angles)
    for place in (folder, folder / "raw"):
        files = _preferred(_images_in(place))
        if files:
            return _flat(folder, place, files, kind)
    tree = [path for part in _subfolders(folder) for path in _preferred(_images_in(part))]
    for its_kind, pattern in _FOLDERS:
        if kind in (None, its_kind):
            named = _match(folder, tree, pattern)
            # Of a kind that was asked for, what is missing is named.
            if named and (kind is not None or _is_complete(its_kind, named)):
                return _assemble(folder, its_kind, named)
    kinds = ", ".join(sorted(SUFFIXES))
    raise DataError(
        folder,
        f"no images in it or in its raw/. Raw mosaics ({kinds}) are expected, or a folder for "
        "each polarizer angle, Stokes image or map; other names are given by `capture.naming`.",
    )


def _flat(
    folder: Path, place: Path, files: Sequence[Path], kind: CaptureKind | None
) -> CaptureFiles:
    """The capture of files in one folder."""
    for its_kind, pattern in _FLAT:
        if kind in (None, its_kind):
            named = _match(place, files, pattern)
            # Names of mosaics are any; the others count if all files have them.
            if named and len(named) == len(files) and _is_complete(its_kind, named):
                return _assemble(folder, its_kind, named)
    if kind is CaptureKind.STOKES:  # all three in each file
        return _assemble(folder, kind, _match(place, files, rf"{_VIEW}{_END}"))
    raise DataError(
        place,
        f"its files' names are not those of a capture of kind {kind}. Say by `capture.naming` how "
        "its files are named.",
    )


def _by_template(
    folder: Path, naming: str, kind: CaptureKind | None, angles: Sequence[float] | None
) -> CaptureFiles:
    """The capture whose paths fit a template."""
    pattern = re.escape(naming).replace(r"\{", "{").replace(r"\}", "}")
    for token in re.findall(r"{(.*?)}", pattern):
        if token not in _TOKENS:
            known = ", ".join(f"{{{name}}}" for name in _TOKENS)
            raise OptionError(f"`capture.naming`: {{{token}}} is unknown; known are {known}.")
        pattern = pattern.replace(f"{{{token}}}", _TOKENS[token], 1)
    try:
        compiled = re.compile(pattern)
    except re.error as error:
        raise OptionError(f"`capture.naming`: {naming!r} names something twice.") from error
    groups = compiled.groupindex
    if "index" in groups and angles is None:
        raise OptionError("`capture.naming` has {index}; give the `capture.angles` of these files.")
    kinds = {"map": CaptureKind.AOLP, "stokes": CaptureKind.STOKES}
    kinds |= {"index": CaptureKind.ANGLES, "angle": CaptureKind.ANGLES}
    told = next((its for name, its in kinds.items() if name in groups), CaptureKind.MOSAIC)
    if told is CaptureKind.MOSAIC and kind is CaptureKind.STOKES:
        told = kind  # one array a view with all three
    if kind not in (None, told):
        raise OptionError(
            f"`capture.naming` {naming!r} is of {told} files, `capture.kind` says {kind}."
        )
    tree = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES)
    named = _match(folder, tree, pattern, angles)
    if not named:
        raise DataError(folder, f"no image's name fits `capture.naming` {naming!r}.")
    return _assemble(folder, told, named)


def _match(
    root: Path, files: Iterable[Path], pattern: str, angles: Sequence[float] | None = None
) -> list[_Named]:
    """Files whose path below a folder matches a pattern, with the match."""
    compiled = re.compile(pattern)
    found = []
    for path in files:
        match = compiled.fullmatch(path.relative_to(root).as_posix())
        if match is None or path.suffix.lower() not in SUFFIXES:
            continue
        said = match.groupdict()
        role = ""
        if said.get("angle"):
            role = f"{float(said['angle']):g}"
        elif said.get("stokes"):
            role = said["stokes"].lower()
        elif said.get("map"):
            role = _MAP_NAMES.get(said["map"], said["map"])
        elif said.get("index"):
            role = said["index"]
        exposure = float(said.get("exposure") or 1) * UNITS_S[said.get("unit") or ""]
        found.append(_Named(path, said["view"], role, exposure))
    if angles is not None:
        return _with_angles(found, angles)
    return found


def _with_angles(named: Sequence[_Named], angles: Sequence[float]) -> list[_Named]:
    """Files with the angle of their place in the order of indices, in each view."""
    places: dict[str, list[int]] = defaultdict(list)
    for item in named:
        if item.role.isdigit() and int(item.role) not in places[item.view]:
            places[item.view].append(int(item.role))
    result = []
    for item in named:
        order = sorted(places[item.view])
        if len(order) != len(angles):
            raise DataError(
                item.path,
                f"its view {item.view!r} has {len(order)} images, `capture.angles` {len(angles)}",
            )
        result.append(item._replace(role=f"{angles[order.index(int(item.role))]:g}"))
    return result


def _is_complete(kind: CaptureKind, named: Sequence[_Named]) -> bool:
    """Whether names make whole views of this kind."""
    if kind is CaptureKind.MOSAIC:
        exposures: dict[str, set[float]] = defaultdict(set)
        for item in named:
            exposures[item.view].add(item.exposure_s)
        # Frames of one series may be named by their time: exposures come with several views.
        same = len(set(map(frozenset, exposures.values()))) == 1
        return len(exposures) == len(named) or (same and len(exposures) > 1)
    roles: dict[str, set[str]] = defaultdict(set)
    for item in named:
        roles[item.view].add(item.role)
    sets = set(map(frozenset, roles.values()))
    if kind is CaptureKind.ANGLES:
        if len(sets) != 1:
            return False
        angles = tuple(sorted(float(role) for role in next(iter(sets))))
        # One view only: four frames of a turntable look like it, most other sets even more.
        return angles in (ANGLE_SETS if len(roles) > 1 else ANGLE_SETS[:1])
    if kind is CaptureKind.STOKES:
        return sets == {frozenset(STOKES_ROLES)}
    return all({"aolp", "dolp"} <= found for found in sets)


def _assemble(folder: Path, kind: CaptureKind, named: Sequence[_Named]) -> CaptureFiles:
    """The capture of these files; every view must have every role and exposure."""
    exposures = sorted({item.exposure_s for item in named}, reverse=True)
    views: dict[str, dict[tuple[str, float], Path]] = defaultdict(dict)
    for item in named:
        slot = views[item.view]
        other = slot.setdefault((item.role, item.exposure_s), item.path)
        if other is not item.path:
            raise DataError(item.path, f"is the same image of the same view as {other}.")
    roles: tuple[str, ...]
    match kind:
        case CaptureKind.MOSAIC:
            roles = ("",)
        case CaptureKind.ANGLES:
            roles = tuple(sorted({item.role for item in named}, key=float))
            if len({float(role) % 180 for role in roles}) < 3:
                raise DataError(
                    folder,
                    f"has images behind polarizers at {', '.join(roles)} degrees; three or more "
                    "different angles are needed.",
                )
        case CaptureKind.STOKES:
            roles = STOKES_ROLES if any(item.role for item in named) else ("",)
        case CaptureKind.AOLP:
            roles = MAP_ROLES
    present = {item.role for item in named}
    result = []
    for view, slots in sorted(views.items()):
        for role in roles:
            for exposure in exposures:
                if role in present and (role, exposure) not in slots:
                    what = f"its image {role!r}" if role else f"its exposure of {exposure:g} s"
                    raise DataError(folder, f"the view {view!r} lacks {what}, which others have.")
        files = tuple(
            tuple(slots[role, t] for t in exposures if (role, t) in slots) for role in roles
        )
        first = next(iter(slots.values()))
        single = kind is CaptureKind.MOSAIC and len(exposures) == 1
        name = first.name if single else f"{view.replace('/', '_')}{first.suffix}"
        _require_usable(folder, name)
        result.append(ViewFiles(name=name, files=files))
    # In the order of the names, as files are listed.
    result.sort(key=lambda view: view.name)
    return CaptureFiles(
        folder=folder,
        kind=kind,
        angles_deg=tuple(map(float, roles)) if kind is CaptureKind.ANGLES else (),
        exposures_s=tuple(exposures) if len(exposures) > 1 else (1.0,),
        views=tuple(result),
    )


def _require_usable(folder: Path, name: str) -> None:
    """Refuse names that fail only when COLMAP, or a file named after them, gets them."""
    require_unicode(folder / name)
    if len(name.encode()) > MAX_NAME_BYTES:
        raise DataError(
            folder, f"{name!r} is longer than {MAX_NAME_BYTES} bytes. Rename its files."
        )


def _images_in(folder: Path) -> list[Path]:
    """Image files of a folder by name, hidden ones left out; none where it does not exist."""
    with as_data_error(folder, "read"):
        found = sorted(folder.iterdir()) if folder.is_dir() else []
    if len(found) > MAX_FILES:
        raise DataError(folder, f"holds {len(found):,} files, more than any capture.")
    return [
        path
        for path in found
        if path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()
    ]


def _subfolders(folder: Path) -> list[Path]:
    """Folders in a folder by name, hidden ones left out."""
    found = sorted(path for path in folder.iterdir() if path.is_dir())
    return [p for p in found if not p.name.startswith(".") and p.name not in NOT_VIEWS]


def _preferred(files: Sequence[Path]) -> list[Path]:
    """Files of the first group of suffixes that has any."""
    for group in SUFFIX_GROUPS:
        chosen = [path for path in files if path.suffix.lower() in group]
        if chosen:
            return chosen
    return []
