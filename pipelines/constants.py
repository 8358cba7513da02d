"""Vary every numeric constant of the package by two, and tell which figures move.

    python pipelines/constants.py OUT CAPTURE [CAPTURE ...] [--way default contour stereo export]
                                  [--workers N] [--only TEXT ...] [--report REPORT.md]

Each CAPTURE holds ``raw/``, ``gt/`` and ``sparse/`` (a COLMAP model of it). Constants are found in
the source: module-level numbers in capitals, defaults of dataclass fields and of parameters, and
numbers without a name in functions. Each is varied in a process of its own, into which the package
is imported anew with the changed number, so that what other modules copied or derived from it
changes, too. The chain begins at the first stage that reads the constant, from the results of an
unchanged run. ``OUT/results.jsonl`` grows by a line for each run; a study that was stopped goes on
with what is missing.

A figure has moved if it differs by more than its rounding and by more than chance explains: the
scatter of runs on the same capture with a sensor's noise added anew.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import importlib
import inspect
import json
import math
import os
import resource
import shutil
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass
from functools import cache
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import polmvs
from polmvs.cli import main as polmvs_main
from polmvs.config import AngleModel
from polmvs.evaluation.comparison import measure_against_truth
from polmvs.evaluation.metrics import CloudMetrics
from polmvs.io.clouds import Cloud, read_cloud
from polmvs.io.ground_truth import GroundTruth, open_ground_truth
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.stages.capture import posed_views
from polmvs.pipeline.stages.clouds import open_dense_views
from polmvs.synthetic.captures import add_noise, quantize

PACKAGE = Path(polmvs.__file__).parent
MODEL = AngleModel.PPA
FACTORS = (2.0, 0.5)
NUM_NOISY = 4  # runs on the same capture with other noise
NUM_SIGMAS = 5.8  # Student's t of 99 % for a deviation from four runs
CLEAR_LIMITS = 1.5  # of a figure's limit: a constant that moves one by more is not run again
COMMANDS = ("sfm", "normals", "densify", "export")  # in order; each reads what those before wrote
WAYS = {  # flags of each command under which other parts of the package run
    "default": {},
    "contour": {"densify": ["--method", "contour"]},
    "stereo": {"densify": ["--surroundings", "stereo"]},
    "export": {},
}
ROUNDING = {  # by which figures may differ unnoticed; all others by a share of their size
    "f_1mm": 0.001,
    "f_2mm": 0.001,
    "complete_1mm": 0.001,
    "complete_2mm": 0.001,
    "coverage": 0.001,
    "within_two_sigma": 0.01,
    "off_5mm": 0.0005,
    "around_off_5mm": 0.002,
    "chamfer_mm": 0.01,
    "depth_rmse_mm": 0.01,
    "depth_median_mm": 0.01,
    "normal_deg": 0.01,
    "map_normal_deg": 0.01,
    "track_normal_deg": 0.02,
}
RELATIVE_ROUNDING = 0.05  # numbers of points and seeds
SPEED = "cpu_s"  # shared machines time badly: only a large change of it is one
SPEED_ROUNDING = 0.25

# What is no tolerance: the instrument, formats, command line, what is about to be replaced.
SKIPPED_FOLDERS = (
    "cli",
    "evaluation",
    "experiments",
    "io",
    "pipeline",
    "report",
    "surface/parts",
    "synthetic",
)
SKIPPED_MODULES = (
    "polmvs.normals.single_view.command",
    "polmvs.colmap.binary_check",
    "polmvs.errors",
    "polmvs.neighbors",
    "polmvs.parallel",
    "polmvs.poses.alignment",
    "polmvs.scene",
)
SKIPPED_NAMES = {  # units, what a file is, sizes of formats and of chunks
    "ABSORBING",
    "ANGLES_DEG",
    "BAND_ROWS",
    "CHUNK",
    "CORNERS",
    "DEPTH_CHANNELS",
    "HEADER_BYTES",
    "MAX_DEFAULT_WORKERS",
    "MAX_NAMES_SHOWN",
    "MAX_OPENCV_COORDINATE",
    "MEDIAN_OF_NORMAL",
    "NORMAL_CHANNELS",
    "OPTICAL_AXIS",
    "OUTSIDE",
    "SAMPLE_BYTES",
    "TINY",
    "UNIFORM_SIGMA",
    "first_curve",
    "gamma",
    "pattern",
    "first_round",
    "seed",
}
NUMERIC_NODES = (  # of expressions that are numbers
    ast.Attribute,
    ast.BinOp,
    ast.Call,
    ast.Name,
    ast.Tuple,
    ast.UnaryOp,
    ast.expr_context,
    ast.operator,
    ast.unaryop,
)
PLAIN_NUMBERS = (0.0, 0.5, 1.0, 2.0, 12.0, 90.0, 100.0, 180.0, 255.0, 1000.0)  # of formulas
OPTION_GROUPS = {  # of polmvs.config: the command that takes the flag
    "CaptureOptions": "sfm",
    "RegionOptions": "normals",
    "NormalOptions": "normals",
    "PropagationOptions": "densify",
    "FusionOptions": "densify",
}


@dataclass(frozen=True, kw_only=True)
class Constant:
    """A number of the source.

    Attributes
    ----------
    module : dotted name.
    name : ``NAME``, ``Class.field``, ``function(parameter)``, or ``function[0.7]`` for a number
        without a name.
    line : of the source.
    value : as the source spells it.
    flag : of the command line, for an option; it is varied there.
    """

    module: str
    name: str
    line: int
    value: str
    flag: str | None = None

    @property
    def key(self) -> str:
        """Its full name."""
        return f"{self.module}:{self.name}"


def find_constants() -> list[Constant]:
    """All numbers of the package that may be tolerances, by module and line."""
    found: list[Constant] = []
    for path in sorted(PACKAGE.rglob("*.py")):
        inside = path.relative_to(PACKAGE)
        module = ".".join(["polmvs", *inside.with_suffix("").parts])
        if module in SKIPPED_MODULES or inside.as_posix().startswith(SKIPPED_FOLDERS):
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for name, node in dict(_numbers_of(tree)).items():
            last = name.rstrip(")").replace("(", ".").split(".")[-1]
            if last in SKIPPED_NAMES or "__post_init__" in name:
                continue
            owner, _, field = name.partition(".")
            flag = None
            if module == "polmvs.config":
                if owner not in OPTION_GROUPS:
                    continue
                flag = "--" + field.replace("_", "-")
            found.append(
                Constant(
                    module=module,
                    name=name,
                    line=node.lineno,
                    value=ast.unparse(_number_in(node)),
                    flag=flag,
                )
            )
    return found


def _numbers_of(tree: ast.Module) -> Iterator[tuple[str, ast.expr]]:
    """Names and expressions of the constants of a module."""
    for node in tree.body:
        for target, value in _assigned(node):
            if target.lstrip("_").isupper() and _is_number(value):
                yield target, value
        if isinstance(node, ast.ClassDef):
            for inner in node.body:
                for target, value in _assigned(inner):
                    if _is_number(_number_in(value)):
                        yield f"{node.name}.{target}", value
                if isinstance(inner, ast.FunctionDef):
                    yield from _defaults_of(inner, f"{node.name}.{inner.name}")
                    yield from _unnamed_in(inner, f"{node.name}.{inner.name}")
        if isinstance(node, ast.FunctionDef):
            yield from _defaults_of(node, node.name)
            yield from _unnamed_in(node, node.name)


def _unnamed_in(function: ast.FunctionDef, name: str) -> Iterator[tuple[str, ast.expr]]:
    """Numbers in the body of a function that nobody has named; guards against zero are none."""
    for statement in function.body:
        for node in ast.walk(statement):
            value = node.value if isinstance(node, ast.Constant) else None
            if not isinstance(node, ast.expr) or not isinstance(value, float):
                continue
            if value not in PLAIN_NUMBERS and 1e-3 <= value < 1e6:
                yield f"{name}[{value:g}]", node


def _assigned(node: ast.stmt) -> Iterator[tuple[str, ast.expr]]:
    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
        yield node.targets[0].id, node.value
    if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value:
        yield node.target.id, node.value


def _defaults_of(function: ast.FunctionDef, name: str) -> Iterator[tuple[str, ast.expr]]:
    arguments = function.args
    positional = [*arguments.posonlyargs, *arguments.args]
    pairs: list[tuple[ast.arg, ast.expr | None]] = [
        *zip(
            positional[len(positional) - len(arguments.defaults) :], arguments.defaults, strict=True
        ),
        *zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True),
    ]
    for argument, default in pairs:
        if default is not None and _is_number(default):
            yield f"{name}({argument.arg})", default


def _number_in(value: ast.expr) -> ast.expr:
    """The default in a call such as ``option(0.5, "help")`` or ``field(default=0.5)``."""
    if isinstance(value, ast.Call) and isinstance(value.func, ast.Name):
        for keyword in value.keywords:
            if keyword.arg == "default":
                return keyword.value
        if value.args and value.func.id in ("option", "tolerance"):
            return value.args[0]
    return value


def _is_number(value: ast.expr) -> bool:
    """Whether an expression is numbers, made of nothing but literals and NumPy's functions."""
    if isinstance(value, ast.Call) and isinstance(value.func, ast.Name):
        return value.func.id in ("float", "int") and _is_number(value.args[0])
    literals = 0
    for node in ast.walk(value):
        if isinstance(node, ast.Constant):
            if isinstance(node.value, bool | str | bytes) or node.value is None:
                return False
            literals += 1
        elif getattr(node, "id", "np") not in ("np", "math") or not isinstance(node, NUMERIC_NODES):
            return False
    return literals > 0


def varied(value: Any, factor: float) -> Any:
    """A number, or each of a tuple or array, a factor larger.

    What lies between a half and one is a share, a cosine or a quantile, whose complement is
    varied, and so is that of a percentile above 95; an odd integer stays odd, as sides of windows
    must.
    """
    if isinstance(value, tuple):
        return tuple(varied(element, factor) for element in value)
    if isinstance(value, np.ndarray):
        return value * factor
    if isinstance(value, int):  # a count, a size in px
        if value % 2 and value > 1:
            return 2 * round((value - 1) / 2 * factor) + 1
        return max(round(value * factor), min(value, 1))
    for whole in (1, 100):
        if 0.5 < value / whole < 1 and (whole == 1 or value > 95):
            return type(value)(whole - (whole - value) * factor)
    return value * factor


class VaryingLoader(SourceFileLoader):
    """Loads a module with some of its numbers varied."""

    def __init__(self, fullname: str, path: str, names: Sequence[str], factor: float) -> None:
        super().__init__(fullname, path)
        self.names = names
        self.factor = factor

    def get_code(self, fullname: str) -> CodeType:
        """Compile the changed source; no cached bytecode."""
        path = self.get_filename(fullname)
        tree = ast.parse(self.get_data(path))
        for name, node in list(_numbers_of(tree)):
            if name in self.names:
                self._replace(tree, _number_in(node))
        return compile(ast.fix_missing_locations(tree), path, "exec", dont_inherit=True)

    def exec_module(self, module: ModuleType) -> None:
        """Run the module, which calls back for its number."""
        module.__dict__["_varied"] = lambda value: varied(value, self.factor)
        super().exec_module(module)

    @staticmethod
    def _replace(tree: ast.Module, number: ast.expr) -> None:
        call = ast.Call(func=ast.Name(id="_varied", ctx=ast.Load()), args=[number], keywords=[])
        ast.copy_location(call, number)
        for parent in ast.walk(tree):
            for field, value in ast.iter_fields(parent):
                if value is number:
                    setattr(parent, field, call)
                elif isinstance(value, list) and parent is not call:
                    value[:] = [call if element is number else element for element in value]


class VaryingFinder(MetaPathFinder):
    """Finds the modules whose numbers are varied."""

    def __init__(self, constants: Sequence[Constant], factor: float) -> None:
        self.constants = constants
        self.factor = factor

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> ModuleSpec | None:
        """The module with another loader."""
        names = [c.name for c in self.constants if c.module == fullname and c.flag is None]
        spec = PathFinder.find_spec(fullname, path) if names else None
        if spec is not None and spec.origin is not None:
            spec.loader = VaryingLoader(fullname, spec.origin, names, self.factor)
        return spec


def import_anew(constants: Sequence[Constant], factor: float) -> Callable[[Sequence[str]], int]:
    """The command line of a package with other constants; for a process of its own."""
    for name in [n for n in sys.modules if n == "polmvs" or n.startswith("polmvs.")]:
        del sys.modules[name]
    sys.meta_path.insert(0, VaryingFinder(constants, factor))
    main: Callable[[Sequence[str]], int] = importlib.import_module("polmvs.cli").main
    return main


@dataclass(frozen=True, kw_only=True)
class Base:
    """An unchanged run of a capture in one way.

    Attributes
    ----------
    capture, out, way : what was run, where its results lie, and how.
    truth : of the capture.
    reads : for each command the keys of the constants that it reads.
    hashes : for each command that of its results.
    """

    capture: Path
    out: Path
    way: str
    truth: GroundTruth
    reads: dict[str, list[str]]
    hashes: dict[str, str]

    def commands_that_read(self, constants: Sequence[Constant]) -> list[str]:
        """The commands that read one of some constants, in order; an option's is its own."""
        keys = {c.key for c in constants if c.flag is None}
        taken = {OPTION_GROUPS[c.name.partition(".")[0]] for c in constants if c.flag is not None}
        return [c for c in commands_of(self.way) if c in taken or keys & set(self.reads[c])]

    def is_of_use(self, constant: Constant) -> bool:
        """Whether this way tells something of a constant: not if the default way tells it."""
        commands = self.commands_that_read([constant])
        return bool(commands) and (self.way != "export" or commands == ["export"])


def commands_of(way: str) -> tuple[str, ...]:
    """The commands that a way consists of."""
    return COMMANDS if way == "export" else COMMANDS[:-1]


def argv_of(command: str, capture: Path, raw: Path, out: Path, way: str) -> list[str]:
    """The command line of one stage."""
    argv = [command, str(raw), str(out), "--workers", "1", *WAYS[way].get(command, [])]
    if command == "sfm":
        return [*argv, "--sparse", str(capture / "sparse")]
    return [*argv, "--overwrite"]


def trace(argv: Sequence[str]) -> set[CodeType]:
    """The package's functions that a command calls."""
    called: set[CodeType] = set()

    def see(frame: FrameType, event: str, argument: Any) -> None:
        code = frame.f_code
        is_function = code.co_flags & inspect.CO_OPTIMIZED  # no module's or class's body
        if event == "call" and is_function and code.co_filename.startswith(str(PACKAGE)):
            called.add(code)

    sys.setprofile(see)
    try:
        status = polmvs_main(argv)
    finally:
        sys.setprofile(None)
    if status != 0:
        raise RuntimeError(f"polmvs {' '.join(argv)} ended with {status}.")
    return called


def constants_read(called: Iterable[CodeType], constants: Sequence[Constant]) -> list[str]:
    """Keys of the constants that some functions read: by name, by default or through another."""
    named: dict[str, set[str]] = {}  # by module
    functions: dict[str, set[str]] = {}
    for code in called:
        path = Path(code.co_filename).relative_to(PACKAGE).with_suffix("")
        module = ".".join(["polmvs", *path.parts]).removesuffix(".__init__")
        inner = [c for c in code.co_consts if isinstance(c, CodeType)]  # comprehensions
        named.setdefault(module, set()).update(*(c.co_names for c in (code, *inner)))
        functions.setdefault(module, set()).add(code.co_qualname)
    _add_defaults_and_derived(named, functions)
    anywhere = set().union(*named.values())
    read = []
    for constant in constants:
        function, _, parameter = constant.name.replace("[", "(").partition("(")
        if parameter:
            reached = function in functions.get(constant.module, set())
        elif "." in constant.name:
            reached = constant.name.partition(".")[2] in anywhere
        else:
            reached = any(constant.name in named.get(m, set()) for m in _holders_of(constant))
        if reached:
            read.append(constant.key)
    return read


def _add_defaults_and_derived(named: dict[str, set[str]], functions: dict[str, set[str]]) -> None:
    """Add what the defaults of called functions name, and what named numbers are made of."""
    for module, names in named.items():
        tree = _tree_of(module)
        called = {qualified.split(".")[-1] for qualified in functions[module]}
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and node.name in called:
                for default in (*node.args.defaults, *filter(None, node.args.kw_defaults)):
                    names |= {n.id for n in ast.walk(default) if isinstance(n, ast.Name)}
        for statement in reversed(tree.body):
            for target, value in _assigned(statement):
                if target in names:
                    names |= {n.id for n in ast.walk(value) if isinstance(n, ast.Name)}


def _holders_of(constant: Constant) -> Iterator[str]:
    """Modules that know a constant by its name: its own, and those that import it from there."""
    yield constant.module
    for name in [n for n in sys.modules if n.startswith("polmvs.") and n != constant.module]:
        for node in _tree_of(name).body:
            if not isinstance(node, ast.ImportFrom) or node.module != constant.module:
                continue
            if constant.name in [alias.name for alias in node.names]:
                yield name


@cache
def _tree_of(module: str) -> ast.Module:
    path = sys.modules[module].__file__
    return ast.parse(Path(path).read_text(encoding="utf-8")) if path else ast.Module([], [])


def hash_of(out: Path, command: str) -> str:
    """Of the results that the following commands and the figures are made of."""
    patterns = {
        "sfm": ["images/*", "sparse/*"],
        "normals": ["maps/*.npy", "normals*.ply"],
        "densify": [f"{MODEL}.ply", f"views_{MODEL}/**/*.npy"],
        "export": [f"{MODEL}_mesh.ply", "dense/stereo/*/*.bin"],
    }[command]
    digest = hashlib.sha256()
    for pattern in patterns:
        for path in sorted(out.glob(pattern)):
            digest.update(str(path.relative_to(out)).encode() + path.read_bytes())
    return digest.hexdigest()


def figures_of(out: Path, truth: GroundTruth, way: str) -> dict[str, float]:
    """The figures of a run's results; lengths in mm, shares from 0 to 1."""
    folder = RunFolder(out)
    views = posed_views(folder)
    if way == "export":
        found = measure_against_truth(read_cloud(folder.mesh(MODEL)), None, views, truth)
        return _cloud_figures(found["cloud"])
    cloud, tracks = read_cloud(folder.cloud(MODEL)), read_cloud(folder.normals(MODEL))
    kinds = cloud.scalars["kind"]
    dense = open_dense_views(folder, MODEL)
    found = measure_against_truth(_part_of(cloud, kinds == 0), tracks, views, truth, dense)
    around = measure_against_truth(_part_of(cloud, kinds != 0), None, views, truth)["cloud"]
    maps = found["maps"]
    return _cloud_figures(found["cloud"]) | {
        "around_off_5mm": float(around.off_surface_share),
        "around_num_points": float(around.num_points),
        "track_normal_deg": float(found["tracks"].errors.mean_deg),
        "num_seeds": float((tracks.scalars["seed"] > 0).sum()),
        "depth_rmse_mm": float(1e3 * maps.depth_rmse_m),
        "depth_median_mm": float(1e3 * maps.depth_median_m),
        "coverage": float(maps.coverage),
        "within_two_sigma": float(maps.within_two_sigma),
        "map_normal_deg": float(maps.normals.mean_deg),
    }


def _cloud_figures(metrics: CloudMetrics) -> dict[str, float]:
    return {
        "f_1mm": float(metrics.f_score[0]),
        "f_2mm": float(metrics.f_score[1]),
        "complete_1mm": float(metrics.completeness[0]),
        "complete_2mm": float(metrics.completeness[1]),
        "chamfer_mm": float(1e3 * metrics.chamfer_m),
        "normal_deg": float(metrics.normal_mean_deg),
        "off_5mm": float(metrics.off_surface_share),
        "num_points": float(metrics.num_points),
    }


def _part_of(cloud: Cloud, keep: NDArray[np.bool_]) -> Cloud:
    normals = None if cloud.normals is None else cloud.normals[keep]
    return Cloud(points=cloud.points[keep], normals=normals, colors=None, scalars={})


def run_base(capture: Path, out: Path, way: str, constants: Sequence[Constant]) -> Base:
    """Run a capture unchanged, and note what each command reads and makes."""
    note, truth = out / "base.json", open_ground_truth(capture / "gt")
    if not note.is_file():
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
        reads, hashes = {}, {}
        for command in commands_of(way):
            argv = argv_of(command, capture, capture / "raw", out / "run", way)
            reads[command] = constants_read(trace(argv), constants)
            hashes[command] = hash_of(out / "run", command)
        note.write_text(json.dumps({"reads": reads, "hashes": hashes}))
    content = json.loads(note.read_text())
    truth.surface_points()  # in memory before processes are forked
    return Base(capture=capture, out=out / "run", way=way, truth=truth, **content)


def run_varied(
    base: Base, constants: Sequence[Constant], factor: float, out: Path
) -> dict[str, Any]:
    """Run what reads some constants with them varied; for a process of its own."""
    reading = base.commands_that_read(constants)
    if not reading:
        return {"unread": True}
    _copy_run(base.out, out)
    extra: dict[str, list[str]] = {}
    for constant in constants:
        if constant.flag is not None:
            value = varied(ast.literal_eval(constant.value), factor)
            command = OPTION_GROUPS[constant.name.partition(".")[0]]
            extra.setdefault(command, []).extend([constant.flag, str(value)])
    main = import_anew(constants, factor)
    start = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    todo = commands_of(base.way)
    todo = todo[todo.index(reading[0]) :]
    for index, command in enumerate(todo):
        if command == "sfm":
            shutil.rmtree(out)
        argv = argv_of(command, base.capture, base.capture / "raw", out, base.way)
        status = main([*argv, *extra.get(command, [])])
        if status != 0:
            return {"status": status, "command": command}
        same = hash_of(out, command) == base.hashes[command]
        if same and not set(todo[index + 1 :]) & set(reading):
            return {"identical": True}
    used = resource.getrusage(resource.RUSAGE_SELF).ru_utime - start
    figures = figures_of(out, base.truth, base.way)
    return {"figures": figures | {SPEED: used}, "commands": list(todo)}


def run_noisy(base: Base, seed: int, out: Path) -> dict[str, Any]:
    """The chain on the capture with noise added anew; with seed 0 on the capture as it is."""
    raw = base.capture / "raw"
    if seed:
        raw = out.with_name(out.name + "_raw")
        raw.mkdir()
        rng = np.random.default_rng(seed)
        for path in sorted((base.capture / "raw").iterdir()):
            image = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
            bits = 8 * image.dtype.itemsize
            noisy = add_noise(image.astype(np.float64) / (2**bits - 1), rng=rng)
            cv2.imwrite(str(raw / path.name), quantize(noisy, bits))
    start = resource.getrusage(resource.RUSAGE_SELF).ru_utime
    seconds = {}
    for command in commands_of(base.way):
        status = polmvs_main(argv_of(command, base.capture, raw, out, base.way))
        if status != 0:
            return {"status": status, "command": command}
        seconds[command] = resource.getrusage(resource.RUSAGE_SELF).ru_utime - start
        start += seconds[command]
    if seed:
        shutil.rmtree(raw)
    return {"figures": figures_of(out, base.truth, base.way), "seconds": seconds}


def _copy_run(source: Path, target: Path) -> None:
    """A copy that shares the files: the program replaces files and does not write into them."""

    def link(path: str, copy: str) -> None:
        if path.endswith((".log", ".json")):
            shutil.copy2(path, copy)
        else:
            os.link(path, copy)

    shutil.copytree(source, target, copy_function=link)


@dataclass(frozen=True, kw_only=True)
class Task:
    """One run on a base: of constants or, without any, of noise with ``factor`` as its seed."""

    base: int
    constants: tuple[Constant, ...]
    factor: float

    def label(self, bases: Sequence[Base]) -> dict[str, Any]:
        """What tells its line in the results from the others."""
        base = bases[self.base]
        key = "+".join(c.key for c in self.constants) or "noise"
        return {
            "capture": base.capture.name,
            "way": base.way,
            "constant": key,
            "factor": self.factor,
        }


def run_forked(tasks: Iterable[Task], bases: Sequence[Base], out: Path, num_workers: int) -> None:
    """Each task in a forked process of its own; a line of ``results.jsonl`` for each."""
    running: set[int] = set()
    for number, task in enumerate(tasks):
        while len(running) >= num_workers:
            running.discard(os.wait()[0])
        pid = os.fork()
        if pid == 0:
            _work(task, bases, out, number)
        running.add(pid)
    while running:
        running.discard(os.wait()[0])


def _work(task: Task, bases: Sequence[Base], out: Path, number: int) -> None:
    """In the forked process: run the task and write its line. Never returns."""
    base, folder = bases[task.base], out / f"work_{os.getpid()}_{number}"
    try:
        with (out / "log.txt").open("a") as log, redirect_stdout(log), redirect_stderr(log):
            if task.constants:
                result = run_varied(base, task.constants, task.factor, folder)
            else:
                result = run_noisy(base, int(task.factor), folder)
    except BaseException as error:  # whatever a wild number leads to is a result
        text = f"{type(error).__name__}: {error}"
        result = {"error": text, "where": traceback.format_exc()[-400:]}
    line = json.dumps(task.label(bases) | result)
    with (out / "results.jsonl").open("a") as results:
        results.write(line + "\n")
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(0)


def read_results(out: Path) -> list[dict[str, Any]]:
    """All lines of the results."""
    path = out / "results.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []


def noise_of(results: Sequence[dict[str, Any]]) -> dict[tuple[str, str], dict[str, float]]:
    """Deviations of the figures by capture and way, over the runs with other noise."""
    draws: dict[tuple[str, str], list[dict[str, float]]] = {}
    for line in results:
        if line["constant"] == "noise" and line["factor"] > 0 and "figures" in line:
            draws.setdefault((line["capture"], line["way"]), []).append(line["figures"])
    return {
        key: {name: float(np.std([d[name] for d in found], ddof=1)) for name in found[0]}
        for key, found in draws.items()
        if len(found) > 1
    }


def effect_of(
    line: dict[str, Any], still: dict[str, Any], noise: dict[str, float]
) -> tuple[dict[str, tuple[float, float, float]], str]:
    """Figures that moved: before, after, and by how many limits; and why a run failed."""
    if line.get("identical"):
        return {}, ""
    if "figures" not in line:
        return {}, str(line.get("error", f"status {line.get('status')}"))
    moved = {}
    before = dict(still["figures"])
    before[SPEED] = sum(still["seconds"][command] for command in line["commands"])
    for name, after in line["figures"].items():
        limit = ROUNDING.get(name, RELATIVE_ROUNDING * abs(before[name]))
        limit = max(limit, NUM_SIGMAS * noise.get(name, 0.0))
        if name == SPEED:
            limit = SPEED_ROUNDING * before[SPEED] + 0.5
        change = abs(after - before[name])  # NaN counts as a move
        if math.isfinite(before[name]) and not change <= limit:
            moved[name] = (before[name], after, change / limit if limit else math.inf)
    return moved, ""


def write_report(out: Path, constants: Sequence[Constant], report: Path) -> None:
    """What each constant moves, as JSON beside the results and as a table in Markdown."""
    table = tabulate(out, constants)
    (out / "constants.json").write_text(json.dumps(table, indent=1))
    report.write_text(_markdown(table))


def tabulate(out: Path, constants: Sequence[Constant]) -> dict[str, dict[str, Any]]:
    """For each constant what it is and what the results so far say of it."""
    results = read_results(out)
    noise = noise_of(results)
    still = {
        (line["capture"], line["way"]): line
        for line in results
        if line["constant"] == "noise" and line["factor"] == 0
    }
    table: dict[str, dict[str, Any]] = {
        c.key: asdict(c) | {"runs": 0, "moved": [], "slower": [], "refused": []} for c in constants
    }
    for line in results:
        at = (line["capture"], line["way"])
        if line["constant"] == "noise" or line.get("unread") or at not in still:
            continue
        where = f"{at[0]}{'' if at[1] == 'default' else ' ' + at[1]} x{line['factor']:g}"
        moved, refused = effect_of(line, still[at], noise.get(at, {}))
        time = moved.pop(SPEED, None)
        keys = [key for key in line["constant"].split("+") if key in table]
        if len(keys) > 1 and (moved or refused):
            continue  # by one of them: the runs of its halves tell by which
        for key in keys:
            table[key]["runs"] += 1
        if len(keys) == 1:
            entry = table[keys[0]]
            entry["moved"] += [(where, name, *values) for name, values in moved.items()]
            entry["slower"] += [(where, *time)] if time is not None else []
            entry["refused"] += [(where, refused)] if refused else []
    return table


def _markdown(table: dict[str, dict[str, Any]]) -> str:
    """The table, a section for each verdict."""
    moving = {k: e for k, e in table.items() if e["moved"] or e["refused"]}
    speed = {k: e for k, e in table.items() if k not in moving and e["slower"]}
    still = {k: e for k, e in table.items() if e["runs"] and k not in moving and k not in speed}
    unread = {k: e for k, e in table.items() if not e["runs"]}
    lines = [
        f"# Constants\n\n{len(table)} numbers: {len(moving)} move a figure, {len(speed)} only "
    ]
    lines[0] += f"the time, {len(still)} nothing; {len(unread)} are read in none of these runs.\n"
    for title, part in (
        ("Move a figure", moving),
        ("Move the time alone", speed),
        ("Move nothing", still),
        ("Not read", unread),
    ):
        lines += [
            f"## {title}\n",
            "| module | constant | value | largest moves |",
            "|---|---|---|---|",
        ]
        for entry in part.values():
            module = entry["module"].removeprefix("polmvs.")
            lines.append(f"| {module} | `{entry['name']}` | {entry['value']} | {_moves(entry)} |")
        lines.append("")
    return "\n".join(lines)


def _moves(entry: dict[str, Any]) -> str:
    """The three largest moves of a constant, of different runs."""
    texts: list[str] = []
    seen: set[str] = set()
    for where, name, before, after, limits in sorted(entry["moved"], key=lambda m: -m[-1]):
        if where not in seen and len(seen) < 3:
            seen.add(where)
            texts.append(f"{where}: {name} {before:.4g} → {after:.4g} ({limits:.1f} limits)")
    texts += [f"{where}: {error}"[:100] for where, error in entry["refused"][:2]]
    texts += [f"{where}: {b:.1f} → {a:.1f} s" for where, b, a, _ in entry["slower"][:2]]
    return "; ".join(texts).replace("|", "\\|") or f"{entry['runs']} runs"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder of the results")
    parser.add_argument("captures", type=Path, nargs="*", help="folders with raw/, gt/, sparse/")
    parser.add_argument("--way", choices=list(WAYS), nargs="+", default=["default"])
    parser.add_argument("--workers", type=int, default=1, help="processes at a time")
    parser.add_argument("--only", nargs="+", help="constants whose full name contains one of these")
    parser.add_argument("--report", type=Path, help="Markdown file to write at the end")
    parser.add_argument("--all", action="store_true", help="run what clearly moves again, too")
    parser.add_argument(
        "--group", type=int, default=1, help="vary so many at once; halve what moves something"
    )
    args = parser.parse_args(argv)
    cv2.setNumThreads(1)
    importlib.import_module("open3d")  # which each process would otherwise import by itself
    args.out.mkdir(parents=True, exist_ok=True)
    constants = find_constants()
    chosen = [c for c in constants if not args.only or any(text in c.key for text in args.only)]
    bases = [
        run_base(capture, args.out / f"base_{capture.name}_{way}", way, constants)
        for way in args.way
        for capture in args.captures
    ]
    bare = [
        Task(base=index, constants=(), factor=float(seed))
        for seed in range(NUM_NOISY + 1)
        for index in range(len(bases))
    ]
    run_forked(_undone(bare, bases, args.out), bases, args.out, args.workers)
    for index in range(len(bases)):
        for factor in FACTORS:
            told = told_of(bases[index], factor, read_results(args.out))
            todo = [c for c in chosen if bases[index].is_of_use(c) and c.key not in told]
            if not args.all:
                table = tabulate(args.out, constants)
                todo = [c for c in todo if not _is_settled(table[c.key])]
            groups = [tuple(todo[i : i + args.group]) for i in range(0, len(todo), args.group)]
            print(f"{bases[index].out.parent.name} x{factor:g}: {len(todo)} constants", flush=True)
            while groups:
                tasks = [Task(base=index, constants=g, factor=factor) for g in groups]
                run_forked(_undone(tasks, bases, args.out), bases, args.out, args.workers)
                groups = halves_of_moved(groups, read_results(args.out), bases[index], factor)
            write_report(args.out, constants, args.report or args.out / "constants.md")
    return 0


def halves_of_moved(
    groups: Sequence[tuple[Constant, ...]],
    results: Sequence[dict[str, Any]],
    base: Base,
    factor: float,
) -> list[tuple[Constant, ...]]:
    """Two halves of each group of several constants that together move something."""
    told = told_of(base, factor, results)
    halves = []
    for group in groups:
        if any(constant.key not in told for constant in group):
            middle = len(group) // 2
            halves += [group[:middle], group[middle:]]
    return halves


def told_of(base: Base, factor: float, results: Sequence[dict[str, Any]]) -> set[str]:
    """Constants whose effect on a base is known: run alone, or in a group that moves nothing."""
    at = (base.capture.name, base.way)
    lines = [line for line in results if (line["capture"], line["way"]) == at]
    noise = noise_of(lines).get(at, {})
    still = next((r for r in lines if r["constant"] == "noise" and r["factor"] == 0), None)
    told: set[str] = set()
    if still is None:
        return told
    for line in lines:
        keys = line["constant"].split("+")
        if line["constant"] == "noise" or line["factor"] != factor:
            continue
        moved, refused = effect_of(line, still, noise)
        if len(keys) == 1 or not (refused or moved.keys() - {SPEED}):
            told.update(keys)
    return told


def _is_settled(entry: dict[str, Any]) -> bool:
    """Whether a constant clearly moves something."""
    return any(limits > CLEAR_LIMITS for *_, limits in entry["moved"])


def _undone(tasks: Iterable[Task], bases: Sequence[Base], out: Path) -> list[Task]:
    """Tasks that have no line in the results yet."""
    done = {(r["capture"], r["way"], r["constant"], r["factor"]) for r in read_results(out)}
    return [task for task in tasks if tuple(task.label(bases).values()) not in done]


if __name__ == "__main__":
    raise SystemExit(main())
