"""Pendulums in mjlab; the module also runs where only mjlab and codrl-mj-core are installed."""

import mujoco
import numpy as np
import torch
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import MujocoCfg, Simulation, SimulationCfg

from codrl_mj.arrays.mjlab import MotorActuatorCfg
from tests.simulators.rod import ROD


class Pendulums:
    """Pendulums in mjlab, each in an environment."""

    def __init__(self, num_envs, timestep=0.002, **settings):  # noqa: D107
        articulation = EntityArticulationInfoCfg(
            actuators=(MotorActuatorCfg(target_names_expr=("hinge",), **settings),)
        )
        start = EntityCfg.InitialStateCfg(joint_pos={"hinge": 0.0}, joint_vel={".*": 0.0})
        entity = EntityCfg(
            spec_fn=lambda: mujoco.MjSpec.from_string(ROD.format(option="", actuator="")),
            articulation=articulation,
            init_state=start,
        )
        self.scene = Scene(
            SceneCfg(num_envs=num_envs, terrain=None, entities={"robot": entity}), "cpu"
        )
        options = MujocoCfg(timestep=timestep, integrator="euler", gravity=(0.0, 0.0, -9.81))
        self.model = self.scene.compile()
        self.simulation = Simulation(
            num_envs=num_envs, cfg=SimulationCfg(mujoco=options), model=self.model, device="cpu"
        )
        self.scene.initialize(self.simulation.mj_model, self.simulation.model, self.simulation.data)
        self.simulation.reset()
        self.scene.reset()
        self.simulation.forward()
        self.robot = self.scene["robot"]
        (self.actuator,) = self.robot.actuators

    def step(self):
        self.scene.write_data_to_sim()
        self.simulation.step()
        self.scene.update(dt=0.002)
        return self.robot.data.joint_pos[:, 0].numpy().copy()

    def push(self, commands):
        """Return the angles, shape (steps, environments)."""
        angles = []
        for rows in commands:
            self.robot.set_joint_effort_target(torch.tensor(rows, dtype=torch.float32))
            angles.append(self.step())
        return np.array(angles)
