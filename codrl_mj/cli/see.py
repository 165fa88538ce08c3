"""`codrl-mj render`, `replay`, `view` and `report`: an episode as a film, in three dimensions, live, and of a run."""

import contextlib
import dataclasses
import functools
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from codrl_mj.actuators import trusting
from codrl_mj.cli.environments import AS_TRAINED, ActuatorName, with_environment
from codrl_mj.cli.parsing import Trust
from codrl_mj.cli.subject import Source, policy_and_environment
from codrl_mj.cli.terminal import progress_bar
from codrl_mj.envs.config import EnvConfig
from codrl_mj.envs.worlds import is_world
from codrl_mj.fields import did_you_mean
from codrl_mj.runs import unique_names


@dataclasses.dataclass(frozen=True)
class OfEpisodes:
    """What acts, in what, and from which seed."""

    subject: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(
            help=(
                "Run folder, a folder with a policy alone, or a Stable-Baselines3 zip (see"
                " --trust); or a task name or an environment's id, for random actions."
            )
        ),
    ]
    source: tyro.conf.OmitArgPrefixes[Source] = Source()
    actuator_name: ActuatorName = AS_TRAINED
    seed: int = 0
    """Seed of the episode, or of the first."""

    for_line = classmethod(with_environment)


@dataclasses.dataclass(frozen=True)
class Render(OfEpisodes):
    """Film one episode: the scene, and a strip of desired and actual torque and the voltage below it.

    Example: codrl-mj render runs/cartpole-ppo-weaker-0 --out balance.mp4, or codrl-mj render
    cartpole (random actions).
    """

    out: Path = Path("episode.mp4")
    """File to write: .mp4 (H.264) or .gif; without a suffix, a folder of PNG frames."""
    trajectory: Path | None = None
    """File for the episode itself, .npz: time, state, observation, action, reward and every actuator signal."""
    width: int = 640
    """Width [px], even."""
    height: int = 480
    """Height of the scene [px], even."""
    camera: str = "fixed"
    """A camera of the model: fixed or close; other models have others, and fixed is their environment's own."""
    pretty: bool = False
    """Shadows, reflections and multisampling: slower."""
    motor: str | None = None
    """Of several motors that whose torque and voltage the strip shows, by its name; the first unless given."""

    def run(self: Any) -> int:
        """Run the episode and film it."""
        from codrl_mj.evaluation import save_episode
        from codrl_mj.viz.films.film import check_film, film, record

        check_film(self.out, self.width, self.height)
        if self.trajectory is not None and self.trajectory.suffix != ".npz":
            raise ValueError(
                f"--trajectory {self.trajectory}: the suffix is {self.trajectory.suffix!r}, must be"
                " .npz"
            )
        policy, env, title = policy_and_environment(self)
        view = self.width, self.height, self.camera, self.pretty
        panel = record(policy, env, self.seed, *view)
        episode = panel.episode
        title = f"{title}: return {episode.total:.0f}"
        if self.motor is not None and self.motor not in episode.motors:
            there = ", ".join(episode.motors) or "one, which needs no name"
            hint = did_you_mean(self.motor, episode.motors)
            raise ValueError(f"--motor {self.motor}: {hint}there are {there}")
        strip = 0 if self.motor is None else episode.motors.index(self.motor)
        title += f"; {episode.motors[strip]}" if episode.motors else ""
        panel = dataclasses.replace(panel, title=title, motor=strip)
        with progress_bar("{task.completed}/{task.total} frames") as bar:
            row = bar.add_task("filming", total=None)
            film(
                [panel],
                self.out,
                *view,
                lambda done, total: bar.update(row, completed=done, total=total),
            )
        print(f"wrote {self.out}{_rank(self, env, episode)}")
        if self.trajectory is not None:
            save_episode(episode, self.trajectory)
            print(f"wrote {self.trajectory}")
        return 0


@dataclasses.dataclass(frozen=True)
class Replay(OfEpisodes):
    """Write one episode as a page in three dimensions: to be turned, scrubbed and played at any speed.

    Example: codrl-mj replay runs/cartpole-ppo-weaker-0 --out balance.html, or codrl-mj replay
    Ant-v5 (random actions).
    """

    out: Path = Path("episode.html")
    """File to write."""

    def run(self: Any) -> int:
        """Run the episode and write it."""
        from codrl_mj.evaluation import run_episodes
        from codrl_mj.viz.replay import motion_of_episode, write_replay

        policy, env, title = policy_and_environment(self)
        (episode,) = run_episodes(policy, env.make, 1, self.seed)
        title = f"{title}: return {episode.total:.0f}"
        write_replay(motion_of_episode(episode, env), self.out, title)
        print(
            f"wrote {self.out} ({self.out.stat().st_size / 1e6:.1f} MB){_rank(self, env, episode)}"
        )
        return 0


def _rank(verb: Any, env: Any, episode: Any) -> str:
    """Return how an episode compares with those of a run's evaluation, if it is one of the same environment."""
    from codrl_mj.runs.summaries import describe_rank, read_evaluation

    evaluation = read_evaluation(Path(verb.subject), verb.source.which == "best") or {}
    try:
        with trusting(verb.source.trust):
            same = EnvConfig.from_mapping(evaluation["conditions"]["env"]) == env
    except (
        KeyError,
        TypeError,
        ValueError,
    ):  # no evaluation, or one that this version does not read
        same = False
    said = describe_rank(evaluation, episode.total) if same else ""
    return f": seed {verb.seed}, return {episode.total:.3g}; {said}" if said else ""


@dataclasses.dataclass(frozen=True)
class LiveView(OfEpisodes):
    """Watch a simulation live in a browser: pause, push, set motor, loop, supply and delay, see what the motors do.

    Example: codrl-mj view runs/cartpole-ppo-weaker-0, or codrl-mj view furuta (random actions).
    """

    policies: tuple[Path, ...] = ()
    """Other run folders whose policies can be chosen."""
    port: int = 8080
    """Where to listen, on this machine alone; the next free one, where it is taken."""
    native: bool = False
    """MuJoCo's own viewer instead of a browser; needs a display."""

    def run(self: Any) -> int:
        """Serve until Ctrl-C."""
        from codrl_mj.training.run import stopping
        from codrl_mj.viz.view.session import Session, run_native

        if not 1 <= self.port <= 65535:
            raise ValueError(f"--port {self.port}: must be from 1 to 65535")
        if self.native:
            if sys.platform == "linux" and not (
                os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
            ):
                raise RuntimeError(
                    "--native needs a display, and neither DISPLAY nor WAYLAND_DISPLAY is set:"
                    " leave it out to see the simulation in a browser, also through ssh -L"
                    " 8080:localhost:8080"
                )
        else:
            try:
                from codrl_mj.viz.view.browser import Browser
            except ModuleNotFoundError as error:
                if (error.name or "").split(".")[0] not in ("viser", "trimesh", "websockets"):
                    raise
                raise RuntimeError(
                    f"the live view needs the extra 'view' ({error}): pip install 'codrl-mj[view]';"
                    " or pass --native"
                ) from None
        policy, env, title = policy_and_environment(self)
        session = Session(env, self._policies(policy, env), self.seed)
        if self.native:
            run_native(session)
            return 0
        shown = Browser(session, self.port, title)
        print(f"{shown.url} (on this machine alone; Ctrl-C ends it)", flush=True)
        with (
            stopping(signal.SIGINT) as asked,
            contextlib.closing(shown),
        ):  # not amidst what libraries have locked
            shown.run(lambda: bool(asked))
        if asked:
            signal.raise_signal(signal.SIGINT)
        return 0

    def _policies(self: Any, given: Any, env: Any) -> dict[str, Callable[[], Any]]:
        """Name -> policy, made when it is chosen: what is watched, its other one, and other runs."""
        found: dict[str, Callable[[], Any]] = {}
        subject = Path(self.subject)
        if not is_world(self.subject):
            found[self.source.which] = lambda: given
            if (subject / "best").is_dir():
                other = "best" if self.source.which == "last" else "last"
                found[other] = lambda: (
                    dataclasses.replace(self.source, which=other).load(subject).policy
                )

        def policy_of(run: Path) -> Any:
            loaded = self.source.load(run)
            loaded.check_interface(env)
            return loaded.policy

        taken = {*found, "random", "zero"}
        for name, run in zip(unique_names(self.policies), self.policies, strict=True):
            found[f"run {name}" if name in taken else name] = functools.partial(policy_of, run)
        return found


@dataclasses.dataclass(frozen=True)
class Report:
    """Write a report of a run as one HTML file: learning, evaluation, and an episode with film and plots on one clock.

    Several runs are shown side by side. Unfinished and damaged runs are reported as far as they go.

    Example: codrl-mj report runs/cartpole-ppo-weaker-0 --out balance.html
    """

    runs: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN", help="Run folders.")
    ]
    out: Path = Path("report.html")
    """The page to write, .html."""
    which: Literal["last", "best"] = "last"
    """Whose policy acts in the episode: the last, or that of the best evaluation; of an unfinished run its best."""
    seed: int | None = None
    """Seed of the episode; unless given, that of the evaluated episode with the median return."""
    film: bool = True
    """Film the episode."""
    replay: bool = False
    """Show it in three dimensions too, on the same clock: 0.7 MB more."""
    certificate: Path | None = None
    """A certificate.json, or its folder, to be summed up; unless given, that in a run folder, if there is one."""
    trust: Trust = False

    def run(self) -> int:
        """Write the page."""
        from codrl_mj.viz.pages.report import replays, report

        with progress_bar("") as bar:
            row = bar.add_task("reading", total=None)
            report(
                self.runs,
                self.out,
                which=self.which,
                seed=self.seed,
                trust=self.trust,
                filmed=self.film,
                joined=replays if self.replay else lambda _: (),
                certificate=self.certificate,
                on_part=lambda what: bar.update(row, description=what),
            )
        print(f"wrote {self.out} ({self.out.stat().st_size / 1e6:.1f} MB)")
        return 0
