"""Step the rod and its motor in mjlab for a second, and compare the angles with our engine.

Example: python step_mjlab.py
"""

import mujoco
import numpy as np
import torch
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import MujocoCfg, Simulation, SimulationCfg
from swing_up import ACTUATORS, MODEL

import codrl_mj
from codrl_mj.arrays.mjlab import MotorActuatorCfg

NUM_STEPS = 250
"""Physics steps of 4 ms."""
TORQUES = np.array([0.1, 0.2, 0.3, 0.48])
"""Torque commanded in each environment [N*m]."""


def rod() -> mujoco.MjSpec:
    """Return the model without its actuator, because mjlab adds its own."""
    spec = mujoco.MjSpec.from_file(str(MODEL))
    spec.delete(spec.actuators[0])
    return spec


ROBOT = EntityCfg(
    spec_fn=rod,
    articulation=EntityArticulationInfoCfg(
        actuators=(
            MotorActuatorCfg(target_names_expr=("hinge",), motor=ACTUATORS["motor"]["motor"]),
        )
    ),
    init_state=EntityCfg.InitialStateCfg(joint_pos={"hinge": 0.0}, joint_vel={".*": 0.0}),
)


def angles_in_mjlab() -> np.ndarray:
    """Return the angles after each step [rad], shape (steps, environments)."""
    num_envs = len(TORQUES)
    scene = Scene(SceneCfg(num_envs=num_envs, terrain=None, entities={"robot": ROBOT}), "cpu")
    options = MujocoCfg(timestep=0.004, integrator="implicitfast")
    simulation = Simulation(
        num_envs=num_envs, cfg=SimulationCfg(mujoco=options), model=scene.compile(), device="cpu"
    )
    scene.initialize(simulation.mj_model, simulation.model, simulation.data)
    simulation.reset()
    scene.reset()
    simulation.forward()
    robot, angles = scene["robot"], []
    for _ in range(NUM_STEPS):
        robot.set_joint_effort_target(torch.tensor(TORQUES[:, np.newaxis], dtype=torch.float32))
        scene.write_data_to_sim()
        simulation.step()
        scene.update(dt=0.004)
        angles.append(robot.data.joint_pos[:, 0].numpy().copy())
    return np.array(angles)


def angles_in_our_engine() -> np.ndarray:
    """Return the same angles in MuJoCo with our plugin."""
    spec = mujoco.MjSpec.from_file(str(MODEL))
    model = codrl_mj.add_motors(spec, ACTUATORS["motor"]).compile()
    angles = np.zeros((NUM_STEPS, len(TORQUES)))
    for column, torque in enumerate(TORQUES):
        data = mujoco.MjData(model)
        data.ctrl[:] = torque
        for step in range(NUM_STEPS):
            mujoco.mj_step(model, data)
            angles[step, column] = data.qpos[0]
    return angles


if __name__ == "__main__":
    angles, ours = angles_in_mjlab(), angles_in_our_engine()
    print(f"the rods turned by up to {np.ptp(ours, axis=0).max():.2f} rad in a second")
    print(f"largest difference between mjlab and our engine: {np.abs(angles - ours).max():.1e} rad")
