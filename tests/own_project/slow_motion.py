"""A physics of one's own: MuJoCo's, with time running at half its pace."""

from typing import Any

from codrl_mj.physics import MujocoPhysics


class SlowMotion(MujocoPhysics):
    """As MuJoCo's, with integration steps of half the length."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Make the simulation, and halve its step."""
        super().__init__(*arguments, **options)
        self.model.opt.timestep /= 2
