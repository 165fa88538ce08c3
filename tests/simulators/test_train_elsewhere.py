"""The example of docs/train_elsewhere.md trains in MJX, and its policies act in our engine."""

import re
import shutil
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import codrl_mj
from codrl_mj import cli
from codrl_mj.runs.policies import load_policy

torch = pytest.importorskip("torch", reason="NOT RUN: torch is not installed: make simulators")
jax = pytest.importorskip("jax", reason="NOT RUN: JAX is not installed: make simulators")
pytest.importorskip("mujoco.mjx", reason="NOT RUN: no MJX: make simulators")

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "train_elsewhere"
PAGE = (ROOT / "docs" / "train_elsewhere.md").read_text()
STEPS = 16_384
"""Steps of the short training: more than an episode of each world."""
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


class Example:
    """Modules of the example, and what its programs wrote."""

    def __init__(self, folder):  # noqa: D107
        # These modules are in the example's folder.
        import compare
        import swing_up
        import swing_up_mjx
        import train_mjx

        self.compare, self.task, self.train = compare, swing_up, train_mjx
        self.policies = folder / "policies"
        self.worlds = swing_up_mjx.Worlds(swing_up.ACTUATORS["motor"], train_mjx.NUM_WORLDS)

    def run(self, program, *words):
        """Run a program with the motor alone, in worlds that are compiled once."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("sys.argv", [program.__name__, *map(str, words)])
            patch.setattr(program, "ACTUATORS", {"motor": self.task.ACTUATORS["motor"]})
            patch.setattr(program, "Worlds", lambda *_: self.worlds)
            program.main()


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    folder = tmp_path_factory.mktemp("example")
    shutil.copytree(EXAMPLE, folder, dirs_exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(folder)
        before = {*sys.modules}
        example = Example(folder)
        example.run(example.train, "--out", example.policies, "--seeds", 1, "--steps", STEPS)
        yield example
        for name in {path.stem for path in EXAMPLE.glob("*.py")} - before:
            sys.modules.pop(name, None)
        gymnasium.registry.pop("SwingUp-v0", None)


def actor(folder, observations):
    """Return the actions that follow from the weights in a policy's file, shape (N, 1)."""
    from safetensors.numpy import load_file

    weights = load_file(folder / "policy.safetensors")
    values = observations
    for layer in ("mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2"):
        values = np.tanh(values @ weights[f"{layer}.weight"].T + weights[f"{layer}.bias"])
    means = values @ weights["action_net.weight"].T + weights["action_net.bias"]
    return np.clip(0.48 * means, -0.48, 0.48)


def test_a_policy_of_mjx_acts_in_our_engine(example):
    policy, actions = load_policy(example.policies / "motor-0"), []
    env = codrl_mj.make(example.compare.TASK, example.task.ACTUATORS["motor"])
    states = example.compare.initial_states()
    positions = np.zeros((example.task.TIME_LIMIT - 1, 4))
    observations = []
    for episode in range(positions.shape[1]):
        observation, _ = env.reset(seed=example.compare.SEED + episode)
        assert env.unwrapped.data.qpos[0] == states[0, episode]
        for row in positions[:, episode : episode + 1]:
            action, _ = policy.predict(observation, deterministic=True)
            observations.append(observation)
            actions.append(action)
            observation, *_ = env.step(action)
            row[:] = env.unwrapped.data.qpos[0]
    env.close()
    gap = np.abs(np.array(actions) - actor(example.policies / "motor-0", np.array(observations)))
    assert np.ptp(actions) > 0.1
    assert gap.max() < 1e-6
    in_mjx = example.compare.play(policy, example.worlds, states).positions[:, :4]
    difference = np.abs(in_mjx - positions)
    print("largest difference of an angle", difference.max(), "range", np.ptp(positions))
    assert np.ptp(positions) > 1.0
    assert difference.max() < 1e-4


def test_the_programs_write_tables_of_a_policy(example, capsys):
    example.run(example.compare, example.policies)
    header, _, row = capsys.readouterr().out.splitlines()[-3:]
    assert header.startswith("| trained on |")
    assert row.startswith("| motor | motor |")
    curve = (example.policies / "learning_curves.csv").read_text().splitlines()
    assert curve[0] == "trained on,seed,steps,return"
    assert [line.rsplit(",", 1)[0] for line in curve[1:]] == ["motor,0,12800"]
    assert (example.policies / "learning_curves.png").stat().st_size > 10_000
    (values,) = (example.policies / "returns.csv").read_text().splitlines()[1:]
    mjx, ours = map(float, values.split(",")[3:5])
    assert abs(mjx - ours) < 0.05
    assert -1000.0 < ours < 200.0


def test_the_command_of_the_page_evaluates_the_policy(example, capsys):
    (line,) = re.findall(r"^\$ codrl-mj (evaluate policies/motor-0 .*)$", PAGE, re.MULTILINE)
    assert cli.main([*line.split(), "--episodes", "1"]) == 0
    assert "motor-0 on motor" in capsys.readouterr().out


def test_weights_of_another_trainer_become_a_policy(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (block,) = (
        text for text in re.findall(r"```py\n(.*?)```", PAGE, re.DOTALL) if "kernel" in text
    )
    generator = np.random.default_rng(0)
    layers = [
        tuple(jax.numpy.asarray(0.2 * generator.normal(size=size)) for size in (shape, shape[1:]))
        for shape in ((3, 64), (64, 64), (64, 1))
    ]
    exec(block, {"layers": layers})
    observations = generator.normal(size=(50, 3)).astype(np.float32)
    actions, _ = load_policy(Path("mine")).predict(observations, deterministic=True)
    values = observations
    for kernel, bias in layers[:2]:
        values = jax.numpy.tanh(values @ kernel + bias)
    expected = np.clip(0.48 * (values @ layers[2][0] + layers[2][1]), -0.48, 0.48)
    assert np.mean(np.abs(expected) < 0.48) > 0.1
    assert np.abs(actions - expected).max() < 1e-6


def test_mjlab_moves_the_rod_as_our_engine_does(example):
    pytest.importorskip("mjlab", reason="NOT RUN: mjlab is not installed: make simulators")
    import step_mjlab

    angles, ours = step_mjlab.angles_in_mjlab(), step_mjlab.angles_in_our_engine()
    assert np.ptp(ours, axis=0).max() > 1.0
    assert np.abs(angles - ours).max() < 1e-5
