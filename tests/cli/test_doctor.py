"""``polmvs doctor`` on this machine, which can run the other tests."""

import json
import re
import sys
from importlib import metadata

import pytest

from polmvs.cli import doctor


def test_all_works(cli) -> None:
    status, out, err = cli("doctor")
    assert (status, err) == (0, ""), out
    assert out.splitlines()[-1] == "all works"
    for what in ("cores", "memory", "pycolmap", "open3d", "self-test: worker processes"):
        assert f"  {what} " in out
    assert metadata.version("pycolmap") in out


def test_json(cli, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also: what fails is marked, and the rest is tried all the same."""

    def broken(folder) -> str:
        raise OSError("no\nCOLMAP")

    monkeypatch.setattr(doctor, "_check_colmap", broken)
    status, out, _ = cli("doctor", "--json")
    content = json.loads(out)
    assert status == 1
    assert content["works"] is False
    [bad] = [finding for finding in content["findings"] if not finding["works"]]
    assert bad["what"] == "self-test: COLMAP model"
    assert bad["text"].startswith("fails (OSError: no COLMAP)")


def test_a_missing_package() -> None:
    finding = doctor.package("nosuchmodule", "nosuchpackage")
    assert not finding.works
    assert "pip install nosuchpackage" in finding.text


def test_without_what_checks_options(cli, monkeypatch: pytest.MonkeyPatch) -> None:
    """It says so itself, and does not fail by it."""
    monkeypatch.setitem(sys.modules, "msgspec", None)
    status, out, err = cli("doctor")
    assert (status, err) == (1, "")
    assert re.search(r"^! msgspec +fails \(ModuleNotFoundError", out, re.MULTILINE)
