"""Several of our motors with other actuators: each is found by its own address."""

import mujoco
import numpy as np
import pytest

from codrl_mj.actuators import DCMotorActuator
from codrl_mj.engine import uninstall
from codrl_mj.engine.families import slot_size
from codrl_mj.physics import motors
from codrl_mj.physics.mjcf import configure_actuator
from tests.engine.models import FULL, STATE, changed, controls, trajectory
from tests.reference import MotorSimulation

pytestmark = pytest.mark.usefixtures("installed")

# Bodies that do not touch: a motor's joint depends on its own actuators only.
JOINTS = {
    "first": "hinge",
    "ball": "ball",
    "second": "hinge",
    "pid": "hinge",
    "third": "slide",
    "dc": "hinge",
}
OURS = {
    "first": changed(FULL, kp=0.5),
    "second": changed(FULL, arm_radius=0.2, ki=1.0),
    "third": changed(FULL, inductance=0.1, max_voltage=1.5),
}
TIMESTEP = 0.01


def _spec(with_ours=True):
    """Return a spec with actuators of all kinds, and our motors among them."""

    def ours(name):
        return f'<general name="{name}" joint="{name}"/>' if with_ours else ""

    bodies = "".join(
        f'<body><joint name="{name}" type="{kind}" axis="0 1 0"/><geom size="0.1" pos="0.2 0'
        ' 0.1"/></body>'
        for name, kind in JOINTS.items()
    )
    spec = mujoco.MjSpec.from_string(f"""
    <mujoco>
      <option timestep="{TIMESTEP}"><flag contact="disable"/></option>
      <worldbody>{bodies}</worldbody>
      <actuator>
        <general joint="dc" dyntype="integrator"/>  <!-- a state before ours -->
        {ours("first")}
        <orientation joint="ball" kp="2" kv="0.1"/>  <!-- three controls and three outputs -->
        {ours("second")}
        <pid joint="pid" kp="3" kv="0.2" ki="1"/>  <!-- two controls, one state -->
        {ours("third")}
        <dcmotor joint="dc" motorconst="0.5 0.5" resistance="1" inductance="0.1" input="voltage"/>
      </actuator>
    </mujoco>""")
    if with_ours:
        for name, actuator in OURS.items():
            configure_actuator(spec.actuator(name), actuator, 0.5 if name == "third" else None)
        spec.actuator("second").group = 2
    return spec


def model_of_several(_=None, integrator="Euler", with_ours=True):
    """Return the compiled spec."""
    model = _spec(with_ours).compile()
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    return model


def test_the_numbers_of_controls_outputs_activations_and_actuators_differ():
    model = model_of_several()
    assert len({model.nu, model.nout, model.na, model.nactuator}) == 4
    for name in ("second", "third"):
        actuator = model.actuator(name).id
        addresses = {model.actuator_ctrladr[actuator], model.actuator_actadr[actuator], actuator}
        assert len(addresses) == 3
    assert list(motors(model)) == [model.actuator(name).id for name in OURS]


@pytest.mark.parametrize("integrator", ["Euler", "RK4"])
def test_every_motor_equals_its_reference(integrator):
    model = model_of_several(integrator=integrator)
    data, references = (
        mujoco.MjData(model),
        {name: MotorSimulation(actuator) for name, actuator in OURS.items()},
    )
    for data.ctrl[:] in controls(100, model.nu):
        forces = {}
        for name, reference in references.items():
            expected = (
                data.ctrl[model.actuator_ctrladr[model.actuator(name).id]]
                / OURS[name].motor.arm_radius
            )
            expected = np.clip(expected, -0.5, 0.5) if name == "third" else expected
            forces[name] = reference.step(TIMESTEP, expected, data.joint(name).qvel[0])
        mujoco.mj_step(model, data)
        for name, reference in references.items():
            actuator, close = model.actuator(name).id, {"rel": 1e-10, "abs": 1e-11}
            act = data.act[model.actuator_actadr[actuator] :][: slot_size(DCMotorActuator)]
            np.testing.assert_allclose(act[STATE], reference.state, rtol=1e-10, atol=1e-11)
            torque = OURS[name].motor.torque_constant * reference.current
            assert data.actuator_force[model.actuator_outadr[actuator]] == pytest.approx(
                torque, **close
            )
            assert data.joint(name).qfrc_actuator[0] == pytest.approx(forces[name], **close)


def test_other_actuators_are_not_affected_by_ours():
    model, bare = model_of_several(), model_of_several(with_ours=False)
    inputs, data, without_motors = (
        controls(100, model.nu),
        mujoco.MjData(model),
        mujoco.MjData(bare),
    )
    foreign = [index for index in range(model.nactuator) if index not in motors(model)]
    starts, counts = model.actuator_ctrladr, model.actuator_ctrlnum
    chosen = np.concatenate(
        [np.arange(starts[index], starts[index] + counts[index]) for index in foreign]
    )
    trajectory(model, inputs, data)
    uninstall()
    trajectory(bare, inputs[:, chosen], without_motors)
    assert np.any(without_motors.act != 0.0)
    for name in ("ball", "pid", "dc"):
        np.testing.assert_allclose(
            data.joint(name).qpos, without_motors.joint(name).qpos, rtol=1e-12, atol=1e-12
        )
        assert np.any(data.joint(name).qfrc_actuator != 0.0)


def test_a_disabled_group_disables_only_its_motor():
    model = model_of_several()
    model.opt.disableactuator = 1 << 2
    data = mujoco.MjData(model)
    trajectory(model, controls(20, model.nu), data)
    for name in OURS:
        act = data.act[model.actuator_actadr[model.actuator(name).id] :][
            : slot_size(DCMotorActuator)
        ]
        assert np.any(act != 0.0) == (name != "second")


@pytest.mark.parametrize("index", [0, 1, -1])
def test_a_bad_control_sets_all_controls_to_zero_as_in_the_engine(index, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # the engine writes a log
    model = model_of_several()
    inputs = controls(40, model.nu)
    zeroed = inputs.copy()
    inputs[20:30, index] = np.nan
    zeroed[20:30] = 0.0
    np.testing.assert_array_equal(trajectory(model, inputs), trajectory(model, zeroed))
