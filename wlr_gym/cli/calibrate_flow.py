"""``wlr calibrate flow``: scale and mounting of the optical-flow sensor, from a run that was recorded straight on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from wlr_gym.base.errors import InputError
from wlr_gym.cli import OK
from wlr_gym.cli.calibrate_robot import save_calibration, source_of, today
from wlr_gym.cli.options import JsonOption
from wlr_gym.cli.results import print_json
from wlr_gym.cli.robot_options import ask_terminal


@dataclass(frozen=True)
class FlowOptions(JsonOption):
    """Find scale and mounting of the optical-flow sensor from a straight run on a floor that grips, driven or pushed.

    Record it with: wlr record --excitation straight

    Attributes:
        run: the run.
        hardware: hardware file (wiring, mounting, safety limits), or name in configs/hardware/.
        robot: robot file, or name in configs/robot/; default: the one that the hardware file names.
        out: hardware file to write; may be the one of --hardware.
        distance: way straight ahead by a tape measure, m (negative: back); default: what the wheels rolled.
        yes: do not ask before the file is written.
    """

    run: Annotated[Path, tyro.conf.Positional]
    out: Path
    hardware: str = "nominal"
    robot: str | None = None
    distance: float | None = None
    yes: bool = False


def calibrate_flow(options: FlowOptions) -> int:
    """Show what was found, ask, and write the file; 1 when the operator stops.

    Raises:
        InputError: a run without flow, too little way, a hardware file that names no flow sensor.
    """
    from wlr_gym.data.read import read_run
    from wlr_gym.hardware.calibration import with_flow_calibration
    from wlr_gym.hardware.config import load_hardware
    from wlr_gym.hardware.flow_comparison import calibrate_flow as find
    from wlr_gym.robot import load_robot

    hardware = load_hardware(options.hardware)
    robot = load_robot(options.robot or hardware.robot or "nominal")
    if hardware.flow is None:
        raise InputError(
            f"--hardware {options.hardware}: names no flow sensor; expected a section flow, such as flow: {{port: ...}}"
        )
    source = source_of(options.hardware, options.out)
    fit = find(read_run(options.run), robot, hardware.flow.calibration, options.distance)
    found = fit.calibration.model_copy(update={"date": today()})
    before = hardware.flow.calibration
    print(
        f"{fit.way:.2f} m in {fit.windows} windows, against {'the wheels' if options.distance is None else 'the tape measure'}"
    )
    print(f"scale     {before.scale:.4f} -> {found.scale:.4f} +- {fit.scale_sigma:.4f}")
    print(f"mount_yaw {before.mount_yaw:.4f} -> {found.mount_yaw:.4f} +- {fit.yaw_sigma:.4f} rad")
    note = f"Flow sensor calibrated by wlr calibrate flow, {today()}: scale, and rotation about body z from body to sensor."
    ask = (lambda text: "y") if options.yes else ask_terminal
    code = save_calibration(options.out, source, lambda file: with_flow_calibration(file, found), "flow", note, ask)
    if options.json and code == OK:
        sigma = {"scale": fit.scale_sigma, "mount_yaw": fit.yaw_sigma}
        print_json({"hardware": options.out, "flow": found.model_dump(mode="json"), "sigma": sigma, "way": fit.way})
    return code
