"""The derivation, the committed generated code and its operation count."""

from pathlib import Path

import pytest

sp = pytest.importorskip("sympy")

from studies import derivation as d  # noqa: E402
from wlr_gym.physics.model import equations  # noqa: E402


@pytest.fixture(scope="module")
def assembly():
    return d.derive_assembly()


def test_committed_equations_are_what_the_generator_writes():
    assert Path(equations.__file__).read_text(encoding="utf-8") == d.source()


def test_generator_refuses_an_entry_that_is_not_the_derived_one():
    program = d.platform_program()
    program.bias[4] = -program.bias[4]
    with pytest.raises(ArithmeticError, match=r"bias\[4\]"):
        d.prove(program, d.derive_platform())


def test_masses_enter_only_through_their_three_moments():
    leg_mass, com, wheel_mass, length = sp.symbols("m_l com m_w l")
    mass, first, second = d.ASSEMBLY_PARAMETERS[3:6]
    moments = {
        mass: leg_mass + wheel_mass,
        first: leg_mass * com + wheel_mass * length,
        second: leg_mass * com**2 + wheel_mass * length**2,
    }
    leg = d.translational_gibbs(leg_mass, d.acceleration_along_leg(com))
    by_body = leg + d.translational_gibbs(wheel_mass, d.acceleration_along_leg(length))
    assert sp.expand(by_body - d.translation_by_moments().subs(moments)) == 0


def test_mass_matrix_is_symmetric_and_depends_on_no_velocity(assembly):
    assert assembly.mass_matrix == assembly.mass_matrix.T
    rates = {*d.W, d.LEG_RATE, d.WHEEL_RATE}
    assert not assembly.mass_matrix.free_symbols & rates


def test_bias_does_no_work_beyond_the_change_of_the_mass_matrix(assembly):
    """Power balance of free motion, a0 = v' + w x v: u . bias + u . M (w x v; 0) = 1/2 u . dM/dt u, M depending on q alone."""
    v = sp.Matrix(sp.symbols("vx vy vz"))
    u = sp.Matrix([*v, *d.W, d.LEG_RATE, d.WHEEL_RATE])
    joint_rate = d.LEG_RATE - d.W[1]
    by_angle = assembly.mass_matrix.applyfunc(lambda m: sp.diff(m, d.SIN_Q) * d.COS_Q - sp.diff(m, d.COS_Q) * d.SIN_Q)
    convective = sp.Matrix([*d.W.cross(v), 0, 0, 0, 0, 0])
    power = (
        u.dot(assembly.bias) + u.dot(assembly.mass_matrix * convective) - sp.Rational(1, 2) * joint_rate * u.dot(by_angle * u)
    )
    assert d.is_zero(power)


def test_operation_count():
    """The engine runs this code in its innermost loop, four assemblies each step."""
    counts = []
    for program in (d.platform_program(), d.assembly_program()):
        counts.append(sp.count_ops([*program.steps.values(), *program.mass_matrix.values(), *program.bias.values()]))
    assert counts[0] <= 60
    assert counts[1] <= 150
