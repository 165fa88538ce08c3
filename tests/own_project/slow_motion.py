"""A physics of one's own: MuJoCo's, with time running at half its pace."""

from codrl_mj.physics import MujocoPhysics, SimulationConfig


class SlowMotion(MujocoPhysics):
    """As MuJoCo's, with integration steps of half the length."""

    def __init__(self, plant: SimulationConfig) -> None:
        """Make the simulation, and halve its step."""
        super().__init__(plant)
        self.model.opt.timestep /= 2
