"""The command line: parses, calls the package, prints. Nothing imports it."""

import ast
import dataclasses
import inspect
import itertools
import sys
import textwrap
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from codrl_mj.agents.ppo import PPOConfig
from codrl_mj.disturbances import Disturbances
from codrl_mj.env_config import EnvConfig
from codrl_mj.motor import NAMED, Actuator, CurrentLoop, Motor
from codrl_mj.registration import ENVIRONMENTS

TaskName = Literal[tuple(ENVIRONMENTS)]  # type: ignore[valid-type]


def _field_docs(kind: type) -> dict[str, str]:
    """The docstring below each field of a dataclass."""
    body = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0].body  # type: ignore[attr-defined]
    return {
        ast.unparse(field.target): " ".join(ast.literal_eval(doc.value).split())
        for field, doc in itertools.pairwise(body)
        if isinstance(field, ast.AnnAssign) and isinstance(doc, ast.Expr)
    }


def _optional(kind: type) -> Any:
    """The dataclass with every field optional: what a user may set over a named actuator's own values."""
    docs = _field_docs(kind)
    fields = [
        (
            field.name,
            Annotated[
                field.type | None,  # type: ignore[operator]
                tyro.conf.arg(help=f"{docs[field.name]} Default: the named actuator's.", help_behavior_hint=""),
            ],
            dataclasses.field(default=None),
        )
        for field in dataclasses.fields(kind)
    ]
    return dataclasses.make_dataclass(f"{kind.__name__}Fields", fields, frozen=True)


def _unchecked(kind: type, **nested: Any) -> Any:
    """The dataclass without its validation, which the verb makes up for: an error while parsing looks like a bug.

    Args:
        kind: the dataclass.
        **nested: fields that are dataclasses, and what takes their place.
    """
    docs = _field_docs(kind)
    fields = [
        (field.name, Annotated[field.type, tyro.conf.arg(help=docs[field.name])], field.default)
        if field.name not in nested
        else (field.name, nested[field.name], nested[field.name]())
        for field in dataclasses.fields(kind)
    ]
    return dataclasses.make_dataclass(f"{kind.__name__}Fields", fields, frozen=True)


_MotorFields, _LoopFields = _optional(Motor), _optional(CurrentLoop)
_PPOFields, _EnvFields = _unchecked(PPOConfig), _unchecked(EnvConfig, disturbances=_unchecked(Disturbances))


def _environment(fields: Any) -> EnvConfig:
    """The environment's arguments that the flags describe.

    Raises:
        ValueError: a value is out of bounds.
    """
    return EnvConfig(**vars(fields) | {"disturbances": Disturbances(**vars(fields.disturbances))})


@dataclasses.dataclass(frozen=True)
class ActuatorFields:
    """Single fields over the named actuator's."""

    motor: _MotorFields = _MotorFields()  # type: ignore[valid-type]
    """The motor and its arm."""
    controller: _LoopFields = _LoopFields()  # type: ignore[valid-type]
    """The current loop."""


ActuatorName = Annotated[
    str,
    tyro.conf.arg(
        name="actuator",
        metavar="NAME",
        help="What the force goes through. "
        + "; ".join(f"{name}: {description}" for name, (description, _) in NAMED.items())
        + ".",
    ),
]
Fields = Annotated[ActuatorFields, tyro.conf.arg(name="actuator")]


def _actuator(name: str, fields: ActuatorFields, task: str, trained: Actuator | None = None) -> Actuator | None:
    """The actuator that the flags describe.

    Raises:
        ValueError: unknown name, value out of bounds, or fields set over the ideal actuator, which has none.
    """
    from codrl_mj.motor import named_actuator

    base = trained if name == _AS_TRAINED else named_actuator(name, task)
    changes = {
        part: {field: value for field, value in vars(getattr(fields, part)).items() if value is not None}
        for part in ("motor", "controller")
    }
    if not any(changes.values()):
        return base
    if base is None:
        raise ValueError(
            "--actuator ideal has no motor and no controller to set fields of: name another actuator, such as "
            "--actuator paper"
        )
    mapping = base.as_mapping()
    return Actuator.from_mapping({part: mapping[part] | changes[part] for part in mapping})


_AS_TRAINED = "as-trained"


# -- train --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Train:
    """Train an agent through an actuator and leave a run folder.

    The folder gets the resolved configuration, the learning curve (CSV and PNG) and the policy (safetensors and JSON).
    Example: codrl-mj train cartpole --actuator weaker --env.center-radius 0.1 --out runs/through-weaker
    """

    task: tyro.conf.Positional[TaskName]  # type: ignore[valid-type]
    """What to learn."""
    actuator_name: ActuatorName = "paper"
    actuator_fields: Fields = ActuatorFields()
    seed: int = 0
    """Seed of weights, actions and environments."""
    total_steps: int = 200_000
    """Environment steps in all; rounded up to whole rollouts."""
    num_envs: int = 8
    """Environments side by side."""
    out: Path | None = None
    """Run folder to make; the default is runs/TASK-ppo-ACTUATOR-SEED."""
    ppo: _PPOFields = _PPOFields()  # type: ignore[valid-type]
    """The agent."""
    env: _EnvFields = _EnvFields()  # type: ignore[valid-type]
    """The environment."""

    def run(self) -> int:
        """Train, with a progress bar."""
        from codrl_mj.terminal import train_with_bars
        from codrl_mj.training import TrainConfig

        actuator = _actuator(self.actuator_name, self.actuator_fields, self.task)
        ppo, env = PPOConfig(**vars(self.ppo)), _environment(self.env)
        config = TrainConfig(self.task, actuator, ppo, self.seed, self.total_steps, self.num_envs, env)
        out = self.out or Path("runs") / f"{self.task}-ppo-{self.actuator_name}-{self.seed}"
        train_with_bars({f"PPO on {self.task}": (config, out)})
        print(f"wrote {out}: see {out / 'learning_curve.png'}; next: codrl-mj evaluate {out}")
        return 0


# -- evaluate -----------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Measure a trained policy on any actuator: return, torque tracking, voltage saturation.

    Example: codrl-mj evaluate runs/cartpole-ppo-ideal-0 --actuator weaker --episodes 100
    """

    run_folder: tyro.conf.Positional[Path]
    """Run folder of a training."""
    actuator_name: ActuatorName = _AS_TRAINED
    actuator_fields: Fields = ActuatorFields()
    episodes: int = 50
    """Episodes, each from its own seed."""
    seed: int = 0
    """Seed of the first episode; the others count up from it."""
    stochastic: bool = False
    """Sample the actions instead of taking the most likely ones."""
    out: Path | None = None
    """JSON file for the result."""
    env: _EnvFields = _EnvFields()  # type: ignore[valid-type]
    """The environment."""

    def run(self) -> int:
        """Evaluate and print a table."""
        from codrl_mj.evaluation import make_env, run_episodes, summarize
        from codrl_mj.policies import load_policy
        from codrl_mj.terminal import print_evaluations, progress_bar
        from codrl_mj.training import load_config

        trained = load_config(self.run_folder)
        actuator = _actuator(self.actuator_name, self.actuator_fields, trained.task, trained.actuator)  # type: ignore[arg-type]
        policy = load_policy(self.run_folder)
        options = _environment(self.env).seen_as(trained.env).as_arguments()
        with progress_bar("{task.completed}/{task.total} episodes") as bar:
            row = bar.add_task("evaluating", total=self.episodes)
            episodes = run_episodes(
                policy,
                lambda: make_env(trained.task, actuator, **options),
                self.episodes,
                self.seed,
                not self.stochastic,
                lambda _, ended: bar.update(row, completed=ended),
            )
        evaluation = summarize(trained.task, actuator, episodes)
        print_evaluations({f"{self.run_folder.name} on {self.actuator_name}": evaluation})
        if self.out is not None:
            from codrl_mj.files import write_json

            write_json(self.out, evaluation.as_mapping())
            print(f"wrote {self.out}")
        return 0


# -- render -------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Render:
    """Film one episode: the scene, and a strip of desired and actual torque and the voltage below it.

    Example: codrl-mj render runs/cartpole-ppo-weaker-0 --out balance.mp4, or codrl-mj render cartpole (random actions).
    """

    subject: tyro.conf.Positional[str]
    """Run folder of a training, or a task name for random actions."""
    actuator_name: ActuatorName = _AS_TRAINED
    actuator_fields: Fields = ActuatorFields()
    seed: int = 0
    """Seed of the episode."""
    out: Path = Path("episode.mp4")
    """File to write: .mp4 (H.264) or .gif; without a suffix, a folder of PNG frames."""
    trajectory: Path | None = None
    """File for the episode itself, .npz: time, state, observation, action, reward and every actuator signal."""
    width: int = 640
    """Width [px], even."""
    height: int = 480
    """Height of the scene [px], even."""
    camera: str = "fixed"
    """A camera of the model: fixed or close."""
    pretty: bool = False
    """Shadows, reflections and multisampling: slower."""
    env: _EnvFields = _EnvFields()  # type: ignore[valid-type]
    """The environment."""

    def run(self) -> int:
        """Run the episode and film it."""
        from codrl_mj.evaluation import RandomPolicy, make_env, run_episodes, save_episode
        from codrl_mj.policies import Policy, load_policy
        from codrl_mj.rendering import Panel, film
        from codrl_mj.terminal import progress_bar
        from codrl_mj.training import load_config

        if self.subject in ENVIRONMENTS:
            task, name = self.subject, "paper" if self.actuator_name == _AS_TRAINED else self.actuator_name
            actuator = _actuator(name, self.actuator_fields, task)
            options = _environment(self.env).as_arguments()
            policy: Policy = RandomPolicy(make_env(task, actuator, **options).action_space, self.seed)
        else:
            trained = load_config(Path(self.subject))
            task, policy, name = trained.task, load_policy(Path(self.subject)), self.actuator_name
            actuator = _actuator(name, self.actuator_fields, task, trained.actuator)  # type: ignore[arg-type]
            options = _environment(self.env).seen_as(trained.env).as_arguments()
        (episode,) = run_episodes(policy, lambda: make_env(task, actuator, **options), 1, self.seed)
        panel = Panel(f"{Path(self.subject).name} on {name}: return {episode.total:.0f}", task, actuator, episode)
        with progress_bar("{task.completed}/{task.total} frames") as bar:
            row = bar.add_task("filming", total=None)
            film(
                [panel],
                self.out,
                self.width,
                self.height,
                self.camera,
                self.pretty,
                lambda done, total: bar.update(row, completed=done, total=total),
            )
        print(f"wrote {self.out}")
        if self.trajectory is not None:
            save_episode(episode, self.trajectory)
            print(f"wrote {self.trajectory}")
        return 0


# -- validate -----------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Validate:
    """Certify that the port is right: every check by name, with its oracle, its tolerance and the worst case found.

    The exit status is 1 if a check fails. Example: codrl-mj validate cartpole --out certificate, or codrl-mj validate
    --model robot.xml (your own model with our motors).
    """

    tasks: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="{" + ",".join(ENVIRONMENTS) + "}", help="What to validate; all tasks if none is named."),
    ] = ()
    model: Path | None = None
    """MJCF file of your own with any number of our motors, to be put through the checks that apply to it."""
    quick: bool = False
    """Fewer states, runs and step sizes: seconds instead of minutes."""
    mutations: bool = False
    """Put the certificate to the test as well: make faults on purpose and see which checks fail."""
    out: Path | None = None
    """Folder for the certificate: certificate.json, and certificate.html with plots."""

    def run(self) -> int:
        """Validate and print a table for each group."""
        from codrl_mj.terminal import print_certificate, print_mutations, progress_bar
        from codrl_mj.validation import own_model, page, try_mutations, validate, validate_model
        from codrl_mj.validation.mutations import unfailed

        if self.model is not None and (self.tasks or self.mutations):
            raise ValueError("--model: give a model or tasks, and no --mutations, which are faults of the tasks")
        if self.out is not None:
            page.check_writable(self.out)
        model = None if self.model is None else own_model.load(self.model)
        with progress_bar("{task.completed}/{task.total}") as bar:
            row = bar.add_task("validating", total=None)

            def show(done: int, total: int, name: str) -> None:
                bar.update(row, completed=done, total=total, description=f"validating: {name}")

            if model is not None:
                certificate = validate_model(model, str(self.model), quick=self.quick, on_part=show)
            else:
                certificate = validate(self.tasks, quick=self.quick, on_part=show)
            caught = try_mutations(self.tasks, on_part=show) if self.mutations else []
        print_certificate(certificate)
        blind = unfailed(certificate.checks, caught) if caught else []
        if caught:
            print_mutations(caught, blind)
        if self.out is not None:
            for file in page.write(certificate, self.out, caught):
                print(f"wrote {file}")
        return 0 if certificate.passed and not blind and all(outcome.failed for outcome in caught) else 1


# -- main ---------------------------------------------------------------------------------------------------

_VERBS: dict[str, Any] = {"train": Train, "evaluate": Evaluate, "render": Render, "validate": Validate}


def main(arguments: list[str] | None = None) -> int:
    """Run `codrl-mj`.

    Args:
        arguments: the command line without the program's name; None takes the process's.

    Returns:
        Exit status: 0, 1 when a validation fails, 2 for bad input, 130 after Ctrl-C.
    """
    verb: Any = tyro.extras.subcommand_cli_from_dict(
        _VERBS,
        prog="codrl-mj",
        description="Reinforcement learning through a real actuator: classic control in MuJoCo, driven by a DC motor.",
        args=arguments,
    )
    try:
        return verb.run()
    except (ValueError, OSError, RuntimeError, ArithmeticError) as error:
        print(f"codrl-mj: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        print(
            f"codrl-mj: error: {error}. Training and evaluation need the extra 'train', videos the extra 'render', "
            "certificates the extra 'validate': pip install 'codrl-mj[all]'",
            file=sys.stderr,
        )
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
