"""Do the tests notice faults? Plants one at a time into a copy of the package and runs them.

A fault is one operator, comparison, number or condition changed. A module's own tests run first,
then those of its folder; what all of them pass is a survivor, printed with its line. Survivors need
a look: some change nothing that matters (a bound that nothing reaches, a text's number).

Usage: python pipelines/mutation.py --num 300 --seed 0 --folders poses io
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

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


@dataclass(frozen=True)
class Fault:
    """A change of a module's text.

    Attributes
    ----------
    path : of the module, from the repository's root.
    line : its number, from 1.
    start, end : of the characters that are replaced.
    text : what takes their place.
    """

    path: Path
    line: int
    start: int
    end: int
    text: str

    def planted(self, source: str) -> str:
        """The module with the fault."""
        return source[: self.start] + self.text + source[self.end :]


def faults_of(path: Path, source: str) -> Iterator[Fault]:
    """All faults of a module, in no order that matters."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def place(line: int, column: int) -> int:
        text = source[starts[line - 1] : starts[line]]
        return starts[line - 1] + len(text.encode()[:column].decode())

    def between(left: ast.expr, right: ast.expr, operator: ast.AST) -> Iterator[Fault]:
        """The operator between two operands; it stands alone there, but for brackets."""
        old, new = SWAPPED.get(type(operator), ("", ""))
        start = place(left.end_lineno or left.lineno, left.end_col_offset or 0)
        end = place(right.lineno, right.col_offset)
        at = source.find(old, start, end) if old else -1
        if at >= 0 and "#" not in source[start:end]:
            yield Fault(path, left.end_lineno or left.lineno, at, at + len(old), new)

    for node in ast.walk(ast.parse(source)):
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
                start = place(test.lineno, test.col_offset)
                end = place(test.end_lineno or 0, test.end_col_offset or 0)
                for text in ("False", "True"):
                    yield Fault(path, test.lineno, start, end, text)
            case ast.Constant(int() | float() as value) if not isinstance(value, bool):
                start = place(node.lineno, node.col_offset)
                end = place(node.end_lineno or 0, node.end_col_offset or 0)
                changed = value + 1 if isinstance(value, int) else 2 * value + 0.1
                yield Fault(path, node.lineno, start, end, repr(changed))
            case _:
                pass


def _is_of_types(node: ast.BinOp) -> bool:
    """Whether ``X | None`` of an annotation, which does nothing when the program runs."""
    if not isinstance(node.op, ast.BitOr):
        return False
    sides = (node.left, node.right)
    return any(
        (isinstance(side, ast.Constant) and side.value is None)
        or (isinstance(side, ast.Name) and (side.id[0].isupper() or side.id in dir(__builtins__)))
        or isinstance(side, ast.Subscript)
        for side in sides
    )


def tests_of(path: Path, copy: Path) -> list[list[str]]:
    """Tests that are run one after the other: those of the module's name, then of its folder."""
    folder = copy / "tests" / path.parts[1]
    words = path.stem.removesuffix("s")
    own = sorted(str(file) for file in folder.glob("test_*.py") if words in file.stem)
    return [own, [str(folder)]] if own else [[str(folder)]]


def is_noticed(copy: Path, fault: Fault, limit_s: float) -> bool:
    """Whether a test fails with the fault, or none comes to its end."""
    target = copy / fault.path
    source = target.read_text(encoding="utf-8")
    target.write_text(fault.planted(source), encoding="utf-8")
    try:
        for tests in tests_of(fault.path, copy):
            command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
            try:
                done = subprocess.run(
                    [*command, *tests],
                    cwd=copy,
                    env=_environment(copy),
                    capture_output=True,
                    timeout=limit_s,
                    check=False,
                )
            except subprocess.TimeoutExpired:
                return True
            if done.returncode not in (0, 5):  # 5: no test has such a name
                # 2 to 4: the module cannot be imported any more.
                return True
        return False
    finally:
        target.write_text(source, encoding="utf-8")


def _environment(copy: Path) -> dict[str, str]:

    return {
        **os.environ,
        "PYTHONPATH": str(copy),
        "OMP_NUM_THREADS": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Plant faults, and print what survived."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--num", type=int, default=300, help="faults, drawn at random")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folders", nargs="+", default=FOLDERS, help="of polmvs/")
    parser.add_argument("--skip", nargs="*", default=(), help="modules, such as normals/light.py")
    parser.add_argument("--limit", type=float, default=300.0, help="seconds of a run of tests")
    parser.add_argument("--until", type=float, default=float("inf"), help="minutes for all")
    given = parser.parse_args(argv)
    found: list[Fault] = []
    for folder in given.folders:
        for module in sorted((ROOT / "polmvs" / folder).rglob("*.py")):
            path = module.relative_to(ROOT)
            if path.relative_to("polmvs").as_posix() not in given.skip:
                found += faults_of(path, module.read_text(encoding="utf-8"))
    chosen = random.Random(given.seed).sample(found, min(given.num, len(found)))
    print(f"{len(chosen)} of {len(found):,} faults", flush=True)
    begin, num, survivors = time.monotonic(), 0, 0
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name)
        for part in ("polmvs", "tests", "pipelines", "data", "docs", "notebooks"):
            if (ROOT / part).exists():
                ignored = shutil.ignore_patterns("__pycache__")
                shutil.copytree(ROOT / part, copy / part, ignore=ignored)
        for part in ("pyproject.toml", "README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
            shutil.copy(ROOT / part, copy / part)
        for fault in chosen:
            if time.monotonic() - begin > 60 * given.until:
                break
            num += 1
            source = (ROOT / fault.path).read_text(encoding="utf-8")
            if not is_noticed(copy, fault, given.limit):
                survivors += 1
                line = source.splitlines()[fault.line - 1].strip()
                old = " ".join(source[fault.start : fault.end].split())
                print(f"{fault.path}:{fault.line}: {old} -> {fault.text}   in   {line}", flush=True)
    seconds = time.monotonic() - begin
    print(f"{num} faults planted, {survivors} survived ({seconds:.0f} s)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
