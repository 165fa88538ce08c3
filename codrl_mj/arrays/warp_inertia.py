"""Inertia at actuators in mujoco_warp, as Warp kernels: `ActuatorInertia`.

When mujoco_warp calls the adapter, it has computed the inertia matrix M, but not factorized it.
"""
# Warp's arrays are annotations that are made at run time.
# mypy: disable-error-code="valid-type,untyped-decorator"

from collections.abc import Sequence
from typing import Any

import warp as wp

# mujoco_warp is not followed by the type checker.
Model = Any
"""Model of mujoco_warp."""
Data = Any
"""Data of mujoco_warp: the states of all worlds."""


@wp.kernel(enable_backward=False)
def _factorize(
    num_dofs: int,
    rownnz: wp.array(dtype=int),
    rowadr: wp.array(dtype=int),
    colind: wp.array(dtype=int),
    matrix: wp.array2d(dtype=float),
    factor: wp.array2d(dtype=wp.float64),
) -> None:
    """Write the factors of M = L^T*D*L, stored as M is: D on the diagonal, L below it.

    A row has the entries of the ancestors in the kinematic tree, then that of the diagonal.
    """
    world = wp.tid()
    for n in range(rowadr[num_dofs - 1] + rownnz[num_dofs - 1]):
        factor[world, n] = wp.float64(matrix[world, n])
    for back in range(num_dofs):
        k = num_dofs - 1 - back
        start = rowadr[k]
        diagonal = start + rownnz[k] - 1
        # The rows of ancestors are changed from the nearest to the farthest, because each needs
        # the entries of row k that belong to its own ancestors unscaled.
        for up in range(rownnz[k] - 1):
            entry = diagonal - 1 - up
            ancestor = colind[entry]
            scaled = factor[world, entry] / factor[world, diagonal]
            for j in range(rownnz[ancestor]):
                target = rowadr[ancestor] + j
                factor[world, target] = factor[world, target] - scaled * factor[world, start + j]
            factor[world, entry] = scaled


@wp.kernel(enable_backward=False)
def _invert(
    num_dofs: int,
    actuators: wp.array(dtype=int),
    rownnz: wp.array(dtype=int),
    rowadr: wp.array(dtype=int),
    colind: wp.array(dtype=int),
    factor: wp.array2d(dtype=wp.float64),
    moment_rownnz: wp.array2d(dtype=int),
    moment_rowadr: wp.array2d(dtype=int),
    moment_colind: wp.array2d(dtype=int),
    moment: wp.array2d(dtype=float),
    work: wp.array3d(dtype=wp.float64),
    inertia: wp.array2d(dtype=float),
) -> None:
    """Write 1/(m*M^-1*m) for the moment m of each actuator; see `codrl_mj.engine.model_access`."""
    world, n = wp.tid()
    actuator = actuators[n]
    for row in range(num_dofs):
        work[world, n, row] = wp.float64(0.0)
    start = moment_rowadr[world, actuator]
    for entry in range(start, start + moment_rownnz[world, actuator]):
        work[world, n, moment_colind[world, entry]] = wp.float64(moment[world, entry])
    total = wp.float64(0.0)
    for back in range(num_dofs):
        row = num_dofs - 1 - back
        value = work[world, n, row]
        if value != wp.float64(0.0):
            diagonal = rowadr[row] + rownnz[row] - 1
            total += value * value / factor[world, diagonal]
            for entry in range(rowadr[row], diagonal):
                column = colind[entry]
                work[world, n, column] = work[world, n, column] - factor[world, entry] * value
    inertia[world, actuator] = float(wp.float64(1.0) / total)


class ActuatorInertia:
    """Inertia at some actuators, for the present positions of all worlds."""

    def __init__(self, model: Model, data: Data, actuators: Sequence[int]) -> None:
        """Create work arrays for the actuators with given indices."""
        device = data.qpos.device
        self._actuators = wp.array(list(actuators), dtype=int, device=device)
        self._factor = wp.zeros(data.M.shape, dtype=wp.float64, device=device)
        shape = data.nworld, len(actuators), model.nv
        self._work = wp.zeros(shape, dtype=wp.float64, device=device)
        self.inertia = wp.zeros(data.actuator_force.shape, dtype=float, device=device)
        """Inertia [kg*m^2] or [kg] at the actuators, before the gear, shape (worlds, actuators)."""

    def compute(self, model: Model, data: Data) -> None:
        """Compute `inertia` from the inertia matrix and the moments of the data."""
        pattern = [model.M_rownnz, model.M_rowadr, model.M_colind]
        wp.launch(
            _factorize,
            dim=data.nworld,
            inputs=[model.nv, *pattern, data.M],
            outputs=[self._factor],
            device=self._factor.device,
        )
        moments = [data.moment_rownnz, data.moment_rowadr, data.moment_colind]
        moments.append(data.actuator_moment)
        wp.launch(
            _invert,
            dim=(data.nworld, self._actuators.shape[0]),
            inputs=[model.nv, self._actuators, *pattern, self._factor, *moments],
            outputs=[self._work, self.inertia],
            device=self._factor.device,
        )
