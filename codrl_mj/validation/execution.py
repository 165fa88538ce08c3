"""Bitwise equality of simulations that are batched, copied, restored, pickled, reset or inspected.

The oracle is a plain loop over `mj_step`. A tolerance would hide state that leaks between
simulations, so there is none: a check counts the 64-bit floats that differ.
"""

import copy
import pickle
from collections.abc import Iterator

import mujoco
import numpy as np
from mujoco.batch import Batch

from codrl_mj.physics import MujocoPhysics, SimulationConfig, install_callbacks, motors
from codrl_mj.tasks import Task, find_task
from codrl_mj.validation.compare import paper_actuators, scaled_forces
from codrl_mj.validation.table import Case, Check, check

UNIT = "64-bit floats that differ"
SERIAL = "a loop over mj_step"
STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
"""State vector of a task: time, positions, velocities, and activations with those of motors."""
FULL_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
"""State vector of a user's model, whose contacts also need the solver's warm start."""
THREADS = {"1 thread": 1, "2 threads": 2}
"""Name in reports -> number of threads of a batch."""


def commands(model: mujoco.MjModel, steps: int, seed: int) -> np.ndarray:
    """Return random controls, shape (steps, nu), held for five steps, in their ranges or +-1."""
    limited = model.actuator_ctrllimited.astype(bool)
    low = np.where(limited, model.actuator_ctrlrange[:, 0], -1.0)
    high = np.where(limited, model.actuator_ctrlrange[:, 1], 1.0)
    drawn = np.random.default_rng(seed).uniform(low, high, (steps // 5 + 1, model.nu))
    return np.repeat(drawn, 5, axis=0)[:steps]


def _state(data: mujoco.MjData) -> np.ndarray:
    return np.concatenate([[data.time], data.qpos, data.qvel, data.act, data.plugin_state])


def _advance_states(model: mujoco.MjModel, data: mujoco.MjData, controls: np.ndarray) -> np.ndarray:
    """Return the states after each step under controls of shape (steps, nu)."""
    states = []
    for control in controls:
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
        states.append(_state(data))
    return np.array(states)


def differs(ours: np.ndarray, oracle: np.ndarray) -> np.ndarray:
    """Return True where the bits of two float64 arrays differ."""
    # Compared as integers, equal NaN are equal, and 0.0 differs from -0.0.
    ours, oracle = (
        np.ascontiguousarray(array, dtype=np.float64).view(np.uint64) for array in (ours, oracle)
    )
    different: np.ndarray = ours != oracle
    return different


def bit_differences(ours: np.ndarray, oracle: np.ndarray) -> Case:
    """Return the number of floats that differ, described by the first step with a difference.

    States have the shape (steps, n) or (steps, simulations, n).
    """
    unequal = differs(ours, oracle)
    first = int(np.argmax(unequal.reshape(len(unequal), -1).any(axis=1)))
    return Case(
        float(unequal.sum()),
        lambda _: f"the first of them at step {first + 1} of {len(unequal)}",
        unequal.size,
    )


@check("execution", Check("batched, {threads}", SERIAL, 0.0, UNIT))
def batched(model: mujoco.MjModel, threads: str, simulations: int, steps: int) -> Iterator[Case]:
    """Compare a batch with simulations in series; each simulation has different commands."""
    inputs = np.stack([commands(model, steps, seed) for seed in range(simulations)], axis=1)
    batch = Batch(model, nsim=simulations, nthread=THREADS[threads])
    batch_controls = batch.bind("ctrl").reshape(simulations, -1)
    fields = [
        batch.bind(name).reshape(simulations, -1)
        for name in ("time", "qpos", "qvel", "act", "plugin_state")
    ]
    ours = []
    for control in inputs:
        batch_controls[:] = control
        batch.step()
        ours.append(np.concatenate(fields, axis=1))
    serial = [
        _advance_states(model, mujoco.MjData(model), inputs[:, index])
        for index in range(simulations)
    ]
    yield bit_differences(np.array(ours), np.stack(serial, axis=1))


@check(
    "execution",
    Check("copied", "the original", 0.0, UNIT),
    Check("restored", "the run it was taken from", 0.0, UNIT),
)
def copied_and_restored(
    model: mujoco.MjModel, steps: int, state: mujoco.mjtState = STATE
) -> Iterator[tuple[Case, ...]]:
    """Compare a copied `MjData`, and one restored from a state vector, with the original.

    Both are created halfway through a run, and each then simulates the second half.
    """

    def restored(original: mujoco.MjData) -> mujoco.MjData:
        new_data, vector = mujoco.MjData(model), np.empty(mujoco.mj_stateSize(model, state))
        mujoco.mj_getState(model, original, vector, state)
        mujoco.mj_setState(model, new_data, vector, state)
        return new_data

    cases = []
    for seed, duplicate in enumerate((copy.copy, restored)):
        inputs, original = commands(model, 2 * steps, seed), mujoco.MjData(model)
        _advance_states(model, original, inputs[:steps])
        pair = duplicate(original), original
        cases.append(
            bit_differences(*(_advance_states(model, data, inputs[steps:]) for data in pair))
        )
    yield tuple(cases)


@check("execution", Check("forward passes", "one forward pass", 0.0, UNIT))
def forward_passes(model: mujoco.MjModel, steps: int) -> Iterator[Case]:
    """Check that three forward passes between steps leave the motors' states as one pass does.

    The motors' states are the activations and the states of plugins.
    """
    inputs, motor_start = commands(model, steps, seed=2), 1 + model.nq + model.nv
    data = mujoco.MjData(model)
    after_one, after_three = [], []
    for control in inputs:
        data.ctrl[:] = control
        inspected = copy.copy(data)
        mujoco.mj_forward(model, inspected)
        after_one.append(_state(inspected)[motor_start:])
        for _ in range(2):
            mujoco.mj_forward(model, inspected)
        after_three.append(_state(inspected)[motor_start:])
        mujoco.mj_step(model, data)
    yield bit_differences(np.array(after_three), np.array(after_one))


def model_checks(
    model: mujoco.MjModel, quick: bool = False, state: mujoco.mjtState = STATE
) -> Iterator[Check]:
    """Run the checks of a model whose callbacks are installed; `state` selects the state vector."""
    simulations, steps = (6, 40) if quick else (32, 200)
    for threads in THREADS:
        yield from batched(model, threads, simulations, steps)
    yield from copied_and_restored(model, steps, state)
    yield from forward_passes(model, steps)


# -- a task with its bounds and its integrator -----------------------------------------------------


def _episode(physics: MujocoPhysics, forces: np.ndarray, inspect: bool = False) -> np.ndarray:
    """Return mechanical and motor states after each step, with forward passes if `inspect`."""
    states = []
    for force in forces:
        physics.step(force)
        states.append(np.concatenate([physics.state, physics.data.act]))
        if inspect:
            mujoco.mj_forward(physics.model, physics.data)
    return np.array(states)


def _simulation(
    task: Task, integrator: str, seed: int, steps: int
) -> tuple[MujocoPhysics, np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    physics = MujocoPhysics(
        SimulationConfig(task, paper_actuators(task), task.motor_inner_steps, integrator)
    )
    initial = task.draw_initial_state(generator, None)
    physics.reset(initial)
    return (
        physics,
        initial,
        scaled_forces(task, generator.uniform(-1.0, 1.0, steps * len(task.motors))),
    )


@check(
    "execution",
    Check("pickled, {integrator}", "the original", 0.0, UNIT),
    Check("repeated, {integrator}", "the first episode", 0.0, UNIT),
    Check("looked at, {integrator}", "an episode that nobody looks at", 0.0, UNIT),
)
def repeated(task: Task, integrator: str, steps: int) -> Iterator[tuple[Case, ...]]:
    """Compare a simulation pickled halfway, and episodes after a reset, with the original.

    In the last episode a forward pass follows every step, as in a viewer.
    """
    physics, _, forces = _simulation(task, integrator, 3, 2 * steps)
    _episode(physics, forces[:steps])
    pair = pickle.loads(pickle.dumps(physics)), physics
    cases = [bit_differences(*(_episode(simulation, forces[steps:]) for simulation in pair))]
    for seed, inspect in ((4, False), (5, True)):
        physics, initial, forces = _simulation(task, integrator, seed, steps)
        oracle = _episode(physics, forces)
        physics.reset(initial)
        cases.append(bit_differences(_episode(physics, forces, inspect), oracle))
    yield tuple(cases)


def checks(task_name: str, quick: bool = False) -> Iterator[Check]:
    """Run the execution checks of a task."""
    task = find_task(task_name)
    physics, _, _ = _simulation(task, task.integrators[0], 0, 1)
    assert motors(physics.model)
    install_callbacks(physics.model)
    yield from model_checks(physics.model, quick)
    for integrator in task.integrators:
        yield from repeated(task, integrator, 30 if quick else 200)
