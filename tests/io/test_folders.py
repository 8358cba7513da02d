"""Folders appear whole or not at all, and what they replace stays until they do."""

from pathlib import Path

import pytest

from polmvs.errors import DataError
from polmvs.io.folders import new_folder


def names(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_a_folder_takes_its_name_at_the_end(tmp_path):
    target = tmp_path / "a" / "b"
    with new_folder(target) as root:
        (root / "x").write_text("1")
        assert not target.exists()
    assert names(tmp_path) == ["a", "a/b", "a/b/x"]
    assert (target.stat().st_mode & 0o777) == ((tmp_path / "a").stat().st_mode & 0o777)


def test_only_an_empty_folder_is_taken_without_a_word(tmp_path):
    (tmp_path / "empty").mkdir()
    with new_folder(tmp_path / "empty") as root:
        (root / "x").touch()
    with pytest.raises(DataError, match="exists already"), new_folder(tmp_path / "empty"):
        pass
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="exists already"), new_folder(tmp_path / "file"):
        pass
    assert names(tmp_path) == ["empty", "empty/x", "file"]


def test_an_old_folder_is_replaced_whole(tmp_path):
    target = tmp_path / "old"
    target.mkdir()
    (target / "kept").touch()
    with pytest.raises(KeyError), new_folder(target, overwrite=True):
        raise KeyError
    assert names(tmp_path) == ["old", "old/kept"]
    with new_folder(target, overwrite=True) as root:
        (root / "new").touch()
    assert names(tmp_path) == ["old", "old/new"]


def test_what_cannot_be_put_in_its_place_leaves_the_old_one(tmp_path, monkeypatch):
    target, rename = tmp_path / "old", Path.rename
    target.mkdir()
    (target / "kept").touch()

    def refuse(self, other):
        if self.name == "content":
            raise OSError(28, "No space left on device")
        return rename(self, other)

    monkeypatch.setattr(Path, "rename", refuse)
    with (
        pytest.raises(DataError, match="cannot be written: No space"),
        new_folder(target, overwrite=True) as root,
    ):
        (root / "new").touch()
    assert names(tmp_path) == ["old", "old/kept"]
