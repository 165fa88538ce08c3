"""A sampled current loop over a winding that is solved exactly, many samples at a time: the mathematics of `Drive`.

Within a sample of length T the voltage u and the back-EMF b are held, and the winding's current is
exact: i+ = v + (i - v)*e with v = (u - b)/R and e = exp(-R*T/L).

With the discrete pole-zero cancellation of `designed_gains` and back-calculation with the tracking
time kp/ki, a whole step of n samples has a closed form, saturated or not. Take the integral as a
current, c = (integral - b')/R with b' the back-EMF that is not compensated; then, with P = 1 -
exp(-wc*T) and G = P/(1 - e), the voltage asked for is b + R*q,

    q = G*(i_ref - i) + c,

and i - c decays as e^k whether the voltage saturates or not. Unsaturated, q - i_ref decays as (1 -
P)^k, so it reaches a limit once at most; saturated, i and c approach v as e^k, so it leaves the
limit once at most.

What the winding draws in a sample is u times the sample's mean current, i + (1 - m)*(v - i) with m
= (1 - e)*L/(R*T). Unsaturated, with E = i_ref - i and l = i - c, v - i = G*E - l, E+ = (1 - P)*E +
(1 - e)*l and l+ = e*l. What is quadratic in E and l is then what p*E^2 + q*E*l + r*l^2 loses in a
sample, for some p, q and r: its sum is in both ends.
"""

import math
from typing import Any

from codrl_mj.actuators.sampled_loop import DEFAULT_BANDWIDTH

_USUAL = 2.0 * math.pi * DEFAULT_BANDWIDTH
"""wc*T of a loop whose bandwidth is not given."""
_USUAL_STEP = -math.expm1(-_USUAL)
"""Its P, which a tenth of a step would go into."""


def designed_gains(
    resistance: float, inductance: float, sample_time: float, bandwidth: float
) -> tuple[float, float]:
    """Proportional gain [V/A] and integral gain per sample [V/A] of the loop whose zero cancels the winding's pole.

    kp = R*P*e/(1 - e) and ki*T = R*P: the loop from reference to current is P/(z - 1 + P).
    """
    x = resistance * sample_time / inductance
    step = -math.expm1(-bandwidth * sample_time)
    return (
        resistance * step * math.exp(-x) / -math.expm1(-x),
        resistance * step,
    )  # exp(x) would overflow


def solve_designed_loop(
    current: float,
    integral: float,
    reference: float,
    low: float,
    high: float,
    samples: int,
    x: float,
    y: float,
    lost: float,
) -> tuple[float, float, float, float, int]:
    """A designed loop over n samples in closed form; all in amperes, with x = R*T/L, y = wc*T and `lost` = 1 - e.

    v lies from `low` to `high`. Found are i, c, the sum of i over the samples' starts [A], that of
    v times the mean current of each sample [A^2], and how many samples were saturated.
    """
    step = _USUAL_STEP if y == _USUAL else -math.expm1(-y)  # P
    gain, apart = step / lost, lost - step
    kept, rest, rising = 1.0 - step, 1.0 - lost, 1.0 - lost / x  # rising: 1 - m
    p = (1.0 - gain) * (1.0 - rising * gain) / (step * (1.0 + kept))
    q = (1.0 + rising * (1.0 - 2.0 * gain) + 2.0 * p * kept * lost) / (lost + step * rest)
    r = (rising + lost * (p * lost + q * rest)) / (lost * (1.0 + rest))
    total, drawn, saturated, left = 0.0, 0.0, 0, samples
    while left > 0:
        asked = gain * (reference - current) + integral
        held = left
        if low <= asked <= high:
            if reference > high:
                held = samples_until(reference - high, reference - asked, y, left)
            elif reference < low:
                held = samples_until(low - reference, asked - reference, y, left)
            before, lag = reference - current, current - integral
            slower, faster = math.exp(-held * y), math.exp(-held * x)
            if abs(apart) > 0.1 * lost or held * abs(x - y) > 50.0:
                ratio = (slower - faster) / apart
            elif x != y:  # without cancellation
                ratio = faster * math.expm1(held * (x - y)) / ((1.0 - lost) * math.expm1(x - y))
            else:
                ratio = held * faster / (1.0 - lost)
            error = before * slower + lost * lag * ratio
            lag_after = lag * faster
            errors = (before - error + lag - lag_after) / step
            total += held * reference - errors
            drawn += reference * (
                held * reference - 2.0 * errors + (1.0 + rising) * (before - error) / lost
            )
            drawn += p * (before * before - error * error) + q * (before * lag - error * lag_after)
            drawn += r * (lag * lag - lag_after * lag_after)
            current = reference - error
            integral = current - lag_after
        else:
            reached = high if asked > high else low
            final = gain * (reference - reached) + reached  # what is asked for in the end
            if (final < high) if asked > high else (final > low):
                held = samples_until(reached - final, asked - final, x, left)
            decay = math.exp(-held * x)
            after = reached + (current - reached) * decay
            total += held * reached + (current - after) / lost
            drawn += reached * (held * reached + (current - after) / x)
            current, integral = after, reached + (integral - reached) * decay
            saturated += held
        left -= held
    return current, integral, total, drawn, saturated


def samples_until(bound: float, start: float, rate: float, most: int) -> int:
    """The first k >= 1 at which start*exp(-rate*k) is within bound, of the same sign; at most `most`."""
    ratio = bound / start
    if ratio <= 0.0:
        return most
    return min(max(math.ceil(-math.log(ratio) / rate), 1), most)


def run_samples(
    parameters: Any,
    current: float,
    integral: float,
    pending: float,
    reference: float,
    back_emf: float,
    compensated: float,
    samples: int,
    resistance: float,
    decay: float,
    lasting: float,
    kp: float,
    ki: float,
) -> tuple[float, float, float, float, float, int]:
    """Any PI loop, sample by sample: i [A], the integral [V], the pending voltage, and then what `solve_designed_loop` finds.

    Its `parameters` are a `Drive`'s, but for the gains: `ki` is the integral gain per sample [V/A].
    `compensated` is the part of the back-EMF [V] that is added to the voltage, `decay` e, and
    `lasting` m. A delayed loop applies the voltage of the sample before, `pending`.
    Back-calculation has the tracking time kp/ki.
    """
    total, drawn, saturated, gain = 0.0, 0.0, 0, kp + ki
    tracking = ki / gain if gain > 0.0 else 0.0
    voltage, sag, deadband = (
        parameters.supply_voltage,
        parameters.supply_resistance,
        parameters.deadband,
    )
    for _ in range(samples):
        limit = max(voltage - sag * abs(current), 0.0) if sag > 0.0 else voltage
        error = reference - current
        asked = gain * error + integral + compensated
        applied = min(max(asked, -limit), limit)
        if parameters.anti_windup == 0.0:  # back-calculation
            integral += ki * error + tracking * (applied - asked)
        elif parameters.anti_windup == 2.0 or applied == asked or (asked - applied) * error < 0.0:
            integral += ki * error
        saturated += applied != asked
        if parameters.delayed != 0.0:
            applied, pending = min(max(pending, -limit), limit), applied
        if deadband > 0.0:
            applied = math.copysign(max(abs(applied) - deadband, 0.0), applied)
        total += current
        reached = (applied - back_emf) / resistance
        drawn += reached * (reached + (current - reached) * lasting)
        current = reached + (current - reached) * decay
    return current, integral, pending, total, drawn, saturated
