"""The networks have the paper's layers, and nothing else about a policy depends on how it was made."""

import gymnasium
import numpy as np
import pytest
import torch
from torch import nn

from codrl_mj.agents import DDPGConfig, PPOConfig
from codrl_mj.agents.presets import ELSEWHERE, PRESETS, find_preset
from codrl_mj.tasks import TASKS
from tests.agents.small import make_envs, make_model

DEEP = [(agent, task, name) for (agent, task), of in PRESETS.items() for name in of]
DEEP = [(agent, task, name) for agent, task, name in DEEP if agent != "sarsa" and task != ELSEWHERE]


def make_policy(agent, task, settings="paper"):
    envs = make_envs(task)
    return find_preset(agent, task, settings).agent.make_policy(envs.observation_space, envs.action_space)


def layers(module):
    """The layers in their order: (inputs, outputs) of the linear ones, names of the others."""
    return [
        (layer.in_features, layer.out_features) if isinstance(layer, nn.Linear) else type(layer).__name__
        for layer in module.modules()
        if isinstance(layer, (nn.Linear, nn.ReLU, nn.Tanh))
    ]


def observations(task, count=50):
    space = make_envs(task).observation_space
    low, high = np.maximum(space.low, -10), np.minimum(space.high, 10)
    return np.random.default_rng(0).uniform(low, high, (count, *space.shape)).astype(np.float32)


def test_ddpg_for_the_pendulum():
    """Actor 64-64 ReLU, tanh; critic: state to 1, action to 32, joined 256-256, ReLU."""
    policy = make_policy("ddpg", "pendulum")
    assert layers(policy.actor) == [(3, 64), "ReLU", (64, 64), "ReLU", (64, 1), "Tanh"]
    for critic in (policy.critic, policy.critic_target):
        (network,) = critic.q_networks
        assert layers(network.state_stream) == [(3, 1), "ReLU"]
        assert layers(network.action_stream) == [(1, 32), "ReLU"]
        assert layers(network.joint) == [(33, 256), "ReLU", (256, 256), "ReLU", (256, 1)]
        assert layers(critic) == layers(network), "no other layers"


def test_ddpg_for_the_continuous_mountain_car():
    """Actor 64-64 ReLU, tanh; critic: state to 64 ReLU, joined with the action 64 ReLU."""
    policy = make_policy("ddpg", "mountain_car_continuous")
    assert layers(policy.actor) == [(2, 64), "ReLU", (64, 64), "ReLU", (64, 1), "Tanh"]
    assert layers(policy.critic) == [(2, 64), "ReLU", (65, 64), "ReLU", (64, 1)]


def test_dqn_for_the_acrobot():
    """64-128 ReLU, 6 observations, 3 actions."""
    policy = make_policy("dqn", "acrobot")
    assert layers(policy.q_net) == [(6, 64), "ReLU", (64, 128), "ReLU", (128, 3)]


def test_ppo_for_the_cart_pole():
    """64-64 tanh for actor and critic, 4 observations, 2 logits, 1 value."""
    policy = make_policy("ppo", "cartpole")
    assert layers(policy.mlp_extractor.policy_net) == [(4, 64), "Tanh", (64, 64), "Tanh"]
    assert layers(policy.mlp_extractor.value_net) == [(4, 64), "Tanh", (64, 64), "Tanh"]
    assert layers(policy.action_net) == [(64, 2)]
    assert layers(policy.value_net) == [(64, 1)]


def test_the_critic_of_two_streams_is_the_function_that_the_paper_describes():
    policy = make_policy("ddpg", "pendulum", "repaired")
    states, actions = torch.randn(20, 3), torch.rand(20, 1) * 2 - 1
    (values,) = policy.critic(states, actions)
    tensors = {name: tensor.numpy() for name, tensor in policy.critic.state_dict().items()}

    def apply(stream, index, inputs):
        weight, bias = (tensors[f"qf0.{stream}.{index}.{part}"] for part in ("weight", "bias"))
        return inputs @ weight.T + bias

    def relu(x):
        return np.maximum(x, 0)

    state = relu(apply("state_stream", 2, relu(apply("state_stream", 0, states.numpy()))))
    joint = np.concatenate([state, relu(apply("action_stream", 0, actions.numpy()))], axis=1)
    expected = apply("joint", 4, relu(apply("joint", 2, relu(apply("joint", 0, joint)))))
    np.testing.assert_allclose(values.detach().numpy(), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("task", "limit"), [("pendulum", 2.0), ("mountain_car_continuous", 1.0)])
def test_ddpg_acts_within_the_range_that_tanh_spans(task, limit):
    policy = make_policy("ddpg", task)
    policy.actor.mu[-2].bias.data.fill_(100.0)
    np.testing.assert_allclose(policy.predict(observations(task), deterministic=True)[0], limit, rtol=1e-6)


@pytest.mark.parametrize("agent", ["ppo", "ddpg", "td3", "sac"])
def test_factors_on_the_input_are_those_on_the_observation(agent):
    """A network with factors, on observations, is the network without them on observations times the factors."""
    task, factors = "mountain_car_continuous", (0.5, 10.0)
    envs = make_envs(task)
    config = find_preset(agent, task).agent
    plain, scaled = (
        type(config)(input_scale=scale).make_policy(envs.observation_space, envs.action_space)
        for scale in (None, factors)
    )
    scaled.load_state_dict(plain.state_dict())
    seen = observations(task)
    np.testing.assert_array_equal(
        scaled.predict(seen, deterministic=True)[0],
        plain.predict(seen * np.array(factors, np.float32), deterministic=True)[0],
    )
    if agent != "ppo":  # critics too
        actions = torch.zeros(len(seen), 1)
        for one, other in zip(
            scaled.critic(torch.tensor(seen), actions),
            plain.critic(torch.tensor(seen * np.array(factors, np.float32)), actions),
            strict=True,
        ):
            assert torch.equal(one, other)


def test_entries_without_a_factor_stay_as_they_are():
    """With the actuator observed, an observation has more entries than the settings have factors."""
    envs = make_envs("mountain_car_continuous", observe_actuator=True)
    policy = DDPGConfig(input_scale=(1.0, 10.0)).make_policy(envs.observation_space, envs.action_space)
    assert policy.actor.features_extractor.factors.tolist() == [1, 10, 1, 1]


@pytest.mark.matrix
@pytest.mark.parametrize(("command", "largest"), [("force", 0.084), ("voltage", 18.0)])
def test_unit_actions_are_those_of_a_plain_actor_times_the_largest(command, largest):
    envs = make_envs("furuta", action=command)
    plain, units = (
        PPOConfig(log_std_init=-0.5, unit_actions=given).make_policy(envs.observation_space, envs.action_space)
        for given in (False, True)
    )
    units.load_state_dict(plain.state_dict())
    seen = torch.as_tensor(observations("furuta"))
    ours, theirs = units.get_distribution(seen).distribution, plain.get_distribution(seen).distribution
    torch.testing.assert_close(ours.mean, largest * theirs.mean)
    torch.testing.assert_close(ours.stddev, torch.full_like(ours.stddev, largest * np.exp(-0.5)))


def test_the_largest_action_may_be_a_negative_one():
    envs, space = make_envs("furuta"), gymnasium.spaces.Box(-2.0, 0.0, (1,), np.float32)
    policy = PPOConfig(log_std_init=0.0, unit_actions=True).make_policy(envs.observation_space, space)
    spread = policy.get_distribution(torch.as_tensor(observations("furuta"))).distribution.stddev
    torch.testing.assert_close(spread, torch.full_like(spread, 2.0))


def test_unit_actions_are_refused_where_they_mean_nothing():
    with pytest.raises(ValueError, match="unit_actions = True: must be False with state_dependent_noise"):
        PPOConfig(unit_actions=True, state_dependent_noise=True)
    envs = make_envs("cartpole")
    with pytest.raises(ValueError, match="unit_actions = True: must be False for discrete actions"):
        PPOConfig(unit_actions=True).make_policy(envs.observation_space, envs.action_space)


def test_activation_is_as_asked():
    envs = make_envs("cartpole")
    policy = PPOConfig(hidden=(5,), activation="relu").make_policy(envs.observation_space, envs.action_space)
    assert layers(policy.mlp_extractor.policy_net) == [(4, 5), "ReLU"]


@pytest.mark.parametrize(("agent", "task", "settings"), DEEP)
def test_weights_make_the_same_policy_again(agent, task, settings):
    preset = find_preset(agent, task, settings)
    model = make_model(preset.agent, task, seed=3, num_envs=preset.num_envs)
    policy = preset.agent.make_policy(model.observation_space, model.action_space)
    assert {name: tensor.shape for name, tensor in policy.state_dict().items()} == {
        name: tensor.shape for name, tensor in model.policy.state_dict().items()
    }
    policy.load_state_dict(model.policy.state_dict())
    seen = observations(task)
    np.testing.assert_array_equal(
        policy.predict(seen, deterministic=True)[0], model.policy.predict(seen, deterministic=True)[0]
    )


def test_every_environment_is_covered():
    assert {task for _, task, _ in DEEP} == set(TASKS)
