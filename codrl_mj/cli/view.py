"""`codrl-mj view`."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import tyro

from codrl_mj.cli.fields import AS_TRAINED, ActuatorName, with_environment
from codrl_mj.cli.subject import Source, SubjectWord, policy_and_environment, title_of
from codrl_mj.envs.worlds import is_world
from codrl_mj.runs.layout import told_apart


@dataclasses.dataclass(frozen=True)
class LiveView:
    """Watch a simulation live in a browser: pause, push, set motor, loop, supply and delay, see what the motors do.

    Example: codrl-mj view runs/cartpole-ppo-weaker-0, or codrl-mj view furuta (random actions).
    """

    subject: SubjectWord
    source: tyro.conf.OmitArgPrefixes[Source] = Source()
    actuator_name: ActuatorName = AS_TRAINED
    seed: int = 0
    """Seed of the first episode."""
    policies: tuple[Path, ...] = ()
    """Other run folders whose policies can be chosen."""
    port: int = 8080
    """Where to listen, on this machine alone; the next free one, where it is taken."""
    native: bool = False
    """MuJoCo's own viewer instead of a browser; needs a display."""

    for_line = classmethod(with_environment)

    def run(self: Any) -> int:
        """Serve until Ctrl-C."""
        from codrl_mj.view.session import Session, check_display, run_native

        if not 1 <= self.port <= 65535:
            raise ValueError(f"--port {self.port}: must be from 1 to 65535")
        if self.native:
            check_display()
        else:
            browser = _browser()
        policy, env = policy_and_environment(self)
        session = Session(env, self._policies(policy, env), self.seed)
        if self.native:
            run_native(session)
            return 0
        shown = browser(session, self.port, title_of(self.subject, env))
        print(f"{shown.url} (on this machine alone; Ctrl-C ends it)", flush=True)
        try:
            shown.run()
        finally:
            shown.close()
        return 0

    def _policies(self: Any, given: Any, env: Any) -> dict[str, Callable[[], Any]]:
        """Name -> policy, made when it is chosen: what is watched, its other one, and other runs."""
        found: dict[str, Callable[[], Any]] = {}
        subject = Path(self.subject)
        if not is_world(self.subject):
            found[self.source.which] = lambda: given
            if (subject / "best").is_dir():
                other = "best" if self.source.which == "last" else "last"
                found[other] = lambda: dataclasses.replace(self.source, which=other).load(subject).policy
        taken = {*found, "random", "zero"}
        for name, run in zip(told_apart(self.policies), self.policies, strict=True):
            found[f"run {name}" if name in taken else name] = functools.partial(self._policy_of, run, env)
        return found

    def _policy_of(self: Any, run: Path, env: Any) -> Any:
        loaded = self.source.load(run)
        loaded.check_interface(env)
        return loaded.policy


def _browser() -> Any:
    try:
        from codrl_mj.view.browser import Browser
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in ("viser", "trimesh", "websockets"):
            raise
        raise RuntimeError(
            f"the live view needs the extra 'view' ({error}): pip install 'codrl-mj[view]'; or pass --native"
        ) from None
    return Browser
