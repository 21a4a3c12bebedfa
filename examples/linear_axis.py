"""A system of your own in the gap workflow: a linear axis, its state equation, tolerances, laws to try and columns.

``RIG`` is all that ``wlr gap RUNS --rig examples/linear_axis.py --out report`` needs. Run as a program, it records eight runs
of a simulated axis (another integrator, friction that truly sticks) whose carriage runs harder forward than backward, and
analyses them; the workflow is told none of it. Ten seconds.

    python examples/linear_axis.py [--out FOLDER] [--quick]
"""

import argparse
import math
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

from wlr_gym.gap.rig.own import EffectParameter, MeasuredSignal, Quantity, Rig, RigLaw

#: m/s; from here on dry friction is full.
CREEP = 5e-4
#: m; from one magnet of the motor to the next.
PITCH = 0.03


def change(x, u, p):
    """Rates of position and speed: motor force against dry and viscous friction and the pull of the magnets."""
    direction = math.tanh(x.speed / CREEP)
    force = p.force_constant * u.current - p.viscous * x.speed
    force -= (p.friction + 0.5 * p.difference * direction) * direction
    force -= p.cogging * math.sin(2.0 * math.pi * x.position / PITCH + p.phase)
    return x.speed, force / (p.mass + p.load)


def readings(x, u, p):
    """What the linear encoder reads."""
    return (x.position,)


RIG = Rig(
    name="axis",
    change=change,
    readings=readings,
    states={"position": "position", "speed": "rate of position"},
    inputs={"current": "A"},
    columns=(MeasuredSignal("position", "m", 2e-5, "position"),),
    parameters=(
        Quantity("mass", "kg", nominal=2.0, sigma=0.05, low=1.0, high=4.0),
        Quantity("force_constant", "N/A", nominal=10.0, sigma=0.3, low=5.0, high=20.0),
        Quantity("friction", "N", nominal=3.0, sigma=0.5, low=0.0, high=10.0),
    ),
    laws={
        "asymmetric_friction": RigLaw(
            "friction is larger forward than backward: friction + difference/2 and friction - difference/2",
            {"difference": EffectParameter("N", "forward less backward", -10.0, 10.0, 0.0, (-4.0, 4.0), 1.0)},
        ),
        "viscous_friction": RigLaw(
            "friction that grows with speed: -viscous speed",
            {"viscous": EffectParameter("N s/m", "per speed", 0.0, 100.0, 0.0, (0.0, 20.0), 2.0)},
        ),
        "cogging": RigLaw(
            "the magnets pull: -cogging sin(2 pi position / pitch + phase)",
            {
                "cogging": EffectParameter("N", "amplitude", 0.0, 10.0, 0.0, (0.0, 3.0), 0.5),
                "phase": EffectParameter("rad", "at position 0", -7.0, 7.0, 0.0, (-3.2, 3.2), 0.5, is_size=False),
            },
        ),
        "load": RigLaw(
            "a mass on the carriage",
            {"load": EffectParameter("kg", "more mass", 0.0, 10.0, 0.0, (0.0, 2.0), 0.3)},
        ),
    },
    step=5e-4,
)


def record(folder: Path, difference: float = 1.0, runs: int = 8, seed: int = 0) -> None:
    """Write runs of 5 s of an axis with its numbers off by their tolerances, under position control."""
    rng = np.random.default_rng(seed)
    mass, constant, friction = (
        2.0 + 0.05 * rng.standard_normal(),
        10.0 + 0.3 * rng.standard_normal(),
        3.0 + 0.5 * rng.standard_normal(),
    )
    for k in range(runs):
        t = 0.005 * np.arange(1000) + 2e-4 * rng.uniform(size=1000)
        frequency, phase = rng.uniform(0.2, 1.5, 3), rng.uniform(0.0, 2.0 * np.pi, 3)
        goal = lambda now, f=frequency, q=phase: 0.05 * np.sin(2.0 * np.pi * f * now + q).sum()  # noqa: E731
        position, speed, h, rows = 0.0, 0.0, 1e-4, []
        now, integral = t[0], 0.0
        for row, start in enumerate(t):
            error = goal(start) - position
            integral += 0.005 * error
            current = 40.0 * error + 100.0 * integral - 6.0 * speed
            rows.append((start, current, np.rint((position + 2e-5 * rng.standard_normal()) / 1e-5) * 1e-5))
            until = t[row + 1] if row + 1 < len(t) else start
            while now < until - 1e-9:
                position, speed = _moved(position, speed, constant * current, mass, friction, difference, min(h, until - now))
                now += min(h, until - now)
        pd.DataFrame(rows, columns=["t", "current", "position"]).to_csv(folder / f"run_{k + 1:02d}.csv", index=False)


def _moved(position, speed, push, mass, friction, difference, h):
    """One step of a carriage that sticks: friction stops it within a step, or holds it."""
    forward, backward = friction + 0.5 * difference, friction - 0.5 * difference
    free = speed + h * push / mass
    speed = max(free - h * forward / mass, 0.0) if free > 0.0 else min(free + h * backward / mass, 0.0)
    return position + h * speed, speed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder for the report")
    parser.add_argument("--quick", action="store_true", help="four runs instead of eight")
    options = parser.parse_args()
    from wlr_gym.gap import analyse

    with tempfile.TemporaryDirectory() as folder:
        record(Path(folder), runs=4 if options.quick else 8)
        found = analyse(folder, options.out, rig=__file__)
    print(f"verdict: {found.verdict}")
    for effect in found.effects:
        for name, one in effect.parameters.items():
            print(f"{effect.name}: {name} = {one.value:.3f} {one.unit} [{one.low:.3f}, {one.high:.3f}]")


if __name__ == "__main__":
    main()
