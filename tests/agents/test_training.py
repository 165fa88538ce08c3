"""Effects of a training step, its limits, and its repetition with a seed."""

import dataclasses

import pytest
import torch

from codrl_mj.agents import DDPGConfig, PPOConfig, SACConfig, SARSAConfig, TD3Config
from tests.agents.small import SMALL, differing, make_model, weights

TINY, LARGE = 1e-30, 1e-2
_SMALL = {"batch_size": 16, "buffer_size": 1000, "learning_starts": 30}
ACTOR_CRITIC = {
    "ddpg": DDPGConfig(actor_units=(8,), joint_units=(8,), **_SMALL),
    "td3": TD3Config(hidden=(8,), policy_delay=1, **_SMALL),
    "sac": SACConfig(hidden=(8,), entropy_coefficient=0.1, **_SMALL),
}


def with_rates(config, actor, critic):
    return dataclasses.replace(config, learning_rate=actor, critic_learning_rate=critic)


def separate_passes(**settings):
    """Return settings of PPO with separate passes and a single rollout."""
    defaults = {
        "rollout_steps": 128,
        "batch_size": None,
        "hidden": (8,),
        "critic_learning_rate": 1e-3,
    }
    return PPOConfig(**defaults | settings)


@pytest.mark.parametrize(
    ("config", "task"),
    [
        *((config, "pendulum") for config in (*ACTOR_CRITIC.values(), separate_passes())),
        (separate_passes(), "cartpole"),
    ],
    ids=lambda value: getattr(value, "name", value),
)
@pytest.mark.parametrize(("actor", "critic"), [(TINY, LARGE), (LARGE, TINY)])
def test_each_learning_rate_moves_its_own_network(config, task, actor, critic):
    model = make_model(with_rates(config, actor, critic), task)
    before = {
        name: tensor for name, tensor in weights(model.policy).items() if "target" not in name
    }
    model.learn(60)
    of_critic = {
        name
        for name in before
        if name.startswith(("critic", "mlp_extractor.value_net", "value_net"))
    }
    moved = of_critic if critic == LARGE else set(before) - of_critic
    assert differing(before, weights(model.policy), by=1e-20) == moved


@pytest.mark.parametrize("agent", ACTOR_CRITIC)
def test_the_critics_learning_rate_is_the_agents_unless_it_has_one(agent):
    config = ACTOR_CRITIC[agent]

    def train(critic):
        model = make_model(with_rates(config, LARGE, critic), "pendulum")
        model.learn(50)
        return weights(model.policy)

    assert not differing(train(None), train(LARGE))


def steps_taken(model):
    """Return Adam's step counts of the first tensor of the actor and of the critic."""
    optimizer = model.policy.optimizer
    return [int(optimizer.state[group["params"][0]]["step"]) for group in optimizer.param_groups]


@pytest.mark.parametrize(
    ("settings", "steps", "expected"),
    [
        ({"epochs": 3, "critic_epochs": 5, "target_kl": None}, 256, [2 * 3, 2 * 5]),  # two rollouts
        ({"epochs": 3, "batch_size": 32, "target_kl": None}, 128, [3 * 4, 3 * 4]),  # in minibatches
        # before its first step the policy has not moved at all; after one, by more than any tiny
        # bound
        ({"epochs": 7, "target_kl": 1e-12, "learning_rate": LARGE}, 128, [1, 7]),
    ],
)
def test_the_actor_stops_after_too_large_a_divergence_and_the_critic_continues(
    settings, steps, expected
):
    model = make_model(separate_passes(**settings), "cartpole")
    model.learn(steps)
    assert steps_taken(model) == expected


@pytest.mark.parametrize("target_kl", [0.003, 0.006, 0.012])
def test_the_actor_stops_at_one_and_a_half_times_the_bound(target_kl):
    """Compute the divergence from probabilities before each pass of an actor without a bound."""
    settings = {"learning_rate": LARGE, "critic_learning_rate": TINY, "epochs": 25}
    free = make_model(separate_passes(**settings, target_kl=None), "pendulum")
    moves, improve = [], free._improve_actor

    def watched():
        rollout = next(free.rollout_buffer.get())
        with torch.no_grad():
            now = free.policy.get_distribution(rollout.observations).log_prob(rollout.actions)
        log_ratio = now - rollout.old_log_prob
        moves.append(float((log_ratio.exp() - 1 - log_ratio).mean()))
        return improve()

    free._improve_actor = watched
    free.learn(128)
    expected = next(index for index, move in enumerate(moves) if move > 1.5 * target_kl)
    bound = make_model(separate_passes(**settings, target_kl=target_kl), "pendulum")
    bound.learn(128)
    assert 1 < expected < 25
    assert steps_taken(bound)[0] == expected


def test_separate_passes_equal_two_optimizers_of_clipped_loss_and_squared_error():
    model = make_model(
        separate_passes(learning_rate=3e-4, critic_learning_rate=1e-3, epochs=4, target_kl=None),
        "cartpole",
    )
    reference = make_model(separate_passes(learning_rate=3e-4), "cartpole").policy
    reference.load_state_dict(model.policy.state_dict())
    model.learn(128)
    critic = [*reference.mlp_extractor.value_net.parameters(), *reference.value_net.parameters()]
    actor = [*reference.mlp_extractor.policy_net.parameters(), *reference.action_net.parameters()]
    optimizers = (
        torch.optim.Adam(actor, lr=3e-4, eps=1e-5),
        torch.optim.Adam(critic, lr=1e-3, eps=1e-5),
    )
    rollout = next(model.rollout_buffer.get())
    advantage = (rollout.advantages - rollout.advantages.mean()) / rollout.advantages.std()
    for _ in range(4):
        value, log_probability, _ = reference.evaluate_actions(
            rollout.observations, rollout.actions.flatten()
        )
        ratio = torch.exp(log_probability - rollout.old_log_prob)
        losses = (
            -torch.minimum(ratio * advantage, ratio.clip(0.8, 1.2) * advantage).mean(),
            ((value.flatten() - rollout.returns) ** 2).mean(),
        )
        for loss, optimizer in zip(losses, optimizers, strict=True):
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    for name, tensor in reference.state_dict().items():
        torch.testing.assert_close(model.policy.state_dict()[name], tensor, rtol=1e-4, atol=1e-6)


LEARNING = SMALL | {"sarsa": (SARSAConfig(), "mountain_car")}


@pytest.mark.parametrize("agent", LEARNING)
def test_the_same_seed_gives_the_same_weights_and_another_seed_does_not(agent):
    def train(seed):
        model = make_model(*LEARNING[agent], seed)
        model.learn(64)
        return weights(model.policy)

    first, again, different = train(5), train(5), train(6)
    assert not differing(first, again)
    assert differing(first, different)


@pytest.mark.parametrize(
    ("agent", "settings", "steps_of_gradient"),
    [
        (
            "ddpg",
            {"train_every": None},
            lambda steps: steps,
        ),  # after every episode as many as it was long
        ("dqn", {"train_every": None}, lambda steps: steps),
        ("dqn", {"train_every": 8, "gradient_steps": 3}, lambda steps: steps / 8 * 3),
    ],
)
def test_gradient_steps_and_their_frequency_are_those_of_the_settings(
    agent, settings, steps_of_gradient
):
    config, task = SMALL[agent]
    model = make_model(
        dataclasses.replace(config, learning_starts=0, **settings), task, max_episode_steps=20
    )
    model.learn(96)
    assert model.num_timesteps >= 96
    assert model._n_updates == steps_of_gradient(model.num_timesteps)
