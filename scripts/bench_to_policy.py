"""Go from bench logs to a policy: identify the motor, randomize within its intervals, test.

The real motor differs from its datasheet: more friction, a higher resistance and a lower torque
constant. Only its logs show that. Agents learn Pendulum through the datasheet's motor and through
the identified one, randomized within its intervals, and are tested on the real one. Interrupted
trainings are resumed.
"""

import argparse
import dataclasses
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.actuators import identified_ranges, mapping_of
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import evaluate
from codrl_mj.identify import Log, identify, read_log
from codrl_mj.identify.synthetic import Excitation, Sampler, Sensor, simulate, write_log
from codrl_mj.runs.policies import load_policy
from codrl_mj.sizing.limits import find_drive
from codrl_mj.training import TrainConfig, train

TASK, EPISODES, TEST_SEED = "pendulum", 20, 3_000_000
DATASHEET = find_drive("maxon-ec45-flat-50w", gear_ratio=20.0)
REAL = dataclasses.replace(
    DATASHEET,
    motor=dataclasses.replace(
        DATASHEET.motor,
        resistance=1.2 * DATASHEET.motor.resistance,
        torque_constant=0.93 * DATASHEET.motor.torque_constant,
        back_emf_constant=0.93 * DATASHEET.motor.torque_constant,
        coulomb_friction=4.0 * DATASHEET.motor.coulomb_friction,
        viscous_friction=1e-4,  # N*m*s/rad at the rotor
    ),
)
# Noise in A, resolution in rad.
SENSORS = {
    "current": Sensor(noise=0.05),
    "position": Sensor(resolution=2.0 * np.pi / 4096),
}
COLUMNS = "time=time:s,voltage=mean(voltage):V,current=current:A,position=position:rad"


def main() -> None:
    """Log, identify, train and test."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=Path("runs/bench_to_policy"), help="folder for all outputs"
    )
    parser.add_argument("--seeds", type=int, default=3, help="trainings of each kind")
    parser.add_argument(
        "--total-steps", type=int, default=15_000, help="environment steps of a training"
    )
    options = parser.parse_args()
    logs = list(_bench())
    # The third log is held out: it only tests the fit.
    fit = identify(logs[:2], "free", {"gear_ratio": 20.0, "load_inertia": 0.0}, held_out=logs[2:])
    for estimate in fit.estimates:
        real = getattr(REAL.motor, estimate.name, None)
        print(
            f"{estimate.name}: {estimate.value:.4g} [{estimate.low:.4g}, {estimate.high:.4g}]"
            f" {estimate.unit}, {estimate.status}; real {real}"
        )
    fit.write(options.out)
    fitted = options.out / "actuator.yaml"
    through = {
        "datasheet": EnvConfig(TASK, mapping_of(DATASHEET)),
        "identified": EnvConfig.from_mapping(
            {"task": TASK, "actuator": str(fitted), "randomize": identified_ranges(str(fitted))}
        ),
    }
    print("| trained through | on the datasheet's motor | on the real motor |\n| --- | --- | --- |")
    for name, env in through.items():
        runs = [
            _trained(env, options.out / f"{name}-{seed}", seed, options.total_steps)
            for seed in range(options.seeds)
        ]
        print(f"| {name} | {_tested(runs, DATASHEET)} | {_tested(runs, REAL)} |", flush=True)


def _bench() -> Iterator[Log]:
    """Simulate three logs of the real motor without a load; yield them as read from files."""
    excitation = Excitation("prbs", amplitude=20.0, duration=4.0, clock=2e-3)
    sampler = Sampler(rate=5000.0, mean_voltage=True)
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(3):
            path = Path(folder) / f"bench{seed}.csv"
            write_log(
                path,
                simulate(
                    REAL, excitation, sensors=SENSORS, sampler=sampler, seed=seed, name=path.stem
                ),
            )
            yield read_log(path, COLUMNS)


def _trained(env: EnvConfig, out: Path, seed: int, steps: int) -> Path:
    config = TrainConfig.preset(TASK, "sac", seed=seed, total_steps=steps)
    return train(dataclasses.replace(config, env=env), out, resume=True, tensorboard=False)


def _tested(runs: list[Path], motor: Any) -> str:
    """Return mean, minimum and maximum return over the runs, and the share of upright episodes."""
    tests = [
        evaluate(load_policy(run), EnvConfig(TASK, motor), EPISODES, TEST_SEED) for run in runs
    ]
    returns = [evaluation.returns.mean for evaluation in tests]
    upright = np.mean(
        [evaluation.success.mean for evaluation in tests if evaluation.success is not None]
    )
    return f"{np.mean(returns):.0f} [{min(returns):.0f}, {max(returns):.0f}], {upright:.0%} upright"


if __name__ == "__main__":
    main()
