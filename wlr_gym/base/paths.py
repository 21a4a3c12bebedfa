"""Where configs and agents live: beside the package in a clone or an editable install, inside it in a wheel."""

from __future__ import annotations

from pathlib import Path

from wlr_gym.base.errors import InputError, nearest, unknown_name

PACKAGE = Path(__file__).resolve().parents[1]


def data_directory(name: str) -> Path:
    """Return the folder ``configs`` or ``agents``, from a wheel or a clone alike."""
    inside = PACKAGE / name
    return inside if inside.is_dir() else PACKAGE.parent / name


def find_config(kind: str, name: str | Path) -> Path:
    """Resolve a config given by path or by the name of a file in ``configs/<kind>/``.

    Raises:
        InputError: no such file; the message lists the shipped names.
    """
    path = Path(name)
    if path.suffix in {".yaml", ".yml"}:
        if path.is_file():
            return path
        beside = [other.name for other in path.parent.glob("*.y*ml")]
        raise InputError(f"{kind} config: no file '{path}'{nearest(path.name, beside)}")
    if str(name) in config_names(kind):
        return data_directory("configs") / kind / f"{name}.yaml"
    raise unknown_name(f"{kind} config", str(name), config_names(kind))


def named_in(file: str | Path, name: str | Path) -> Path:
    """Return what ``file`` means by ``name``: a file seen from its own folder, else ``name`` itself, for :func:`find_config`.

    A file has one absolute path, by whatever way it is named.
    """
    beside = Path(file).parent / name
    return beside.resolve() if beside.is_file() else Path(name)


def config_names(kind: str) -> list[str]:
    """Return the names of the files in ``configs/<kind>/``."""
    return sorted(path.stem for path in (data_directory("configs") / kind).glob("*.yaml"))
