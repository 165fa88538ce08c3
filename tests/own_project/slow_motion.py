"""A custom physics: MuJoCo's, with time at half the speed."""

from codrl_mj.physics import MujocoPhysics, SimulationConfig


class SlowMotion(MujocoPhysics):
    """MuJoCo's physics with integration steps of half the length."""

    def __init__(self, simulation: SimulationConfig) -> None:
        """Create the simulation, and halve its step."""
        super().__init__(simulation)
        self.model.opt.timestep /= 2
