"""Do the tests notice faults? Plants one at a time into a copy of the package and runs them.

A fault is one operator, comparison, number or condition changed. Only the tests that run its line
are run, the nearest and quickest first, until one fails. A fault that all of them pass is a
survivor, printed with its line. Survivors need a look: some change nothing that matters (a bound
that nothing reaches). Messages, annotations and `__all__` are left alone.

WORK keeps the copy, the lines that each test runs, by test file, and what became of each fault, so
that a call goes on where the last one ended and runs again what had survived.

Usage: python pipelines/mutation.py WORK --num 300 --seed 0 --folders poses io
"""

from __future__ import annotations

import argparse
import ast
import builtins
import compileall
import contextlib
import gc
import hashlib
import json
import os
import random
import re
import shutil
import signal
import sys
import threading
import time
import traceback
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("polarization", "normals", "poses", "io", "pipeline")

SWAPPED: dict[type[ast.AST], tuple[str, str]] = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.Lt: ("<", ">="),
    ast.LtE: ("<=", ">"),
    ast.Gt: (">", "<="),
    ast.GtE: (">=", "<"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
    ast.BitAnd: ("&", "|"),
    ast.BitOr: ("|", "&"),
}

# Imported once, before the forks that run the tests.
HEAVY = ("cv2", "scipy.optimize", "scipy.sparse.linalg", "scipy.spatial", "pycolmap")


@dataclass(frozen=True)
class Fault:
    """A change of a module's text.

    Attributes
    ----------
    path : of the module, from the repository's root.
    lines : first and last of the statement, from 1; of a compound one, of its head.
    line : of the change.
    start, end : of the characters that are replaced.
    text : what takes their place.
    in_function : whether the statement runs when a function is called, not at import.
    """

    path: Path
    lines: tuple[int, int]
    line: int
    start: int
    end: int
    text: str
    in_function: bool

    def planted(self, source: str) -> str:
        """The module with the fault."""
        return source[: self.start] + self.text + source[self.end :]

    def named(self, source: str) -> str:
        """Place, change and line, in words."""
        old = " ".join(source[self.start : self.end].split())
        line = source.splitlines()[self.line - 1].strip()
        column = self.start - source.rfind("\n", 0, self.start)
        return f"{self.path}:{self.line}:{column}: {old} -> {self.text}   in   {line}"


def faults_of(path: Path, source: str) -> Iterator[Fault]:
    """All faults of a module, in the order of its text."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def place(line: int, column: int) -> int:
        text = source[starts[line - 1] : starts[line]]
        return starts[line - 1] + len(text.encode()[:column].decode())

    def span(node: ast.expr) -> tuple[int, int]:
        end = place(node.end_lineno or node.lineno, node.end_col_offset or 0)
        return place(node.lineno, node.col_offset), end

    def between(
        left: ast.expr, right: ast.expr, operator: ast.AST
    ) -> Iterator[tuple[int, int, str]]:
        """The operator between two operands; it stands alone there, but for brackets."""
        old, new = SWAPPED.get(type(operator), ("", ""))
        start, end = span(left)[1], span(right)[0]
        at = source.find(old, start, end) if old else -1
        if at >= 0 and "#" not in source[start:end]:
            yield at, at + len(old), new

    def changes(node: ast.AST) -> Iterator[tuple[int, int, str]]:
        match node:
            case ast.BinOp(left, operator, right) if not _is_of_types(node):
                yield from between(left, right, operator)
            case ast.Compare(left, comparisons, others):
                for first, comparison, second in zip(
                    [left, *others], comparisons, others, strict=False
                ):
                    yield from between(first, second, comparison)
            case ast.BoolOp(operator, values):
                for first, second in pairwise(values):
                    yield from between(first, second, operator)
            case ast.If(test) | ast.IfExp(test):
                for text in ("False", "True"):
                    yield *span(test), text
            case ast.Constant(int() | float() as value) if not isinstance(value, bool):
                small = isinstance(value, int) and value <= 10
                changed = value + 1 if small else 2 * value + (isinstance(value, float) and 0.1)
                yield *span(node), repr(changed)
            case _:
                pass

    def walk(node: ast.AST, head: tuple[int, int], inside: bool) -> Iterator[Fault]:
        if isinstance(node, ast.stmt):
            body = getattr(node, "body", None)
            last = body[0].lineno - 1 if body else node.end_lineno
            head = (node.lineno, max(node.lineno, last or 0))
        for start, end, text in changes(node):
            line = source.count("\n", 0, start) + 1
            yield Fault(path, head, line, start, end, text, inside)
        for child in _that_act(node):
            within = inside
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
                # Defaults and decorators run at import.
                within = child in node.body if isinstance(node.body, list) else True
            yield from walk(child, head, within)

    yield from walk(ast.parse(source), (1, 1), False)


def _that_act(node: ast.AST) -> Iterator[ast.AST]:
    """Parts of a node but for those that only name types, explain or write messages."""
    match node:
        case ast.Raise() | ast.JoinedStr():
            return
        case ast.Expr(ast.Call(function)) if re.search(
            r"\b(warn|warning|info|debug|write_line|logger\w*)\b", ast.unparse(function)
        ):
            return
        case ast.Assign([ast.Name("__all__"), *_]):
            return
        case ast.If(ast.Name("TYPE_CHECKING")):
            return
        case _:
            pass
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "type_params"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.keyword) and child.arg in ("stacklevel", "indent", "help"):
                continue
            if isinstance(child, ast.AST):
                yield child


def _is_of_types(node: ast.BinOp) -> bool:
    """Whether ``X | None`` of an annotation, which does nothing when the program runs."""
    if not isinstance(node.op, ast.BitOr):
        return False
    sides = (node.left, node.right)
    return any(
        (isinstance(side, ast.Constant) and side.value is None)
        or (isinstance(side, ast.Name) and (side.id[0].isupper() or side.id in dir(builtins)))
        or isinstance(side, ast.Subscript)
        for side in sides
    )


class LineMap:
    """Plugin of pytest: which lines each test runs, its fixtures' included, if it passes."""

    def __init__(self, package: Path) -> None:
        self.package = f"{package}{os.sep}"
        self.tests: dict[str, tuple[float, set[tuple[str, int]]]] = {}
        self._of_fixtures: dict[Any, set[tuple[str, int]]] = {}
        self._seen: set[tuple[str, int]] = set()
        self._failed: set[str] = set()
        self._ours: dict[CodeType, bool] = {}

    def _trace(self, frame: FrameType, event: str, argument: Any) -> Any:
        code = frame.f_code
        ours = self._ours.get(code)
        if ours is None:
            ours = code.co_filename.startswith(self.package) and code.co_name != "<module>"
            self._ours[code] = ours
        return self._line if ours else None

    def _line(self, frame: FrameType, event: str, argument: Any) -> Any:
        if event == "line":
            self._seen.add((frame.f_code.co_filename, frame.f_lineno))
        return self._line


def _line_map_hooks() -> type[LineMap]:
    """The plugin with its hooks; pytest is imported only where tests run."""
    import pytest

    class Hooks(LineMap):
        @pytest.hookimpl(wrapper=True)
        def pytest_fixture_setup(self, fixturedef: Any) -> Any:
            outer, self._seen = self._seen, set()
            try:
                return (yield)
            finally:
                self._of_fixtures[fixturedef] = self._seen
                self._seen = outer

        @pytest.hookimpl(wrapper=True)
        def pytest_runtest_protocol(self, item: Any) -> Any:
            self._seen = set()
            begin = time.process_time()
            threading.settrace(self._trace)
            sys.settrace(self._trace)
            try:
                return (yield)
            finally:
                sys.settrace(None)
                threading.settrace(None)
                lines = set(self._seen)
                for definitions in item._fixtureinfo.name2fixturedefs.values():
                    for definition in definitions:
                        lines |= self._of_fixtures.get(definition, set())
                if item.nodeid not in self._failed:
                    self.tests[item.nodeid] = (time.process_time() - begin, lines)

        def pytest_runtest_logreport(self, report: Any) -> None:
            if report.failed:
                self._failed.add(report.nodeid)

    return Hooks


@dataclass
class Coverage:
    """Which tests run a line: their names, and seconds of each."""

    tests_of_line: dict[tuple[str, int], set[str]]
    seconds: dict[str, float]

    def tests(self, fault: Fault) -> list[str]:
        """Tests that run a fault's line: the quick ones and those of its folder first."""
        path = fault.path.as_posix()
        if fault.in_function:
            first, last = fault.lines
            lines = range(first, last + 1)
            found = set().union(*(self.tests_of_line.get((path, line), set()) for line in lines))
        else:
            paths = {path} | set(_importers(fault.path))
            found = set().union(
                *(tests for (path, _), tests in self.tests_of_line.items() if path in paths)
            )
        words = fault.path.stem.removesuffix("s")
        folder = f"tests/{fault.path.parts[1]}/"
        return sorted(
            found,
            key=lambda test: (
                self.seconds[test] > 2,
                words not in test.split("::")[0],
                not test.startswith(folder),
                self.seconds[test],
            ),
        )


def _importers(path: Path) -> Iterator[str]:
    """Modules that import one; its constants act in them."""
    name = path.with_suffix("").as_posix().replace("/", ".")
    package, _, module = name.rpartition(".")
    pattern = rf"from {re.escape(name)} import|from {re.escape(package)} import .*\b{module}\b"
    for other in (ROOT / "polmvs").rglob("*.py"):
        if re.search(pattern, other.read_text(encoding="utf-8")):
            yield other.relative_to(ROOT).as_posix()


class Copy:
    """A copy of the repository in which tests run, each time in a fork of this process."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "copy"
        self.temporary = folder / "tmp"
        self.log = folder / "log.txt"
        self.temporary.mkdir(parents=True, exist_ok=True)
        ignored = shutil.ignore_patterns("__pycache__")
        for part in ("polmvs", "tests", "pipelines", "data", "docs", "notebooks"):
            if (ROOT / part).exists():
                shutil.copytree(ROOT / part, self.folder / part, ignore=ignored, dirs_exist_ok=True)
        for part in ("pyproject.toml", "README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
            shutil.copy(ROOT / part, self.folder / part)
        compileall.compile_dir(self.folder / "polmvs", quiet=2)

    def run(self, arguments: Sequence[str], limit_s: float, plugins: Sequence[object] = ()) -> int:
        """Status of pytest in a fork; see :func:`forked`."""
        return forked(lambda: self._tested(arguments, plugins), limit_s, self.log)

    def planting(self, arguments: Sequence[str], planter: Planter) -> None:
        """The tests of a planter, collected in a fork."""
        forked(lambda: self._tested(arguments, [planter]), None, self.log)

    @contextlib.contextmanager
    def planted(self, fault: Fault) -> Iterator[None]:
        """The copy with a fault in it."""
        target = self.folder / fault.path
        source, stat = target.read_text(encoding="utf-8"), target.stat()
        target.write_text(fault.planted(source), encoding="utf-8")
        try:
            yield
        finally:
            target.write_text(source, encoding="utf-8")
            os.utime(target, ns=(stat.st_atime_ns, stat.st_mtime_ns))  # so what is compiled counts

    def _tested(self, arguments: Sequence[str], plugins: Sequence[object]) -> int:
        import pytest

        os.chdir(self.folder)
        os.environ["PYTHONPATH"] = str(self.folder)
        # The run that many tests look at is made once, by the sound package.
        os.environ["PYTEST_XDIST_WORKER"] = "gw0"
        if not any(isinstance(plugin, LineMap) for plugin in plugins):
            # A fault is in the package, and must not stay in what is compiled of it.
            os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
            sys.dont_write_bytecode = True
        sys.path[:] = [str(self.folder), *(p for p in sys.path if Path(p) != ROOT / "pipelines")]
        shown = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
        status = int(
            pytest.main(
                [*shown, f"--basetemp={self.temporary / 'now'}", *arguments], plugins=list(plugins)
            )
        )
        sys.stdout.flush()
        for plugin in plugins:
            if isinstance(plugin, LineMap):
                plugin_tests = [
                    [name, seconds, _by_file(self.folder, lines)]
                    for name, (seconds, lines) in plugin.tests.items()
                ]
                (self.temporary / "map.json").write_text(json.dumps(plugin_tests))
        return status


def forked(call: Callable[[], int], limit_s: float | None, log: Path | None = None) -> int:
    """Status of a call in a fork of this process, 1 if it does not come to its end.

    Parameters
    ----------
    limit_s : of processor time; of the clock ten times that, for the machine may be busy.
    log : takes what it prints.
    """
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.setsid()
            if limit_s is not None:
                import resource  # of POSIX, as forks are

                resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s) + 1, int(limit_s) + 6))
            if log is not None:
                output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
                os.dup2(output, 1)
                os.dup2(output, 2)
            status = call()
        except BaseException:
            traceback.print_exc()
            sys.stderr.flush()
        finally:
            os._exit(status)
    end = time.monotonic() + (10 * limit_s if limit_s is not None else float("inf"))
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done or time.monotonic() > end:
            break
        time.sleep(0.02)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # with what it started
    if not done:
        os.waitpid(child, 0)
        return 1
    return os.waitstatus_to_exitcode(status)


def _by_file(root: Path, lines: Iterable[tuple[str, int]]) -> dict[str, list[int]]:
    found: dict[str, list[int]] = defaultdict(list)
    for path, line in lines:
        found[Path(path).relative_to(root).as_posix()].append(line)
    return found


def coverage_of(copy: Copy, folder: Path, tests: Sequence[Path], limit_s: float) -> Coverage:
    """Lines of each test; a test file that has not changed since the last call is not run again."""
    folder.mkdir(parents=True, exist_ok=True)
    lines: dict[tuple[str, int], set[str]] = defaultdict(set)
    seconds: dict[str, float] = {}
    for path in tests:
        name = path.relative_to(ROOT).as_posix()
        digest = hashlib.sha256((copy.folder / name).read_bytes()).hexdigest()[:12]
        kept = folder / f"{name.replace('/', '.')}.{digest}.json"
        if not kept.exists():
            made = copy.temporary / "map.json"
            made.unlink(missing_ok=True)
            begin = time.monotonic()
            plugin = _line_map_hooks()(copy.folder / "polmvs")
            status = copy.run(["--maxfail=1000", name], limit_s, [plugin])
            print(f"{name}: {time.monotonic() - begin:.0f} s, status {status}", flush=True)
            kept.write_text(made.read_text() if made.exists() else "[]")
        for test, took, places in json.loads(kept.read_text()):
            seconds[test] = took
            for module, numbers in places.items():
                for number in numbers:
                    lines[module, number].add(test)
    return Coverage(lines, seconds)


@dataclass(frozen=True)
class Limits:
    """Of a fault's tests: seconds that they take without it, and how many times that with it."""

    tests_s: float
    slowdown: float = 5.0
    start_s: float = 30.0


def chosen_tests(fault: Fault, coverage: Coverage, limits: Limits) -> list[str]:
    """A fault's tests, as many as its time allows."""
    tests: list[str] = []
    spent = 0.0
    for test in coverage.tests(fault):
        spent += coverage.seconds[test]
        if spent > limits.tests_s and tests:
            break
        tests.append(test)
    return tests


def fate_of(copy: Copy, fault: Fault, tests: Sequence[str], time_s: float, limits: Limits) -> str:
    """``noticed`` with the first test that failed or hung, or ``survived``; by processes anew."""
    with copy.planted(fault):
        status = copy.run(tests, limits.start_s + limits.slowdown * time_s)
    # 2 to 4: the module cannot be imported any more; negative: the process crashed.
    return f"noticed {_last_failure(copy.log)}" if status else f"survived {len(tests)} tests"


class Planter:
    """Plugin of pytest: collects tests once; those of a fault run in a fork that has the fault.

    Parameters
    ----------
    copy : whose tests they are.
    work : faults, their tests, and the seconds that these take without a fault.
    limits : of a fault's tests.
    told : takes a fault and what became of it; nothing of those that need a new process.
    """

    def __init__(
        self,
        copy: Copy,
        work: Sequence[tuple[Fault, Sequence[str], float]],
        limits: Limits,
        told: Callable[[Fault, str], None],
    ) -> None:
        self.copy, self.work, self.limits, self.told = copy, work, limits, told
        self._failed = ""
        self._functions: dict[str, list[FunctionType]] = defaultdict(list)

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Remember the first test that failed."""
        if report.failed:
            self._failed = self._failed or report.nodeid

    def pytest_runtestloop(self, session: Any) -> bool:
        """Plant one fault after the other, in place of a run of all tests."""
        items = {item.nodeid: item for item in session.items}
        for one in gc.get_objects():
            if isinstance(one, FunctionType):
                self._functions[one.__code__.co_filename].append(one)
        for fault, names, time_s in self.work:
            tests = [items[name] for name in names if name in items]
            failed = self.copy.temporary / "failed.txt"
            failed.unlink(missing_ok=True)
            limit_s = self.limits.start_s + self.limits.slowdown * time_s
            with self.copy.planted(fault):
                status = forked(partial(self._run, fault, tests, failed), limit_s)
            if status == CANNOT:
                continue
            by = failed.read_text() if failed.exists() else "at its end"
            fate = f"noticed {by}" if status else f"survived {len(tests)} tests"
            self.told(fault, fate)
        return True

    def _run(self, fault: Fault, items: Sequence[Any], failed: Path) -> int:
        functions = self._functions[str(self.copy.folder / fault.path)]
        if not functions or not _changed(fault, functions):
            return CANNOT
        for item, after in zip(items, [*items[1:], None], strict=True):
            factory = item.config._tmp_path_factory
            factory._basetemp = None
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
            if self._failed:
                failed.write_text(self._failed)
                return 1
        return 0


CANNOT = 77  # status of a fork whose fault cannot be planted into what is imported


def _changed(fault: Fault, functions: Sequence[FunctionType]) -> bool:
    """Give a module's functions the code that they have with the fault, if they can take it."""
    source = (ROOT / fault.path).read_text(encoding="utf-8")
    old = _codes(compile(source, "", "exec"))
    new = _codes(compile(fault.planted(source), functions[0].__code__.co_filename, "exec"))
    for function in functions:
        code = function.__code__
        lines = [one.co_firstlineno for one in old.get(code.co_qualname, ())]
        if code.co_firstlineno not in lines:
            continue  # made by a decorator of another module
        changed = new[code.co_qualname][lines.index(code.co_firstlineno)]
        if changed.co_freevars != code.co_freevars:
            return False
        function.__code__ = changed
    return True


def _codes(code: CodeType) -> dict[str, list[CodeType]]:
    found = defaultdict(list, {code.co_qualname: [code]})
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            for name, codes in _codes(constant).items():
                found[name] += codes
    return found


def _last_failure(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return next((line for line in lines if line.startswith(("FAILED", "ERROR"))), "at its end")


def drawn(folders: Sequence[str], num: int, seed: int, skip: Sequence[str]) -> list[Fault]:
    """Faults, as many from each folder, in an order in which the folders take turns."""
    rows = []
    for index, folder in enumerate(folders):
        found = []
        for module in sorted((ROOT / "polmvs" / folder).rglob("*.py")):
            path = module.relative_to(ROOT)
            if path.relative_to("polmvs").as_posix() not in skip:
                found += list(faults_of(path, module.read_text(encoding="utf-8")))
        share = (num + len(folders) - 1 - index) // len(folders)
        chosen = random.Random(seed).sample(found, min(share, len(found)))
        print(f"{folder}: {len(chosen)} of {len(found):,} faults", flush=True)
        rows += [(number, index, fault) for number, fault in enumerate(chosen)]
    return [fault for _, _, fault in sorted(rows, key=lambda row: row[:2])]


def _test_files(place: Path) -> list[Path]:
    return [place] if place.is_file() else sorted(place.rglob("test_*.py"))


def main(argv: Sequence[str] | None = None) -> int:
    """Plant faults, and print what survived."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path, help="folder of the copy and of what is known so far")
    parser.add_argument("--num", type=int, default=300, help="faults, drawn at random")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folders", nargs="+", default=FOLDERS, help="of polmvs/")
    parser.add_argument(
        "--tests", nargs="+", help="folders and files of tests/; those of --folders if not given"
    )
    parser.add_argument("--skip", nargs="*", default=(), help="modules, such as normals/light.py")
    parser.add_argument("--limit", type=float, default=60.0, help="seconds of a fault's tests")
    parser.add_argument("--map-limit", type=float, default=900.0, help="seconds of a test file")
    parser.add_argument("--until", type=float, default=float("inf"), help="minutes for all")
    given = parser.parse_args(argv)
    begin = time.monotonic()
    work = given.work.resolve()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    for name in HEAVY:
        __import__(name)
    copy = Copy(work)
    tests = [
        path
        for folder in given.tests or given.folders
        for path in _test_files(ROOT / "tests" / folder)
    ]
    coverage = coverage_of(copy, work / "lines", tests, given.map_limit)
    kept = work / "fates.json"
    fates: dict[str, str] = json.loads(kept.read_text()) if kept.exists() else {}
    faults = drawn(given.folders, given.num, given.seed, given.skip)
    names = {fault: fault.named((ROOT / fault.path).read_text("utf-8")) for fault in faults}
    limits = Limits(given.limit)

    output = os.dup(1)  # forks write to their log

    def told(fault: Fault, fate: str) -> None:
        fates[names[fault]] = fate
        kept.write_text(json.dumps(fates, indent=1))
        if not fate.startswith("noticed"):
            os.write(output, f"{names[fault]}   {fate}\n".encode())
        if time.monotonic() - begin > 60 * given.until:
            raise TimeoutError

    # Tests may have been added since: what survived is planted again.
    fates = {name: fate for name, fate in fates.items() if fate.startswith("noticed")}
    kept.write_text(json.dumps(fates, indent=1))
    work = []
    for fault in faults:
        if names[fault] in fates:
            continue
        chosen = chosen_tests(fault, coverage, limits)
        work.append((fault, chosen, sum(coverage.seconds[test] for test in chosen)))
        if not chosen:
            told(fault, "no test")
    # Faults of functions are planted into what is imported, by a fork that collects the tests once.
    fast = [row for row in work if row[0].in_function and row[1]]
    with contextlib.suppress(TimeoutError):
        if fast:
            files = sorted({test.split("::")[0] for row in fast for test in row[1]})
            copy.planting(files, Planter(copy, fast, limits, told))
            fates.update(json.loads(kept.read_text()))
        for fault, chosen, time_s in work:
            if names[fault] not in fates:
                told(fault, fate_of(copy, fault, chosen, time_s, limits))
    for folder in given.folders:
        of_it = [
            fates[n] for n in names.values() if n.startswith(f"polmvs/{folder}/") and n in fates
        ]
        lost = sum(not fate.startswith("noticed") for fate in of_it)
        print(f"{folder}: {len(of_it)} faults planted, {lost} survived")
    print(f"{time.monotonic() - begin:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
