"""The report: one HTML file with everything in it, made from a finished run."""

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
    alt : for who cannot see it.
    uri : the coded picture.
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
    caption : what it shows, in a sentence.
    wide : whether it takes the whole width.
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
    """The part against its reference.

    Attributes
    ----------
    sentence : what came out.
    passed : whether it keeps to the tolerance; None without one.
    table : figures.
    picture : coded picture of the coloured cloud.
    histogram : SVG text.
    """

    sentence: str
    passed: bool | None
    table: Table
    picture: str
    histogram: str


@dataclass(frozen=True, kw_only=True)
class Page:
    """All that the page shows.

    Attributes
    ----------
    title : of the page.
    sentence : what came out, in one or two sentences.
    facts : name and value of what counts most.
    warnings : of the run, each with its remedy.
    tables : of the models' figures, if there are any: those to begin with, and all.
    trust : figures of the result about itself, with what is normal.
    deviation : the part against its reference; None where it was not compared.
    views, plots : in order.
    scene : of the 3D view; None where no cloud has a point.
    thinned : points above which the clouds on the page are thinned; 0 if none is.
    stages : name, seconds and peak memory of each stage.
    record : options, versions and command line, in terms of JSON.
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
    """The page as HTML that needs nothing beside itself.

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
    """What is put into the page; markup is the page's own."""
    return printable(value, keep="\n\t") if type(value) is str else value


def _asset(name: str) -> str:
    return files("polmvs.report").joinpath(name).read_text(encoding="utf-8")
