"""The equations of motion, derived symbolically by the Gibbs-Appell method (docs/derivation.md is the handout).

The robot is a rigid platform with four leg-and-wheel assemblies. With quasi-velocities u and the Gibbs function
S(u'), the "energy of the accelerations", the equations of motion are dS/du' = Q. S is a sum over bodies, so the platform
and ONE assembly at a general hip are derived; a robot is their sum. Nothing else is needed: no Lagrange multipliers, no
kinetic energy, no free-body diagrams.

Quasi-velocities (body frame: x forward, y left, z up, origin at the platform's geometric centre):
    v            velocity of the origin, body frame, m/s
    w            angular velocity of the platform, body frame, rad/s
    leg_rate     ABSOLUTE pitch rate of a leg   = w_y + hip joint rate, rad/s
    wheel_rate   ABSOLUTE spin rate of a wheel  = leg_rate + wheel joint rate, rad/s
Quasi-acceleration of the origin: a0 = v' + w x v - gravity. Gravity is thus an acceleration of the frame, and neither it
nor v occurs anywhere else: M (a0, w', leg_rate', wheel_rate') + bias(w, leg_rate, wheel_rate, q) = Q.

``python -m studies.derivation`` writes ``wlr_gym/physics/model/equations.py``. It needs sympy.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import sympy as sp

# sympy's own annotations are too wide to check against
Expression = Any
Matrix = Any

HALF = sp.Rational(1, 2)
PITCH_AXIS: Matrix = sp.Matrix([0, 1, 0])

# Velocities and accelerations of the platform. "_dot" marks a quasi-acceleration.
W: Matrix = sp.Matrix(sp.symbols("wx wy wz"))
W_DOT: Matrix = sp.Matrix(sp.symbols("wx_dot wy_dot wz_dot"))
A0: Matrix = sp.Matrix(sp.symbols("a0x a0y a0z"))
BASE_ACCELERATIONS = (*A0, *W_DOT)

# Platform: mass, first moment mass * com, inertia tensor about the ORIGIN (so jxy = -integral of x y dm).
PLATFORM_PARAMETERS = sp.symbols("mass cx cy cz jxx jyy jzz jxy jxz jyz")

# Assembly: hip, mass, first and second moment of the mass along the leg, principal inertias, rotor inertias.
ASSEMBLY_PARAMETERS = sp.symbols(
    "hx hy hz mass first_moment second_moment leg_ixx leg_iyy leg_izz wheel_transverse wheel_spin armature_leg armature_wheel"
)
SIN_Q, COS_Q = sp.symbols("sin_q cos_q")
LEG_RATE, WHEEL_RATE = sp.symbols("leg_rate wheel_rate")
LEG_RATE_DOT, WHEEL_RATE_DOT = sp.symbols("leg_rate_dot wheel_rate_dot")
ASSEMBLY_ACCELERATIONS = (*BASE_ACCELERATIONS, LEG_RATE_DOT, WHEEL_RATE_DOT)


@dataclass(frozen=True)
class Equations:
    """``mass_matrix @ accelerations + bias = Q``, one row per quasi-velocity."""

    mass_matrix: Matrix
    bias: Matrix


def appell_equations(gibbs: Expression, accelerations: tuple[sp.Symbol, ...]) -> Equations:
    """Appell's equations dS/du' = Q, split into what is linear in u' (mass matrix) and what is left at u' = 0 (bias)."""
    rows: list[Expression] = [sp.expand(sp.diff(gibbs, acceleration)) for acceleration in accelerations]
    at_rest = dict.fromkeys(accelerations, 0)
    mass_matrix = sp.Matrix([[sp.diff(row, acceleration) for acceleration in accelerations] for row in rows])
    return Equations(mass_matrix, sp.Matrix([row.subs(at_rest) for row in rows]))


def translational_gibbs(mass: Expression, acceleration: Matrix) -> Expression:
    """1/2 m a.a of a mass point (or of a body, with the acceleration of its centre of mass)."""
    return HALF * mass * acceleration.dot(acceleration)


def rotational_gibbs(inertia: Matrix, omega: Matrix, alpha: Matrix) -> Expression:
    """1/2 alpha.I alpha + alpha.(omega x I omega) of a body about its centre of mass (terms without alpha are left out)."""
    return HALF * alpha.dot(inertia * alpha) + alpha.dot(omega.cross(inertia * omega))


def acceleration_at(start: Matrix, offset: Matrix, omega: Matrix, alpha: Matrix) -> Matrix:
    """Acceleration of a point of a rigid body, from the acceleration ``start`` of the body's point ``offset`` away from it."""
    return start + alpha.cross(offset) + omega.cross(omega.cross(offset))


def inertia_about_origin(mass: Expression, com: Matrix) -> Matrix:
    """What a mass point at ``com`` adds to the inertia tensor about the origin (parallel axes)."""
    return mass * (com.dot(com) * sp.eye(3) - com * com.T)


def derive_platform() -> Equations:
    """The platform's share in the rows (a0, w'): mass matrix 6 x 6 and bias."""
    mass, cx, cy, cz, jxx, jyy, jzz, jxy, jxz, jyz = PLATFORM_PARAMETERS
    com = sp.Matrix([cx, cy, cz]) / mass
    about_origin = sp.Matrix([[jxx, jxy, jxz], [jxy, jyy, jyz], [jxz, jyz, jzz]])
    about_com = about_origin - inertia_about_origin(mass, com)
    gibbs = translational_gibbs(mass, acceleration_at(A0, com, W, W_DOT)) + rotational_gibbs(about_com, W, W_DOT)
    return appell_equations(gibbs, BASE_ACCELERATIONS)


def leg_frame() -> tuple[Matrix, Matrix]:
    """Unit vectors of the leg in the body frame: from hip to wheel, and across it (x of a leg that hangs down)."""
    return sp.Matrix([COS_Q, 0, -SIN_Q]), sp.Matrix([SIN_Q, 0, COS_Q])


def rotation(rate: Expression, rate_dot: Expression) -> tuple[Matrix, Matrix]:
    """Angular velocity and acceleration of a leg or a wheel, which turns on the pitch axis relative to the platform.

    The components change in the turning body frame, hence w x.
    """
    omega = sp.Matrix([W[0], rate, W[2]])
    return omega, sp.Matrix([W_DOT[0], rate_dot, W_DOT[2]]) + W.cross(omega)


def acceleration_along_leg(distance: Expression) -> Matrix:
    """Acceleration of the leg's point ``distance`` from the hip: affine in the distance."""
    hip = sp.Matrix(ASSEMBLY_PARAMETERS[:3])
    axis, _ = leg_frame()
    return acceleration_at(acceleration_at(A0, hip, W, W_DOT), distance * axis, *rotation(LEG_RATE, LEG_RATE_DOT))


def translation_by_moments() -> Expression:
    """Translational Gibbs function of all mass on the leg line (leg at its centre of mass, wheel at the leg's end).

    The acceleration is affine in the distance rho, so 1/2 sum m a.a is a polynomial of degree 2 in rho: the masses enter
    only through sum m, sum m rho and sum m rho^2.
    """
    mass, first_moment, second_moment = ASSEMBLY_PARAMETERS[3:6]
    rho = sp.Symbol("rho")
    per_unit_mass = sp.Poly(translational_gibbs(sp.Integer(1), acceleration_along_leg(rho)), rho)
    constant, linear, quadratic = (per_unit_mass.coeff_monomial(rho**power) for power in range(3))
    assert per_unit_mass.degree() == 2
    return mass * constant + first_moment * linear + second_moment * quadratic


def rotation_of_assembly() -> Expression:
    """Rotational Gibbs function of leg, wheel and the two rotors.

    Rotors count with the square of the joint's RELATIVE acceleration; their gyroscopic moments are left out, as the usual
    "armature" of robot simulators does.
    """
    leg_ixx, leg_iyy, leg_izz, transverse, spin, armature_leg, armature_wheel = ASSEMBLY_PARAMETERS[6:]
    axis, across = leg_frame()
    leg_inertia = leg_ixx * across * across.T + leg_iyy * PITCH_AXIS * PITCH_AXIS.T + leg_izz * axis * axis.T
    rotors = armature_leg * (LEG_RATE_DOT - W_DOT[1]) ** 2 + armature_wheel * (WHEEL_RATE_DOT - LEG_RATE_DOT) ** 2
    leg = rotational_gibbs(leg_inertia, *rotation(LEG_RATE, LEG_RATE_DOT))
    wheel = rotational_gibbs(sp.diag(transverse, spin, transverse), *rotation(WHEEL_RATE, WHEEL_RATE_DOT))
    return leg + wheel + HALF * rotors


def derive_assembly() -> Equations:
    """One leg with its wheel: mass matrix 8 x 8 and bias in the rows (a0, w', leg_rate', wheel_rate')."""
    return appell_equations(translation_by_moments() + rotation_of_assembly(), ASSEMBLY_ACCELERATIONS)


def is_zero(expression: Expression) -> bool:
    """True if the expression vanishes identically, given sin^2 + cos^2 = 1."""
    numerator = sp.numer(sp.together(sp.expand(expression)))
    return sp.rem(sp.expand(numerator), COS_Q**2 + SIN_Q**2 - 1, COS_Q) == 0


# ---- equations.py ----------------------------------------------------------------------------------------------------

# The derivation gives each entry of M and the bias as an expanded polynomial. Here the same entries are written with shared
# sub-expressions (products of parameters apart, leg rotation resolved in the leg's own frame), which costs a fraction of the
# operations; each entry is PROVED identical to the derived one before anything is written.


TARGET = Path(__file__).parents[1] / "wlr_gym" / "physics" / "model" / "equations.py"
BASE = range(6)
LEG = 6
WHEEL = 7
RESULT_KINDS = {"base_mass": "Entries", "base_bias": "Rows", "leg_coupling": "Rows"}

HEADER = '''"""Mass matrix and bias of the robot's equations of motion.

Generated by ``python -m studies.derivation`` from the Gibbs function in ``studies/derivation.py``,
every entry proved identical to dS/du' there. Do not edit: a test compares this file with what the generator writes.

    M (a0; w'; leg_rate'; wheel_rate') + bias = Q,     a0 = v' + w x v - gravity  (body frame)

Straight-line code with + - * only: arguments may be floats, numpy arrays that broadcast, or traced nodes. SI units, body
frame. Rows and columns 0..5 are a0 and w'. A robot is the platform plus one assembly per leg.
"""

from __future__ import annotations

from typing import Any

Value = Any  # float | numpy array | traced node
Entries = dict[tuple[int, int], Value]
Rows = dict[int, Value]
'''

PLATFORM_DOC = '''"""Return the platform's share of M and of the bias.

    Args:
        mass: kg.
        cx, cy, cz: first moment mass * com, kg m.
        jxx, jyy, jzz, jxy, jxz, jyz: inertia tensor about the body ORIGIN (jxy = -integral of x y dm), kg m2.
        wx, wy, wz: angular velocity, rad/s.

    Returns:
        Non-zero entries {(row, column): value} with row <= column of the 6 x 6 mass matrix, and {row: value} of the bias.
    """'''

ASSEMBLY_DOC = '''"""Return the share of one leg with its wheel in M and in the bias.

    Args:
        hx, hy, hz: hip, m.
        mass, first_moment, second_moment: sum m (kg), sum m rho (kg m), sum m rho^2 (kg m2) of the leg (at its centre of mass)
            and the wheel (at the leg's end), rho = distance from the hip.
        leg_ixx, leg_iyy, leg_izz: leg about its own centre of mass, leg straight down, kg m2.
        wheel_transverse, wheel_spin: wheel across and about its axle, kg m2.
        armature_leg, armature_wheel: rotor inertia at the joint, kg m2.
        sin_q, cos_q: of the leg angle (0 forward, pi/2 down).
        wx, wy, wz, leg_rate, wheel_rate: angular velocity; absolute pitch rate of leg and wheel, rad/s.

    Returns:
        base_mass, base_bias: as ``platform_terms``. leg_coupling: column leg_rate' of M, rows 0..5 (column wheel_rate' has
        none). leg_leg, leg_wheel, wheel_wheel: entries of M. leg_bias, wheel_bias.
    """'''


@dataclass
class Program:
    """Straight-line code: named intermediates in order, then the results by (row, column) of M and by row of the bias."""

    steps: dict[sp.Symbol, Expression] = field(default_factory=dict)
    mass_matrix: dict[tuple[int, int], Expression] = field(default_factory=dict)
    bias: dict[int, Expression] = field(default_factory=dict)

    def let(self, name: str, expression: Expression) -> sp.Symbol:
        """Add an intermediate and return its symbol."""
        symbol = sp.Symbol(name)
        self.steps[symbol] = expression
        return symbol

    def expand(self, expression: Expression) -> Expression:
        """Put every intermediate's definition back in."""
        for symbol, definition in reversed(self.steps.items()):
            expression = expression.subs(symbol, definition)
        return expression


def rate_products(program: Program) -> tuple[sp.Symbol, ...]:
    """Products of the angular velocity's components: xy, xz, yz and the three centripetal sums."""
    wx, wy, wz = W
    xx, yy, zz = program.let("xx", wx * wx), program.let("yy", wy * wy), program.let("zz", wz * wz)
    xy, xz, yz = program.let("xy", wx * wy), program.let("xz", wx * wz), program.let("yz", wy * wz)
    sums = program.let("yy_zz", yy + zz), program.let("xx_zz", xx + zz), program.let("xx_yy", xx + yy)
    return xy, xz, yz, *sums


def centripetal(products: tuple[sp.Symbol, ...], x: Expression, y: Expression, z: Expression) -> tuple[Expression, ...]:
    """w x (w x r)."""
    xy, xz, yz, yy_zz, xx_zz, xx_yy = products
    return xy * y + xz * z - yy_zz * x, xy * x + yz * z - xx_zz * y, xz * x + yz * y - xx_yy * z


def platform_program() -> Program:
    """The platform with first moment c and inertia J about the origin: force w x (w x c), moment w x (J w)."""
    mass, cx, cy, cz, jxx, jyy, jzz, jxy, jxz, jyz = PLATFORM_PARAMETERS
    wx, wy, wz = W
    p = Program()
    products = rate_products(p)
    lx = p.let("lx", jxx * wx + jxy * wy + jxz * wz)
    ly = p.let("ly", jxy * wx + jyy * wy + jyz * wz)
    lz = p.let("lz", jxz * wx + jyz * wy + jzz * wz)
    p.mass_matrix = {(row, row): mass for row in range(3)} | {
        (0, 4): cz, (0, 5): -cy, (1, 3): -cz, (1, 5): cx, (2, 3): cy, (2, 4): -cx,
        (3, 3): jxx, (3, 4): jxy, (3, 5): jxz, (4, 4): jyy, (4, 5): jyz, (5, 5): jzz,
    }  # fmt: skip
    p.bias = dict(enumerate((*centripetal(products, cx, cy, cz), wy * lz - wz * ly, wz * lx - wx * lz, wx * ly - wy * lx)))
    return p


def assembly_program() -> Program:
    """One leg with its wheel: force F on it and moment T about its hip, resolved along and across the leg."""
    (hx, hy, hz, mass, first_moment, second_moment, leg_ixx, leg_iyy, leg_izz, wheel_transverse, wheel_spin,
     armature_leg, armature_wheel) = ASSEMBLY_PARAMETERS  # fmt: skip
    wx, wy, wz = W
    p = Program()

    # Parameters only: constant during a run.
    mx, my, mz = p.let("mx", mass * hx), p.let("my", mass * hy), p.let("mz", mass * hz)
    mxx, myy, mzz = p.let("mxx", mx * hx), p.let("myy", my * hy), p.let("mzz", mz * hz)
    across_hip = p.let("across_hip", second_moment + leg_ixx)  # about the hip, across the leg in its plane
    pitch_hip = p.let("pitch_hip", second_moment + leg_iyy)  # about the hip axis
    slender = p.let("slender", across_hip - leg_izz)
    fixed = p.let("fixed", leg_izz + wheel_transverse + myy)
    fixed_x, fixed_z = p.let("fixed_x", fixed + mzz), p.let("fixed_z", fixed + mxx)
    gyro_across, gyro_along = p.let("gyro_across", pitch_hip - leg_izz), p.let("gyro_along", leg_iyy - leg_ixx)

    # First moment about the hip: (forward, 0, -drop); its products with the hip position.
    forward, drop = p.let("forward", first_moment * COS_Q), p.let("drop", first_moment * SIN_Q)
    hx_forward, hz_drop = p.let("hx_forward", hx * forward), p.let("hz_drop", hz * drop)
    slender_sin = p.let("slender_sin", slender * SIN_Q)
    slender_sin_sin = p.let("slender_sin_sin", slender_sin * SIN_Q)
    p.mass_matrix = {(row, row): mass for row in range(3)} | {
        (0, 4): mz, (0, 5): -my, (1, 3): drop - mz, (1, 5): mx + forward, (2, 3): my, (2, 4): -mx,
        (3, 3): fixed_x + slender_sin_sin - 2 * hz_drop,
        (3, 4): -mx * hy,
        (3, 5): slender_sin * COS_Q - mx * hz + hx * drop - hz * forward,
        (4, 4): mxx + mzz + armature_leg,
        (4, 5): -my * hz,
        (5, 5): fixed_z + slender - slender_sin_sin + 2 * hx_forward,
        (0, LEG): -drop, (2, LEG): -forward, (3, LEG): -hy * forward, (4, LEG): hx_forward - hz_drop - armature_leg,
        (5, LEG): hy * drop,
        (LEG, LEG): pitch_hip + armature_leg + armature_wheel, (LEG, WHEEL): -armature_wheel,
        (WHEEL, WHEEL): wheel_spin + armature_wheel,
    }  # fmt: skip

    # Acceleration of the hip and, per unit length, of the leg relative to it, both at u' = 0.
    hip_x, hip_y, hip_z = (
        p.let(f"hip_{axis}", value) for axis, value in zip("xyz", centripetal(rate_products(p), hx, hy, hz), strict=True)
    )
    joint_rate = p.let("joint_rate", LEG_RATE - wy)
    along, across = p.let("along", COS_Q * wx - SIN_Q * wz), p.let("across", SIN_Q * wx + COS_Q * wz)  # of w
    towards_hip = p.let("towards_hip", LEG_RATE * LEG_RATE + across * across)
    sideways = p.let("sideways", along * across)
    force_x = p.let("force_x", mass * hip_x - forward * towards_hip + drop * sideways)
    force_y = p.let("force_y", mass * hip_y + first_moment * ((LEG_RATE + joint_rate) * along))
    force_z = p.let("force_z", mass * hip_z + drop * towards_hip + forward * sideways)

    # Moment about the hip: Euler's equations in the leg's frame, lever of the hip's acceleration, wheel's gyroscopic moment.
    moment_across = p.let("moment_across", along * (across_hip * joint_rate + gyro_across * LEG_RATE))
    moment_along = p.let("moment_along", across * (leg_izz * joint_rate + gyro_along * LEG_RATE))
    gyro_wheel = p.let("gyro_wheel", wheel_transverse * wy - wheel_spin * WHEEL_RATE)
    moment_x = SIN_Q * moment_across - COS_Q * moment_along + drop * hip_y + gyro_wheel * wz
    moment_z = COS_Q * moment_across + SIN_Q * moment_along + forward * hip_y - gyro_wheel * wx
    p.bias = {
        0: force_x, 1: force_y, 2: force_z,
        3: moment_x + hy * force_z - hz * force_y, 4: hz * force_x - hx * force_z, 5: moment_z + hx * force_y - hy * force_x,
        LEG: -(drop * hip_x) - forward * hip_z - slender * sideways,
    }  # fmt: skip
    return p


def prove(program: Program, derived: Equations) -> None:
    """Raise ArithmeticError unless the program equals the derived equations entry by entry, zeros included."""
    size = derived.bias.rows
    for row in range(size):
        for column in range(row, size):
            entry = program.mass_matrix.get((row, column), sp.Integer(0))
            _require_equal(f"M[{row}, {column}]", program.expand(entry), derived.mass_matrix[row, column])
            _require_equal(f"M[{column}, {row}]", program.expand(entry), derived.mass_matrix[column, row])
        _require_equal(f"bias[{row}]", program.expand(program.bias.get(row, sp.Integer(0))), derived.bias[row])


def _require_equal(name: str, written: Expression, derived: Expression) -> None:
    if not is_zero(written - derived):
        raise ArithmeticError(f"{name} is written as {sp.expand(written)}, but dS/du' gives {derived}")


class Printer:
    """Prints expressions with parameters first, so that left-to-right evaluation keeps products of parameters apart."""

    def __init__(self, program: Program, parameters: tuple[sp.Symbol, ...]) -> None:
        self.constants: set[sp.Basic] = set(parameters)
        for symbol, definition in program.steps.items():
            if definition.free_symbols <= self.constants:
                self.constants.add(symbol)

    def text(self, expression: Expression) -> str:
        """Python source of a polynomial, without powers."""
        terms = sorted(sp.Add.make_args(expression), key=self._rank)
        first, *rest = (self._term(term) for term in terms)
        return first + "".join(f" - {term[1:]}" if term.startswith("-") else f" + {term}" for term in rest)

    def _rank(self, part: Expression) -> tuple[bool, bool, str]:
        return not part.free_symbols <= self.constants, part.could_extract_minus_sign(), str(part)

    def _term(self, term: Expression) -> str:
        coefficient, product = term.as_coeff_Mul()
        powers = (factor.as_base_exp() for factor in sp.Mul.make_args(product))
        factors = sorted((base for base, exponent in powers for _ in range(int(exponent))), key=self._rank)
        sign = "-" if coefficient < 0 else ""
        number = [] if abs(coefficient) == 1 else [f"{float(abs(coefficient))}"]
        return sign + " * ".join(number + [f"({self.text(f)})" if f.is_Add else str(f) for f in factors])


def function_source(
    name: str, doc: str, program: Program, parameters: tuple[sp.Symbol, ...], state: tuple[sp.Symbol, ...]
) -> str:
    """Return the Python source of a function that computes a program's results, as ruff would format it."""
    printer, matrix, bias = Printer(program, parameters), program.mass_matrix, program.bias

    def entries(items: Mapping[Any, Expression]) -> str:
        return "\n".join(["{", *(f"        {key}: {printer.text(value)}," for key, value in items.items()), "    }"])

    results = {
        "base_mass": entries({key: value for key, value in matrix.items() if key[1] in BASE}),
        "base_bias": entries({row: value for row, value in bias.items() if row in BASE}),
    }
    if (LEG, LEG) in matrix:
        results |= {
            "leg_coupling": entries({row: value for (row, column), value in matrix.items() if column == LEG and row in BASE}),
            "leg_leg": printer.text(matrix[LEG, LEG]),
            "leg_wheel": printer.text(matrix[LEG, WHEEL]),
            "wheel_wheel": printer.text(matrix[WHEEL, WHEEL]),
            "leg_bias": printer.text(bias[LEG]),
            "wheel_bias": "0.0",
        }
    kinds = ", ".join(RESULT_KINDS.get(result, "Value") for result in results)
    arguments = [f"    {argument}: Value," for argument in (*parameters, *state)]
    steps = [f"    {symbol} = {printer.text(definition)}" for symbol, definition in program.steps.items()]
    returns = [f"    {result} = {text}" for result, text in results.items()]
    head = [f"def {name}(", *arguments, f") -> tuple[{kinds}]:", f"    {doc}"]
    return "\n".join([*head, *steps, *returns, f"    return {', '.join(results)}", ""])


def source() -> str:
    """Return the text of ``equations.py``, after proving it against the derivation.

    Raises:
        ArithmeticError: an entry differs from dS/du'.
    """
    platform, assembly = platform_program(), assembly_program()
    prove(platform, derive_platform())
    prove(assembly, derive_assembly())
    state = (SIN_Q, COS_Q, *W, LEG_RATE, WHEEL_RATE)
    of_platform = function_source("platform_terms", PLATFORM_DOC, platform, PLATFORM_PARAMETERS, (*W,))
    of_assembly = function_source("assembly_terms", ASSEMBLY_DOC, assembly, ASSEMBLY_PARAMETERS, state)
    return f"{HEADER}\n\n{of_platform}\n\n{of_assembly}"


def main() -> None:
    """Write ``equations.py`` beside this file."""
    temporary = TARGET.with_suffix(".tmp")
    temporary.write_text(source(), encoding="utf-8")
    os.replace(temporary, TARGET)


if __name__ == "__main__":
    main()
