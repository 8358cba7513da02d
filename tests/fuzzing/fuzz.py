"""Damage files and read them: ``fuzz.py FOLDER SEED ROUNDS [KIND ...]``.

ROUNDS is a number of mutations of each kind, or minutes for all of them, as in ``3min``.

Prints each mutation before it is read, so that the last line names what crashed the interpreter,
and a traceback of each that ended neither well nor in a ``PolmvsError`` that names a file of it.
The exit status is 1 if there was one.
"""

import faulthandler
import logging
import random
import resource
import shutil
import signal
import sys
import time
import traceback
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from polmvs.colmap.cameras import quiet_colmap
from polmvs.errors import PolmvsError

MAX_SECONDS = 10
MAX_BYTES = 1 << 30  # that a reader may take
MAX_RESIDENT = 4 << 30  # of the whole process


def files_of(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def restore(source: Path, folder: Path) -> None:
    """Make the folder as it was."""
    shutil.rmtree(folder)
    shutil.copytree(source, folder)


def check(read, folder: Path) -> None:
    """Read; AssertionError, or whatever else came, where that did not end as it must."""
    # Of work; of waiting a multiple, since others may be at work on the machine.
    signal.setitimer(signal.ITIMER_PROF, MAX_SECONDS)
    signal.alarm(6 * MAX_SECONDS)
    try:
        read(folder)
    except PolmvsError as error:
        text = str(error)
        assert str(folder) in text, f"names no file: {text[:300]}"
        assert len(text) < 2000, f"is no line: {text[:300]}"
        text.encode()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)


def peak_bytes() -> int:
    """Largest resident memory of this process so far."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def fuzz(
    root: Path, seed: int, rounds: int, names: list[str], minutes: float = float("inf")
) -> int:
    """Number of mutations that did not end as they must."""
    end = time.monotonic() + 60 * minutes
    from fuzzing.mutations import mutated
    from fuzzing.readers import KINDS

    kinds = {name: kind for name, kind in KINDS.items() if not names or name in names}
    sources = {}
    for name, kind in kinds.items():
        source, folder = root / f"{name}.sound", root / name
        folder.mkdir(parents=True)
        kind.write(folder)
        shutil.copytree(folder, source)
        kind.read(folder)  # sound as it is
        restore(source, folder)
        sources[name] = source
    # Address space that is never touched costs nothing; what is touched is counted below.
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 16 * MAX_BYTES,) * 2)
    peak = peak_bytes()
    num_bad = 0
    for index in range(rounds):
        for name, kind in kinds.items():
            if time.monotonic() > end:
                return num_bad
            folder, source = root / name, sources[name]
            rng = random.Random(f"{seed} {index} {name}")
            path = rng.choice(files_of(folder))
            sound = path.read_bytes()
            path.write_bytes(mutated(rng, sound))
            print(f"{name}: {path.relative_to(folder)}, seed {seed}, round {index}", flush=True)
            before = set(files_of(folder))
            try:
                check(kind.read, folder)
            except BaseException:
                num_bad += 1
                traceback.print_exc()
                if "--keep" in sys.argv:
                    shutil.copytree(folder, root / f"bad-{num_bad}-{name}")
            if set(files_of(folder)) == before:
                path.write_bytes(sound)
            else:
                restore(source, folder)
            if peak_bytes() > min(peak + MAX_BYTES, MAX_RESIDENT):
                print(f"{name}: took {(peak_bytes() - peak) / 1e9:.1f} GB", file=sys.stderr)
                num_bad, peak = num_bad + 1, peak_bytes()
    return num_bad


if __name__ == "__main__":
    faulthandler.enable()
    logging.disable()
    warnings.simplefilter("ignore")
    place, seed_text, rounds_text, *given = sys.argv[1:]
    with quiet_colmap():
        limit, names = rounds_text.removesuffix("min"), [g for g in given if g != "--keep"]
        if limit == rounds_text:
            found = fuzz(Path(place), int(seed_text), int(rounds_text), names)
        else:
            found = fuzz(Path(place), int(seed_text), 1 << 30, names, float(limit))
    print(f"{peak_bytes() / 1e9:.1f} GB at most", file=sys.stderr)
    print(f"{found} bad", file=sys.stderr)
    sys.exit(found > 0)
