"""All pictures of the README and of the documentation, made by one script.

    python docs/pictures.py [NAME ...] [--work WORK] [--captures FOLDER]
    python docs/pictures.py --check

Without names all are made. What they show, runs and pages, is made in WORK and used again where it
is there. Some show captures with ground truth that are not part of the repository, each with
mosaics of 1224x1024 in FOLDER/NAME. ``images/made.json`` keeps a digest of each picture and the
words on it, so that ``--check``, which a test calls, tells those that this script did not make and
those that show words which are gone.

Needs the extras dev, docs and, for some, simulate; Chromium for the pages.
"""

from __future__ import annotations

import argparse
import html
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from shutil import which

import cv2

DOCS = Path(__file__).parent
ROOT = DOCS.parent
IMAGES = DOCS / "images"
MADE = "made.json"
INTRINSICS = "445,445,307.53,262.144"  # of the captures' polarization images
PAGE_PX = (1100, 1400)
SITE_PX = (1280, 800)
# What a page is known by: its headings, the names of its figures and of what can be chosen.
# WebGL in software, where there is no graphics card.
FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
WORDS = "h1, h2, h3, th, dt, summary, label, button, .sidebar-tree a"


class UnavailableError(Exception):
    """What a picture needs is not there; the message says what."""


@dataclass(frozen=True)
class Sources:
    """What pictures are made from; all is made once and kept.

    Attributes
    ----------
    work : folder of runs and pages.
    captures : folder of the captures that are not part of the repository; None: there are none.
    """

    work: Path
    captures: Path | None

    def demo(self) -> Path:
        """The run of ``polmvs demo`` and its report."""
        out = self.work / "demo"
        if not (out / "report.html").is_file():
            polmvs("demo", out, "--overwrite")
        return out

    def site(self) -> Path:
        """The built documentation."""
        out = self.work / "site"
        call(sys.executable, "-m", "sphinx", "-W", "-n", "-q", DOCS, out)
        return out

    def capture(self, name: str) -> Path:
        """A capture that is not part of the repository."""
        if self.captures is None or not (self.captures / name).is_dir():
            raise UnavailableError(f"needs the capture {name!r} in --captures FOLDER")
        return self.captures / name

    def run(self, name: str) -> Path:
        """Its reconstruction under PPA."""
        capture, out = self.capture(name), self.work / name
        if not (out / "ppa.ply").is_file():
            flags = ("--intrinsics", INTRINSICS, "--no-report", "--overwrite")
            polmvs("reconstruct", capture, out, *flags)
        return out


# A picture is written to a path; what is given back are the words on it.
Make = Callable[[Sources, Path], Sequence[str]]


def report(sources: Sources, path: Path) -> Sequence[str]:
    """The top of the demo's report."""
    return screenshot(sources.demo() / "report.html", path, PAGE_PX, "#view3d[data-ready=true]")


def site(sources: Sources, path: Path) -> Sequence[str]:
    """A page of the documentation."""
    return screenshot(sources.site() / "how_it_works.html", path, SITE_PX, "h1")


def sheet(sources: Sources, path: Path) -> Sequence[str]:
    """The sheet of the bundled capture, half as large."""
    with tempfile.TemporaryDirectory() as folder:  # the sheet names the capture as it is called
        (Path(folder) / "capture").symlink_to(ROOT / "polmvs" / "demo_capture" / "raw")
        polmvs("inspect", "capture", "--sheet", path.absolute(), place=Path(folder))
    whole = cv2.imread(str(path))
    cv2.imwrite(str(path), cv2.resize(whole, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    return ()


def opa_ppa(sources: Sources, path: Path) -> Sequence[str]:
    """The bundled board under OPA and PPA."""
    clouds = [sources.demo() / f"{model}.ply" for model in ("opa", "ppa")]
    polmvs("render", path, *clouds, "--labels", "OPA,PPA", "--plain", "--part", "--overwrite")
    return ()


def surface(sources: Sources, path: Path) -> Sequence[str]:
    """Two captures, from above and from below."""
    clouds = [sources.run(name) / "ppa.ply" for name in ("mug", "step")]
    polmvs("render", path, *clouds, "--plain", "--part", "--elevations", "30,-25", "--overwrite")
    return ()


def levels(sources: Sources, path: Path) -> Sequence[str]:
    """From the hull of the silhouettes to the surface."""
    views = sources.run("mug") / "views_ppa"
    made = sorted(views.glob("surface_*.ply"))
    meshes = [made[0], made[1], made[-1], views / "surface.ply"]
    labels = "hull,first level,last level,supported"
    flags = ("--plain", "--elevations", 35, "--size", "400,300", "--overwrite")
    polmvs("render", path, *meshes, "--labels", labels, *flags)
    return ()


def of_mug(name: str) -> Make:
    """One of the README's pictures."""

    def make(sources: Sources, path: Path) -> Sequence[str]:
        import hero

        from polmvs.pipeline.run_folder import RunFolder

        getattr(hero, name)(sources.capture("mug"), RunFolder(sources.run("mug")), path)
        return ()

    return make


def drawn(name: str) -> Make:
    """One of the drawings."""

    def make(sources: Sources, path: Path) -> Sequence[str]:
        import figures

        figures.FIGURES[name](path)
        return ()

    return make


def calibration(sources: Sources, path: Path) -> Sequence[str]:
    """What a calibration of the polarizers takes away."""
    call(sys.executable, ROOT / "pipelines" / "calibration.py", path)
    return ()


def gallery(light: str) -> Make:
    """Materials under one light."""

    def make(sources: Sources, path: Path) -> Sequence[str]:
        script = ROOT / "pipelines" / "simulated_gallery.py"
        with tempfile.TemporaryDirectory() as folder:
            call(sys.executable, script, sources.work / "gallery", folder, "--lights", light)
            path.write_bytes((Path(folder) / f"simulated_{light}.jpg").read_bytes())
        return ()

    return make


def growth(sources: Sources, path: Path) -> Sequence[str]:
    """Time and memory by the number of views; its page, one of the records, is written with it."""
    script, work = ROOT / "pipelines" / "benchmark.py", sources.work / "growth"
    numbers = ("--views", "25,50,100", "--num-workers", "1,2,4")
    with tempfile.TemporaryDirectory() as folder:
        call(sys.executable, script, "--growth", work, *numbers, "--write", folder)
        path.write_bytes((Path(folder) / "images" / path.name).read_bytes())
        page = (Path(folder) / "growth.md").read_text(encoding="utf-8")
    text = page.replace("](images/", "](../images/")
    (DOCS / "records" / "growth.md").write_text(text, encoding="utf-8")
    return ()


def pictures() -> Mapping[str, Make]:
    """All pictures by the name of their file."""
    import figures

    return {
        "report.png": report,
        "sheet.png": sheet,
        "opa_ppa.png": opa_ppa,
        "site.png": site,
        "hero.png": of_mug("hero"),
        "phases.png": of_mug("phases"),
        "levels.png": levels,
        "surface.png": surface,
        "calibration.png": calibration,
        **{f"simulated_{light}.jpg": gallery(light) for light in LIGHTS},
        "growth.png": growth,
        **{name: drawn(name) for name in figures.FIGURES},
    }


LIGHTS = ("studio", "overcast", "even", "softbox", "ring")


def faults(folder: Path = IMAGES, shown: Mapping[str, str] | None = None) -> list[str]:
    """A sentence for each picture that is not as this script made it, or is out of date.

    Parameters
    ----------
    shown : text in which the words on a picture must stand, by its name; others' are not compared.
    """
    made = read_made(folder)
    found = []
    there = {path.name for path in folder.iterdir()} - {MADE}
    for name in sorted(there | set(made) | set(pictures())):
        if name not in pictures():
            found.append(f"{name}: no function of docs/pictures.py makes it.")
        elif name not in there or name not in made:
            found.append(f"{name}: is not made.")
        elif digest(folder / name) != made[name]["digest"]:
            found.append(f"{name}: is not what docs/pictures.py made.")
        else:
            text = (shown or {}).get(name)
            gone = [] if text is None else [w for w in made[name]["words"] if w not in text]
            if gone:
                found.append(f"{name}: shows what is gone: {', '.join(map(repr, gone))}.")
    return [f"{text} Make it by: python docs/pictures.py {text.split(':')[0]}" for text in found]


def words_of_site() -> str:
    """All that its pages say."""
    others = [ROOT / name for name in ("CHANGELOG.md", "CONTRIBUTING.md", "data/README.md")]
    found = [*DOCS.glob("*.md"), *others, *(ROOT / "notebooks").glob("*.ipynb")]
    return plain(" ".join(path.read_text(encoding="utf-8") for path in sorted(found)))


def words_of_page(page: Path) -> str:
    """All that a page may show, in its markup or by its script."""
    return plain(html.unescape(page.read_text(encoding="utf-8")))


def plain(text: str) -> str:
    """Words alone: figures differ from run to run."""
    return " ".join(re.sub(r"[^\w%-]|\d", " ", text).split())


def screenshot(page: Path, path: Path, size: tuple[int, int], ready: str) -> list[str]:
    """Picture of the top of a page; its words."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium(), args=list(FLAGS))
        width, height = size
        tab = browser.new_page(viewport={"width": width, "height": height}, color_scheme="light")
        tab.goto(page.absolute().as_uri())
        tab.wait_for_selector(ready, timeout=120_000)
        tab.wait_for_timeout(500)
        tab.screenshot(path=path)
        texts = tab.eval_on_selector_all(
            WORDS,
            """(all, height) => all.filter((e) => {
              const box = e.getBoundingClientRect();
              return box.height > 0 && box.top >= 0 && box.bottom <= height;
            }).map((e) => e.innerText)""",
            height,
        )
        browser.close()
    lines = (line for text in texts for line in text.splitlines())
    # Single letters are those of formulas, whose source has other characters.
    return list(dict.fromkeys(words for line in lines if len(words := plain(line)) > 1))


def chromium() -> str | None:
    """The system's browser; None: Playwright's own."""
    return which("chromium") or which("chromium-browser") or which("google-chrome")


def polmvs(*words: object, place: Path = ROOT) -> None:
    """Run a command of the program in a folder."""
    call(sys.executable, "-m", "polmvs", *words, place=place)


def call(*words: object, place: Path = ROOT) -> None:
    """Run a command in a folder; its failure is this script's."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([str(word) for word in words], cwd=place, env=environment, check=True)


def digest(path: Path) -> str:
    """What tells one file from another."""
    return blake2b(path.read_bytes(), digest_size=8).hexdigest()


def read_made(folder: Path) -> dict[str, dict[str, object]]:
    """Digest and words of each picture."""
    path = folder / MADE
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def make(names: Sequence[str], sources: Sources, folder: Path = IMAGES) -> list[str]:
    """Make pictures; sentences on those that could not be."""
    left = []
    for name in names or pictures():
        if name not in pictures():
            raise SystemExit(f"{name}: no such picture; there are {', '.join(pictures())}")
        path = folder / name
        try:
            words = pictures()[name](sources, path)
        except UnavailableError as error:
            left.append(f"{name}: {error}")
            continue
        made = {**read_made(folder), name: {"digest": digest(path), "words": list(words)}}
        text = json.dumps(dict(sorted(made.items())), indent=1, ensure_ascii=False)
        (folder / MADE).write_text(text + "\n", encoding="utf-8")
        print(path)
    return left


def main() -> int:
    """Make pictures, or check them."""
    parser = argparse.ArgumentParser(description="Make the pictures of the documentation.")
    parser.add_argument("names", nargs="*", help="of pictures; all by default")
    parser.add_argument("--work", type=Path, default=ROOT / "pictures", help="runs and pages")
    parser.add_argument("--captures", type=Path, help="folder of the captures mug and step")
    parser.add_argument("--check", action="store_true", help="name those that are out of date")
    given = parser.parse_args()
    if given.check:
        found = faults(shown={"site.png": words_of_site()})
        print("\n".join(found) or "all pictures are as they were made")
        return 1 if found else 0
    given.work.mkdir(parents=True, exist_ok=True)
    left = make(given.names, Sources(given.work, given.captures))
    print("\n".join(left), file=sys.stderr, end="\n" * bool(left))
    return 1 if left else 0


if __name__ == "__main__":
    raise SystemExit(main())
