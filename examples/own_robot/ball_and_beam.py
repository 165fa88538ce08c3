"""Hold a steel ball in the middle of a beam that a geared motor turns. Its model is beside it."""

from pathlib import Path

import numpy as np

import codrl_mj

HALF_LENGTH = 0.2  # of the beam [m]
MAX_TORQUE = 0.4  # [N*m]


def initial_bounds(options):
    """Return bounds of the initial state: ball within 8 cm of the middle, beam nearly level."""
    return np.array([-0.05, -0.08, 0.0, 0.0]), np.array([0.05, 0.08, 0.0, 0.0])


def initial_state(draws):
    """Return the initial state, which is drawn directly."""
    return draws[0], draws[1], draws[2], draws[3]


def observation(state):
    """Return the state, scaled to numbers around one."""
    return 5.0 * state[0], state[1] / HALF_LENGTH, 0.5 * state[2], 2.0 * state[3]


def reward(state, force, next_state, options):
    """Return 1 for a ball in the middle of a level beam, 0 at the edge; never less."""
    # A negative reward would make it pay to drop the ball early.
    position, effort = next_state[1] / HALF_LENGTH, force / MAX_TORQUE
    return np.maximum(
        0.0, 1.0 - position * position - next_state[0] * next_state[0] - 0.01 * effort * effort
    )


def terminated(state):
    """Return True if the ball has left the beam, or the beam is too steep for the groove."""
    return (np.abs(state[1]) > HALF_LENGTH) | (np.abs(state[0]) > 0.7)


TASK = codrl_mj.register(
    codrl_mj.Task(
        name="ball_and_beam",
        env_id="own_robot/BallAndBeam-v0",
        asset=str(Path(__file__).with_name("ball_and_beam.xml")),
        actuator="quanser-srv02",
        max_force=MAX_TORQUE,
        step_duration=0.02,
        motor_inner_steps=10,
        ideal_inner_steps=10,
        max_episode_steps=250,
        integrators=("rk4",),
        state_names=("beam [rad]", "ball [m]", "beam_dot [rad/s]", "ball_dot [m/s]"),
        observation_names=("beam", "ball", "beam_dot", "ball_dot"),
        initial_bounds=initial_bounds,
        initial_state=initial_state,
        observation=observation,
        reward=reward,
        terminated=terminated,
    )
)
