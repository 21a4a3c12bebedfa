"""Options that several commands share."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import refuse_existing
from wlr_gym.base.provenance import CONFIG_FILE, PROVENANCE_FILE

if TYPE_CHECKING:
    from wlr_gym.physics.effects import Patch


@dataclass(frozen=True, kw_only=True)
class PatchOption:
    """``--effects`` of every command that simulates."""

    effects: tuple[str, ...] = ()
    """Patch files, or names in configs/effects/: what is added to the nominal model; see: wlr effects."""

    def patch(self) -> Patch:
        """Return all given patches as one.

        Raises:
            InputError: see :func:`wlr_gym.physics.effects.load_patch`.
        """
        from wlr_gym.physics.effects import load_patch

        return load_patch(list(self.effects))


@dataclass(frozen=True, kw_only=True)
class JsonOption:
    """``--json`` of every command that prints results."""

    json: bool = False
    """Print the results as JSON; everything else goes to the standard error."""


@dataclass(frozen=True, kw_only=True)
class ForceOption:
    """``--force`` of every command that writes results under a given name."""

    force: bool = False
    """Replace results that are there."""

    def refuse_results(self, folder: Path, own: str) -> None:
        """Refuse, without ``--force``, to write over the results of this command, its ``own`` file, or among those of another.

        Raises:
            InputError: they are there.
        """
        from wlr_gym.data.format import META_FILE

        refuse_existing(folder / own, self.force)
        for name in (CONFIG_FILE, PROVENANCE_FILE, META_FILE):
            if (folder / name).exists() and not self.force:
                what = f"'{name}' of another command is in it"
                raise InputError(f"--out {folder}: {what}; choose another folder, or write into it with --force")


@dataclass(frozen=True, kw_only=True)
class SensorsOption:
    """``--sensors`` of commands that make robots."""

    sensors: tuple[Literal["camera", "flow", "none"], ...] | None = None
    """Which of the sensors that not every robot has the robots have: camera, flow (optical flow), or none; default: as the
    robot's file says."""

    def present(self) -> tuple[str, ...] | None:
        """Return the sensors; None = as the robot's file says.

        Raises:
            InputError: none, and others beside it.
        """
        if self.sensors and len(self.sensors) > 1 and "none" in self.sensors:
            raise InputError(f"--sensors {' '.join(self.sensors)}: expected none alone, or camera, flow or both")
        return None if self.sensors is None else tuple(name for name in self.sensors if name != "none")


def require_simulator(backend: str, robot: str) -> None:
    """Raise :class:`InputError` where ``--backend`` is no simulator; ``robot`` says what a real robot is for."""
    from wlr_gym.physics.plants import REAL, check_simulator

    if backend in REAL:
        raise InputError(f"--backend {backend}: {robot}")
    check_simulator(backend, "--backend")


def require_counts(options: object, *names: str, least: int = 1) -> None:
    """Raise :class:`InputError` for the first of some options that is below the least; None = left open."""
    for name in names:
        value = getattr(options, name)
        if value is not None and not value >= least:
            raise InputError(f"--{name.replace('_', '-')} {value:g}: expected {least} or more")


def note_untrained(sources: Iterable[str]) -> None:
    """Say which of some policies is one before any training."""
    from wlr_gym.policy import untrained

    for words in filter(None, map(untrained, sources)):
        print(f"note: {words}", file=sys.stderr)


def settings_of(options: Any) -> dict[str, Any]:
    """Return the options of a command as ``config.yaml`` has them."""
    return {name: str(value) if isinstance(value, Path) else value for name, value in asdict(options).items()}


def environment_of(env: str | None, policy: str | Path) -> str:
    """Return the given environment id; else the one a policy was trained in; else ``WLR-Velocity-v0``.

    Raises:
        InputError: see :func:`wlr_gym.policy.trained_environment`.
    """
    from wlr_gym.policy import trained_environment

    return env or trained_environment(policy) or "WLR-Velocity-v0"


def ray_address(words: tuple[str, ...] | None) -> str | None:
    """Return what ``--ray`` means: None = no Ray, ``local`` = one that is started here, otherwise the address of a cluster."""
    if words is not None and len(words) > 1:
        raise InputError(f"--ray {' '.join(words)}: expected one address, or none")
    return None if words is None else (words or ("local",))[0]
