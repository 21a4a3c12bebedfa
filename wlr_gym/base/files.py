"""Write files so that a reader never sees half of one; what cannot be written, or would be written over, is refused by name."""

from __future__ import annotations

import json
import os
import platform
import shlex
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError

#: File of a folder for results by which one process holds it.
LOCK = ".lock"
#: Folders that this process holds, and the threads that do.
_HELD: dict[Path, int] = {}


def make_output_folder(path: Path, option: str = "--out") -> None:
    """Make a folder for results, if it is not there."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        why = "it is a file" if path.is_file() else error.strerror
        raise InputError(f"{option} {path}: cannot be a folder: {why}") from None
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"{option} {path}: cannot be written to")


def require_output_place(path: Path) -> None:
    """Refuse, before the work, a place where no folder for results can be made; nothing is."""
    nearest = next(parent for parent in (path, *path.absolute().parents) if parent.exists())
    if not nearest.is_dir():
        raise InputError(f"--out {path}: {nearest} is a file; expected a folder")
    try:
        with tempfile.TemporaryDirectory(dir=nearest):  # rights alone do not tell: /proc has them
            pass
    except OSError as error:
        raise InputError(f"--out {path}: cannot be written to: {error.strerror}") from None


@contextmanager
def alone_in(folder: Path | None, patience: float = 0.0) -> Iterator[None]:
    """Make a folder for results, if it is not there, and hold it; None = there is none. See :func:`locked`.

    Work that fails or is interrupted in here leaves no empty folder. What holds it already may hold it again.

    Raises:
        InputError: it cannot be made or written to, or another process, or another thread, works in it.
    """
    if folder is None or _HELD.get(folder.resolve()) == threading.get_ident():
        yield
        return
    path = folder.resolve()
    if path in _HELD:
        raise InputError(f"--out {folder}: another thread of this program works in it; choose another folder")
    made = [one for one in (folder, *folder.parents) if not one.exists()]
    make_output_folder(folder)
    try:
        with locked(folder / LOCK, patience, stays=False):
            _HELD[path] = threading.get_ident()
            try:
                yield
            finally:
                del _HELD[path]
    except BaseException:
        for one in made:
            with suppress(OSError):  # not empty
                one.rmdir()
        raise


def contents(folder: Path) -> list[Path]:
    """Return what is in a folder, in order, without the file by which a process holds it; nothing where there is none."""
    return sorted(path for path in folder.iterdir() if path.name != LOCK) if folder.is_dir() else []


def refuse_existing(path: Path, force: bool, option: str = "--out") -> None:
    """Refuse to write over a file or folder, unless ``--force`` is given."""
    if path.exists() and not force:
        raise InputError(f"{option} {path}: exists; choose another name, or replace it with --force")


def require_empty(folder: Path, resume: str) -> None:
    """Refuse a folder that something is in; ``resume`` is the command that goes on with it, empty = none does."""
    if folder.is_file():
        raise InputError(f"{folder}: cannot be a folder: it is a file")
    if contents(folder):
        hint = f", or resume what is there: {resume} --resume {shlex.quote(str(folder))}" if resume else ""
        raise InputError(f"{folder}: not empty; give another folder{hint}")


def require_ending(path: Path, endings: Iterable[str], option: str = "--out", *, any_case: bool = False) -> None:
    """Refuse a file of another kind.

    Args:
        path: of the file. endings: lower case.
        option: what gave it.
        any_case: capitals will do, too: nothing reads it by its ending.
    """
    if (path.suffix.lower() if any_case else path.suffix) not in endings:
        raise InputError(f"{option} {path}: expected a file that ends in {', '.join(endings)}")


def check_new_file(
    path: Path, force: bool, option: str = "--out", endings: Iterable[str] = (), *, any_case: bool = False
) -> None:
    """Refuse, before the work, a file that cannot be the result: see :func:`require_ending` and :func:`refuse_existing`."""
    if endings:
        require_ending(path, endings, option, any_case=any_case)
    refuse_existing(path, force, option)
    if not path.parent.is_dir():
        raise InputError(f"{option} {path}: folder {path.parent} does not exist")


def resumes(folder: Path, file: str) -> bool:
    """Whether work in a folder for results resumes from its ``file``; otherwise the folder is new or empty, and is made."""
    if (folder / file).is_file():
        return True
    if folder.is_file() or contents(folder):
        raise InputError(f"--out {folder}: expected a new folder, or one with a {file} of the same command")
    make_output_folder(folder)
    return False


def keep_request(path: Path, requested: Mapping[str, Any]) -> None:
    """Write what is requested of a folder into its file; refuse, if it is there, to go on with what was requested otherwise."""
    if path.is_file():
        check_same_request(path, json.loads(path.read_text(encoding="utf-8")), requested)
    write_json(path, requested)


def check_same_request(path: Path, there: Mapping[str, Any], requested: Mapping[str, Any]) -> None:
    """Refuse to resume what was requested otherwise.

    Args:
        path: file that says what was requested. there: what it says. requested: now.
    """
    for name, value in requested.items():
        if there.get(name) != value:
            raise InputError(
                f"{path}: {name}: {there.get(name)}, requested {value}; expected the same command, or another --out"
            )


def replace_file(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill a temporary file in the folder of ``path``, then move it there in one step.

    Raises:
        InputError: it cannot be written: no such folder, no rights, no space, or a folder of that name.
    """
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
        os.close(handle)
        try:
            write(Path(name))
            umask = os.umask(0)
            os.umask(umask)
            os.chmod(name, 0o666 & ~umask)  # mkstemp makes files private
            os.replace(name, path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error


def write_json(path: Path, content: Any) -> None:
    """Write ``content`` as indented JSON."""
    write_text(path, json.dumps(content, indent=2) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file (UTF-8)."""
    replace_file(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


@contextmanager
def locked(path: Path, patience: float, *, stays: bool = True) -> Iterator[None]:
    """Hold a file as a lock, among all processes and machines that see it; the system frees that of a process that died.

    Where there are no such locks (Windows, some shared file systems) nothing is held.

    Args:
        path: of the file, which is made, and says who holds it.
        patience: how long to wait for another process to let go, s.
        stays: the file is left there.

    Raises:
        InputError: another process still holds it, or it cannot be written.
    """
    deadline = time.monotonic() + patience
    while True:
        try:
            file = path.open("a+", encoding="utf-8")
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
        if (is_free := try_lock(file.fileno())) and _is_at(file.fileno(), path):
            break
        file.seek(0)
        holder = file.read().strip() or "another process"
        file.close()
        if not is_free and time.monotonic() > deadline:
            for_so_long = f" for {patience:g} s" if patience else ""
            raise InputError(f"{path}: held{for_so_long} by {holder}; wait until it ends, or choose another folder")
        time.sleep(0.1 * (not is_free))
    with file:
        with suppress(OSError):  # a full disk
            file.truncate(0)
            file.write(f"process {os.getpid()} on {platform.node()}: {shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])}\n")
            file.flush()
        try:
            yield
        finally:
            if not stays:
                path.unlink(missing_ok=True)


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether an open file is the one at a path: who held it may have removed it meanwhile."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def try_lock(descriptor: int, *part: int) -> bool:
    """Lock an open file until it is closed, or only a part (length, start) of it; return whether no other process holds it."""
    try:
        import fcntl

        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, *part)
    except (BlockingIOError, PermissionError):
        return False
    except (ImportError, OSError):
        return True
    return True


def unlock(descriptor: int, *part: int) -> None:
    """Let go what :func:`try_lock` locked."""
    with suppress(ImportError, OSError):
        import fcntl

        fcntl.lockf(descriptor, fcntl.LOCK_UN, *part)
