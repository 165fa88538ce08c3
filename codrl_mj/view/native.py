"""The live view in MuJoCo's own viewer, on a machine with a display."""

import os
import sys
import time

from codrl_mj.view.session import Session


def check_display() -> None:
    """Refuse where there is no display."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RuntimeError(
            "--native needs a display, and neither DISPLAY nor WAYLAND_DISPLAY is set: leave it out to see the "
            "simulation in a browser, also through ssh -L 8080:localhost:8080"
        )


def run(session: Session) -> None:
    """Simulate in real time until the window is closed; there its mouse pushes bodies."""
    from mujoco import viewer

    with viewer.launch_passive(session.model, session.data) as window:
        while window.is_running():
            began = time.perf_counter()
            with window.lock():
                session.step()
            window.sync()
            time.sleep(max(0.0, session.step_duration - (time.perf_counter() - began)))
