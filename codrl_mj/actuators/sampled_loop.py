"""The current loop of a drive: its settings. `codrl_mj.actuators.sampled` is its mathematics."""

import dataclasses
import math

from codrl_mj.fields import Checked, choice, flag, real

DEFAULT_BANDWIDTH = 0.349 / (2 * math.pi)
"""Bandwidth of the loop over its sample rate: 60 degrees of phase margin with one and a half samples of delay."""


@dataclasses.dataclass(frozen=True)
class SampledLoop(Checked):
    """The PI current loop of a drive, at a sample rate of its own.

    Raises:
        ValueError: a field is out of bounds, or the bandwidth is beyond what the sample rate
            allows.
    """

    sample_rate: float = real(20e3, above=0.0, unit="Hz")
    """Samples a second [Hz], > 0; a mechanical step must hold a whole number of them."""
    bandwidth: float = real(0.0, minimum=0.0, unit="Hz")
    """Bandwidth [Hz] that the gains are designed for by pole-zero cancellation, >= 0. 0: 0.0555 of
    the sample rate, 60 degrees of phase margin with `delayed`.
    """
    kp: float = real(0.0, minimum=0.0, unit="V/A")
    """Proportional gain [V/A], >= 0. It and `ki` replace the designed gains where one of them is not 0."""
    ki: float = real(0.0, minimum=0.0, unit="V/(A*s)")
    """Integral gain [V/(A*s)], >= 0."""
    anti_windup: str = choice("back_calculation", "back_calculation", "clamping", "none")
    """What the integrator does while the voltage saturates: it follows what was possible
    (`back_calculation`, with the tracking time kp/ki), it stands still (`clamping`), or it goes on
    (`none`).
    """
    delayed: bool = flag(False)
    """Whether the voltage that a sample computes is applied in the next one, as most digital drives do."""
    bemf_compensation: bool = flag(True)
    """Add the back-EMF kE*omega to the voltage."""
    deadband: float = real(0.0, minimum=0.0, unit="V")
    """Voltage [V] that the bridge loses, >= 0: what is asked for comes short by it, and within it there is none."""
    max_current: float = real(math.inf, above=0.0, unit="A", infinite=True)
    """Largest current [A] that the drive asks for, > 0; `inf` for none."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        most = self.sample_rate / (2 * math.pi)
        if self.bandwidth > most:
            raise ValueError(
                f"SampledLoop.bandwidth = {self.bandwidth:g}: must be <= {most:g} Hz at sample_rate"
                f" = {self.sample_rate:g} Hz, where a delay of one sample leaves 4 degrees of phase"
                " margin; lower it, or raise the sample rate"
            )
