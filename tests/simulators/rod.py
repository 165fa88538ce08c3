"""Model of a pendulum for tests in several simulators."""

ROD = """
<mujoco model="rod">
  {option}
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 1 0" damping="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  {actuator}
</mujoco>
"""
