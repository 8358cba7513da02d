"""The report: one self-contained HTML file, made from a finished run."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from polmvs._version import __version__
from polmvs.errors import printable
from polmvs.report import pictures
from polmvs.report.glossary import meaning
from polmvs.report.layers import Scene3D


@dataclass(frozen=True, kw_only=True)
class PagePicture:
    """One picture of a view.

    Attributes
    ----------
    title : under the thumbnail.
    alt : alternative text.
    uri : the encoded picture.
    scale : lowest, highest and colour map of the legend; None without one.
    """

    title: str
    alt: str
    uri: str
    scale: tuple[str, str, str] | None = None


@dataclass(frozen=True, kw_only=True)
class ViewPage:
    """All pictures of a view.

    Attributes
    ----------
    name : of the view.
    pictures : in reading order.
    wipe : two pictures that a slider wipes between, the first model's and the second's.
    """

    name: str
    pictures: tuple[PagePicture, ...]
    wipe: tuple[PagePicture, PagePicture] | None


@dataclass(frozen=True, kw_only=True)
class Plot:
    """A plot of the page.

    Attributes
    ----------
    svg : its text.
    caption : its content, in a sentence.
    wide : whether it has the whole width.
    """

    svg: str
    caption: str
    wide: bool = False


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table: the first cell of each row is its name."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, kw_only=True)
class DeviationSection:
    """Comparison of the part with its reference.

    Attributes
    ----------
    sentence : the result.
    passed : whether it is within the tolerance; None without one.
    table : statistics.
    picture : encoded picture of the coloured cloud.
    histogram : SVG text.
    """

    sentence: str
    passed: bool | None
    table: Table
    picture: str
    histogram: str


@dataclass(frozen=True, kw_only=True)
class Page:
    """Content of the page.

    Attributes
    ----------
    title : of the page.
    sentence : the result, in one or two sentences.
    facts : names and values of the main numbers.
    warnings : of the run, each with its remedy.
    tables : of the models' metrics, if there are any: the main ones, and all.
    trust : the quality checks with their ranges.
    deviation : comparison with a reference, if there is one.
    views, plots : in order.
    scene : of the 3D view; None if no cloud has a point.
    thinned : number of points to which clouds on the page are thinned; 0 if none is.
    stages : name, seconds and peak memory of each stage.
    record : options, versions and command line, as JSON.
    """

    title: str
    sentence: str
    facts: Sequence[tuple[str, str]]
    warnings: Sequence[str]
    tables: Sequence[Table]
    trust: Table | None
    deviation: DeviationSection | None
    views: Sequence[ViewPage]
    plots: Sequence[Plot]
    scene: Scene3D | None
    thinned: int
    stages: Sequence[tuple[str, str, str]]
    record: Mapping[str, Any]


def page_text(page: Page) -> str:
    """The page as self-contained HTML.

    Every text is escaped; file names and warnings may hold anything.
    """
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, finalize=_without_controls
    )
    template = environment.from_string(_asset("page.html.j2"))
    return template.render(
        vars(page)
        | {
            "meaning": meaning,
            "version": __version__,
            "css": _asset("page.css"),
            "js": _asset("page.js"),
            "viewer": _asset("viewer/viewer.min.js"),
            "wheel": pictures.data_uri(pictures.angle_wheel()),
            "gradients": {
                name: f"linear-gradient(90deg,{','.join(pictures.hex_palette(name, 9))})"
                for name in (pictures.SEQUENTIAL, pictures.ERROR)
            },
            "record": json.dumps(page.record, indent=1),
        }
    )


def _without_controls(value: Any) -> Any:
    """A value for the page without control characters."""
    return printable(value, keep="\n\t") if type(value) is str else value


def _asset(name: str) -> str:
    return files("polmvs.report").joinpath(name).read_text(encoding="utf-8")
