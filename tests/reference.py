"""Independent references: the paper's equations and textbook mechanics in plain Python.

Nothing here uses the package: a mistake in it cannot hide in both.
"""

import math


def paper_loop(
    *,
    r,
    inductance,
    kt,
    ke,
    kp,
    ki,
    kd,
    kff=0.0,
    u_max=math.inf,
    compensate=True,
    leak=0.0,
    td=0.0,
    arm=1.0,
):
    """Return Algorithm 1 (DCMotorENVStep) as (dt, i, I, e_old, force, velocity) -> (i, I, e, u, f).

    f is the delivered force. `leak` and `td` are the appendix's low-pass integral and
    high-pass derivative, by backward Euler: (I - I_old)/dt = e - leak*I and (D - D_old)/dt*td + D =
    (e - e_old)/dt. With `td` the third state is the low-passed error, y = e - td*D, for which D =
    (e - y_old)/(dt + td).
    """

    def step(dt, i, integral, e_old, force, velocity):
        torque = arm * force
        omega = velocity / arm
        i_ref = torque / kt
        e = i_ref - i
        integral = (integral + e * dt) / (1.0 + leak * dt) if leak else integral + e * dt
        d = (e - e_old) / (dt + td) if td else (e - e_old) / dt
        u = kp * e + ki * integral + kd * d
        if compensate:
            u += ke * omega
        u += kff * i_ref
        if u > u_max:
            u = u_max
        if u < -u_max:
            u = -u_max
        v_bemf = ke * omega
        i_next = i + (u - v_bemf - r * i) / inductance * dt
        return i_next, integral, (e - td * d if td else e), u, kt * i_next / arm

    return step


def of_actuator(actuator, u_max=None):
    """Return `paper_loop` for a `DCMotorActuator` of one substep, or with another voltage limit."""
    motor, loop = actuator.motor, actuator.controller
    return paper_loop(
        r=motor.resistance,
        inductance=motor.inductance,
        kt=motor.torque_constant,
        ke=motor.back_emf_constant,
        kp=loop.kp,
        ki=loop.ki,
        kd=loop.kd,
        kff=loop.kff,
        u_max=loop.max_voltage if u_max is None else u_max,
        compensate=loop.bemf_compensation,
        leak=loop.integral_leak,
        td=loop.derivative_time_constant,
        arm=motor.arm_radius,
    )


class MotorSimulation:
    """Motor that stores its state between steps; electrical substeps are repeated calls."""

    def __init__(self, actuator):
        """Start at rest."""
        self._step = of_actuator(actuator)
        self._substeps = actuator.controller.substeps
        self.state = (0.0, 0.0, 0.0)
        self.voltage = 0.0

    @property
    def current(self):
        """Current [A]."""
        return self.state[0]

    def step(self, dt, force, velocity):
        """Advance by `dt`; return the delivered force."""
        for _ in range(self._substeps):
            *state, self.voltage, delivered = self._step(
                dt / self._substeps, *self.state, force, velocity
            )
            self.state = tuple(state)
        return delivered


GRAVITY, CART_MASS, POLE_MASS, HALF_LENGTH = 9.8, 1.0, 0.1, 0.5


def cartpole_accelerations(theta, theta_dot, force):
    """Return the accelerations of cart and pole, a uniform rod of length 2*l, by Lagrange.

    (M + m) x'' + m l cos(theta) theta'' = F + m l theta'^2 sin(theta)
    m l cos(theta) x'' + (4/3) m l^2 theta'' = m g l sin(theta)
    """
    m, half = POLE_MASS, HALF_LENGTH
    a11, a12, a22 = CART_MASS + m, m * half * math.cos(theta), 4.0 / 3.0 * m * half * half
    b1 = force + m * half * theta_dot * theta_dot * math.sin(theta)
    b2 = m * GRAVITY * half * math.sin(theta)
    determinant = a11 * a22 - a12 * a12
    return (b1 * a22 - a12 * b2) / determinant, (a11 * b2 - a12 * b1) / determinant


def cartpole_rk4(state, force, dt):
    """Return (x, x_dot, theta, theta_dot) after a Runge-Kutta step with a constant force."""

    def derivative(y):
        x_acc, theta_acc = cartpole_accelerations(y[2], y[3], force)
        return (y[1], x_acc, y[3], theta_acc)

    def moved(k, h):
        return [s + h * d for s, d in zip(state, k, strict=True)]

    k1 = derivative(state)
    k2 = derivative(moved(k1, dt / 2))
    k3 = derivative(moved(k2, dt / 2))
    k4 = derivative(moved(k3, dt))
    return [
        s + dt / 6 * (a + 2 * b + 2 * c + d)
        for s, a, b, c, d in zip(state, k1, k2, k3, k4, strict=True)
    ]
