"""Writing files in one step."""

from pathlib import Path

import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import alone_in, replace_file


def write(path: Path) -> None:
    path.write_text("new")


def test_a_file_is_replaced(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("old")
    replace_file(path, write)
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_written_is_named(tmp_path):
    with pytest.raises(InputError, match=r"nowhere/file\.txt: cannot be written: No such file or directory"):
        replace_file(tmp_path / "nowhere" / "file.txt", write)
    folder = tmp_path / "folder.txt"
    folder.mkdir()
    with pytest.raises(InputError, match=r"folder\.txt: cannot be written: .*directory"):
        replace_file(folder, write)
    assert list(tmp_path.iterdir()) == [folder]


def test_a_full_disk_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("old")

    def fail(temporary: Path) -> None:
        temporary.write_text("half")
        raise OSError(28, "No space left on device")

    with pytest.raises(InputError, match=r"file\.txt: cannot be written: No space left on device"):
        replace_file(path, fail)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def _fail(folder, error, written=""):
    with alone_in(folder):
        if written:
            (folder / written).touch()
        raise error


@pytest.mark.parametrize("error", [InputError, KeyboardInterrupt])
def test_work_that_fails_leaves_no_empty_folder(tmp_path, error):
    for written in ("", "kept.txt"):
        with pytest.raises(error):
            _fail(tmp_path / "new" / "out", error, written)
        assert (tmp_path / "new").exists() == bool(written)
    with pytest.raises(error):
        _fail(tmp_path, error)
    assert tmp_path.exists()
