"""The networks have the paper's layers, and a policy does not depend on how it was created."""

import operator

import gymnasium
import numpy as np
import pytest
import torch
from torch import nn

from codrl_mj.agents import AGENTS, DDPGConfig, PPOConfig
from codrl_mj.agents.presets import OTHER_ENV, PRESETS, find_preset
from tests.agents.small import make_envs, make_model

EVERY = [
    (agent, task, name) for (agent, task), of in PRESETS.items() for name in of if task != OTHER_ENV
]


def policy_of(config, task, **arguments):
    envs = make_envs(task, **arguments)
    return config.make_policy(envs.observation_space, envs.action_space)


def paper(agent, task):
    return find_preset(agent, task, "paper").agent


def layers(module):
    """Return (inputs, outputs) of linear layers and names of other layers, in order."""
    return [
        (
            (layer.in_features, layer.out_features)
            if isinstance(layer, nn.Linear)
            else type(layer).__name__
        )
        for layer in module.modules()
        if isinstance(layer, (nn.Linear, nn.ReLU, nn.Tanh))
    ]


def observations(task, count=50):
    space = make_envs(task).observation_space
    low, high = np.maximum(space.low, -10), np.minimum(space.high, 10)
    return np.random.default_rng(0).uniform(low, high, (count, *space.shape)).astype(np.float32)


CAR = "mountain_car_continuous"
TWO_STREAMS = [(3, 1), "ReLU", (1, 32), "ReLU", (33, 256), "ReLU", (256, 256), "ReLU", (256, 1)]
ACTOR = [(64, 64), "ReLU", (64, 1), "Tanh"]


@pytest.mark.parametrize(
    ("config", "task", "part", "expected"),
    [
        (paper("ddpg", "pendulum"), "pendulum", "actor", [(3, 64), "ReLU", *ACTOR]),
        (paper("ddpg", "pendulum"), "pendulum", "critic", TWO_STREAMS),
        (paper("ddpg", "pendulum"), "pendulum", "critic_target", TWO_STREAMS),
        (paper("ddpg", CAR), CAR, "actor", [(2, 64), "ReLU", *ACTOR]),
        (paper("ddpg", CAR), CAR, "critic", [(2, 64), "ReLU", (65, 64), "ReLU", (64, 1)]),
        (
            paper("dqn", "acrobot"),
            "acrobot",
            "q_net",
            [(6, 64), "ReLU", (64, 128), "ReLU", (128, 3)],
        ),
        (
            paper("ppo", "cartpole"),
            "cartpole",
            "mlp_extractor.policy_net",
            [(4, 64), "Tanh", (64, 64), "Tanh"],
        ),
        (
            paper("ppo", "cartpole"),
            "cartpole",
            "mlp_extractor.value_net",
            [(4, 64), "Tanh", (64, 64), "Tanh"],
        ),
        (paper("ppo", "cartpole"), "cartpole", "action_net", [(64, 2)]),
        (paper("ppo", "cartpole"), "cartpole", "value_net", [(64, 1)]),
        (
            PPOConfig(hidden=(5,), activation="relu"),
            "cartpole",
            "mlp_extractor.policy_net",
            [(4, 5), "ReLU"],
        ),
    ],
)
def test_layers_are_those_of_the_paper_or_the_settings(config, task, part, expected):
    """Compare (inputs, outputs) of linear layers; of two streams those of state, action, joint."""
    assert layers(operator.attrgetter(part)(policy_of(config, task))) == expected


def test_the_critic_of_two_streams_is_the_function_that_the_paper_describes():
    policy = policy_of(find_preset("ddpg", "pendulum", "repaired").agent, "pendulum")
    states, actions = torch.randn(20, 3), torch.rand(20, 1) * 2 - 1
    (values,) = policy.critic(states, actions)
    tensors = {name: tensor.numpy() for name, tensor in policy.critic.state_dict().items()}

    def apply(layer, inputs):
        weight, bias = (tensors[f"qf0.{layer}.{part}"] for part in ("weight", "bias"))
        return inputs @ weight.T + bias

    def relu(x):
        return np.maximum(x, 0)

    state = relu(apply("state_stream.2", relu(apply("state_stream.0", states.numpy()))))
    joint = np.concatenate([state, relu(apply("action_stream.0", actions.numpy()))], axis=1)
    expected = apply("joint.4", relu(apply("joint.2", relu(apply("joint.0", joint)))))
    np.testing.assert_allclose(values.detach().numpy(), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("task", "limit"), [("pendulum", 2.0), (CAR, 1.0)])
def test_ddpg_acts_within_the_range_that_tanh_spans(task, limit):
    policy = policy_of(paper("ddpg", task), task)
    policy.actor.mu[-2].bias.data.fill_(100.0)
    np.testing.assert_allclose(
        policy.predict(observations(task), deterministic=True)[0], limit, rtol=1e-6
    )


@pytest.mark.parametrize("agent", ["ppo", "ddpg", "td3", "sac"])
def test_input_scale_multiplies_the_observation(agent):
    """A network with factors equals the one without factors on observations times the factors."""
    task, factors = CAR, (0.5, 10.0)
    plain, scaled = (policy_of(AGENTS[agent](input_scale=scale), task) for scale in (None, factors))
    scaled.load_state_dict(plain.state_dict())
    inputs = observations(task)
    times = inputs * np.array(factors, np.float32)
    ours, theirs = (
        policy.predict(values, deterministic=True)[0]
        for policy, values in ((scaled, inputs), (plain, times))
    )
    np.testing.assert_array_equal(ours, theirs)
    if agent != "ppo":  # critics too
        actions = torch.zeros(len(inputs), 1)
        ours, theirs = (
            scaled.critic(torch.tensor(inputs), actions),
            plain.critic(torch.tensor(times), actions),
        )
        assert all(map(torch.equal, ours, theirs))


def test_entries_without_a_factor_are_not_scaled():
    """An observation with the actuator's signals has more entries than there are factors."""
    policy = policy_of(DDPGConfig(input_scale=(1.0, 10.0)), CAR, observe_actuator=True)
    assert policy.actor.features_extractor.factors.tolist() == [1, 10, 1, 1]


@pytest.mark.matrix
@pytest.mark.parametrize(("command", "largest"), [("force", 0.084), ("voltage", 18.0)])
def test_unit_actions_are_multiplied_by_the_largest_action(command, largest):
    configs = (
        PPOConfig(log_std_init=-0.5, unit_actions=unit_actions) for unit_actions in (False, True)
    )
    plain, units = (policy_of(config, "furuta", action=command) for config in configs)
    units.load_state_dict(plain.state_dict())
    inputs = torch.as_tensor(observations("furuta"))
    ours, theirs = (
        units.get_distribution(inputs).distribution,
        plain.get_distribution(inputs).distribution,
    )
    torch.testing.assert_close(ours.mean, largest * theirs.mean)
    torch.testing.assert_close(ours.stddev, torch.full_like(ours.stddev, largest * np.exp(-0.5)))


def test_the_largest_action_may_be_a_negative_one():
    envs, space = make_envs("furuta"), gymnasium.spaces.Box(-2.0, 0.0, (1,), np.float32)
    policy = PPOConfig(log_std_init=0.0, unit_actions=True).make_policy(
        envs.observation_space, space
    )
    spread = policy.get_distribution(torch.as_tensor(observations("furuta"))).distribution.stddev
    torch.testing.assert_close(spread, torch.full_like(spread, 2.0))


@pytest.mark.parametrize(("agent", "task", "settings"), EVERY)
def test_weights_restore_the_same_policy(agent, task, settings):
    preset = find_preset(agent, task, settings)
    model = make_model(preset.agent, task, seed=3, num_envs=preset.num_envs)
    policy = preset.agent.make_policy(model.observation_space, model.action_space)
    # This raises an error unless all names and shapes are the same.
    policy.load_state_dict(model.policy.state_dict())
    ours, theirs = (
        each.predict(observations(task), deterministic=True)[0] for each in (policy, model.policy)
    )
    np.testing.assert_array_equal(ours, theirs)
