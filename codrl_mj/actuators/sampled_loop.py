"""Settings of a drive's current loop. `codrl_mj.actuators.sampled` computes it."""

import dataclasses
import math

from codrl_mj.fields import Checked, choice, flag, real

DEFAULT_BANDWIDTH = 0.349 / (2 * math.pi)
"""Ratio of bandwidth to sample rate: 60 degrees of phase margin with a delay of one and a half
samples.
"""


@dataclasses.dataclass(frozen=True)
class SampledLoop(Checked):
    """PI current loop of a drive with its own sample rate.

    Raises:
        ValueError: a field is out of bounds, or the bandwidth is too high for the sample rate.
    """

    sample_rate: float = real(20e3, above=0.0, unit="Hz")
    """Sample rate [Hz], > 0; a mechanical step must be a whole number of samples."""
    bandwidth: float = real(0.0, minimum=0.0, unit="Hz")
    """Bandwidth [Hz] for which the gains are designed by pole-zero cancellation, >= 0. 0: 0.0555 of
    the sample rate, 60 degrees of phase margin with `delayed`.
    """
    kp: float = real(0.0, minimum=0.0, unit="V/A")
    """Proportional gain [V/A], >= 0. If it or `ki` is not 0, the two replace the designed gains."""
    ki: float = real(0.0, minimum=0.0, unit="V/(A*s)")
    """Integral gain [V/(A*s)], >= 0."""
    anti_windup: str = choice("back_calculation", "back_calculation", "clamping", "none")
    """Behavior of the integrator while the voltage saturates: it follows the applied voltage
    (`back_calculation`, with the tracking time kp/ki), stops (`clamping`), or continues (`none`).
    """
    delayed: bool = flag(False)
    """True if the voltage computed in a sample is applied in the next one, as in most digital
    drives.
    """
    bemf_compensation: bool = flag(True)
    """Add the back-EMF kE*omega to the voltage."""
    deadband: float = real(0.0, minimum=0.0, unit="V")
    """Voltage [V] lost in the bridge, >= 0: it reduces the magnitude of the voltage, down to 0."""
    max_current: float = real(math.inf, above=0.0, unit="A", infinite=True)
    """Largest current [A] that the drive requests, > 0; `inf` for no limit."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        max_bandwidth = self.sample_rate / (2 * math.pi)
        if self.bandwidth > max_bandwidth:
            raise ValueError(
                f"SampledLoop.bandwidth = {self.bandwidth:g}: must be <= {max_bandwidth:g} Hz at"
                f" sample_rate = {self.sample_rate:g} Hz, where a delay of one sample leaves 4"
                " degrees of phase margin; lower it, or raise the sample rate"
            )
