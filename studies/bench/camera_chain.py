"""The whole chain in emulated time: servo protocol, rendered frames, detector, observer, policy; beside the simulator.

Every episode has the robot, floor, place and commands that a simulated episode of the same seed has, so the two are paired. The
emulated robot starts at rest, the simulated one is put down with some speed: their first second differs.

``python -m studies.bench.camera_chain FIGURE.png`` drives an emulated robot in emulated time and draws what its sensors saw.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.bench.measure import Measurement, Size
from wlr_gym.base.errors import require_package
from wlr_gym.base.plots import BLUE, GREEN, GREY, ORANGE, legend_below, new_figure, save, tidy
from wlr_gym.envs.core import Core
from wlr_gym.envs.tasks.signals import yaw_of
from wlr_gym.envs.tasks.task import scales_of, tracking_error
from wlr_gym.hardware.camera.reading import CameraFile, load_camera_file
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.link import emulated_link
from wlr_gym.hardware.emulator.machine import Machine, MachineOptions
from wlr_gym.hardware.plant import RobotPlant
from wlr_gym.learning.evaluation.rollout import make_core, roll_out
from wlr_gym.perception.observer import ESTIMATE_LAYOUT
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, PlantState, RobotOptions, standing_state
from wlr_gym.policy import environment_for, make_policy
from wlr_gym.robot import WHEELS
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Where the policies that are measured were trained.
ENVIRONMENT = "WLR-Velocity-v0"
#: s of emulated time per tick.
_TICK = 0.002
#: s at the beginning of an episode that do not count.
_SKIPPED = 1.0
#: Seed of the first episode.
_FIRST_SEED = 9000


@dataclass(frozen=True, eq=False)
class ChainDrive:
    """One episode on the emulated robot, a row per control step.

    Attributes:
        time: (T,) s. command: (T, C). sensors: (T, SENSOR_LAYOUT.width). truth: (T, TRUTH_LAYOUT.width).
        start: (3,) true x, y (m) and yaw (rad) at the run's start.
        estimate: (T, W) of the observer. reasons: (T,) why there is no camera pose; empty = nothing is wrong.
        reason: why the drive ended. camera: statistics of the loop.
    """

    time: Array
    command: Array
    sensors: Array
    truth: Array
    start: Array
    estimate: Array
    reasons: tuple[str, ...]
    reason: str
    camera: Mapping[str, Any]

    def sensed(self, name: str) -> Array:
        """Return a channel of the sensors, (T,) or (T, size)."""
        return SENSOR_LAYOUT.view(self.sensors, name)

    def true_pose(self) -> Array:
        """Return the true x, y, yaw (T, 3) from the start pose; yaw unwrapped."""
        position, quaternion = self.true("position"), self.true("quaternion")
        dx, dy = (position[:, :2] - self.start[:2]).T
        cosine, sine = np.cos(self.start[2]), np.sin(self.start[2])
        yaw = np.unwrap(np.concatenate([self.start[2:], yaw_of(*quaternion.T)]))[1:] - self.start[2]
        return np.stack([cosine * dx + sine * dy, cosine * dy - sine * dx, yaw], axis=1)

    def errors(self) -> dict[str, float]:
        """Return measure -> rms of the task Velocity without the first second, SI units."""
        late = self.time > _SKIPPED
        speed = self.true("linear_velocity_in_body")[late, 0] - self.command[late, 0]
        turn = self.true("angular_velocity_in_body")[late, 2] - self.command[late, 1]
        return {"velocity_error": float(np.sqrt(np.mean(speed**2))), "yaw_rate_error": float(np.sqrt(np.mean(turn**2)))}

    def true(self, name: str) -> Array:
        """Return a channel of the truth, (T,) or (T, size)."""
        return TRUTH_LAYOUT.view(self.truth, name)


@dataclass(frozen=True)
class ChainSetting:
    """What is driven.

    Attributes:
        policy: its source. floor: randomisation that robots and floors are drawn from.
        camera: above the floor; None = there is none.
        seconds: of an episode. faults: lines of text, as ``wlr emulate`` takes them; they count from the run's start.
        extra: further keywords of the environment.
    """

    policy: str
    floor: str
    camera: CameraFile | None = None
    seconds: float = 20.0
    faults: tuple[str, ...] = ()
    extra: Mapping[str, Any] = field(default_factory=dict)


def measure_camera(size: Size) -> list[Measurement]:
    """Tracking error of the chain over the simulator's, with and without a camera; with the lens covered over without a camera.

    Means over the same episodes, each without its first second.
    """
    require_package("cv2", "vision")
    seeds, seconds = range(_FIRST_SEED, _FIRST_SEED + size(6, 1)), float(size(8, 2))
    at = 0.625 * seconds
    camera, covered = _quick(chain_camera()), (f"camera_covered after={at:g}",)
    rows, floors = [], ("slippery", "ice", "split")
    for done, floor in enumerate(floors):
        size.tell(done / len(floors))
        setting = ChainSetting("velocity_slip_aware", floor, camera, seconds)
        simulated, chain = simulated_errors(setting, seeds), chain_errors(setting, seeds)
        without = replace(setting, camera=None, extra={"task": {"sensors": {"camera": 0.0, "flow": 0.0}}})
        blind, imagined = chain_errors(without, seeds), simulated_errors(without, seeds)
        hidden = chain_errors(replace(setting, faults=covered), seeds)
        what = f"{floor}, {len(seeds)} episodes of {seconds:g} s: tracking error"
        late = f"lens covered from {at:g} s on"
        of_each = {"with a camera": chain, late: hidden, "without a camera": blind}
        of_each |= {"with a camera, in the simulator": simulated, "without a camera, in the simulator": imagined}
        rows += [Measurement("camera", f"{what} {name}", "-", tuple(map(float, found))) for name, found in of_each.items()]
        for name, ours, other, bar in (
            ("with a camera, over the simulator's", chain, simulated, 1.1),
            ("without a camera, over the simulator's", blind, imagined, 1.1),
            (f"{late}, over that without a camera", hidden, blind, 1.0),
        ):
            rows.append(Measurement("camera", f"{what} {name}", "-", (float(ours.mean() / other.mean()),), bar=bar))
    return rows


def _quick(file: CameraFile) -> CameraFile:
    """Return a camera with fewer pixels, nearer to the floor: rendering is what takes the time."""
    lens = {"width": 640, "height": 360, "focal": (380.0, 380.0), "centre": (319.5, 179.5)}
    scene = file.emulated.model_copy(update={"height": 2.0, "samples": 3})
    return file.model_copy(update={"calibration": file.calibration.model_copy(update=lens), "emulated": scene})


def chain_camera() -> CameraFile:
    """Return the emulated camera with a latency of 40 ms and a tenth of the frames lost."""
    file = load_camera_file("emulated")
    return file.model_copy(update={"emulated": file.emulated.model_copy(update={"latency": 0.04, "dropout": 0.1})})


def simulated_core(setting: ChainSetting) -> Core:
    """Return the simulated robot of a setting."""
    keywords = {"randomization": setting.floor, "episode_length": setting.seconds, **setting.extra}
    return make_core(ENVIRONMENT, 1, environment_for(setting.policy, keywords))


def simulated_errors(setting: ChainSetting, seeds: Sequence[int]) -> Array:
    """Return the tracking errors (episodes,) in the simulator, with its own camera, without the first second."""
    with closing(simulated_core(setting)) as core:
        policy, first = make_policy(setting.policy, core.contract()), round(_SKIPPED / core.task.config.control_period)
        found = []
        for seed in seeds:
            rollout = roll_out(core, policy, seed)
            rms = np.sqrt((rollout.measured[first:, 0] ** 2).mean(axis=0))
            found.append(_tracking(core, dict(zip(core.task.measures, rms, strict=True)), bool(rollout.fell[0])))
        return np.array(found)


def chain_errors(setting: ChainSetting, seeds: Sequence[int]) -> Array:
    """Return the tracking errors (episodes,) of the whole chain, without the first second; a run that was stopped fell."""
    core = simulated_core(setting)
    core.close()
    drives = (drive_chain(setting, seed) for seed in seeds)
    return np.array([_tracking(core, drive.errors(), drive.reason != "time is over") for drive in drives])


def _tracking(core: Core, rms: Mapping[str, float], fell: bool) -> float:
    scales = scales_of(core.task.config)
    return float(tracking_error(scales, {which: np.array([rms[which[0]]]) for which in scales}, np.array([fell]))[0])


def drive_chain(setting: ChainSetting, seed: int) -> ChainDrive:
    """Drive one episode on an emulated robot that is as the simulated one of this seed is drawn.

    Floors that change with time are those of the start.
    """
    drawn = simulated_core(setting)
    drawn.seed(0, seed)
    drawn.begin_episodes(drawn.everyone)
    parameters = Parameters(drawn.parameters.values.copy())
    state = _standing(drawn, parameters)
    drawn.close()
    keywords = {"backend": "dynamixel", "hardware": RobotOptions(emulated=True, camera=None), "episode_length": setting.seconds}
    core = make_core(ENVIRONMENT, 1, environment_for(setting.policy, {**keywords, **setting.extra}))
    core.plant.close()
    plant = core.plant
    assert isinstance(plant, RobotPlant)
    hardware = plant.loop.hardware
    options = MachineOptions(timing=NO_TIME, tick=_TICK, seed=seed)
    machine = Machine(core.task.robot, hardware, options, parameters=parameters, state=state)
    camera = None
    if setting.camera is not None:
        scene = setting.camera.emulated.model_copy(update={"seed": seed})
        camera = setting.camera.model_copy(update={"emulated": scene})
    core.plant = RobotPlant(core.task.robot, 1, plant.options, RobotOptions(), emulated_link(machine, camera))
    with closing(core):
        return _watched(core, machine, setting, seed)


def _standing(core: Core, parameters: Parameters) -> PlantState:
    """Return the robot standing where a simulated episode begins, on the same patches of floor, at rest."""
    state = standing_state(core.task.robot, parameters)
    yaw = yaw_of(*core.state.quaternion[0])
    state.position[0, :2] = core.state.position[0, :2]
    state.quaternion[0] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
    return state


def _watched(core: Core, machine: Machine, setting: ChainSetting, seed: int) -> ChainDrive:
    """Drive a core and keep what was read, estimated and true at every control step."""
    from wlr_gym.hardware.loop import StoppedError

    assert isinstance(core.plant, RobotPlant)
    loop, policy = core.plant.loop, make_policy(setting.policy, core.contract())
    core.seed(0, seed)
    policy.reset(core.everyone)
    rows: list[tuple[Array, ...]] = []
    reasons: list[str] = []
    began = np.zeros(3)
    try:
        core.begin_episodes(core.everyone)
        start, before = machine.time, machine.plant.truth()
        began = np.array([*before.position[0, :2], yaw_of(*before.quaternion[0])])
        for fault in setting.faults:
            machine.inject(fault)
        while not (core.terminated[0] or core.truncated[0]):
            command = core.command[0].copy()
            core.step(policy.act(core.observation), core.everyone)
            estimate = np.zeros(0) if core.observer is None else core.observer.values[0].copy()
            now, truth = np.array([machine.time - start]), machine.plant.truth().values[0].copy()
            rows.append((now, command, core.sensors.values[0].copy(), truth, estimate))
            status = loop.status
            reasons.append("" if status is None or status.camera is None else status.camera.reason)
        loop.stop("time is over")
    except StoppedError:
        pass
    time, command, sensors, truth, estimate = (np.array(column) for column in zip(*rows, strict=True))
    return ChainDrive(
        time[:, 0], command, sensors, truth, began, estimate, tuple(reasons), loop.reason,
        loop.statistics().get("camera", {}),
    )  # fmt: skip


# ---- picture of what camera, optical flow and observer saw -----------------------------------------------------------


#: s of the drive that is drawn, from when on the lens is covered, and for how long.
_SECONDS, _COVERED, _FOR = 12.0, 5.0, 3.0
#: The truth is wide and pale: what lies on it hides no more than its middle.
_TRUTH: dict[str, Any] = {"color": "0.6", "lw": 4.0, "label": "truth"}
_SEEN, _ESTIMATE, _FLOW = ORANGE, BLUE, GREEN


def draw_chain(drive: ChainDrive, path: Path, title: str) -> None:
    """Draw a drive: errors of position and heading, forward speed, slip of one wheel, age of the camera's pose.

    Args:
        drive: what was seen. path: of the picture. title: of it.
    """
    figure = new_figure(8.0, 6.8)
    axes = figure.subplots(5, 1, sharex=True, height_ratios=(2, 2, 3, 3, 1.5))
    _draw_pose_error(axes[0], drive, 0, "error of x\n(mm)")
    _draw_pose_error(axes[1], drive, 2, "error of the\nheading (mrad)")
    _draw_speed(axes[2], drive)
    _draw_slip(axes[3], drive)
    axes[4].plot(drive.time, 1e3 * drive.sensed("camera_age"), color=_SEEN, lw=1.0)
    axes[4].set_ylabel("age of the\npose (ms)")
    axes[4].set_yscale("log")
    axes[4].yaxis.set_major_formatter("{x:g}")
    axes[4].set_xlabel("time (s)")
    blind = np.array([bool(reason) for reason in drive.reasons])
    for axis in axes:
        shade = {"transform": axis.get_xaxis_transform(), "color": "0.92", "lw": 0, "zorder": 0}
        axis.fill_between(drive.time, 0, 1, where=blind, label="no pose", **shade)
        tidy(axis)
        axis.set_xlim(0, drive.time[-1])
    axes[0].set_title(title, fontsize=10)
    figure.align_ylabels(axes)
    legend_below(figure, columns=3)
    save(figure, path)


def _estimate(drive: ChainDrive, name: str) -> Any:
    return ESTIMATE_LAYOUT.view(drive.estimate, name)


def _draw_pose_error(axis: Any, drive: ChainDrive, k: int, label: str) -> None:
    """One component of the pose, less the truth: the estimate, and every frame against when it was exposed."""
    true = drive.true_pose()[:, k]
    estimate = _estimate(drive, "yaw") if k == 2 else _estimate(drive, "position")[:, k]
    is_new = drive.sensed("camera_is_new") > 0.5
    exposed = (drive.time - drive.sensed("camera_age"))[is_new]
    seen = drive.sensed("camera_pose")[is_new, k] - np.interp(exposed, drive.time, true)
    axis.plot(exposed, 1e3 * seen, ".", color=_SEEN, ms=3, label="camera, when exposed")
    axis.plot(drive.time, 1e3 * (estimate - true), color=_ESTIMATE, lw=1.2, label="observer")
    axis.axhline(0.0, color="black", lw=0.6)
    axis.set_ylabel(label)


def _draw_band(axis: Any, time: Any, values: Any, sigma: Any) -> None:
    axis.fill_between(time, values - 2 * sigma, values + 2 * sigma, color=_ESTIMATE, alpha=0.2, lw=0, label="2 sigma")
    axis.plot(time, values, color=_ESTIMATE, lw=1.2, label="observer")


def _draw_speed(axis: Any, drive: ChainDrive) -> None:
    speed, sigma = (_estimate(drive, f"linear_velocity_{name}")[:, 0] for name in ("in_body", "sigma"))
    axis.plot(drive.time, drive.true("linear_velocity_in_body")[:, 0], **_TRUTH)
    _draw_band(axis, drive.time, speed, sigma)
    axis.plot(drive.time, drive.command[:, 0], "--", color=GREY, lw=1.0, label="command")
    if "flow" in SENSOR_LAYOUT.channels and (is_new := drive.sensed("flow_is_new") > 0.5).any():
        turned = drive.sensed("flow")[:, 0] + drive.sensed("gyro")[:, 1]
        height = drive.true("position")[:, 2]
        axis.plot(drive.time[is_new], (turned * height)[is_new], ".", color=_FLOW, ms=2, label="flow times height")
    axis.set_ylabel("forward speed\n(m/s)")
    axis.set_ylim(*_limits(drive.true("linear_velocity_in_body")[:, 0], speed))


def _draw_slip(axis: Any, drive: ChainDrive, wheel: int = 0) -> None:
    slip, sigma = (_estimate(drive, name)[:, 2 * wheel] for name in ("slip_velocity", "slip_sigma"))
    true = drive.true("slip_velocity")[:, 2 * wheel]
    axis.plot(drive.time, true, **_TRUTH)
    _draw_band(axis, drive.time, slip, sigma)
    axis.set_ylabel(f"slip of {WHEELS[wheel]}\n(m/s)")
    axis.set_ylim(*_limits(true, slip))


def _limits(*series: Any) -> tuple[float, float]:
    low, high = (function([function(values) for values in series]) for function in (np.min, np.max))
    margin = 0.25 * max(high - low, 0.01)
    return float(low - margin), float(high + margin)


def main(arguments: list[str]) -> int:
    """Drive and draw; 0 when done."""
    fault = f"camera_covered after={_COVERED:g} duration={_FOR:g}"
    setting = ChainSetting("velocity_slip_aware", "split", chain_camera(), _SECONDS, (fault,))
    drive = drive_chain(setting, 9000)
    title = "Emulated robot on a split floor; rendered frames, 40 ms latency, 10 % lost; lens covered from 5 to 8 s"
    draw_chain(drive, Path(arguments[0]), title)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
