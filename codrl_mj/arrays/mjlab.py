"""Our motors in mjlab: `MotorActuatorCfg`, for the `actuators` of an articulation."""
# mjlab's classes are not followed by the type checker.
# mypy: disable-error-code="misc"

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp
from mjlab.actuator import Actuator, ActuatorCfg
from mjlab.utils.spec import create_motor_actuator

from codrl_mj.actuators import ActuatorSetting, resolve
from codrl_mj.arrays.c_code import Real
from codrl_mj.arrays.warp import StepArrays, WarpActuators
from codrl_mj.arrays.warp_inertia import ActuatorInertia, Data, Model
from codrl_mj.engine.shafts import check_shafts

_NO_LIMIT = 1e9
"""Limit of the force of mjlab's actuator [N] or [N*m], which the motor's limits replace."""
# Entities and tensors come from mjlab and torch.
Entity = Any
Tensor = Any


def _unwrap(wrapper: Any) -> Any:
    """Return the structure of mujoco_warp that mjlab wraps, for tensors in place of its arrays."""
    return getattr(wrapper, "struct", wrapper)


@dataclass(kw_only=True)
class MotorActuatorCfg(ActuatorCfg):
    """Motor behind joints of an mjlab entity.

    Its command is `stiffness * (position target - position) + damping * (velocity target -
    velocity) + effort target`. A servo takes the position target, or the velocity target, instead.
    The motor's inertia and friction are added to those of the joint.
    """

    motor: ActuatorSetting = None
    """The motor: an actuator, a mapping of its fields, the name of a family or of a motor in the
    catalogue, a file, or `module:NAME`.
    """
    stiffness: float = 0.0
    """Gain of the position error [N*m/rad] or [N/m]."""
    damping: float = 0.0
    """Gain of the velocity error [N*m*s/rad] or [N*s/m]."""
    varying: tuple[str, ...] = ()
    """Dotted paths of parameters that each environment has for itself, to be randomized."""
    allow_unstable: bool = False
    """True to accept a motor that is unstable at the model's step."""
    seed: int = 0
    """Seed of the noise of sensors, which differs in each environment."""
    real: Real = "double"
    """Precision in which the motor is computed; mjlab's is `float`."""

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> "MotorActuator":
        """Build the actuator; mjlab calls this."""
        return MotorActuator(self, entity, target_ids, target_names)


class MotorActuator(Actuator[MotorActuatorCfg]):
    """Motors of one kind in all environments of mjlab."""

    def __init__(
        self,
        cfg: MotorActuatorCfg,
        entity: Entity,
        target_ids: list[int],
        target_names: list[str],
    ) -> None:
        """Resolve the motor.

        Raises:
            ValueError: the motor is unknown or not valid, or the targets are no joints.
        """
        super().__init__(cfg, entity, target_ids, target_names)
        if cfg.transmission_type != "joint":
            raise ValueError(
                f"transmission_type = {cfg.transmission_type}: motors in mjlab drive joints"
            )
        self.motor = resolve(cfg.motor, None, "an mjlab entity")
        self.motors: WarpActuators
        """Parameters, states and signals on the device, after `initialize`."""

    def edit_spec(self, spec: mujoco.MjSpec, target_names: list[str]) -> None:
        """Add an actuator to each joint, and the motor's inertia and friction to the joint."""
        additions = self.motor.additions
        for name in target_names:
            self._mjs_actuators.append(
                create_motor_actuator(
                    spec,
                    name,
                    effort_limit=_NO_LIMIT,
                    armature=self.cfg.armature,
                    frictionloss=self.cfg.frictionloss,
                    viscous_damping=self.cfg.viscous_damping,
                )
            )
            joint = spec.joint(name)
            joint.armature += additions.armature
            joint.damping[0] += additions.damping
            joint.frictionloss += additions.friction

    def initialize(self, mj_model: mujoco.MjModel, model: Model, data: Data, device: str) -> None:
        """Check the motor at the model's step, and create its tables.

        Raises:
            UnstableError: the motor, or its loops with the joints, are unstable; see
                `codrl_mj.add_motors`.
        """
        super().initialize(mj_model, model, data, device)
        self._model, self._data = _unwrap(model), _unwrap(data)
        columns: list[int] = self._global_ctrl_ids.tolist()
        timestep = float(mj_model.opt.timestep)
        self.motor.check_at(timestep, self.cfg.allow_unstable)
        check_shafts(
            mj_model,
            dict.fromkeys(columns, self.motor),
            dict.fromkeys(columns, self.motor.arm_radius),
            self.cfg.allow_unstable,
        )
        self.motors = WarpActuators(
            [self.motor] * len(columns),
            self._data.nworld,
            timestep,
            varying=self.cfg.varying,
            per_world=bool(self.cfg.varying),
            device=self._data.qpos.device,
            real=self.cfg.real,
        )
        if self.motors.family.RANDOM:
            self.motors.draw_noise_keys(np.random.default_rng(self.cfg.seed))
        self._force = torch.zeros(self._data.nworld, len(columns), device=device)
        self._inertia = None
        if self.motor.INERTIA:
            self._inertia = ActuatorInertia(self._model, self._data, columns)

    def compute(self, cmd: Any) -> Tensor:
        """Return the motors' forces over the next step, shape (environments, joints)."""
        inertia = None
        if self._inertia is not None:
            # The inertia matrix is that of the previous step, which changes results by less than
            # the rounding of mujoco_warp's 32-bit floats.
            self._inertia.compute(self._model, self._data)
            columns = wp.to_torch(self._inertia.inertia)[:, self._global_ctrl_ids]
            inertia = wp.from_torch(columns.contiguous())
        self.motors.step(
            StepArrays(
                self._data.time,
                wp.from_torch(self._command(cmd).contiguous()),
                wp.from_torch(cmd.pos.contiguous()),
                wp.from_torch(cmd.vel.contiguous()),
                wp.from_torch(self._force),
                inertia,
            )
        )
        return self._force

    def _command(self, cmd: Any) -> Tensor:
        """Return the motors' commands: forces, or motions of a servo."""
        if self.motor.MOTION:
            is_position = "position" in self.motor.commands()
            return cmd.position_target if is_position else cmd.velocity_target
        stiffness, damping = self.cfg.stiffness, self.cfg.damping
        return (
            cmd.effort_target
            + stiffness * (cmd.position_target - cmd.pos)
            + damping * (cmd.velocity_target - cmd.vel)
        )

    def reset(self, env_ids: Tensor | slice | Sequence[int] | None = None) -> None:
        """Bring the motors of some environments to rest; None: of all."""
        super().reset(env_ids)
        if hasattr(self, "motors"):
            # A mask on the device, because indices would have to be copied to the host.
            mask = torch.zeros(self.motors.num_worlds, dtype=torch.bool, device=self._force.device)
            mask[slice(None) if env_ids is None else env_ids] = True
            self.motors.reset(wp.from_torch(mask))

    def signal(self, name: str) -> Tensor:
        """Return a tensor that views a signal of the last step, shape (environments, joints)."""
        return wp.to_torch(self.motors.signal(name))

    def parameter(self, path: str) -> Tensor:
        """Return a tensor that views a parameter of `varying`, shape (environments, joints).

        Write it to randomize the parameter. Nothing checks whether the values are stable.
        """
        return wp.to_torch(self.motors.parameter(path))
