"""The experiments of the mismatch study: who is trained on what, tested on what, and compared with whom."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence

from codrl_mj.study.conditions import Condition, conditions, ladder, stall_supply
from codrl_mj.study.plan import AGENTS, PAPER_RADIUS, Arm, Comparison, Plan, Trial


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A question to be put to every task."""

    title: str
    """Heading."""
    about: str
    """What is trained, tested and compared, and why: a paragraph of Markdown."""
    plan: Callable[[str], Plan | None]
    """(task) -> what is done on it; None if the question does not arise there."""


EXACT_OVER_IDEAL = "trained on it, over trained on ideal"


def _plan(
    trials: Iterable[Trial], comparisons: Iterable[Comparison], series: Mapping[str, Iterable[Trial]] | None = None
) -> Plan:
    """A plan in which every trial comes once."""
    return Plan(
        tuple({trial.name: trial for trial in trials}.values()),
        tuple(comparisons),
        tuple((label, tuple(drawn)) for label, drawn in (series or {}).items()),
    )


def _main(task: str, condition: Condition, **changes: object) -> Arm:
    """The arm of the task's main agent on a condition."""
    return Arm(task, AGENTS[task][0], condition, **changes)  # type: ignore[arg-type]


def _every(arms: Iterable[Arm], tests: Sequence[Condition]) -> list[Trial]:
    return [Trial(arm, test) for arm in arms for test in tests]


def _own(arms: Mapping[str, Arm], tests: Iterable[Condition]) -> list[Trial]:
    """Every arm on the condition that it was trained on."""
    return [Trial(arms[test.name], test) for test in tests]


def _on(
    question: str, tests: Iterable[Condition], one: Mapping[str, Arm], other: Mapping[str, Arm]
) -> list[Comparison]:
    """The question on each test condition.

    Args:
        question: the question.
        tests: the conditions.
        one: the arm that may be better, by the condition's name.
        other: the arm that it is compared with.
    """
    return [
        Comparison(question, Trial(one[test.name], test), Trial(other[test.name], test))
        for test in tests
        if one[test.name] != other[test.name]
    ]


def _matrix(task: str) -> Plan:
    tests = list(conditions(task).values())
    arms = {test.name: _main(task, test) for test in tests}
    ideal, paper = (dict.fromkeys(arms, arms[name]) for name in ("ideal", "paper"))
    return _plan(
        _every(arms.values(), tests),
        [
            *_on(EXACT_OVER_IDEAL, tests, arms, ideal),
            *_on("trained on it, over trained on paper", tests, arms, paper),
        ],
    )


def _ladder(task: str) -> Plan:
    rungs = list(ladder(task).values())
    arms = {rung.name: _main(task, rung) for rung in rungs}
    ideal, paper = (dict.fromkeys(arms, arms[name]) for name in ("ideal", "paper"))
    series = {
        "trained on ideal": _every([arms["ideal"]], rungs),
        "trained on paper": _every([arms["paper"]], rungs),
        "trained on the rung": _own(arms, rungs),
    }
    return _plan(
        [trial for trials in series.values() for trial in trials],
        [
            *_on("trained on the rung, over trained on ideal", rungs, arms, ideal),
            *_on("trained on the rung, over trained on paper", rungs, arms, paper),
        ],
        series,
    )


def _action(task: str) -> Plan:
    known = conditions(task)
    tests = [known["paper"], stall_supply(task), known["slow_winding"]]
    force, voltage, seeing = (
        {test.name: _main(task, test, **changes) for test in tests}
        for changes in ({}, {"action": "voltage"}, {"action": "voltage", "observe": True})
    )
    kinds = (force, voltage, seeing)
    # a table of voltages is one of a supply: policies move between the two motors on 24 V
    moved = [Trial(arms["paper"], known["slow_winding"]) for arms in kinds]
    series = {
        "force through the loop": _own(force, tests),
        "voltage": _own(voltage, tests),
        "voltage, current observed": _own(seeing, tests),
        "force, trained on paper": moved[:1],
        "voltage, trained on paper": moved[1:2],
        "voltage, current observed, trained on paper": moved[2:],
    }
    return _plan(
        [trial for trials in series.values() for trial in trials],
        [
            *_on("voltage, over force through the loop", tests, voltage, force),
            *_on("voltage with the current observed, over force through the loop", tests, seeing, force),
            *_on("voltage with the current observed, over without", tests, seeing, voltage),
            Comparison("trained on paper: voltage, over force through the loop", moved[1], moved[0]),
            Comparison(
                "trained on paper: voltage with the current observed, over force through the loop", moved[2], moved[0]
            ),
        ],
        series,
    )


def _observation(task: str) -> Plan:
    known = conditions(task)
    tests = [known[name] for name in ("weaker", "open_loop", "delay", "randomised")]
    blind, seeing = ({test.name: _main(task, test, observe=observe) for test in tests} for observe in (False, True))
    drawn = [dict.fromkeys(blind, arms["randomised"]) for arms in (seeing, blind)]
    question = "current observed, over not observed"
    series = {
        "not observed": _own(blind, tests),
        "observed": _own(seeing, tests),
        "not observed, trained on randomised": _every([blind["randomised"]], tests[:-1]),
        "observed, trained on randomised": _every([seeing["randomised"]], tests[:-1]),
    }
    return _plan(
        [trial for trials in series.values() for trial in trials],
        [
            *_on(question, tests, seeing, blind),
            *_on(f"trained on randomised: {question}", tests[:-1], *drawn),
        ],
        series,
    )


def _randomised(task: str) -> Plan:
    tests = list(conditions(task).values())
    exact = {test.name: _main(task, test) for test in tests}
    ideal, drawn = (dict.fromkeys(exact, exact[name]) for name in ("ideal", "randomised"))
    series = {
        "trained on ideal": _every([exact["ideal"]], tests),
        "trained on randomised": _every([exact["randomised"]], tests),
        "trained on it": _own(exact, tests),
    }
    return _plan(
        [trial for trials in series.values() for trial in trials],
        [
            *_on("trained on randomised, over trained on ideal", tests, drawn, ideal),
            *_on("trained on randomised, over trained on it", tests, drawn, exact),
        ],
        series,
    )


def _reward(task: str) -> Plan | None:
    if task != "cartpole":
        return None  # the paper trains the others with Gymnasium's rewards
    known = conditions(task)
    tests = [known[name] for name in ("ideal", "paper", "weaker", "open_loop")]
    paper, plain = ({test.name: _main(task, test, plain_reward=plainly) for test in tests} for plainly in (False, True))
    from_ideal = [dict.fromkeys(arms, arms["ideal"]) for arms in (plain, paper)]
    return _plan(
        _every([*paper.values(), *plain.values()], tests),
        [
            *_on(f"the paper's reward: {EXACT_OVER_IDEAL}", tests, paper, from_ideal[1]),
            *_on(f"plain reward: {EXACT_OVER_IDEAL}", tests, plain, from_ideal[0]),
            *_on("trained on ideal: plain reward, over the paper's", tests, *from_ideal),
            *_on("trained on it: plain reward, over the paper's", tests, plain, paper),
        ],
    )


def _agents(task: str) -> Plan:
    known = conditions(task)
    tests = [known[name] for name in ("ideal", "weaker", "open_loop")]
    first, second = ({test.name: Arm(task, agent, test) for test in tests} for agent in AGENTS[task])
    main, other = AGENTS[task]
    return _plan(
        _every([*first.values(), *second.values()], tests),
        [
            *_on(f"{main}: {EXACT_OVER_IDEAL}", tests, first, dict.fromkeys(first, first["ideal"])),
            *_on(f"{other}: {EXACT_OVER_IDEAL}", tests, second, dict.fromkeys(second, second["ideal"])),
            *_on(f"trained on it: {other}, over {main}", tests, second, first),
        ],
    )


EXPERIMENTS: dict[str, Experiment] = {
    "matrix": Experiment(
        "Train on one actuator, test on another",
        "Every policy is tested on every actuator. The diagonal is what training on the actuator itself gives, the row "
        "`ideal` what is left of a policy that has never met a motor.",
        _matrix,
    ),
    "ladder": Experiment(
        "From ideal to real, one rung at a time",
        "Each rung adds one thing to the actuator, on top of all before it. Where the return of the ideal-trained "
        "and of the paper-trained policy falls is where it is lost; training on the rung itself shows what can be had "
        "there.",
        _ladder,
    ),
    "action": Experiment(
        "Force through the loop, or voltage end to end",
        "The paper's agent commands a force, and a current loop makes it. The alternative commands the motor's voltage "
        "itself, with the same agent and the same number of steps, on the same motor and supply. It may exceed the "
        "task's largest force, except at standstill on `stall_supply`; the tables' peak currents say by how much. "
        "Discrete tasks choose from seven voltages: none, and all, a quarter and a sixteenth of the supply, of either "
        "sign.",
        _action,
    ),
    "observation": Experiment(
        "With and without the measured current",
        "The winding's current is a state that the paper's agent does not see. Here it also observes the measured and "
        "the reference current.",
        _observation,
    ),
    "randomised": Experiment(
        "Training on drawn actuators, or on the exact one",
        "One policy is trained on actuators that are drawn anew for every episode. It is compared, on every actuator, "
        "with the ideal-trained one and with the one that was trained on that very actuator.",
        _randomised,
    ),
    "reward": Experiment(
        "The paper's reward and Gymnasium's",
        f"The paper trains CartPole with a reward that is 0 farther than {PAPER_RADIUS:g} m from the centre; "
        "Gymnasium's pays for every step. Both are tested with Gymnasium's.",
        _reward,
    ),
    "agents": Experiment(
        "Another agent",
        "The same question put to a second agent of another kind, with its own default settings and budget.",
        _agents,
    ),
}
"""The experiments, by name."""
