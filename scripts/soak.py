"""Run a million steps with random actuators: memory must not grow, threads must not matter.

Two vector environments draw new actuators for every episode and take the same random actions, one
on one thread, one on two. Their results must be equal bit for bit. The infos must account for each
end of an episode and each unstable draw. No unstable actuator may be used, and memory must not grow
after the first tenth.
"""

# isort: skip - before mujoco, which chooses its OpenGL platform when it is imported
import argparse
import hashlib
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Discrete
from gymnasium.vector import AutoresetMode

import codrl_mj
from codrl_mj import LogUniform
from codrl_mj.actuators import spectral_radius
from codrl_mj.cli.terminal import console
from codrl_mj.envs import ActuatedVectorEnv
from codrl_mj.tasks import PAPER_TASKS, TASKS, named_actuator

GROWTH = 4 * 2**20
"""Maximum growth of memory after the first tenth [bytes]: 4 MiB, less than 5 bytes a step."""


def resident() -> int:
    """Return the resident memory of this process [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


RANDOMIZE = {
    # The ranges are so wide that about a fifth of the draws are unstable at the tasks' steps.
    "motor.resistance": LogUniform(0.3, 3.0),
    "motor.inductance": LogUniform(0.1, 1.0),
    "motor.torque_constant": LogUniform(0.3, 3.0),
    "controller.kp": LogUniform(0.3, 30.0),
    "controller.ki": LogUniform(0.3, 30.0),
    "controller.max_voltage": LogUniform(1.0, 30.0),
}
"""Distributions of the actuators, which are drawn for every episode."""


def unstable(env: ActuatedVectorEnv) -> int:
    """Return the number of actuators in use whose loop is unstable, each judged separately."""
    drawn = env.randomization
    assert drawn is not None
    nominal = named_actuator("paper", env.task.name)
    timestep = env.task.step_duration / env.setup.inner_steps
    rows = ({name: float(drawn[name][row]) for name in RANDOMIZE} for row in range(env.num_envs))
    return sum(spectral_radius(nominal.replaced(values), timestep) >= 1.0 for values in rows)


def digest(results: tuple[Any, ...]) -> bytes:
    """Return a checksum of everything that a step returned, including infos."""
    checksum = hashlib.blake2b(digest_size=8)
    *arrays, infos = results
    for array in arrays:
        checksum.update(array.tobytes())
    for group in (infos, infos.get("randomization", {}), infos.get("final_info", {})):
        for name in sorted(group):
            if isinstance(group[name], np.ndarray) and group[name].dtype != object:
                checksum.update(group[name].tobytes())
    return checksum.digest()


def soak(task: str, num_envs: int, steps: int) -> int:
    """Step both environments and print the results.

    Returns:
            0, or 1 if anything was wrong.
    """
    generator = np.random.default_rng(0)
    limit = TASKS[task].max_episode_steps
    assert limit is not None
    arguments: dict[str, Any] = {
        "max_episode_steps": limit,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }
    arguments["randomize"] = RANDOMIZE
    envs = [
        ActuatedVectorEnv(num_envs, task, num_threads=threads, **arguments) for threads in (1, 2)
    ]
    first, _ = (env.reset(seed=0)[1] for env in envs)
    rejected = int(first["randomization"]["rejected"].sum())
    draws, num_unstable = num_envs, unstable(envs[0])
    space: Any = envs[0].single_action_space
    lengths = np.zeros(num_envs, dtype=np.int64)
    ended = truncations = finished_steps = differing = unaccounted = 0
    base, start = 0, time.perf_counter()
    for step in range(1, steps + 1):
        if isinstance(space, Discrete):
            actions = generator.integers(space.n, size=num_envs)
        else:
            actions = generator.uniform(space.low, space.high, (num_envs, 1)).astype(np.float32)
        single_threaded, two_threaded = (env.step(actions) for env in envs)
        differing += digest(single_threaded) != digest(two_threaded)
        _, _, terminated, truncated, infos = single_threaded
        ends = terminated | truncated
        lengths += 1
        unaccounted += int((lengths > limit).sum()) + int((truncated & (lengths != limit)).sum())
        if ends.any():
            unaccounted += int(
                (infos["_final_obs"] != ends).sum()
                + (infos["final_info"]["_current"] != ends).sum()
            )
            unaccounted += sum(
                not np.isfinite(observation).all() for observation in infos["final_obs"][ends]
            )
            unaccounted += int((infos["_randomization"] != ends).sum())
            rejected += int(infos["randomization"]["rejected"][ends].sum())
            draws += int(ends.sum())
        ended += int(ends.sum())
        truncations += int(truncated.sum())
        finished_steps += int(lengths[ends].sum())
        # After the first tenth all buffers have their final size.
        lengths[ends] = 0
        if step == max(1, steps // 10):
            base = resident()
        if step % max(1, steps // 10) == 0:
            num_unstable += unstable(envs[0])
            rate = 2 * step * num_envs / (time.perf_counter() - start)
            growth = (resident() - base) / 2**20
            console().print(
                f"{step * num_envs:>10,} steps on 1 and on 2 threads, {rate:,.0f} steps/s;"
                f" {ended:,} episodes ({truncations:,} to the limit); memory {growth:+.1f} MiB"
                " since the first tenth"
            )
    unaccounted += abs(finished_steps + int(lengths.sum()) - steps * num_envs)
    same_end = all(
        np.array_equal(envs[0].snapshot()[name], value)
        for name, value in envs[1].snapshot().items()
    )
    growth = resident() - base
    verdicts = {
        f"memory grew by {growth / 2**20:.1f} MiB, must be <= {GROWTH / 2**20:.0f}": (
            growth <= GROWTH
        ),
        f"steps that differ between 1 and 2 threads: {differing}": differing == 0,
        "physics, generators and counters are equal at the end": same_end,
        f"episodes or steps unaccounted for: {unaccounted}": unaccounted == 0,
        f"unstable actuators in use: {num_unstable} ({draws:,} drawn, {rejected:,} rejected)": (
            num_unstable == 0 and rejected > 0
        ),
    }
    for verdict, is_ok in verdicts.items():
        console().print(f"{'ok  ' if is_ok else 'FAIL'} {verdict}")
    return 0 if all(verdicts.values()) else 1


def main() -> int:
    """Run the soak test."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", choices=[task.name for task in PAPER_TASKS], default="cartpole")
    parser.add_argument("--num-envs", type=int, default=1024)
    parser.add_argument(
        "--steps",
        type=int,
        default=1_000_000,
        help="environment steps in all, on each of 1 and 2 threads",
    )
    options = parser.parse_args()
    for name in ("num_envs", "steps"):
        if getattr(options, name) < 1:
            parser.error(f"--{name.replace('_', '-')} {getattr(options, name)}: must be >= 1")
    console().print(f"codrl_mj {codrl_mj.__version__}, {os.cpu_count()} CPUs")
    return soak(options.task, options.num_envs, -(-options.steps // options.num_envs))


if __name__ == "__main__":
    sys.exit(main())
