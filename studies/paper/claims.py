"""The paper's claims that a simulation can check: what it says, what comes out here, and whether that is the same.

Verdicts: ``holds``, ``does not hold``, ``partly``, ``open`` (depends on something the paper does not give; see
:mod:`studies.paper.slip_search`). Every claim states what it would take to hold; the verdict follows from the numbers, but for
the three that are about words or counting (3, 9, 25).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from studies.paper import printed, reduced
from studies.paper.experiments import (
    DURATION,
    LEG_SPEED,
    TESTS,
    WHEEL_ACCELERATION,
    WHEEL_SPEED,
    IdealMotion,
    PaperTest,
    Record,
    drive,
    error_of_ignoring_slip,
    ideal_motion,
    no_slip_travel,
)
from studies.paper.quantities import State
from studies.tables import markdown_table
from wlr_gym.physics.effects import Patch, apply_patch, load_patch
from wlr_gym.robot import LEG_SLICE, WHEEL_SLICE, Robot
from wlr_gym.robot.parameters import Parameters

#: N m; dry friction added to the gear of each free rear wheel, so that there is slip to speak of.
DRAG = 0.07
#: Straight on, in the posture the first test starts with: most of the weight on the rear wheels.
_STRAIGHT = PaperTest("straight", "legs at 30 degrees", TESTS["test_1"].start, TESTS["test_1"].start)


def _drag(left: float = DRAG, right: float = DRAG) -> list[dict[str, object]]:
    return [
        {"name": "coulomb_friction", "where": [wheel], "parameters": {"torque": torque}}
        for wheel, torque in (("wheel_lr", left), ("wheel_rr", right))
    ]


def _with(name: str, where: Sequence[str], **parameters: float) -> dict[str, object]:
    return {"name": name, "where": list(where), "parameters": parameters}


#: Robots of the side experiments: label -> patch. "drag" is what each of the others is compared with.
VARIANTS: Mapping[str, Patch] = {
    "drag": load_patch(_drag()),
    "mu 0.3": load_patch([*_drag(), _with("friction_level", ["ground"], mu=0.3)]),
    "mu 0.9": load_patch([*_drag(), _with("friction_level", ["ground"], mu=0.9)]),
    "centre of mass 3 cm back": load_patch([*_drag(), _with("com_offset", ["body"], x=-0.03)]),
    "centre of mass 3 cm ahead": load_patch([*_drag(), _with("com_offset", ["body"], x=0.03)]),
    "2 kg more": load_patch([*_drag(), _with("payload", ["body"], mass=2.0)]),
    "more drag left": load_patch(_drag(0.12, 0.02)),
    "left front wheel 2 % small": load_patch([_with("wheel_radius_error", ["wheel_lf"], scale=0.98)]),
}


def variant_row(label: str) -> int:
    """Return which robot of a record of the variants has this label."""
    return list(VARIANTS).index(label)


@dataclass(frozen=True, eq=False)
class PaperEvidence:
    """What claims are checked with.

    Attributes:
        robot: nominal. plant: records of both tests on one simulator. ideal: both tests without slip.
        variants: both tests with :data:`VARIANTS`, one robot each. free, driven: yaw (rad) at the end of a straight drive, rear
            wheels free or driven, of two robots: left wheel 5 % small and right one 5 % large, behind or in front.
    """

    robot: Robot
    plant: Mapping[str, Record]
    ideal: Mapping[str, IdealMotion]
    variants: Mapping[str, Record]
    free: tuple[float, float]
    driven: tuple[float, float]

    def variant_error(self, test: str, label: str) -> float:
        """Error of ignoring slip of one of the variants."""
        return float(error_of_ignoring_slip(self.robot, self.variants[test])[variant_row(label)])


def gather(robot: Robot, plant: Mapping[str, Record], threads: int = 1) -> PaperEvidence:
    """Make the side experiments on the Gibbs-Appell engine; ``plant``: both tests on a nominal robot."""
    nominal = Parameters.nominal(robot)
    rows = Parameters(np.concatenate([apply_patch(patch, nominal).values for patch in VARIANTS.values()]))
    variants = {name: drive("gibbs_appell", test, robot, rows, threads=threads) for name, test in TESTS.items()}
    unequal = [
        load_patch([_with("wheel_radius_error", [left], scale=0.95), _with("wheel_radius_error", [right], scale=1.05)])
        for left, right in (("wheel_lr", "wheel_rr"), ("wheel_lf", "wheel_rf"))
    ]
    uneven = Parameters(np.concatenate([apply_patch(patch, nominal).values for patch in unequal]))
    yaw = []
    for rear_driven in (False, True):
        record = drive("gibbs_appell", replace(_STRAIGHT, rear_driven=rear_driven), robot, uneven, threads=threads)
        behind, in_front = map(float, record.attitude[-1, :, 0])
        yaw.append((behind, in_front))
    ideal = {name: ideal_motion(test) for name, test in TESTS.items()}
    return PaperEvidence(robot, plant, ideal, variants, *yaw)


# ---- claims ----------------------------------------------------------------------------------------------------------


HOLDS = "holds"
FAILS = "does not hold"
PARTLY = "partly"
OPEN = "open"
#: rev/min in 1 rad/s.
_RPM = 60.0 / (2.0 * math.pi)


@dataclass(frozen=True)
class CheckedClaim:
    """One claim: number, what is claimed, the paper's number, when it holds, what came out here, and the verdict."""

    number: int
    text: str
    paper: str
    holds_if: str
    ours: str
    verdict: str


#: What came out, and the verdict.
Finding = tuple[str, str]
#: Number of a claim -> how it is checked, in the paper's order.
CLAIMS: dict[int, Callable[[PaperEvidence], CheckedClaim]] = {}


def _claim(number: int, text: str, paper: str, holds_if: str) -> Callable[[Callable[[PaperEvidence], Finding]], None]:
    """Let a function check a claim."""

    def add(check: Callable[[PaperEvidence], Finding]) -> None:
        CLAIMS[number] = lambda evidence: CheckedClaim(number, text, paper, holds_if, *check(evidence))

    return add


def check_all(evidence: PaperEvidence) -> list[CheckedClaim]:
    """Check every claim of :data:`CLAIMS`."""
    return [check(evidence) for check in CLAIMS.values()]


def claims_table(claims: Sequence[CheckedClaim]) -> list[str]:
    """Return checked claims as lines of a Markdown table."""
    rows = [(c.number, c.text, c.paper, c.holds_if, c.ours, f"**{c.verdict}**") for c in claims]
    return markdown_table(("#", "claim", "paper", "holds if", "here", "verdict"), rows)


# ---- the checks ------------------------------------------------------------------------------------------------------


def _graded(holds: bool, partly: bool = False) -> str:
    """The whole of a claim, a part of it, or nothing."""
    return HOLDS if holds else PARTLY if partly else FAILS


def _after(record: Record, time: float) -> int:
    return int(np.searchsorted(record.time, time - 1e-9))


def _slip_error(e: PaperEvidence, test: str, paper: float) -> Finding:
    error = 100 * float(error_of_ignoring_slip(e.robot, e.plant[test])[0])
    near = abs(abs(error) - paper) < 1.5
    return f"{error:.2f} % with rigid Coulomb friction", HOLDS if near else OPEN


_claim(1, "ignoring slip gives an error, first test", "11.5 %", "error within 1.5 points, either sign")(
    partial(_slip_error, test="test_1", paper=11.5)
)
_claim(2, "the same, second test", "5 %", "the same")(partial(_slip_error, test="test_2", paper=5.0))


@_claim(3, "the error is that of neglecting slip", "-", "one of the two is meant")
def _wording(e: PaperEvidence) -> Finding:
    return "abstract: error of neglecting slip; conclusion: of a constant slip coefficient. One number cannot be both", FAILS


@_claim(4, "lateral displacement", "1.1 and 5.2 cm", "both within 5 mm")
def _lateral(e: PaperEvidence) -> Finding:
    own = [1000 * abs(float(e.plant[test].end[0, 1])) for test in TESTS]
    k = variant_row("more drag left")
    uneven = [100 * float(e.variants[test].end[k, 1]) for test in TESTS]
    return (
        f"{own[0]:.3f} and {own[1]:.3f} mm on a symmetric robot; {uneven[0]:.1f} and {uneven[1]:.1f} cm with unequal rear drag",
        HOLDS if all(abs(a - 1000 * test.lateral) < 5.0 for a, test in zip(own, TESTS.values(), strict=True)) else OPEN,
    )


def _half_way(record: Record, robot: int) -> float:
    """Share of the path after which half of the final lateral displacement is reached."""
    x, y = record.position[:, robot, 0], np.abs(record.position[:, robot, 1])
    reached = int(np.argmax(y >= 0.5 * y[-1]))
    return float(x[reached] / x[-1])


@_claim(
    5, "first test: lateral displacement at the beginning, when the wheels slip", "-",
    "half of it in the first third of the path; partly: front axle below a quarter of the weight",
)  # fmt: skip
def _early_drift(e: PaperEvidence) -> Finding:
    record = e.variants["test_1"]
    share = _half_way(record, variant_row("more drag left"))
    load = float(e.plant["test_1"].force[_after(e.plant["test_1"], 0.0), 0, :2, 2].sum())
    portion = load / (e.robot.total_mass * e.robot.gravity)
    return (
        f"front axle carries {100 * portion:.0f} % of the weight at first; with unequal rear drag the rear wheels slip "
        f"while the legs turn, but half of the drift comes after {100 * share:.0f} % of the path",
        _graded(share < 1 / 3, partly=portion < 0.25),
    )


@_claim(6, "second test: large lateral displacement at the end of the path", "-", "half of it in the last third of the path")
def _late_drift(e: PaperEvidence) -> Finding:
    record = e.variants["test_2"]
    share = _half_way(record, variant_row("left front wheel 2 % small"))
    base = float(e.ideal["test_2"].posture.wheelbase[-1])
    return (
        f"with unequal front wheels half of it comes after {100 * share:.0f} % of the path; wheelbase {base:.3f} m at the end",
        _graded(share > 2 / 3, partly=share > 0.5),
    )


@_claim(7, "posture strongly changes slip", "-", "first test's error over three times the second's, and a point")
def _posture_and_slip(e: PaperEvidence) -> Finding:
    errors = [100 * e.variant_error(test, "drag") for test in TESTS]
    loads = [float(e.ideal[test].inverse_dynamics().normal[0, 0]) for test in TESTS]
    return (
        f"front load per wheel at the start {loads[0]:.2f} and {loads[1]:.2f} N; with {DRAG + 0.03:.2f} N m of rear drag "
        f"{errors[0]:.1f} % and {errors[1]:.1f} %",
        _graded(abs(errors[0]) > 3 * abs(errors[1]) + 1),
    )


@_claim(8, "equipment at the body's centre reduces slip", "-", "least error when centred")
def _centre_of_mass(e: PaperEvidence) -> Finding:
    labels = ("centre of mass 3 cm back", "drag", "centre of mass 3 cm ahead")
    errors = [100 * e.variant_error("test_1", label) for label in labels]
    at_centre_least = abs(errors[1]) < min(abs(errors[0]), abs(errors[2]))
    said = f"first test, 3 cm back, centred, 3 cm ahead: {errors[0]:.1f}, {errors[1]:.1f}, {errors[2]:.1f} %"
    return said, _graded(at_centre_least)


@_claim(9, "leg angles reduce the friction coefficient", "-", "mu depends on the legs")
def _coefficient(e: PaperEvidence) -> Finding:
    c = reduced.constants_of(Parameters.nominal(e.robot))
    start = State(alpha=TESTS["test_1"].start[0], beta=TESTS["test_1"].start[1])
    as_printed = replace(c, m_l=c.m_l + c.m_w, m_w=0.0)  # legs and wheels as one mass at mid-leg
    end = State(alpha=TESTS["test_1"].end[0], beta=TESTS["test_1"].end[1])
    loads = [float(np.ravel(printed.eq16_normal_force_in_front(as_printed, s))[0]) for s in (start, end)]
    return f"mu is the floor's; the force limit mu F_n changes: front {loads[0]:.2f} to {loads[1]:.2f} N times mu", FAILS


@_claim(
    10, "four wheel turns; 18.32 rpm, 214.58 rev/min2, 3.44 rpm", "4 turns",
    "every wheel within 0.05 of four turns; partly: the front ones",
)  # fmt: skip
def _four_turns(e: PaperEvidence) -> Finding:
    turns = np.array([e.plant[test].joint_position[-1, 0, WHEEL_SLICE] / (2 * math.pi) for test in TESTS])
    four = np.abs(turns - 4.0) < 0.05
    return (
        f"{WHEEL_SPEED * _RPM:.2f} rpm = 80 counts, {WHEEL_ACCELERATION * 3600 / (2 * math.pi):.2f} rev/min2 = 1 count, "
        f"{LEG_SPEED * _RPM:.3f} rpm = 15 counts; front {turns[0][0]:.2f} and {turns[1][0]:.2f} turns, "
        f"rear {turns[0][2]:.2f} and {turns[1][2]:.2f}",
        _graded(bool(four.all()), partly=bool(four[:, :2].all())),
    )


@_claim(11, "rear wheel speed grows with the body's", "-", "grows, never backwards; partly: grows")
def _rear_speed(e: PaperEvidence) -> Finding:
    record = e.plant["test_1"]
    speed = record.joint_velocity[:, 0, 6] * _RPM
    backwards = float(speed[_after(record, 0.0) : _after(record, 1.0)].min())
    later = speed[[_after(record, 2.0), _after(record, 5.0)]]
    grows = later[0] < later[1] < speed[_after(record, 10.0)]
    return (
        f"first test: {backwards:.1f} rpm, backwards, at first; {later[0]:.1f} at 2 s, {later[1]:.1f} at 5 s",
        _graded(grows and backwards > -1.0, partly=grows),
    )


@_claim(12, "second test: motors 5 and 8 stop when the legs are done", "0", "below 1 rpm at 6.5 s")
def _rear_stops(e: PaperEvidence) -> Finding:
    record = e.plant["test_2"]
    at = _after(record, 6.5)
    speed = float(record.joint_velocity[at, 0, 6]) * _RPM
    said = f"{speed:.1f} rpm at 6.5 s; they stop with the front wheels at {DURATION:.1f} s"
    return said, _graded(abs(speed) < 1.0)


@_claim(13, "leg motors stop at the end of their rotation", "-", "within 0.15 s of the profile")
def _legs_stop(e: PaperEvidence) -> Finding:
    record = e.plant["test_1"]
    moving = np.abs(record.joint_velocity[:, 0, 2]) > 0.1 * LEG_SPEED
    last = float(record.time[moving].max(initial=0.0))
    profile = math.radians(120) / LEG_SPEED
    return f"{last:.2f} s (120 degrees at 15 counts: {profile:.2f} s)", _graded(abs(last - profile) < 0.15)


@_claim(14, "leg torque falls as the body stabilises", "-", "less at the end than at the start; partly: one axle")
def _leg_torque(e: PaperEvidence) -> Finding:
    torque = e.ideal["test_1"].inverse_dynamics().leg_torque / 2
    less = np.abs(torque[-1]) < np.abs(torque[0])
    return (
        f"first test, one motor: front {torque[0, 0]:.2f} to {torque[-1, 0]:.2f}, rear {torque[0, 1]:.2f} to "
        f"{torque[-1, 1]:.2f} N m, through 0 on the way",
        _graded(bool(less.all()), partly=bool(less.any())),
    )


@_claim(15, "a small torque on the free rear wheels from legs and surface", "small", "below 2 % of the stall torque")
def _free_wheel_torque(e: PaperEvidence) -> Finding:
    largest = max(float(np.abs(e.ideal[test].u_dot[:, 9:]).max()) * e.ideal[test].constants.I_o for test in TESTS)
    return (
        f"motor 0; I_o theta'' of the rear wheels up to {1000 * largest:.1f} mN m in a 0.1 s leg start, else their drag",
        _graded(largest < 0.02 * e.robot.servo.wheel.stall_torque),
    )


@_claim(16, "wheel motors need little torque", "small", "below 5 % of the stall torque")
def _wheel_torque(e: PaperEvidence) -> Finding:
    away = []
    for test in TESTS:
        motion = e.ideal[test]
        calm = (motion.time > 0.3) & (np.abs(motion.time - 5.87) > 0.2)
        away.append(float(np.abs(motion.inverse_dynamics().wheel_torque[calm, :2]).max()))
    ours = float(np.abs(e.plant["test_1"].torque[e.plant["test_1"].time > 1.0][:, 0, 4:6]).mean())
    return f"up to {1000 * max(away):.1f} mN m without any drag; {ours:.3f} N m with the nominal gears", _graded(
        ours < 0.05 * e.robot.servo.wheel.stall_torque
    )


@_claim(17, "the body's height changes", "-", "over 1 cm in both tests")
def _height(e: PaperEvidence) -> Finding:
    rise = [100 * float(np.ptp(e.ideal[test].posture.height)) for test in TESTS]
    own = [100 * float(np.ptp(e.plant[test].position[:, 0, 2])) for test in TESTS]
    return f"{rise[0]:.2f} and {rise[1]:.2f} cm by geometry; {own[0]:.2f} and {own[1]:.2f} cm with legs that give", _graded(
        min(rise + own) > 1.0
    )


@_claim(18, "the body pitches in the tests", "-", "over 1 degree in both tests; partly: in one")
def _pitch(e: PaperEvidence) -> Finding:
    most = [math.degrees(float(e.ideal[test].posture.pitch.max())) for test in TESTS]
    own = [math.degrees(float(np.abs(e.plant[test].attitude[:, 0, 1]).max())) for test in TESTS]
    return f"{most[0]:.2f} (nose down) and {most[1]:.2f} degrees by geometry; {own[0]:.2f} and {own[1]:.2f} simulated", _graded(
        min(own) > 1.0, partly=max(own) > 1.0
    )


@_claim(19, "the body does not roll", "0", "below 0.1 degrees; partly: if symmetric")
def _roll(e: PaperEvidence) -> Finding:
    own = max(math.degrees(float(np.abs(e.plant[test].attitude[:, 0, 2]).max())) for test in TESTS)
    k = variant_row("more drag left")
    uneven = max(math.degrees(float(np.abs(e.variants[test].attitude[:, k, 2]).max())) for test in TESTS)
    force = max(float(np.abs(np.diff(e.variants[test].force[:, k, :, 2])[:, [0, 2]]).max()) for test in TESTS)
    return (
        f"{own:.1e} degrees on a symmetric robot; {uneven:.2f} degrees and up to {force:.1f} N between left and right with "
        "unequal drag",
        _graded(max(own, uneven) < 0.1, partly=own < 0.1),
    )


@_claim(20, "Webots and MATLAB agree", "-", "within 1 cm")
def _two_simulations(e: PaperEvidence) -> Finding:
    record = e.plant["test_2"]
    apart = 100 * float(no_slip_travel(e.robot, record, True)[-1, 0] - no_slip_travel(e.robot, record, False)[-1, 0])
    return (
        f"a joint's angle is relative to its leg, that of (3) is not: if MATLAB ran (3) as printed, {apart:.1f} cm apart in "
        "the second test",
        _graded(abs(apart) < 1.0),
    )


@_claim(21, "a heavier robot slips less", "-", "less slip with 2 kg more, against any cause; partly: against drag")
def _heavier(e: PaperEvidence) -> Finding:
    light, heavy = (100 * e.variant_error("test_1", label) for label in ("drag", "2 kg more"))
    return (
        f"against gear drag, yes: {light:.1f} to {heavy:.1f} % with 2 kg more; inertia alone does not slip at any mass",
        _graded(False, partly=abs(heavy) < abs(light)),
    )


@_claim(22, "tyres or floor with more friction reduce slip", "-", "less with every step of mu")
def _grip(e: PaperEvidence) -> Finding:
    errors = [100 * e.variant_error("test_1", label) for label in ("mu 0.3", "drag", "mu 0.9")]
    less = abs(errors[2]) < abs(errors[1]) < abs(errors[0])
    said = f"first test with drag, mu 0.3, 0.6, 0.9: {errors[0]:.1f}, {errors[1]:.1f}, {errors[2]:.1f} %"
    return said, _graded(less)


@_claim(23, "free rear wheels prevent oversteer", "-", "less than half the yaw of driven ones; partly: for one axle")
def _oversteer(e: PaperEvidence) -> Finding:
    free, driven = np.degrees(e.free), np.degrees(e.driven)
    less = np.abs(free) < 0.5 * np.abs(driven)
    return (
        f"straight on, left wheel 5 % small and right one 5 % large: behind, yaw {free[0]:.1f} degrees if the rear wheels are "
        f"free, {driven[0]:.1f} if driven; in front, {free[1]:.1f} and {driven[1]:.1f}",
        _graded(bool(less.all()), partly=bool(less.any())),
    )


@_claim(24, "motors stay within Table II", "7.3 / 1.5 N m, 66 / 61 rpm", "below stall torque and 12 V speed")
def _limits(e: PaperEvidence) -> Finding:
    hip = max(float(np.abs(e.plant[test].torque[..., LEG_SLICE]).max()) for test in TESTS)
    wheel = max(float(np.abs(e.plant[test].torque[..., WHEEL_SLICE]).max()) for test in TESTS)
    rates = [np.abs(e.plant[test].joint_velocity[e.plant[test].time > 0.0]) * _RPM for test in TESTS]
    leg_rate, wheel_rate = (max(float(rate[..., part].max()) for rate in rates) for part in (LEG_SLICE, WHEEL_SLICE))
    return (
        f"hips {hip:.2f} of 7.3 N m and {leg_rate:.1f} rpm, wheels {wheel:.2f} of 1.5 N m and {wheel_rate:.1f} rpm; 66 rpm "
        "belongs to 14.8 V, 53 rpm to 12 V",
        _graded(hip < 7.3 and wheel < 1.5 and leg_rate < 53.0 and wheel_rate < 61.0),
    )


@_claim(25, "Gibbs-Appell needs fewer equations: twelve independent coordinates", "12", "twelve are independent")
def _fewer(e: PaperEvidence) -> Finding:
    return "nine velocities suffice; the twelve are dependent (rank 9), and three equations of the body are missing", FAILS
