"""`codrl-mj render`, `replay`, `view` and `report`: films, 3D replays, live views and reports."""

import contextlib
import dataclasses
import functools
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import tyro

from codrl_mj.actuators import allow_imports
from codrl_mj.cli.parsing import Trust
from codrl_mj.cli.subject import EpisodeVerb, policy_and_environment
from codrl_mj.cli.terminal import progress_bar
from codrl_mj.envs.config import EnvConfig, is_source_name
from codrl_mj.evaluation import Episode
from codrl_mj.fields import did_you_mean
from codrl_mj.runs import unique_names
from codrl_mj.runs.policies import Policy


@dataclasses.dataclass(frozen=True)
class Render(EpisodeVerb):
    """Film one episode, with plots of desired torque, actual torque and voltage below the scene.

    Example: codrl-mj render runs/cartpole-ppo-weaker-0 --out balance.mp4, or codrl-mj render
    cartpole (random actions).
    """

    out: Path = Path("episode.mp4")
    """File to write: .mp4 (H.264) or .gif; without a suffix, a folder of PNG frames."""
    trajectory: Path | None = None
    """NPZ file for the episode: time, state, observation, action, reward and every actuator signal.
    """
    width: int = 640
    """Width [px], even."""
    height: int = 480
    """Height of the scene [px], even."""
    camera: str = "fixed"
    """Name of a camera in the model. Tasks have `fixed` and `close`; for other environments `fixed`
    selects the default camera.
    """
    pretty: bool = False
    """Render with shadows, reflections and multisampling, which is slower."""
    motor: str | None = None
    """Name of the motor whose torque and voltage are plotted; default: the first."""

    def run(self) -> int:
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
            choices = ", ".join(episode.motors) or "not named: there is only one"
            hint = did_you_mean(self.motor, episode.motors)
            raise ValueError(f"--motor {self.motor}: {hint}the motors are {choices}")
        strip = 0 if self.motor is None else episode.motors.index(self.motor)
        title += f"; {episode.motors[strip]}" if episode.motors else ""
        panel = dataclasses.replace(panel, title=title, motor=strip)
        with progress_bar("{task.completed}/{task.total} frames") as bar:
            row = bar.add_task("filming", total=None)
            film(
                [panel],
                self.out,
                *view,
                lambda written, total: bar.update(row, completed=written, total=total),
            )
        print(f"wrote {self.out}{_rank_text(self, env, episode)}")
        if self.trajectory is not None:
            save_episode(episode, self.trajectory)
            print(f"wrote {self.trajectory}")
        return 0


@dataclasses.dataclass(frozen=True)
class Replay(EpisodeVerb):
    """Write one episode as a 3D web page that you can rotate, scrub and play at any speed.

    Example: codrl-mj replay runs/cartpole-ppo-weaker-0 --out balance.html, or codrl-mj replay
    Ant-v5 (random actions).
    """

    out: Path = Path("episode.html")
    """File to write."""

    def run(self) -> int:
        """Run the episode and write the page."""
        from codrl_mj.evaluation import run_episodes
        from codrl_mj.viz.replay import motion_of_episode, write_replay

        policy, env, title = policy_and_environment(self)
        (episode,) = run_episodes(policy, env.build, 1, self.seed)
        title = f"{title}: return {episode.total:.0f}"
        write_replay(motion_of_episode(episode, env), self.out, title)
        print(
            f"wrote {self.out} ({self.out.stat().st_size / 1e6:.1f} MB)"
            f"{_rank_text(self, env, episode)}"
        )
        return 0


def _rank_text(verb: EpisodeVerb, env: EnvConfig, episode: Episode) -> str:
    """Return text that ranks an episode within the run's evaluation, in the same environment."""
    from codrl_mj.runs.summaries import describe_rank, read_evaluation

    evaluation = read_evaluation(Path(verb.subject), verb.source.which == "best") or {}
    try:
        with allow_imports(verb.source.trust):
            is_same_env = EnvConfig.from_mapping(evaluation["conditions"]["env"]) == env
    except (
        # The run has no evaluation, or one of a format that this version cannot read.
        KeyError,
        TypeError,
        ValueError,
    ):
        is_same_env = False
    ranking = describe_rank(evaluation, episode.total) if is_same_env else ""
    return f": seed {verb.seed}, return {episode.total:.3g}; {ranking}" if ranking else ""


@dataclasses.dataclass(frozen=True)
class LiveView(EpisodeVerb):
    """Watch a simulation live in a browser: pause, push, and change motor, loop, supply and delay.

    Example: codrl-mj view runs/cartpole-ppo-weaker-0, or codrl-mj view furuta (random actions).
    """

    policies: tuple[Path, ...] = ()
    """Further run folders whose policies can be selected."""
    port: int = 8080
    """Port to listen on, on this machine only; if it is taken, the next free one."""
    native: bool = False
    """Use MuJoCo's own viewer instead of a browser; needs a display."""

    def run(self) -> int:
        """Serve until Ctrl-C."""
        from codrl_mj.training.run import collecting_signals
        from codrl_mj.viz.view.session import Session, run_native

        if not 1 <= self.port <= 65535:
            raise ValueError(f"--port {self.port}: must be from 1 to 65535")
        if self.native:
            if sys.platform == "linux" and not (
                os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
            ):
                raise RuntimeError(
                    "--native needs a display, and neither DISPLAY nor WAYLAND_DISPLAY is set:"
                    " omit it to see the simulation in a browser, also through ssh -L"
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
        browser = Browser(session, self.port, title)
        print(f"{browser.url} (on this machine only; Ctrl-C ends it)", flush=True)
        # Ctrl-C only sets a flag, which the loop reads between two frames: an exception inside a
        # library could leave a lock held.
        with (
            collecting_signals(signal.SIGINT) as signals,
            contextlib.closing(browser),
        ):
            browser.run(lambda: bool(signals))
        if signals:
            signal.raise_signal(signal.SIGINT)
        return 0

    def _policies(self, loaded_policy: Policy, env: EnvConfig) -> dict[str, Callable[[], Policy]]:
        """Return name -> factory of a policy: last or best of this run, and those of other runs.

        A policy is loaded only when it is selected.
        """
        factories: dict[str, Callable[[], Policy]] = {}
        subject = Path(self.subject)
        if not is_source_name(self.subject):
            factories[self.source.which] = lambda: loaded_policy
            if (subject / "best").is_dir():
                alternative: Literal["last", "best"]
                alternative = "best" if self.source.which == "last" else "last"
                factories[alternative] = lambda: (
                    dataclasses.replace(self.source, which=alternative).load(subject).policy
                )

        def load_policy(run: Path) -> Policy:
            loaded = self.source.load(run)
            loaded.check_interface(env)
            return loaded.policy

        used_names = {*factories, "random", "zero"}
        for name, run in zip(unique_names(self.policies), self.policies, strict=True):
            factories[f"run {name}" if name in used_names else name] = functools.partial(
                load_policy, run
            )
        return factories


@dataclasses.dataclass(frozen=True)
class Report:
    """Write a report of a run as one HTML file: learning, evaluation, a filmed episode with plots.

    The report shows several runs side by side. Of unfinished and damaged runs, it shows the parts
    that can be read.

    Example: codrl-mj report runs/cartpole-ppo-weaker-0 --out balance.html
    """

    runs: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN", help="Run folders.")
    ]
    out: Path = Path("report.html")
    """HTML file to write."""
    which: Literal["last", "best"] = "last"
    """Policy of the episode: the last one, or that of the best evaluation. An unfinished run has
    only its best one.
    """
    seed: int | None = None
    """Seed of the episode; default: that of the evaluated episode with the median return."""
    film: bool = True
    """Film the episode."""
    replay: bool = False
    """Also show the episode in 3D, synchronized with the plots. This adds 0.7 MB to the file."""
    certificate: Path | None = None
    """Certificate to summarize: a certificate.json, or its folder. Default: the one in a run
    folder.
    """
    trust: Trust = False

    def run(self) -> int:
        """Write the page."""
        from codrl_mj.viz.pages.report import replay_parts, report

        with progress_bar("") as bar:
            row = bar.add_task("reading", total=None)
            report(
                self.runs,
                self.out,
                which=self.which,
                seed=self.seed,
                trust=self.trust,
                with_film=self.film,
                extra_parts=replay_parts if self.replay else lambda _: (),
                certificate=self.certificate,
                on_part=lambda part: bar.update(row, description=part),
            )
        print(f"wrote {self.out} ({self.out.stat().st_size / 1e6:.1f} MB)")
        return 0
