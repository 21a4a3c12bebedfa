"""Steps that learn: training on from the policy, and the acceptance test of what comes out."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.files import write_json
from wlr_gym.base.provenance import CONFIG_FILE, write_yaml
from wlr_gym.base.text import quoted
from wlr_gym.envs.core import Core
from wlr_gym.envs.tasks.task import having
from wlr_gym.hardware.config import load_hardware
from wlr_gym.hardware.safety.joints import JointMemory, is_apart, is_lost, remember_joints
from wlr_gym.hardware.safety.status import RobotStatus, ratings_of
from wlr_gym.hardware.servos import UNREAD
from wlr_gym.learning.adaptation.state import AdaptStep, Asked, Progress
from wlr_gym.learning.adaptation.uncertainty import STATED, TRAINED_SHARE, Family, Uncertainty
from wlr_gym.learning.evaluation.conditions import FIRST_SEED
from wlr_gym.learning.evaluation.rollout import make_core, roll_out, seen_observations
from wlr_gym.learning.evaluation.scoring import (
    LARGEST_LOSS,
    Acceptance,
    accept,
    acceptance_rows,
    read_acceptance,
    write_acceptance,
)
from wlr_gym.learning.evaluation.subjects import make_player
from wlr_gym.learning.training import resume_training, train
from wlr_gym.policy import export_policy, make_policy, policy_environment
from wlr_gym.policy.agents import TrainingProgress, agent_function
from wlr_gym.robot import JOINTS, Robot

#: Share of the learning rate that is left at the end of the training.
FALLS_TO = 0.2
#: Logarithm of the exploration noise of legs and wheels at the start, where the policy's file has none of its own: that at
#: which trainings of the recipe end.
LOG_STD = (-4.2, -2.1)
#: Reward term of a second training, where the supervision may stop the policy of the first more often. Not of all trainings:
#: it makes policies for weak motors 36 % worse.
STUCK_WHEELS = {"stuck_wheels": {"weight": -6.0}}
#: Simulated episodes that the supervision watches, and their length, s.
WATCHED, WATCHED_SECONDS = 512, 10.0
#: Environment steps between scores on held-out episodes, and between checkpoints, as shares of the training.
_SCORES = 4
TRAINING, AGAIN = "training", "training_again"
#: Folder of what both policies do on simulated robots.
ACCEPTANCE = "acceptance"
#: Robots, and s of their episodes, on whose observations the file is compared with the policy.
EXPORT_ROBOTS, EXPORT_SECONDS = 8, 4.0


# ---- training --------------------------------------------------------------------------------------------------------


def training_settings(asked: Asked, family: Family, rewards: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the settings of a training on from a policy: its own recipe, on the robots of a family.

    Args:
        asked: which policy, how long, at which rate, with which sensors. family: what it trains with.
        rewards: terms beside those of the recipe.
    """
    settings = dict(agent_function("ppo", "settings_to_start_from")(asked.policy))
    environment = dict(settings.get("environment") or {})
    task = environment.get("task") or {}
    if isinstance(task, Mapping):  # not a task file
        present = having(asked.sensors)["task"] if task.get("sensors") else {}
        own = {"rewards": {**(task.get("rewards") or {}), **rewards}} if rewards else {}
        environment["task"] = {**task, **present, **own}
    environment["randomization"] = dict(family.randomization)
    if asked.floor is not None:
        environment["floor"] = asked.floor
    if family.effects:
        environment["effects"] = [dict(one) for one in family.effects]
    else:
        environment.pop("effects", None)
    batch = settings.get("num_envs", 512) * settings.get("steps_per_env", 32)
    every = max(batch, asked.steps // _SCORES)
    return settings | {
        "environment": environment,
        "tasks": {},
        "seed": asked.seed,
        "total_steps": asked.steps,
        "learning_rate": asked.learning_rate,
        "final_learning_rate": FALLS_TO * asked.learning_rate,
        "initial_log_std": LOG_STD,
        "evaluate_every": every,
        "checkpoint_every": every,
    }


def train_in(progress: Progress, name: str, family: Family, rewards: Mapping[str, Any] | None = None) -> str:
    """Train on from the policy with a family; an interrupted training resumes from its newest checkpoint.

    Args:
        progress: what was asked for. name: of the run folder in that of the adaptation. family: what it trains with.
        rewards: terms beside those of the recipe.

    Returns:
        The command that does the same.
    """
    asked, folder = progress.asked, progress.out / name
    config = progress.folder("model") / f"{name}.yaml"

    def on_update(update: TrainingProgress) -> None:
        progress.tell("training", update.steps / update.total_steps)

    if (folder / CONFIG_FILE).is_file() and not (folder / "policy").is_dir():
        resume_training(folder, on_update=on_update)
    elif not (folder / "policy").is_dir():
        write_yaml(config, training_settings(asked, family, rewards))
        train(asked.environment, folder, config, init=asked.policy, on_update=on_update)
    return f"wlr train {asked.environment} --config {quoted(config)} --init {quoted(asked.policy)} --out {quoted(folder)}"


def train_supervised(progress: Progress, found: Uncertainty, own: Robot) -> AdaptStep:
    """Train on; once more, wheels that stick being a cost, where the supervision may stop the new policy more often."""
    asked = progress.asked
    command = train_in(progress, TRAINING, found.training)
    said = [
        f"{asked.steps:,} environment steps from {asked.policy}, learning rate {asked.learning_rate:g}, in "
        f"{TRAINED_SHARE:.0%} of each interval."
    ]
    trained = str(progress.out / TRAINING / "policy")
    old, new = (watched(progress, found, own, policy) for policy in (asked.policy, trained))
    if may_stop_more(new, old):
        often = f"The supervision would stop it in {new.mean():.0%} of episodes, and the old policy in {old.mean():.0%}"
        if _takes_rewards(asked.policy):
            command = train_in(progress, AGAIN, found.training, STUCK_WHEELS)
            said.append(f"{often}; that may be more often: trained again, wheels that stick being a cost.")
        else:
            said.append(f"{often}; its task is a file of its own, so nothing was changed.")
    numbers = {"steps": asked.steps, "learning_rate": asked.learning_rate}
    return AdaptStep(said=tuple(said), command=command, numbers=numbers)


def _takes_rewards(policy: str) -> bool:
    """Whether reward terms can be laid over the task of a policy's recipe: it is not a file."""
    environment = agent_function("ppo", "settings_to_start_from")(policy).get("environment") or {}
    return isinstance(environment.get("task") or {}, Mapping)


def watched(progress: Progress, found: Uncertainty, own: Robot, policy: str) -> NDArray[np.bool_]:
    """Return in which simulated episodes (N,) the supervision would stop a robot as the result states it; kept in a file."""
    asked, family = progress.asked, found.families[0]
    name = "old" if policy == asked.policy else Path(policy).parent.name
    path = progress.folder(ACCEPTANCE) / f"stopped_{name}.json"
    if not path.is_file():
        keywords = {"randomization": dict(family.randomization), "effects": list(family.effects) or None, "robot": own}
        keywords["floor"] = asked.floor
        keywords |= {"precision": "float32", "episode_length": WATCHED_SECONDS, **having(asked.sensors)}
        progress.tell("supervision on simulated episodes", 0.0)
        write_json(path, stopped_episodes(policy, asked.environment, keywords, WATCHED, FIRST_SEED).tolist())
    return np.array(json.loads(path.read_text(encoding="utf-8")), bool)


def trained_policy(progress: Progress) -> str:
    """Return the policy of the last training: that of its end, where the learning rate has fallen."""
    again = progress.out / AGAIN / "policy"
    return str(again if again.is_dir() else progress.out / TRAINING / "policy")


def export_trained(progress: Progress) -> str:
    """Write the trained policy as one file, which runs without torch, and return its path."""
    source, path = trained_policy(progress), progress.out / "policy.onnx"
    with closing(make_core(progress.asked.environment, EXPORT_ROBOTS, policy_environment(source))) as core:
        seen = seen_observations(core, make_policy(source, core.contract()), EXPORT_SECONDS)
    export_policy(source, path, seen)
    return str(path)


# ---- acceptance ------------------------------------------------------------------------------------------------------


def accept_policy(progress: Progress, found: Uncertainty, own: Robot) -> AdaptStep:
    """Test the trained policy against the old one over all that the result leaves open; ``policy`` is the one that is kept."""
    asked, new = progress.asked, trained_policy(progress)
    tests = [acceptance_on(progress, new, family, own, k / len(found.families)) for k, family in enumerate(found.families)]
    losses = tuple(loss for test in tests for loss in test.losses)
    worse = [loss for loss in losses if not loss.bound <= LARGEST_LOSS]
    better = next(loss for loss in losses if loss.floors == STATED).bound < 0.0
    stopped, stopped_before = (watched(progress, found, own, policy) for policy in (new, asked.policy))
    stops_more = may_stop_more(stopped, stopped_before)
    is_new = better and not worse and not stops_more
    if is_new:
        verdict = "The new policy is kept: better on the robot as the result states it, and nowhere worse."
    elif worse:
        verdict = f"The old policy is kept: the new one may be worse in '{worse[0].floors}' (by up to {worse[0].bound:.1f} %)."
    elif stops_more:
        shares = f"{stopped.mean():.0%} of episodes, not {stopped_before.mean():.0%}"
        verdict = f"The old policy is kept: the supervision may stop the new one more often (in {shares})."
    else:
        verdict = "The old policy is kept: the new one is not better beyond the interval."
    numbers = {
        "kept": "new" if is_new else "old",
        "policy": export_trained(progress) if is_new else asked.policy,
        "stopped": {"old": float(stopped_before.mean()), "new": float(stopped.mean())},
        "losses": [{"family": one.floors, "loss_percent": one.loss, "upper_bound": one.bound} for one in losses],
        "rows": [row for test in tests for row in acceptance_rows(test)[1:]],
    }
    randomization = progress.out / "model" / "randomization.yaml"
    sensors = " ".join(asked.sensors) or "none"
    named = f"{quoted(f'new={new}')} {quoted(f'old={asked.policy}')}"
    command = f"wlr evaluate {named} --randomization {quoted(randomization)} --sensors {sensors}"
    return AdaptStep(said=(verdict,), command=command, numbers=numbers)


def acceptance_on(progress: Progress, new: str, family: Family, own: Robot, share: float) -> Acceptance:
    """Return how a new policy does against the old one on the robots of a family; kept in a file. ``share``: of the step."""
    asked = progress.asked
    path = progress.folder(ACCEPTANCE) / f"{Path(new).parent.name}_{family.name.replace(' ', '_')}.json"
    if not path.is_file():
        progress.tell(f"acceptance: {family.name}", share)
        result = accept(
            new,
            asked.environment,
            references=[asked.policy],
            floors=[{**family.randomization, "name": family.name}],
            episodes=asked.episodes,
            blocks=1,
            sensors=asked.sensors,
            robot=own,
            effects=list(family.effects) or None,
            floor=asked.floor,
            threads=progress.threads,
        )
        write_acceptance(path, result)
    return read_acceptance(path)


# ---- would the supervision stop the robot? its rules on simulated episodes; the simulator drives on ------------------

#: Share of episodes by which a new policy may be stopped more often than the old one.
LARGEST_RISE = 0.02


def stopped_episodes(policy: str, environment: str, keywords: Mapping[str, Any], episodes: int, seed: int) -> NDArray[np.bool_]:
    """Return in which episodes (N,) the supervision would stop a robot that a policy drives.

    Args:
        policy, environment: who drives, and what. keywords: of the environment.
        episodes: N. seed: of the first one; the others count up from it.
    """
    core, player = make_player(environment, policy, episodes, keywords)
    with closing(core):
        watched = _Watched(core)
        roll_out(core, player, seed, on_tick=watched.look)
        return watched.stopped


def may_stop_more(new: NDArray[np.bool_], old: NDArray[np.bool_]) -> bool:
    """Whether it is not shown that the first is stopped in at most 2 % more of the same episodes (N,) than the second.

    The upper end of the 95 % interval of the difference of two paired shares (Bonett and Price 2012) is compared.
    """
    more, less, count = int((new & ~old).sum()) + 1, int((old & ~new).sum()) + 1, len(new) + 2
    rise = (more - less) / count
    return rise + 1.96 * np.sqrt((more + less - count * rise**2) / count**2) > LARGEST_RISE


class _Watched:
    """The supervision's rules on what joints do, on all robots of a batch; it has others for registers, sensors and bus."""

    def __init__(self, core: Core) -> None:
        free = core.actions.torque_on  # of tasks whose wheels have no torque
        self._core, self._on = core, np.ones((core.count, len(JOINTS)), bool) if free is None else free
        self._limits = load_hardware("nominal").safety
        self._ratings = ratings_of(core.task.robot, core.task.config.control_period)
        self._memory = JointMemory()
        self.stopped: NDArray[np.bool_] = np.zeros(core.count, bool)

    def look(self) -> None:
        """Judge the robots whose episodes go on."""
        core, limits, ratings = self._core, self._limits, self._ratings
        self._memory = remember_joints(limits, ratings, self._status(), self._memory, core.actions.setpoints.copy(), self._on)
        bad = is_apart(limits, self._memory) | is_lost(limits, ratings, self._memory)
        self.stopped |= bad.any(axis=1) & ~(core.terminated | core.truncated)

    def _status(self) -> RobotStatus:
        """What the servos say, copied, since sensors are read in place; that legs' motors draw current is not looked at."""
        sensors, none, unknown = self._core.sensors, np.zeros(self._on.shape), np.full(3, np.nan)
        return RobotStatus(
            time=0.0,
            position=sensors.joint_position.copy(),
            velocity=sensors.joint_velocity.copy(),
            effort=none,
            silence=none,
            alert=none > 0,
            restarted=none > 0,
            voltage=none + self._ratings.supply,
            temperature=none,
            gyro=unknown,
            accelerometer=unknown,
            imu_silence=0.0,
            up=unknown,
            registers=UNREAD._replace(torque=np.ones(self._on.shape)),
        )
