"""Left and right: the mirror image of observations and actions, and samples of PPO that are seen in it.

The robot is symmetric about its x-z plane. So an experience that is mirrored is an experience that it might have had: legs and
wheels swap sides, velocities and forces along y change their sign, rotations about x and z too (Mittal et al. 2024).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer

from wlr_gym.base.errors import InputError
from wlr_gym.envs import Sb3VecEnv
from wlr_gym.envs.tasks.describe import column_name

#: Terms whose numbers have no direction, whatever their labels say.
_UNSIGNED = ("_sigma", "effective_friction", "_quality", "_age", "_present", "_is_new", "friction_demand")
#: Terms that are rotations: those about x and z change sign, those about y do not.
_ROTATIONS = ("gyro", "angular_velocity_in_body", "quaternion")
#: Labels and terms that are positive to the left.
_LEFTWARD = {
    "yaw", "yaw_rate", "lateral", "heading", "y", "yaw_rate_integral", "path_curvature", "path_offset", "path_heading",
    "estimated_yaw", "estimated_yaw_rate", "camera_yaw",
}  # fmt: skip
#: Labels and terms that the mirror leaves as they are.
_SAME = {
    "x", "z", "w", "linear_velocity_x", "velocity_integral", "slip_difference", "speed_command", "climb_command",
    "body_clearance", "supply_voltage", "leg_rate", "path_shape", "path_wavelength", "climb_speed", "climb_time",
    "front_leg_first", "front_leg_second", "rear_leg_first", "rear_leg_second", "mechanical_energy", "electrical_energy",
}  # fmt: skip
_SIDES = {"_lf": "_rf", "_rf": "_lf", "_lr": "_rr", "_rr": "_lr"}


@dataclass(frozen=True)
class Mirror:
    """``mirrored[..., k] = sign[k] * row[..., source[k]]``."""

    source: NDArray[np.intp]
    sign: NDArray[np.float32]

    def of(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the mirror image of rows (N, D)."""
        return rows[..., self.source] * self.sign


def mirror_of(names: Sequence[str]) -> Mirror:
    """Return the mirror image of numbers by their names: ``wheel_velocity[wheel_lf]``, or joints' plain names.

    Args:
        names: with the lag appended where it is not 0, so that each occurs once.

    Raises:
        InputError: a name whose mirror image is not known.
    """
    images = [_image(name) for name in names]
    source = np.array([names.index(image) for image, _ in images], np.intp)
    return Mirror(source, np.array([sign for _, sign in images], np.float32))


def _image(name: str) -> tuple[str, float]:
    """Return the name of the number on the other side, and the sign it comes with."""
    term, _, rest = name.partition("[")
    label, _, lag = rest.partition("]")
    joint, _, axis = label.partition(",")
    plain = label or term
    if plain[-3:] in _SIDES:
        return name.replace(plain, plain[:-3] + _SIDES[plain[-3:]]), 1.0
    other = f"{term}[{joint[:-3] + _SIDES[joint[-3:]]},{axis}]{lag}" if axis else name
    if any(part in term for part in _UNSIGNED):
        return other, 1.0
    direction = axis or label
    if term in _ROTATIONS:
        return other, 1.0 if direction in ("y", "w") else -1.0
    if direction in _LEFTWARD or term in _LEFTWARD:
        return other, -1.0
    if direction in _SAME or plain in _SAME:
        return other, 1.0
    raise InputError(f"agent 'ppo': setting 'mirror': the mirror image of observation '{name}' is not known; set mirror=false")


class _MirroredSamples:
    """Every other sample of a minibatch is seen in the mirror. Sampling is as ever: the same random numbers."""

    mirrors: Mapping[str, Mirror]
    action_mirror: Mirror

    def _get_samples(self, batch_inds: NDArray[np.intp], env: Any = None) -> Any:
        samples = super()._get_samples(batch_inds, env)  # type: ignore[misc]
        seen = samples.observations
        for name, rows in seen.items() if isinstance(seen, dict) else (("policy", seen),):
            _mirror(rows, self.mirrors[name])
        _mirror(samples.actions, self.action_mirror)
        return samples


def _mirror(rows: torch.Tensor, mirror: Mirror) -> None:
    rows[1::2] = rows[1::2][:, torch.from_numpy(mirror.source)] * torch.from_numpy(mirror.sign)


class MirroredBuffer(_MirroredSamples, RolloutBuffer):
    """For plain observations."""


class MirroredDictBuffer(_MirroredSamples, DictRolloutBuffer):
    """For observations in groups."""


def set_mirror(buffer: Any, env: Sb3VecEnv) -> None:
    """Tell a buffer what the mirror image of the task's observations and actions is."""
    task = env.core.task
    groups = {"policy": task.policy, "privileged": task.privileged}
    names = {group: [column_name(c) + (f"@{c.lag}" if c.lag else "") for c in columns] for group, columns in groups.items()}
    used = names if env.core.dictionary else {"policy": names["policy"]}
    buffer.mirrors = {group: mirror_of(some) for group, some in used.items()}
    buffer.action_mirror = mirror_of([column.joint for column in task.actions])
