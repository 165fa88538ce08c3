"""The motor against gym-electric-motor's permanently excited DC motor, driven by the same voltages.

gym-electric-motor (https://github.com/upb-lea/gym-electric-motor) is a simulator of drives written by others. Its whole
chain runs here: ideal supply, continuous four-quadrant converter, `DcPermanentlyExcitedMotor`, inertial load, and
scipy's DOP853 at a relative tolerance of 1e-11. Its one constant psi_e is both kT and kE. The voltage is held over each
of its periods, as ours is.

It is no dependency of the package, because it installs pytest and coverage; where it is absent the check does not
apply and is left out.
"""

import importlib.util
from collections.abc import Iterator

import numpy as np

from codrl_mj.actuators import Motor
from codrl_mj.validation.rotors import FREE, Record, drive, driven_by_voltage, motors_on
from codrl_mj.validation.table import Case, Family, check, of_order, order

SUPPLY = 12.0
"""Supply voltage [V]."""
PERIOD = 0.05
"""How long each voltage is held [s]."""


def available() -> bool:
    """Whether gym-electric-motor is installed."""
    return importlib.util.find_spec("gym_electric_motor") is not None


def gem_run(motor: Motor, inertia: float, voltages: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Speed [rad/s] and current [A] of gym-electric-motor's drive after each voltage's period."""
    from gym_electric_motor.physical_systems import converters, electric_motors, solvers, voltage_supplies
    from gym_electric_motor.physical_systems.mechanical_loads import PolynomialStaticLoad
    from gym_electric_motor.physical_systems.physical_systems import DcMotorSystem

    parameters = {
        "r_a": motor.resistance,
        "l_a": motor.inductance,
        "psi_e": motor.back_emf_constant,
        "j_rotor": 0.0,
    }
    system = DcMotorSystem(
        converter=converters.ContFourQuadrantConverter(tau=PERIOD),
        motor=electric_motors.DcPermanentlyExcitedMotor(motor_parameter=parameters),
        load=PolynomialStaticLoad(load_parameter={"a": 0.0, "b": 0.0, "c": 0.0, "j_load": inertia}),
        supply=voltage_supplies.IdealVoltageSupply(u_nominal=SUPPLY),
        ode_solver=solvers.ScipySolveIvpSolver(method="DOP853", rtol=1e-11, atol=1e-12),
        tau=PERIOD,
    )
    system.reset()
    names = list(system.state_names)
    rows = []
    for voltage in voltages:
        state = system.simulate([voltage / SUPPLY]) * system.limits
        rows.append((state[names.index("omega")], state[names.index("i")]))
    speed, current = np.array(rows).T
    return speed, current


@check("motor", order("gym-electric-motor, order in the step", "gym-electric-motor's DcPermanentlyExcitedMotor"))
def gem_check(motor: Motor, quick: bool) -> Iterator[Case]:
    """Convergence of speed and current to gym-electric-motor's at first order in the step, Euler on a free rotor."""
    voltages = np.random.default_rng(1).uniform(-SUPPLY, SUPPLY, 20 if quick else 40)
    speed, current = gem_run(motor, FREE.inertia, voltages)
    counts = 2 ** np.arange(4, 8 if quick else 11)
    errors: tuple[list[float], list[float]] = ([], [])
    for count in counts:
        model = motors_on(FREE, [driven_by_voltage(motor)], PERIOD / int(count))
        run: Record = drive(model, voltages.repeat(count))
        ends = slice(int(count) - 1, None, int(count))
        errors[0].append(float(np.abs(run.speed[ends, 0] - speed).max()))
        errors[1].append(float(np.abs(run.current[ends, 0] - current).max()))
    steps = PERIOD / counts
    families = [Family("speed [rad/s]", steps, np.array(errors[0])), Family("current [A]", steps, np.array(errors[1]))]
    title = "Ours against gym-electric-motor, free rotor"
    yield of_order(1.0, families, title, "step [s]", "largest difference [rad/s, A]")
