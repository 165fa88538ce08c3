"""The whole idea in one file: a motor, its current loop, a cart-pole, and two trained policies.

Read it from top to bottom; it only needs numpy. If you run it, you see within a minute a policy
that balances a pole on ideal forces and drops it on a motor. Another one, also of five numbers, has
learned through the motor and keeps the pole up.

    python examples/the_whole_idea.py

Everything else in codrl_mj is the same, with MuJoCo instead of `cartpole_step`, real motors instead
of `Motor`, and better agents instead of `learn`. Up to rounding, `motor_step` and `cartpole_step`
are the package's own steps.
"""

from typing import NamedTuple

import numpy as np

STEP = 0.02  # time between two decisions [s]
LIMIT = 500  # steps of an episode: ten seconds
PUSH = 10.0  # desired force, to the left or to the right [N]


# 1. A motor.
# ----------------------------------------------------------------------------------------------
# A policy asks for a force, but a motor only takes a voltage. It has a winding, to which a
# controller applies a voltage u. The voltage drives a current i against three things: the winding's
# resistance R, its inductance L, and the voltage kE*omega that the turning motor induces. The
# current makes a torque kT*i, and an arm r turns that into a force on the cart:
#
#     L di/dt = u - kE*omega - R*i,      force = kT*i / r,      omega = speed of the cart / r
#
# The inductance makes forces late, and the induced voltage makes them weak.


class Motor(NamedTuple):
    """A DC motor with an arm that pushes a cart, and the current loop that drives it."""

    resistance: float = 1.0  # R [ohm]
    inductance: float = 0.1  # L [H]
    torque_constant: float = 1.0  # kT [N*m/A]
    back_emf_constant: float = 1.0  # kE [V*s/rad]
    arm: float = 0.15  # r [m]
    kp: float = 4.3  # gains of the loop: proportional [V/A],
    ki: float = 1.0  # integral [V/(A*s)],
    kd: float = 1e-6  # derivative [V*s/A],
    kff: float = 0.6  # feed-forward [V/A]
    max_voltage: float = 24.0  # limit of the supply [V]


# arXiv 2507.00268 drives its cart with this motor, which is so fast that a policy does not notice
# it.
PAPER = Motor()
# This one has ten times the inductance, and a gentle loop.
SLOW = Motor(inductance=1.0, kp=1.0, ki=1.0, kd=0.0, kff=0.0)


# 2. Its current loop.
# ----------------------------------------------------------------------------------------------
# A desired force needs a current: i_ref = r*force/kT. A PID controller compares it with the actual
# current and chooses the voltage. It adds the induced voltage kE*omega, and it cannot exceed the
# supply. One step of it is one step of Algorithm 1 of the paper; the winding then moves by explicit
# Euler.


def motor_at_rest(many: int) -> np.ndarray:
    """Return zero current, zero integral of the error and zero last error, an array (3, many)."""
    return np.zeros((3, many))


def motor_step(
    motor: Motor, state: np.ndarray, desired: np.ndarray, speed: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Step the loop; return the motor's next state, the cart's force [N], and the voltage [V]."""
    current, integral, last_error = state
    back_emf = motor.back_emf_constant * speed / motor.arm
    reference = motor.arm * desired / motor.torque_constant
    error = reference - current
    integral = integral + error * STEP
    voltage = motor.kp * error + motor.ki * integral + motor.kd * (error - last_error) / STEP
    voltage = voltage + motor.kff * reference + back_emf
    voltage = np.clip(voltage, -motor.max_voltage, motor.max_voltage)
    current = current + (voltage - back_emf - motor.resistance * current) / motor.inductance * STEP
    return (
        np.array([current, integral, error]),
        motor.torque_constant * current / motor.arm,
        voltage,
    )


# 3. A cart with a pole on it.
# ----------------------------------------------------------------------------------------------
# Gymnasium's CartPole-v1: a cart of 1 kg, a pole of 0.1 kg and 1 m, explicit Euler. An episode ends
# when the cart is 2.4 m away or the pole leans by 12 degrees. Many of them are simulated at once,
# one in each column.


def cartpole_step(state: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return the next position [m], speed [m/s], angle [rad], rate [rad/s], an array (4, many)."""
    _, speed, angle, rate = state
    sine, cosine = np.sin(angle), np.cos(angle)
    pushed = (force + 0.05 * rate**2 * sine) / 1.1
    angular_acceleration = (9.8 * sine - cosine * pushed) / (0.5 * (4 / 3 - 0.1 * cosine**2 / 1.1))
    rates = np.array(
        [speed, pushed - 0.05 * angular_acceleration * cosine / 1.1, rate, angular_acceleration]
    )
    return state + STEP * rates


def standing(state: np.ndarray) -> np.ndarray:
    """Return True for each cart that is on the track with its pole up."""
    return (np.abs(state[0]) <= 2.4) & (np.abs(state[2]) <= np.radians(12))


# 4. A policy.
# ----------------------------------------------------------------------------------------------
# A policy is five numbers: weights of position, speed, angle and rate, and a bias. Their sum gives
# the probability of a push to the right. While it learns, the policy draws its pushes with that
# probability; afterwards it takes the likelier one. It never sees the motor.


def preference(policy: np.ndarray, observation: np.ndarray) -> np.ndarray:
    """Return the logit of the probability to push to the right; `observation` is (4, ...)."""
    return np.tensordot(policy[:4], observation, 1) + policy[4]


def probability(policy: np.ndarray, observation: np.ndarray) -> np.ndarray:
    """Return the probability of a push to the right."""
    return 1 / (1 + np.exp(-preference(policy, observation)))


# 5. Episodes.
# ----------------------------------------------------------------------------------------------
# The only line that matters is the one with `motor_step`. Most simulations leave it out, and the
# cart gets the desired force at once.


class Episodes(NamedTuple):
    """Episodes step by step; the last axes are (steps, many)."""

    observations: np.ndarray  # (4, steps, many)
    right: np.ndarray  # True for a push to the right
    alive: np.ndarray  # True if the pole still stood; the sum over steps is an episode's return


def play(
    policy: np.ndarray, motor: Motor | None, many: int, rng: np.random.Generator, explore: bool
) -> Episodes:
    """Run episodes side by side, through a motor or, without one, on ideal forces."""
    state, motor_state, alive = (
        rng.uniform(-0.05, 0.05, (4, many)),
        motor_at_rest(many),
        np.ones(many, bool),
    )
    steps = []
    while alive.any() and len(steps) < LIMIT:
        p_right = probability(policy, state)
        right = rng.random(many) < p_right if explore else p_right > 0.5
        steps.append((state, right, alive))
        force = np.where(right, PUSH, -PUSH)
        if motor is not None:
            motor_state, force, _ = motor_step(motor, motor_state, force, state[1])
        state = cartpole_step(state, force)
        alive = alive & standing(state)
        # Fallen poles are not simulated any further.
        state = np.where(alive, state, 0.0)
    observations, right, alive = (np.array(column) for column in zip(*steps, strict=True))
    return Episodes(np.moveaxis(observations, 1, 0), right, alive)


# 6. Learning.
# ----------------------------------------------------------------------------------------------
# This is the oldest policy gradient (Williams, 1992): play, and make the actions likelier that went
# better than the average at that step of an episode. An action went well if the pole stood for many
# steps afterwards; later steps count less. Adam (Kingma and Ba, 2015) chooses the size of the step.


def learn(motor: Motor | None, seed: int = 0, rounds: int = 100, many: int = 64) -> np.ndarray:
    """Learn a policy from zero, in `rounds` of `many` episodes."""
    rng = np.random.default_rng(seed)
    policy, mean, square = np.zeros((3, 5))
    for number in range(1, rounds + 1):
        observations, right, alive = play(policy, motor, many, rng, explore=True)
        returns_to_go, tail = np.zeros(alive.shape), np.zeros(many)
        for step in reversed(range(len(alive))):
            returns_to_go[step] = tail = alive[step] * (1 + 0.99 * tail)
        baseline = returns_to_go.sum(1, keepdims=True) / np.maximum(alive.sum(1, keepdims=True), 1)
        advantages = (returns_to_go - baseline) * alive / (returns_to_go - baseline)[alive].std()

        # The gradient of the log-probability is this factor times the observation.
        weights = (right - probability(policy, observations)) * advantages
        gradient = np.append(np.tensordot(observations, weights, 2), weights.sum()) / alive.sum()
        mean, square = 0.9 * mean + 0.1 * gradient, 0.99 * square + 0.01 * gradient**2
        policy = policy + 0.1 * mean / (1 - 0.9**number) / (
            np.sqrt(square / (1 - 0.99**number)) + 1e-8
        )
        if number % 20 == 0:
            print(f"    round {number:3}: the pole stands for {alive.sum(0).mean() * STEP:4.1f} s")
    return policy


def score(policy: np.ndarray, motor: Motor | None, many: int = 100) -> float:
    """Return the mean return of greedy episodes from other initial states; the maximum is 500."""
    return float(
        play(policy, motor, many, np.random.default_rng(10_000), explore=False).alive.sum(0).mean()
    )


# 7. Results.
# ----------------------------------------------------------------------------------------------


def step_response(motor: Motor) -> list[float]:
    """Return the force [N] of a steady command on a blocked cart, step by step."""
    state, forces = motor_at_rest(1), []
    for _ in range(50):
        state, force, _ = motor_step(motor, state, np.array([PUSH]), np.zeros(1))
        forces.append(float(force[0]))
    return forces


def main() -> dict[str, dict[str, float]]:
    """Print the results, and return the numbers of the table."""
    print(f"You ask for {PUSH:g} N. The motor gives")
    for name, motor in (("the paper's", PAPER), ("the slow one", SLOW)):
        forces = step_response(motor)
        print(
            f"    {name:14}"
            + ", ".join(f"{forces[n - 1]:.1f} N after {n * STEP:.2f} s" for n in (1, 10, 25, 50))
        )
    print("Learn on ideal forces:")
    ideal = learn(None)
    print("Learn through the slow motor:")
    through = learn(SLOW)
    motors = {"ideal forces": None, "the paper's motor": PAPER, "the slow motor": SLOW}
    print(f"\n{'steps of 500':24}" + "".join(f"{'on ' + name:>24}" for name in motors))
    table = {}
    for name, policy in {"learned on ideal forces": ideal, "learned through it": through}.items():
        table[name] = {
            name_of_motor: score(policy, motor) for name_of_motor, motor in motors.items()
        }
        print(f"{name:24}" + "".join(f"{result:24.0f}" for result in table[name].values()))
    # A policy looks ahead by the weight of the rate over the weight of the angle.
    first, second = (policy[3] / policy[2] for policy in (ideal, through))
    print(
        f"\nThe first looks {first:.1f} s ahead. The second met a force that is late, and looks"
        f" {second:.1f} s ahead."
    )
    return table


if __name__ == "__main__":
    main()
