"""A film of a measured run beside its simulation.

Both sides are drawn from the same channels in the same way: joints from the encoders, x, y and yaw from the camera (smoothed),
height and tilt from the legs, as of a robot with all wheels on a flat floor. Slip is not measured, so none is drawn, and no
friction. Both cameras look at the place of the measured robot, so that a simulated one that drifts is seen to drift.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.read import Run
from wlr_gym.data.replay import ReplayResult
from wlr_gym.data.run_states import measured_state
from wlr_gym.physics.plants.base import TRUTH_LAYOUT, PlantState, Truth, standing_state
from wlr_gym.render.view import View
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

FPS = 12.5
VIEW = View(size=(480, 360), friction=False, slip=False)


def film_length(run: Run) -> int:
    """Return the number of pictures in a run's film."""
    return len(_times(run))


def replay_film(result: ReplayResult, parameters: Parameters, backend: str, view: View = VIEW) -> Iterator[Picture]:
    """Yield pictures at :data:`FPS`: the recorded run at the left, its simulation from start to end at the right.

    Args:
        result: the run and its replay.
        parameters: (1) that it was replayed with.
        backend: name of the simulator, for the title.
        view: what to show.
    """
    from wlr_gym.render import side_by_side

    simulated = replace(result.run, table=result.run.table.assign(**result.full))
    times = _times(result.run)
    many = Parameters(np.repeat(parameters.values, len(times), axis=0))
    truths = [truth_of(measured_state(run, times, standing_state(result.robot, many), many)) for run in (result.run, simulated)]
    titles = ("recorded: camera and encoders", f"simulated ({backend}): same commands, open loop")
    middle = truths[0].position[:, :2]
    left, right = (_pictures(result, truth, many, times, middle, view) for truth in truths)
    yield from side_by_side(left, right, titles)


def _pictures(
    result: ReplayResult, truth: Truth, parameters: Parameters, times: Array, middle: Array, view: View
) -> Iterator[Picture]:
    from wlr_gym.render import Scene

    scene, name = Scene(result.robot, view), result.run.name
    try:
        for row, time in enumerate(times - times[0]):
            yield scene.draw(truth, parameters, row, time=float(time), title=name, look_at=middle[row])
    finally:
        scene.close()


def truth_of(state: PlantState) -> Truth:
    """Return a truth (N) that knows the motion of ``state`` and nothing else: forces and slip are 0."""
    truth = Truth(np.zeros((len(state), TRUTH_LAYOUT.width)))
    velocities = ("linear_velocity_in_body", "angular_velocity_in_body", "joint_velocity")
    for name in ("position", "quaternion", "joint_position", *velocities):
        truth[name][:] = getattr(state, name)
    return truth


def _times(run: Run) -> Array:
    t = run["t"]
    return np.arange(t[0], t[-1], 1.0 / FPS)
