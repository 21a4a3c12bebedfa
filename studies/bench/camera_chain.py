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
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, RobotOptions, standing_state
from wlr_gym.policy import environment_for, make_policy
from wlr_gym.robot import WHEELS
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Where the policies that are measured were trained.
ENVIRONMENT = "WLR-Velocity-v0"
#: s at the beginning of an episode that do not count.
_SKIPPED = 1.0
_FIRST_SEED = 9000


@dataclass(frozen=True, eq=False)
class ChainDrive:
    """One episode on the emulated robot, a row per control step.

    Attributes:
        time: (T,) s. command: (T, C). sensors: (T, SENSOR_LAYOUT.width). truth: (T, TRUTH_LAYOUT.width).
        start: (3,) true x, y (m) and yaw (rad) at the run's start.
        estimate: (T, W) of the observer. reasons: (T,) why there is no camera pose; empty = nothing is wrong.
        reason: why the drive ended.
    """

    time: Array
    command: Array
    sensors: Array
    truth: Array
    start: Array
    estimate: Array
    reasons: tuple[str, ...]
    reason: str

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
    # fewer pixels, nearer to the floor: rendering is what takes the time
    lens = {"width": 640, "height": 360, "focal": (380.0, 380.0), "centre": (319.5, 179.5)}
    scene = {"height": 2.0, "samples": 3}
    camera, covered = chain_camera(), (f"camera_covered after={at:g}",)
    camera = camera.model_copy(
        update={"calibration": camera.calibration.model_copy(update=lens), "emulated": camera.emulated.model_copy(update=scene)}
    )
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
    state, yaw = standing_state(drawn.task.robot, parameters), yaw_of(*drawn.state.quaternion[0])
    state.position[0, :2] = drawn.state.position[0, :2]  # on the same patches of floor, at rest
    state.quaternion[0] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
    drawn.close()
    keywords = {"backend": "dynamixel", "hardware": RobotOptions(emulated=True, camera=None), "episode_length": setting.seconds}
    core = make_core(ENVIRONMENT, 1, environment_for(setting.policy, {**keywords, **setting.extra}))
    core.plant.close()
    plant = core.plant
    assert isinstance(plant, RobotPlant)
    hardware = plant.loop.hardware
    options = MachineOptions(timing=NO_TIME, tick=0.002, seed=seed)
    machine = Machine(core.task.robot, hardware, options, parameters=parameters, state=state)
    camera = None
    if setting.camera is not None:
        scene = setting.camera.emulated.model_copy(update={"seed": seed})
        camera = setting.camera.model_copy(update={"emulated": scene})
    core.plant = RobotPlant(core.task.robot, 1, plant.options, RobotOptions(), emulated_link(machine, camera))
    with closing(core):
        return _watched(core, machine, setting, seed)


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
    return ChainDrive(time[:, 0], command, sensors, truth, began, estimate, tuple(reasons), loop.reason)


# ---- picture of what camera, optical flow and observer saw -----------------------------------------------------------


#: s of the drive that is drawn, from when on the lens is covered, and for how long.
_SECONDS, _COVERED, _FOR = 12.0, 5.0, 3.0


def draw_chain(drive: ChainDrive, path: Path, title: str) -> None:
    """Draw a drive: errors of position and heading, forward speed, slip of one wheel, age of the camera's pose.

    Args:
        drive: what was seen. path: of the picture. title: of it.
    """
    figure, time, age = new_figure(8.0, 6.8), drive.time, drive.sensed("camera_age")
    axes = figure.subplots(5, 1, sharex=True, height_ratios=(2, 2, 3, 3, 1.5))

    def estimate(name: str) -> Any:
        return ESTIMATE_LAYOUT.view(drive.estimate, name)

    def draw_estimate(axis: Any, true: Array, values: Array, sigma: Array, label: str) -> None:
        """Draw the estimate with 2 sigma on the truth, which is wide and pale: its middle alone is hidden."""
        axis.plot(time, true, color="0.6", lw=4.0, label="truth")
        axis.fill_between(time, values - 2 * sigma, values + 2 * sigma, color=BLUE, alpha=0.2, lw=0, label="2 sigma")
        axis.plot(time, values, color=BLUE, lw=1.2, label="observer")
        low, high = min(true.min(), values.min()), max(true.max(), values.max())
        margin = 0.25 * max(high - low, 0.01)
        axis.set(ylabel=label, ylim=(low - margin, high + margin))

    is_new = drive.sensed("camera_is_new") > 0.5
    exposed = (time - age)[is_new]
    poses = ((0, estimate("position")[:, 0], "error of x\n(mm)"), (2, estimate("yaw"), "error of the\nheading (mrad)"))
    for axis, (k, estimated, label) in zip(axes, poses, strict=False):
        true = drive.true_pose()[:, k]
        seen = drive.sensed("camera_pose")[is_new, k] - np.interp(exposed, time, true)
        axis.plot(exposed, 1e3 * seen, ".", color=ORANGE, ms=3, label="camera, when exposed")
        axis.plot(time, 1e3 * (estimated - true), color=BLUE, lw=1.2, label="observer")
        axis.axhline(0.0, color="black", lw=0.6)
        axis.set_ylabel(label)
    speed, sigma = (estimate(f"linear_velocity_{name}")[:, 0] for name in ("in_body", "sigma"))
    draw_estimate(axes[2], drive.true("linear_velocity_in_body")[:, 0], speed, sigma, "forward speed\n(m/s)")
    axes[2].plot(time, drive.command[:, 0], "--", color=GREY, lw=1.0, label="command")
    if (flows := drive.sensed("flow_is_new") > 0.5).any():
        flow = (drive.sensed("flow")[:, 0] + drive.sensed("gyro")[:, 1]) * drive.true("position")[:, 2]
        axes[2].plot(time[flows], flow[flows], ".", color=GREEN, ms=2, label="flow times height")
    slip, sigma = (estimate(name)[:, 0] for name in ("slip_velocity", "slip_sigma"))
    draw_estimate(axes[3], drive.true("slip_velocity")[:, 0], slip, sigma, f"slip of {WHEELS[0]}\n(m/s)")
    axes[4].plot(time, 1e3 * age, color=ORANGE, lw=1.0)
    axes[4].set(ylabel="age of the\npose (ms)", yscale="log", xlabel="time (s)")
    axes[4].yaxis.set_major_formatter("{x:g}")
    blind = np.array([bool(reason) for reason in drive.reasons])
    for axis in axes:
        shade = {"transform": axis.get_xaxis_transform(), "color": "0.92", "lw": 0, "zorder": 0}
        axis.fill_between(time, 0, 1, where=blind, label="no pose", **shade)
        tidy(axis)
        axis.set_xlim(0, time[-1])
    axes[0].set_title(title, fontsize=10)
    figure.align_ylabels(axes)
    legend_below(figure, columns=3)
    save(figure, path)


def main(arguments: list[str]) -> int:
    """Drive and draw; 0 when done."""
    fault = f"camera_covered after={_COVERED:g} duration={_FOR:g}"
    setting = ChainSetting("velocity_slip_aware", "split", chain_camera(), _SECONDS, (fault,))
    drive = drive_chain(setting, _FIRST_SEED)
    title = "Emulated robot on a split floor; rendered frames, 40 ms latency, 10 % lost; lens covered from 5 to 8 s"
    draw_chain(drive, Path(arguments[0]), title)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
