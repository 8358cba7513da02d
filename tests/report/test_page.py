"""The page's text from what it shows."""

import pytest

from polmvs.evaluation.trust import Trust
from polmvs.pipeline.record import Record
from polmvs.report import report
from polmvs.report.page import Page, Table, page_text

FIGURES = Table(header=["", "OPA"], rows=[["a & b", "1"]])
TRUST = Table(header=["PPA", "value", "normal", ""], rows=[["agreement", "50", "80 to 100", "<x>"]])


def page(**changes) -> str:
    empty = {"facts": [], "warnings": (), "tables": (), "trust": None, "views": [], "plots": []}
    empty |= {"deviation": None, "scene": None, "thinned": 0, "stages": [], "record": {}}
    return page_text(Page(title="title", sentence="sentence", **(empty | changes)))


def test_all_figures_are_folded_below_the_first() -> None:
    text = page(tables=(FIGURES, FIGURES))
    assert text.count("a &amp; b") == 2
    assert text.index("<summary>All figures") > text.index("a &amp; b")
    assert text.count("<table>") == text.count("</table>") == 3  # with that of the stages


@pytest.mark.parametrize(("tables", "opened"), [((), True), ((FIGURES, FIGURES), False)])
def test_trust_is_open_where_nothing_else_tells(tables, opened: bool) -> None:
    text = page(tables=tables, trust=TRUST)
    assert ('<details class="all trust" open>' in text) is opened
    assert "check" not in text
    assert "&lt;x&gt;" in text


def test_trust_names_what_to_check(monkeypatch) -> None:
    found = Trust(
        residual_deg=0.5,
        residual_sigmas=0.5,
        agreement=0.5,
        inside=1.0,
        determined=1.0,
        sigma_share=1e-4,
    )
    monkeypatch.setattr(Record, "find", lambda self, kind, model: found)
    given = type("Given", (), {"main": report.MAIN[0], "record": Record()})
    table = report.trust_table(given)
    odd = [row for row in table.rows if row[3]]
    assert [row[0] for row in odd] == ["views that agree with a point they see, %"]
    assert odd[0][1:] == ["50.00", "80 to 100", "check poses: sfm.intrinsics, sfm.sparse"]


def test_names_are_shown_without_what_a_terminal_acts_on() -> None:
    text = page(warnings=("view a\x1b[31m\u202eb: is <dark>",))
    assert r"view a\x1b[31m\u202eb: is &lt;dark&gt;" in text
    assert "\x1b" not in text
    assert "\u202e" not in text
