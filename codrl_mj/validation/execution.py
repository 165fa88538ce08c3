"""However it is executed, a simulation is the same, bit for bit: batched, copied, restored, pickled, reset, looked at.

The oracle is a plain loop over `mj_step`. A tolerance would hide a leak between simulations, so
there is none: what is counted is the number of 64-bit floats that differ.
"""

import copy
import pickle
from collections.abc import Iterator

import mujoco
import numpy as np
from mujoco.batch import Batch

from codrl_mj.physics import MujocoPhysics, SimulationConfig, install_callbacks, motors
from codrl_mj.tasks import Task, find_task
from codrl_mj.validation.compare import actuators_of, forces_of
from codrl_mj.validation.table import Case, Check, check

UNIT = "64-bit floats that differ"
SERIAL = "a loop over mj_step"
STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
"""What a state vector of a task holds: time, positions, velocities and activations, the motor's among them."""
FULL_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
"""The same for a user's model, whose contacts also need the solver's warm start."""
THREADS = {"1 thread": 1, "2 threads": 2}


def commands(model: mujoco.MjModel, steps: int, seed: int) -> np.ndarray:
    """Random controls, each held for five steps, within the control ranges or +-1: shape (steps, nu)."""
    limited = model.actuator_ctrllimited.astype(bool)
    low = np.where(limited, model.actuator_ctrlrange[:, 0], -1.0)
    high = np.where(limited, model.actuator_ctrlrange[:, 1], 1.0)
    drawn = np.random.default_rng(seed).uniform(low, high, (steps // 5 + 1, model.nu))
    return np.repeat(drawn, 5, axis=0)[:steps]


def _state(data: mujoco.MjData) -> np.ndarray:
    return np.concatenate([[data.time], data.qpos, data.qvel, data.act, data.plugin_state])


def _advance(model: mujoco.MjModel, data: mujoco.MjData, controls: np.ndarray) -> np.ndarray:
    """The states after each step under the given controls."""
    states = []
    for control in controls:
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
        states.append(_state(data))
    return np.array(states)


def differing(ours: np.ndarray, oracle: np.ndarray) -> np.ndarray:
    """Where two float64 arrays are not the same bits."""
    ours, oracle = (
        np.ascontiguousarray(array, dtype=np.float64).view(np.uint64) for array in (ours, oracle)
    )
    return ours != oracle


def bits(ours: np.ndarray, oracle: np.ndarray) -> Case:
    """States of shape (steps, n) or (steps, simulations, n): how many floats differ, and from which step on."""
    unequal = differing(ours, oracle)
    first = int(np.argmax(unequal.reshape(len(unequal), -1).any(axis=1)))
    return Case(
        float(unequal.sum()),
        lambda _: f"the first of them at step {first + 1} of {len(unequal)}",
        unequal.size,
    )


@check("execution", Check("batched, {threads}", SERIAL, 0.0, UNIT))
def batched(model: mujoco.MjModel, threads: str, simulations: int, steps: int) -> Iterator[Case]:
    """A batch, each simulation under commands of its own, against one simulation after the other."""
    inputs = np.stack([commands(model, steps, seed) for seed in range(simulations)], axis=1)
    batch = Batch(model, nsim=simulations, nthread=THREADS[threads])
    bound = batch.bind("ctrl").reshape(simulations, -1)
    fields = [
        batch.bind(name).reshape(simulations, -1)
        for name in ("time", "qpos", "qvel", "act", "plugin_state")
    ]
    ours = []
    for control in inputs:
        bound[:] = control
        batch.step()
        ours.append(np.concatenate(fields, axis=1))
    serial = [_advance(model, mujoco.MjData(model), inputs[:, each]) for each in range(simulations)]
    yield bits(np.array(ours), np.stack(serial, axis=1))


@check(
    "execution",
    Check("copied", "the original", 0.0, UNIT),
    Check("restored", "the run it was taken from", 0.0, UNIT),
)
def half_way(
    model: mujoco.MjModel, steps: int, state: mujoco.mjtState = STATE
) -> Iterator[tuple[Case, ...]]:
    """Half-way a copy of `MjData`, and a new one that a state vector is put into, against what they were made of."""

    def restored(original: mujoco.MjData) -> mujoco.MjData:
        fresh, vector = mujoco.MjData(model), np.empty(mujoco.mj_stateSize(model, state))
        mujoco.mj_getState(model, original, vector, state)
        mujoco.mj_setState(model, fresh, vector, state)
        return fresh

    cases = []
    for seed, twin_of in enumerate((copy.copy, restored)):
        inputs, original = commands(model, 2 * steps, seed), mujoco.MjData(model)
        _advance(model, original, inputs[:steps])
        pair = twin_of(original), original
        cases.append(bits(*(_advance(model, one, inputs[steps:]) for one in pair)))
    yield tuple(cases)


@check("execution", Check("forward passes", "one forward pass", 0.0, UNIT))
def forward_passes(model: mujoco.MjModel, steps: int) -> Iterator[Case]:
    """Between any two steps, three forward passes leave activations and plugins' states, the motors', as one does."""
    inputs, moving = commands(model, steps, seed=2), 1 + model.nq + model.nv
    data = mujoco.MjData(model)
    once, often = [], []
    for control in inputs:
        data.ctrl[:] = control
        looked_at = copy.copy(data)
        mujoco.mj_forward(model, looked_at)
        once.append(_state(looked_at)[moving:])
        for _ in range(2):
            mujoco.mj_forward(model, looked_at)
        often.append(_state(looked_at)[moving:])
        mujoco.mj_step(model, data)
    yield bits(np.array(often), np.array(once))


def model_checks(
    model: mujoco.MjModel, quick: bool = False, state: mujoco.mjtState = STATE
) -> Iterator[Check]:
    """The checks of any model whose callbacks are installed; a state vector holds `state`."""
    simulations, steps = (6, 40) if quick else (32, 200)
    for threads in THREADS:
        yield from batched(model, threads, simulations, steps)
    yield from half_way(model, steps, state)
    yield from forward_passes(model, steps)


# -- with a task's bounds and integrator around it ----------------------------------------------------------


def _episode(physics: MujocoPhysics, forces: np.ndarray, look: bool = False) -> np.ndarray:
    """The motor's and the mechanical state after each environment step, looked at by a forward pass or not."""
    states = []
    for force in forces:
        physics.step(force)
        states.append(np.concatenate([physics.state, physics.data.act]))
        if look:
            mujoco.mj_forward(physics.model, physics.data)
    return np.array(states)


def _simulation(
    task: Task, integrator: str, seed: int, steps: int
) -> tuple[MujocoPhysics, np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    physics = MujocoPhysics(
        SimulationConfig(task, actuators_of(task), task.motor_inner_steps, integrator)
    )
    initial = task.draw_initial_state(generator, None)
    physics.reset(initial)
    return physics, initial, forces_of(task, generator.uniform(-1.0, 1.0, steps * len(task.motors)))


@check(
    "execution",
    Check("pickled, {integrator}", "the original", 0.0, UNIT),
    Check("repeated, {integrator}", "the first episode", 0.0, UNIT),
    Check("looked at, {integrator}", "an episode that nobody looks at", 0.0, UNIT),
)
def again(task: Task, integrator: str, steps: int) -> Iterator[tuple[Case, ...]]:
    """A simulation that was pickled half-way, and episodes after a reset, against what they repeat.

    The last is looked at after every step: by a forward pass, as viewers make them.
    """
    physics, _, forces = _simulation(task, integrator, 3, 2 * steps)
    _episode(physics, forces[:steps])
    pair = pickle.loads(pickle.dumps(physics)), physics
    cases = [bits(*(_episode(each, forces[steps:]) for each in pair))]
    for seed, look in ((4, False), (5, True)):
        physics, initial, forces = _simulation(task, integrator, seed, steps)
        oracle = _episode(physics, forces)
        physics.reset(initial)
        cases.append(bits(_episode(physics, forces, look), oracle))
    yield tuple(cases)


def checks(task_name: str, quick: bool = False) -> Iterator[Check]:
    """The checks of this group."""
    task = find_task(task_name)
    physics, _, _ = _simulation(task, task.integrators[0], 0, 1)
    assert motors(physics.model)
    install_callbacks(physics.model)
    yield from model_checks(physics.model, quick)
    for integrator in task.integrators:
        yield from again(task, integrator, 30 if quick else 200)
