"""Equations (1) to (30) with the right physics: the paper's assumptions, everything that follows from them.

Legs pairwise equal, no roll, four wheels on a level floor. (7) to (11) are the whole Gibbs function with its velocity terms;
(19) to (30) are its Appell equations, solved for what the paper asks for. studies/tests/paper derives them symbolically.
"""

from __future__ import annotations

from functools import partial

from studies.paper import printed
from studies.paper.quantities import (
    WHEELS,
    Forces,
    PaperConstants,
    State,
    Value,
    Vector,
    ahead,
    cos,
    is_front,
    lever,
    root,
    sign,
    sin,
    to_the_right,
    wheelbase,
)

#: (1) and (18) stand as they are.
eq1_velocity_of_a_wheel_centre = printed.eq1_velocity_of_a_wheel_centre


def eq2_velocity_of_the_body(velocity_in_floor: Vector, yaw: Value) -> Vector:
    """(2): x', y', z' are the components of the velocity in the YAW frame, not derivatives of the floor coordinates."""
    x, y, z = velocity_in_floor
    return x * cos(yaw) + y * sin(yaw), y * cos(yaw) - x * sin(yaw), z


def _contact_slip(c: PaperConstants, s: State, wheel: str) -> Vector:
    """(3)-(6): velocity of the wheel's contact point over the floor: wheel centre minus rolling, with the ABSOLUTE spin rate.

    That is (x_s', y_s', z_s' = 0 on the floor): what the printed left side leaves open.
    """
    v = printed.eq1_velocity_of_a_wheel_centre((s.x_d, s.y_d, s.z_d), s.yaw_d, *printed.wheel_vector(c, s, wheel))
    return v[0] - c.a * (s.theta_d[wheel] + s.absolute_leg(wheel)[1]), v[1], v[2]


eq3_slip_of_the_right_front_wheel = partial(_contact_slip, wheel="rf")
eq4_slip_of_the_left_front_wheel = partial(_contact_slip, wheel="lf")
eq5_slip_of_the_right_rear_wheel = partial(_contact_slip, wheel="rr")
eq6_slip_of_the_left_rear_wheel = partial(_contact_slip, wheel="lr")


# ---- Gibbs function --------------------------------------------------------------------------------------------------


def point_acceleration(c: PaperConstants, s: State, wheel: str, distance: Value) -> Vector:
    """Acceleration of the point ``distance`` from the hip on a wheel's leg, yaw frame, z up, turning of the frame included."""
    phi, phi_d, phi_dd = s.absolute_leg(wheel)
    hip = ahead(wheel) * c.l_x / 2
    x, y = lever(c, s, wheel, distance), -to_the_right(wheel) * c.l_y / 2
    x_d = -hip * sin(s.psi) * s.psi_d - distance * sin(phi) * phi_d
    x_dd = -hip * (sin(s.psi) * s.psi_dd + cos(s.psi) * s.psi_d**2) - distance * (sin(phi) * phi_dd + cos(phi) * phi_d**2)
    z_dd = -hip * (cos(s.psi) * s.psi_dd - sin(s.psi) * s.psi_d**2) - distance * (cos(phi) * phi_dd - sin(phi) * phi_d**2)
    a_x, a_y, a_z = eq11_acceleration_of_the_body(s)
    return (
        a_x + x_dd - s.yaw_dd * y - s.yaw_d**2 * x,
        a_y + s.yaw_dd * x + 2 * s.yaw_d * x_d - s.yaw_d**2 * y,
        a_z + z_dd,
    )


def rotational_gibbs(inertia: Vector, phi: Value, rate: Value, acceleration: Value, yaw_d: Value, yaw_dd: Value) -> Value:
    """Gibbs function of a body that is pitched by ``phi`` and yaws: principal inertias (along, about the pitch axis, normal).

    I_yaw = I_1 sin^2 + I_3 cos^2; its change with the pitch couples yaw and pitch. Terms without accelerations are left out.
    """
    along, about, normal = inertia
    yaw = along * sin(phi) ** 2 + normal * cos(phi) ** 2
    by_pitch = 2 * (along - normal) * sin(phi) * cos(phi)
    return (
        (about * acceleration**2 + yaw * yaw_dd**2) / 2
        + by_pitch * rate * yaw_d * yaw_dd
        - by_pitch * yaw_d**2 * acceleration / 2
    )


def _translational(mass: Value, acceleration: Vector) -> Value:
    return mass / 2 * sum(component**2 for component in acceleration)


def eq7_gibbs_function_of_the_wheels(c: PaperConstants, s: State) -> Value:
    """(7): absolute spin of the disc, relative spin of the rotor, diametral inertia, mass."""
    total = 0
    for wheel in WHEELS:
        spin = s.theta_dd[wheel] + s.absolute_leg(wheel)[2]
        total = total + (c.I_o * spin**2 + c.J_w * s.theta_dd[wheel] ** 2 + c.I_t * s.yaw_dd**2) / 2
        total = total + _translational(c.m_w, point_acceleration(c, s, wheel, c.l))
    return total


def eq8_gibbs_function_of_the_legs(c: PaperConstants, s: State) -> Value:
    """(8): absolute rates and angles, velocity terms, acceleration of the leg's own centre of mass, hip rotors."""
    total = c.J_h * (s.alpha_dd**2 + s.beta_dd**2)
    for wheel in WHEELS:
        inertia = (c.I_along, c.I_ly, c.I_lx)
        total = total + rotational_gibbs(inertia, *s.absolute_leg(wheel), s.yaw_d, s.yaw_dd)
        total = total + _translational(c.m_l, point_acceleration(c, s, wheel, c.lam * c.l))
    return total


def eq9_gibbs_function_of_the_body(c: PaperConstants, s: State) -> Value:
    """(9): with Psi''^2, the inertia about x of a pitched body, and its velocity terms."""
    inertia = (c.I_Gx, c.I_Gy, c.I_Gz)
    rotation = rotational_gibbs(inertia, s.psi, s.psi_d, s.psi_dd, s.yaw_d, s.yaw_dd)
    return rotation + _translational(c.M_G, eq11_acceleration_of_the_body(s))


def eq10_gibbs_function(c: PaperConstants, s: State) -> Value:
    """(10): the sum."""
    wheels = eq7_gibbs_function_of_the_wheels(c, s)
    return wheels + eq8_gibbs_function_of_the_legs(c, s) + eq9_gibbs_function_of_the_body(c, s)


def eq11_acceleration_of_the_body(s: State) -> Vector:
    """(11): theta' k x all of the velocity: x'' - theta' y', y'' + theta' x', z''."""
    return s.x_dd - s.yaw_d * s.y_d, s.y_dd + s.yaw_d * s.x_d, s.z_dd


def eq12_potential(c: PaperConstants, s: State) -> Value:
    """(12): the whole potential on a level floor, J, constants included; psi follows from alpha and beta."""
    raised = sin(s.alpha + s.psi) + sin(s.beta + s.psi)
    body = c.M_G * (c.a + c.l / 2 * raised)
    legs = 2 * c.m_l * (2 * c.a + (1 - c.lam) * c.l * raised)
    return c.g * (body + legs + 4 * c.m_w * c.a)


# ---- friction and loads ----------------------------------------------------------------------------------------------


def eq13_dahl_friction(sigma_0: Value, displacement: Value, velocity: Value, mu: Value, f_n: Value) -> tuple[Value, Value]:
    """(13): force, and the missing state equation z' = v - sigma_0 |v| z/(mu F_n); sigma_0 is the bristles' stiffness, N/m."""
    return -sigma_0 * displacement, velocity - sigma_0 * velocity * sign(velocity) * displacement / (mu * f_n)


def eq14_coulomb_friction(mu: Value, f_n: Value, slip: tuple[Value, Value]) -> tuple[Value, Value]:
    """(14): force against the SLIP velocity of the contact point, as a vector; a wheel that sticks takes any up to mu F_n."""
    speed = root(slip[0] ** 2 + slip[1] ** 2)
    return -mu * f_n * slip[0] / speed, -mu * f_n * slip[1] / speed


def eq15_dissipation(c: PaperConstants, s: State, f_nf: Value, f_nr: Value) -> Value:
    """(15): power lost on the friction ELLIPSE, sum F_n sqrt((mu_x x_s')^2 + (mu_y y_s')^2); the printed box adds them up."""
    total = 0
    for wheel in WHEELS:
        across = s.y_f_d if is_front(wheel) else s.y_r_d
        load = f_nf if is_front(wheel) else f_nr
        total = total + load * root((c.mu_dx * s.x_s_d[wheel]) ** 2 + (c.mu_dy * across) ** 2)
    return total


def eq16_normal_force_in_front(c: PaperConstants, s: State) -> Value:
    """(16): on one front wheel at rest, N; as printed, with the leg's centre of mass at ``lam`` and the wheel's weight."""
    hips, front, rear = c.l_x * cos(s.psi), c.l * cos(s.alpha + s.psi), c.l * cos(s.beta + s.psi)
    moment = c.M_G * c.g / 2 * (hips / 2 - rear) + c.m_l * c.g * (hips + c.lam * front - (2 - c.lam) * rear)
    return moment / wheelbase(c, s) + c.m_w * c.g


def eq17_normal_force_behind(c: PaperConstants, s: State) -> Value:
    """(17): on one rear wheel at rest, N; likewise."""
    hips, front, rear = c.l_x * cos(s.psi), c.l * cos(s.alpha + s.psi), c.l * cos(s.beta + s.psi)
    moment = c.M_G * c.g / 2 * (hips / 2 + front) + c.m_l * c.g * (hips + (2 - c.lam) * front - c.lam * rear)
    return moment / wheelbase(c, s) + c.m_w * c.g


eq18_generalised_force = printed.eq18_generalised_force


# ---- equations of motion ---------------------------------------------------------------------------------------------


def _leg_torque(c: PaperConstants, s: State, f: Forces, right: str, left: str) -> Value:
    """(19), (20): sum of both hip motors of an axle, N m: inertia, gravity, normal forces and traction.

    At rest, in front: 2 l cos(alpha + psi) (N_f - lam m_l g - m_w g).
    """
    phi, _, _ = s.absolute_leg(right)
    angle, _, leg_dd = s.leg(right)
    k1, k2, sigma = (c.lam * c.m_l + c.m_w) * c.l, (c.lam**2 * c.m_l + c.m_w) * c.l**2, ahead(right)
    about_hip = 2 * (c.I_ly + k2 + c.I_o)
    a_x, _, a_z = eq11_acceleration_of_the_body(s)
    inertia = (
        (about_hip + 2 * c.J_h) * leg_dd
        + (about_hip + sigma * k1 * c.l_x * cos(angle)) * s.psi_dd
        - 2 * k1 * (sin(phi) * a_x + cos(phi) * a_z)
        + c.I_o * (s.theta_dd[right] + s.theta_dd[left])
    )
    turning = (
        sigma * k1 * c.l_x * s.psi_d**2 * sin(angle)
        + 2 * s.yaw_d**2 * sin(phi) * (sigma * k1 * c.l_x / 2 * cos(s.psi) + k2 * cos(phi))
        - 2 * (c.I_along - c.I_lx) * s.yaw_d**2 * sin(phi) * cos(phi)
    )
    loads = 2 * c.l * cos(phi) * f.n(right) + (c.l * sin(phi) + c.a) * (f.x[right] + f.x[left])
    return inertia + turning - 2 * k1 * c.g * cos(phi) + loads


eq19_torque_of_the_front_legs = partial(_leg_torque, right="rf", left="lf")
eq20_torque_of_the_rear_legs = partial(_leg_torque, right="rr", left="lr")


def spin_inertia_torque(c: PaperConstants, s: State, wheel: str) -> Value:
    """I_o (theta'' + leg'' + psi'') + J_w theta'': what a wheel takes without any traction, N m."""
    return c.I_o * (s.theta_dd[wheel] + s.absolute_leg(wheel)[2]) + c.J_w * s.theta_dd[wheel]


def _wheel_torque(c: PaperConstants, s: State, f: Forces, wheel: str) -> Value:
    """(21)-(24): I_o (theta'' + leg'' + psi'') + J_w theta'' + a F_x, N m; of a free wheel it is minus its gear's drag."""
    return spin_inertia_torque(c, s, wheel) + c.a * f.x[wheel]


eq21_torque_of_the_right_front_wheel = partial(_wheel_torque, wheel="rf")
eq22_torque_of_the_left_front_wheel = partial(_wheel_torque, wheel="lf")
eq23_torque_of_the_right_rear_wheel = partial(_wheel_torque, wheel="rr")
eq24_torque_of_the_left_rear_wheel = partial(_wheel_torque, wheel="lr")


def _longitudinal_force(c: PaperConstants, s: State, f: Forces, wheel: str) -> Value:
    """(25)-(28): (tau - I_o (theta'' + leg'' + psi'') - J_w theta'')/a, N: (21)-(24) for a motor torque that is known.

    Of a wheel that sticks or not: within mu F_n, and equal to it against the slip.
    """
    return (f.tau_theta[wheel] - spin_inertia_torque(c, s, wheel)) / c.a


eq25_force_on_the_right_front_wheel = partial(_longitudinal_force, wheel="rf")
eq26_force_on_the_left_front_wheel = partial(_longitudinal_force, wheel="lf")
eq27_force_on_the_right_rear_wheel = partial(_longitudinal_force, wheel="rr")
eq28_force_on_the_left_rear_wheel = partial(_longitudinal_force, wheel="lr")


def _lateral(c: PaperConstants, s: State, f: Forces) -> tuple[Value, Value]:
    """Inertia in the rows of y and yaw: the force to the left and the moment about the vertical that the floor must give.

    The moment of the forces along the wheels, x_i at y_i: -y_i x_i, is taken off.
    """
    _, a_y, _ = eq11_acceleration_of_the_body(s)
    inertia = c.I_Gx * sin(s.psi) ** 2 + c.I_Gz * cos(s.psi) ** 2
    of_body = inertia * s.yaw_dd + 2 * (c.I_Gx - c.I_Gz) * sin(s.psi) * cos(s.psi) * s.psi_d * s.yaw_d  # dS_3/dtheta''
    force, moment = c.M_G * a_y, of_body
    for wheel in WHEELS:
        for mass, distance in ((c.m_l, c.lam * c.l), (c.m_w, c.l)):
            p_x, p_y, _ = point_acceleration(c, s, wheel, distance)
            force = force + mass * p_y
            moment = moment + mass * (lever(c, s, wheel, distance) * p_y + to_the_right(wheel) * c.l_y / 2 * p_x)
        along = c.I_along - c.I_lx
        phi, phi_d, _ = s.absolute_leg(wheel)
        inertia = c.I_along * sin(phi) ** 2 + c.I_lx * cos(phi) ** 2 + c.I_t
        moment = moment + inertia * s.yaw_dd + 2 * along * sin(phi) * cos(phi) * phi_d * s.yaw_d
    return force, moment - sum(to_the_right(wheel) * c.l_y / 2 * f.x[wheel] for wheel in WHEELS)


def eq29_lateral_force_in_front(c: PaperConstants, s: State, f: Forces) -> Value:
    """(29): on both front wheels, to the left, N: from the rows of y and yaw, given the forces along the wheels."""
    force, moment = _lateral(c, s, f)
    return (moment - lever(c, s, "rr") * force) / wheelbase(c, s)


def eq30_lateral_force_behind(c: PaperConstants, s: State, f: Forces) -> Value:
    """(30): on both rear wheels, likewise."""
    force, moment = _lateral(c, s, f)
    return (lever(c, s, "rf") * force - moment) / wheelbase(c, s)
