"""Where configs and agents live: beside the package in a clone or an editable install, inside it in a wheel."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from wlr_gym.base.errors import InputError, nearest, unknown_name

PACKAGE = Path(__file__).resolve().parents[1]


def data_directory(name: str) -> Path:
    """Return the folder ``configs`` or ``agents``, from a wheel or a clone alike."""
    inside = PACKAGE / name
    return inside if inside.is_dir() else PACKAGE.parent / name


def as_path(given: str | Path) -> Path:
    """Return a path as users write it: ``~`` is their home."""
    return Path(os.path.expanduser(given))


def find_config(kind: str, name: str | Path) -> Path:
    """Resolve a config given by path or by the name of a file in ``configs/<kind>/``.

    Raises:
        InputError: no such file; the message lists the shipped names.
    """
    path = as_path(name)
    if path.suffix in {".yaml", ".yml"} and path.is_file():
        return path
    if str(name) in config_names(kind):
        return data_directory("configs") / kind / f"{name}.yaml"
    if path.exists():
        found = "is a folder; " if path.is_dir() else ""
        raise InputError(f"{path}: {found}expected a .yaml file, or a name in configs/{kind}/: {', '.join(config_names(kind))}")
    if path.suffix in {".yaml", ".yml"}:
        raise InputError(f"{kind} config: no file '{path}'{_nearest_file(path)}")
    raise unknown_name(f"{kind} config", str(name), config_names(kind))


def _nearest_file(path: Path) -> str:
    """Return ``nearest`` among the files beside ``path``; their common ending would make any two names close."""
    hint = nearest(path.stem, [other.stem for other in path.parent.glob(f"*{path.suffix}")])
    return hint.replace("'?", f"{path.suffix}'?")


@contextmanager
def named_by(file: str | Path, key: str) -> Iterator[None]:
    """Say of bad input in here which file and key named it."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{file}: {key}: {error}") from None


def named_in(file: str | Path, name: str | Path) -> Path:
    """Return what ``file`` means by ``name``: a file seen from its own folder, else ``name`` itself, for :func:`find_config`.

    A file has one absolute path, by whatever way it is named.
    """
    beside = Path(file).parent / as_path(name)
    return beside.resolve() if beside.is_file() else as_path(name)


def config_names(kind: str) -> list[str]:
    """Return the names of the files in ``configs/<kind>/``."""
    return sorted(path.stem for path in (data_directory("configs") / kind).glob("*.yaml"))
