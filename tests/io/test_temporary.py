"""What a clean-up may remove: names that this program gave, with its token, to what it makes."""

from pathlib import Path

import pytest

from polmvs.io import temporary
from polmvs.io.temporary import TOKEN, is_temporary, remove_temporary, temporary_path


@pytest.mark.parametrize("name", ["a.ply", "a folder", "long" * 20 + ".png", "line\nend.txt"])
def test_a_name_is_known_by_its_token_and_by_what_it_is_for(tmp_path: Path, name: str) -> None:
    path = temporary_path(tmp_path / name)
    assert path.parent == tmp_path
    assert path.suffix == Path(name).suffix
    assert len(path.name) < 100
    assert is_temporary(path, TOKEN, ["other", name])
    assert not is_temporary(path, TOKEN, ["other"])
    assert not is_temporary(path, TOKEN, [])
    other = "0" * 16 if TOKEN != "0" * 16 else "1" * 16
    assert not is_temporary(path, other, [name])
    assert not is_temporary(tmp_path / name, TOKEN, [name])


@pytest.mark.parametrize(
    "name",
    [
        "a.ply",
        ".polmvs-a.ply",
        ".polmvs-{token}-a.ply",
        ".polmvs-{token}-1-a.ply",
        "x.polmvs-{token}-1-2-a.ply",
        ".polmvs-{token}-1-12345678901-a.ply",
        ".polmvs-{token}-1-2-",
    ],
)
def test_names_that_look_alike_are_no_business_of_ours(tmp_path: Path, name: str) -> None:
    assert not is_temporary(tmp_path / name.format(token=TOKEN), TOKEN, ["a.ply", ""])


def test_names_differ_and_follow_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = temporary_path(tmp_path / "a"), temporary_path(tmp_path / "a")
    assert first != second
    monkeypatch.setattr(temporary, "TOKEN", "f" * 16)
    assert is_temporary(temporary_path(tmp_path / "a"), "f" * 16, ["a"])


def test_a_link_goes_and_what_it_names_stays(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "mine").write_text("mine")
    (tmp_path / "link").symlink_to(folder)
    for name in ("link", "no such file"):
        remove_temporary(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]
    assert (folder / "mine").read_text() == "mine"
    remove_temporary(folder)
    assert list(tmp_path.iterdir()) == []
