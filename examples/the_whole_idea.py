"""The whole idea in one file: a motor, its current loop, a cart-pole, and a policy that learns with or without them.

Read it from top to bottom; it needs numpy alone. Run it, and within a minute you see a policy that
balances a pole on ideal forces and drops it on a motor, and another of five numbers that learned
through the motor and keeps it up.

    python examples/the_whole_idea.py

Everything else in codrl_mj is this with MuJoCo in the place of `cartpole`, real motors in the place
of `Motor`, and better agents in the place of `learn`. Up to rounding, `motor_step` and
`cartpole_step` are the package's own steps.
"""

from typing import NamedTuple

import numpy as np

STEP = 0.02  # between two decisions [s]
LIMIT = 500  # steps in an episode: ten seconds
PUSH = 10.0  # what the policy may ask for, to the left or to the right [N]


# 1. A motor. -------------------------------------------------------------------------------------------------------
#
# A policy asks for a force. A motor has none to give: it has a winding, to which somebody applies a voltage u. The
# voltage drives a current i, against the winding's resistance R, its inductance L, and the voltage kE*omega that the
# turning motor makes itself. The current makes a torque kT*i, and an arm r turns that into a force on the cart:
#
#     L di/dt = u - kE*omega - R*i,      force = kT*i / r,      omega = speed of the cart / r
#
# The inductance is why forces come late, and the turning why they come weak.


class Motor(NamedTuple):
    """A DC motor with an arm that pushes a cart, and the current loop that drives it."""

    resistance: float = 1.0  # R [ohm]
    inductance: float = 0.1  # L [H]
    torque_constant: float = 1.0  # kT [N*m/A]
    back_emf_constant: float = 1.0  # kE [V*s/rad]
    arm: float = 0.15  # r [m]
    kp: float = 4.3  # the loop's gains: proportional [V/A],
    ki: float = 1.0  # integral [V/(A*s)],
    kd: float = 1e-6  # derivative [V*s/A],
    kff: float = 0.6  # feed-forward [V/A]
    max_voltage: float = 24.0  # what the supply has [V]


PAPER = (
    Motor()
)  # arXiv 2507.00268 drives its cart with this one, which is quick enough not to be noticed
SLOW = Motor(
    inductance=1.0, kp=1.0, ki=1.0, kd=0.0, kff=0.0
)  # ten times its inductance, under a gentle loop


# 2. Its current loop.
# ----------------------------------------------------------------------------------------------
# Who wants a force wants a current: i_ref = r*force/kT. A PID controller compares it with the
# current that flows and chooses the voltage. It adds what the turning takes away (kE*omega), and it
# cannot go beyond the supply. One step of it is one step of Algorithm 1 of the paper; the winding
# then moves by explicit Euler.


def motor_at_rest(many: int) -> np.ndarray:
    """No current, no integral of its error, no last error: an array (3, many)."""
    return np.zeros((3, many))


def motor_step(
    motor: Motor, state: np.ndarray, desired: np.ndarray, speed: np.ndarray
) -> tuple[np.ndarray, ...]:
    """One step of the loop: the motor's next state, the force [N] that the cart gets, and the voltage [V]."""
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
# --------------------------------------------------------------------------------------
# Gymnasium's CartPole-v1: a cart of 1 kg, a pole of 0.1 kg and 1 m, explicit Euler. An episode ends
# when the cart is 2.4 m away or the pole leans by 12 degrees. Here are many of them at once, a
# column each.


def cartpole_step(state: np.ndarray, force: np.ndarray) -> np.ndarray:
    """The next position [m], speed [m/s], angle [rad] and turning [rad/s], an array (4, many)."""
    _, speed, angle, turning = state
    sine, cosine = np.sin(angle), np.cos(angle)
    pushed = (force + 0.05 * turning**2 * sine) / 1.1
    falling = (9.8 * sine - cosine * pushed) / (0.5 * (4 / 3 - 0.1 * cosine**2 / 1.1))
    rates = np.array([speed, pushed - 0.05 * falling * cosine / 1.1, turning, falling])
    return state + STEP * rates


def standing(state: np.ndarray) -> np.ndarray:
    """Which of the carts are on the track with their poles up."""
    return (np.abs(state[0]) <= 2.4) & (np.abs(state[2]) <= np.radians(12))


# 4. A policy.
# ------------------------------------------------------------------------------------------------------
# Five numbers: how much position, speed, angle and turning speak for a push to the right, and a
# bias. While it learns, the policy tosses a coin with that probability; afterwards it takes the
# likelier side. It never sees the motor.


def preference(policy: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """How much it would rather push to the right: the logit of the probability; `seen` is (4, ...)."""
    return np.tensordot(policy[:4], seen, 1) + policy[4]


def probability(policy: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Of a push to the right."""
    return 1 / (1 + np.exp(-preference(policy, seen)))


# 5. Episodes.
# ------------------------------------------------------------------------------------------------------
# The only line that matters is the one with `motor_step` in it. Leave it out, as nearly everybody
# does, and the cart gets what the policy asked for, at once.


class Episodes(NamedTuple):
    """What happened, step by step in the last axes (steps, many)."""

    seen: np.ndarray  # (4, steps, many)
    right: np.ndarray  # pushed to the right?
    alive: np.ndarray  # was it still standing when it decided? Their sum is an episode's return.


def play(
    policy: np.ndarray, motor: Motor | None, many: int, rng: np.random.Generator, explore: bool
) -> Episodes:
    """Episodes side by side, through a motor or, if there is none, on ideal forces."""
    state, inside, alive = (
        rng.uniform(-0.05, 0.05, (4, many)),
        motor_at_rest(many),
        np.ones(many, bool),
    )
    steps = []
    while alive.any() and len(steps) < LIMIT:
        chance = probability(policy, state)
        right = rng.random(many) < chance if explore else chance > 0.5
        steps.append((state, right, alive))
        force = np.where(right, PUSH, -PUSH)
        if motor is not None:
            inside, force, _ = motor_step(motor, inside, force, state[1])
        state = cartpole_step(state, force)
        alive = alive & standing(state)
        state = np.where(alive, state, 0.0)  # what has fallen is out of the game
    seen, right, alive = (np.array(each) for each in zip(*steps, strict=True))
    return Episodes(np.moveaxis(seen, 1, 0), right, alive)


# 6. Learning.
# ------------------------------------------------------------------------------------------------------
# Policy gradient, the oldest one (Williams, 1992): play, and make likelier what went better than
# usual at that time of an episode. What "went" means is the number of steps that the pole stood
# afterwards, later ones counting less. Adam (Kingma and Ba, 2015) chooses the size of the step.


def learn(motor: Motor | None, seed: int = 0, rounds: int = 100, many: int = 64) -> np.ndarray:
    """A policy, from nothing, by `rounds` of `many` episodes."""
    rng = np.random.default_rng(seed)
    policy, mean, square = np.zeros((3, 5))
    for number in range(1, rounds + 1):
        seen, right, alive = play(policy, motor, many, rng, explore=True)
        to_come, after = np.zeros(alive.shape), np.zeros(many)
        for step in reversed(range(len(alive))):
            to_come[step] = after = alive[step] * (1 + 0.99 * after)
        usual = to_come.sum(1, keepdims=True) / np.maximum(alive.sum(1, keepdims=True), 1)
        better = (to_come - usual) * alive / (to_come - usual)[alive].std()

        surprise = (
            right - probability(policy, seen)
        ) * better  # the gradient of log-probability times `better`
        gradient = np.append(np.tensordot(seen, surprise, 2), surprise.sum()) / alive.sum()
        mean, square = 0.9 * mean + 0.1 * gradient, 0.99 * square + 0.01 * gradient**2
        policy = policy + 0.1 * mean / (1 - 0.9**number) / (
            np.sqrt(square / (1 - 0.99**number)) + 1e-8
        )
        if number % 20 == 0:
            print(f"    round {number:3}: the pole stands for {alive.sum(0).mean() * STEP:4.1f} s")
    return policy


def score(policy: np.ndarray, motor: Motor | None, many: int = 100) -> float:
    """Mean return of greedy episodes from starts that learning never saw; 500 is full marks."""
    return float(
        play(policy, motor, many, np.random.default_rng(10_000), explore=False).alive.sum(0).mean()
    )


# 7. The story.
# -----------------------------------------------------------------------------------------------------


def late(motor: Motor) -> list[float]:
    """What a cart that is held gets of a steady push [N], step by step."""
    state, got = motor_at_rest(1), []
    for _ in range(50):
        state, force, _ = motor_step(motor, state, np.array([PUSH]), np.zeros(1))
        got.append(float(force[0]))
    return got


def main() -> dict[str, dict[str, float]]:
    """Tell it, and return the table's numbers."""
    print(f"You ask for {PUSH:g} N. The motor gives")
    for name, motor in (("the paper's", PAPER), ("the slow one", SLOW)):
        got = late(motor)
        print(
            f"    {name:14}"
            + ", ".join(f"{got[n - 1]:.1f} N after {n * STEP:.2f} s" for n in (1, 10, 25, 50))
        )
    print("Learn on ideal forces:")
    ideal = learn(None)
    print("Learn through the slow motor:")
    through = learn(SLOW)
    where = {"ideal forces": None, "the paper's motor": PAPER, "the slow motor": SLOW}
    print(f"\n{'steps of 500':24}" + "".join(f"{'on ' + name:>24}" for name in where))
    table = {}
    for name, policy in {"learned on ideal forces": ideal, "learned through it": through}.items():
        table[name] = {place: score(policy, motor) for place, motor in where.items()}
        print(f"{name:24}" + "".join(f"{one:24.0f}" for one in table[name].values()))
    first, second = (
        policy[3] / policy[2] for policy in (ideal, through)
    )  # what turning counts, over what the angle does
    print(
        f"\nThe first looks {first:.1f} s ahead. The second met a force that is late, and looks"
        f" {second:.1f} s ahead."
    )
    return table


if __name__ == "__main__":
    main()
