"""Closed-form solution of a sampled current loop with an exact winding, used by `Drive`.

Within a sample of length T the voltage u and the back-EMF b are held, and the winding's current is
exact: i+ = v + (i - v)*e with v = (u - b)/R and e = exp(-R*T/L).

With the discrete pole-zero cancellation of `designed_gains` and back-calculation with the tracking
time kp/ki, a whole step of n samples has a closed form, saturated or not. Write the integral as a
current, c = (integral - b')/R with b' the part of the back-EMF that is not compensated. Then, with
P = 1 - exp(-wc*T) and G = P/(1 - e), the commanded voltage is b + R*q,

    q = G*(i_ref - i) + c,

and i - c decays as e^k whether the voltage saturates or not. Unsaturated, q - i_ref decays as (1 -
P)^k, so the voltage reaches a limit at most once; saturated, i and c approach v as e^k, so the
voltage leaves the limit at most once.

The energy that the winding draws in a sample is u times the sample's mean current, i + (1 - m)*(v -
i) with m = (1 - e)*L/(R*T). Unsaturated, with E = i_ref - i and l = i - c, v - i = G*E - l, E+ = (1
- P)*E + (1 - e)*l and l+ = e*l. The part that is quadratic in E and l equals the decrease of p*E^2
+ q*E*l + r*l^2 in a sample, for some p, q and r, so its sum follows from the first and last values.
"""

import math

from codrl_mj.actuators.parameters import Parameters
from codrl_mj.actuators.sampled_loop import DEFAULT_BANDWIDTH

_DEFAULT_ANGLE = 2.0 * math.pi * DEFAULT_BANDWIDTH
"""Value of wc*T for a loop without a specified bandwidth."""
_DEFAULT_LOOP_DROP = -math.expm1(-_DEFAULT_ANGLE)
"""P for that angle, precomputed because `expm1` would take a tenth of a step's time."""


def designed_gains(
    resistance: float, inductance: float, sample_time: float, bandwidth: float
) -> tuple[float, float]:
    """Return proportional and integral gain per sample [V/A] that cancel the winding's pole.

    kp = R*P*e/(1 - e) and ki*T = R*P: the loop from reference to current is P/(z - 1 + P).
    """
    x = resistance * sample_time / inductance
    loop_drop = -math.expm1(-bandwidth * sample_time)
    # The gain is written with exp(-x), because exp(x) would overflow.
    return (
        resistance * loop_drop * math.exp(-x) / -math.expm1(-x),
        resistance * loop_drop,
    )


def solve_designed_loop(
    current: float,
    integral: float,
    reference: float,
    low: float,
    high: float,
    samples: int,
    x: float,
    y: float,
    drop: float,
) -> tuple[float, float, float, float, int]:
    """Advance a designed loop by n samples in closed form, all quantities in amperes.

    The arguments are x = R*T/L, y = wc*T and `drop` = 1 - e; v lies between `low` and `high`.

    The result is i, c, the sum of i over the samples' starts [A], the sum of v times the mean
    current of each sample [A^2], and the number of saturated samples.
    """
    # In the module's docstring, `loop_drop` is P, `gain` is G, `decay` is e and `mean_drop` 1 - m.
    loop_drop = _DEFAULT_LOOP_DROP if y == _DEFAULT_ANGLE else -math.expm1(-y)
    gain, separation = loop_drop / drop, drop - loop_drop
    loop_decay, decay, mean_drop = 1.0 - loop_drop, 1.0 - drop, 1.0 - drop / x
    p = (1.0 - gain) * (1.0 - mean_drop * gain) / (loop_drop * (1.0 + loop_decay))
    q = (1.0 + mean_drop * (1.0 - 2.0 * gain) + 2.0 * p * loop_decay * drop) / (
        drop + loop_drop * decay
    )
    r = (mean_drop + drop * (p * drop + q * decay)) / (drop * (1.0 + decay))
    total, drawn, saturated, samples_left = 0.0, 0.0, 0, samples
    while samples_left > 0:
        command = gain * (reference - current) + integral
        count = samples_left
        if low <= command <= high:
            if reference > high:
                count = samples_until(reference - high, reference - command, y, samples_left)
            elif reference < low:
                count = samples_until(low - reference, command - reference, y, samples_left)
            error_before, lag = reference - current, current - integral
            slower, faster = math.exp(-count * y), math.exp(-count * x)
            if abs(separation) > 0.1 * drop or count * abs(x - y) > 50.0:
                # The ratio is (1-P)^k - e^k over their difference for one sample, and is 0/0 where
                # P = 1 - e. Close to that, `expm1` avoids the cancellation.
                ratio = (slower - faster) / separation
            elif x != y:
                ratio = faster * math.expm1(count * (x - y)) / ((1.0 - drop) * math.expm1(x - y))
            else:
                ratio = count * faster / (1.0 - drop)
            error = error_before * slower + drop * lag * ratio
            lag_after = lag * faster
            errors = (error_before - error + lag - lag_after) / loop_drop
            total += count * reference - errors
            drawn += reference * (
                count * reference - 2.0 * errors + (1.0 + mean_drop) * (error_before - error) / drop
            )
            drawn += p * (error_before * error_before - error * error) + q * (
                error_before * lag - error * lag_after
            )
            drawn += r * (lag * lag - lag_after * lag_after)
            current = reference - error
            integral = current - lag_after
        else:
            limit = high if command > high else low
            # `final` is the command that the saturated loop approaches. The voltage leaves the
            # limit only if that is inside.
            final = gain * (reference - limit) + limit
            if (final < high) if command > high else (final > low):
                count = samples_until(limit - final, command - final, x, samples_left)
            total_decay = math.exp(-count * x)
            after = limit + (current - limit) * total_decay
            total += count * limit + (current - after) / drop
            drawn += limit * (count * limit + (current - after) / x)
            current, integral = after, limit + (integral - limit) * total_decay
            saturated += count
        samples_left -= count
    return current, integral, total, drawn, saturated


def samples_until(bound: float, start: float, rate: float, maximum: int) -> int:
    """Return the first k >= 1 with start*exp(-rate*k) within a bound; at most `maximum`.

    Bound and start have the same sign; otherwise the result is `maximum`.
    """
    ratio = bound / start
    if ratio <= 0.0:
        return maximum
    return min(max(math.ceil(-math.log(ratio) / rate), 1), maximum)


def run_samples(
    parameters: Parameters,
    current: float,
    integral: float,
    pending: float,
    reference: float,
    back_emf: float,
    compensated: float,
    samples: int,
    resistance: float,
    decay: float,
    mean_decay: float,
    kp: float,
    ki: float,
) -> tuple[float, float, float, float, float, int]:
    """Advance any PI loop sample by sample.

    `parameters` are those of a `Drive`, except for the gains: `ki` is the integral gain per sample
    [V/A]. `compensated` is the part of the back-EMF [V] that is added to the voltage, `decay` is e,
    and `mean_decay` is m. A delayed loop applies the voltage of the previous sample, `pending`.
    Back-calculation has the tracking time kp/ki.

    The result is i [A], the integral [V], the pending voltage [V], and then the last three entries
    of `solve_designed_loop`.
    """
    total, drawn, saturated, gain = 0.0, 0.0, 0, kp + ki
    tracking = ki / gain if gain > 0.0 else 0.0
    voltage = parameters.supply_voltage
    sag = parameters.supply_resistance
    for _ in range(samples):
        limit = max(voltage - sag * abs(current), 0.0) if sag > 0.0 else voltage
        error = reference - current
        command = gain * error + integral + compensated
        total += current
        current, integral, pending, _, _, drawn_now, limited = advance_sample(
            parameters,
            current,
            integral,
            pending,
            error,
            command,
            limit,
            back_emf,
            resistance,
            decay,
            mean_decay,
            ki,
            tracking,
        )
        drawn, saturated = drawn + drawn_now, saturated + limited
    return current, integral, pending, total, drawn, saturated


def advance_sample(
    parameters: Parameters,
    current: float,
    integral: float,
    pending: float,
    error: float,
    command: float,
    limit: float,
    back_emf: float,
    resistance: float,
    decay: float,
    mean_decay: float,
    ki: float,
    tracking: float,
) -> tuple[float, float, float, float, float, float, int]:
    """Advance a PI loop by one sample, from the voltage that it commands and the voltage limit.

    `error` is the error of the current [A], and `tracking` the gain of the back-calculation. The
    other arguments are those of `run_samples`.

    The result is i [A], the integral [V], the pending voltage [V], the applied voltage [V], the
    mean current [A] of the sample, the drawn power over the resistance [A^2], and 1 if the voltage
    is saturated.
    """
    applied = min(max(command, -limit), limit)
    # The three modes are back-calculation, clamping (1) and none (2).
    if parameters.anti_windup == 0.0:
        integral += ki * error + tracking * (applied - command)
    elif parameters.anti_windup == 2.0 or applied == command or (command - applied) * error < 0.0:
        integral += ki * error
    saturated = applied != command
    if parameters.delayed != 0.0:
        applied, pending = min(max(pending, -limit), limit), applied
    if parameters.deadband > 0.0:
        applied = math.copysign(max(abs(applied) - parameters.deadband, 0.0), applied)
    final = (applied - back_emf) / resistance
    mean = final + (current - final) * mean_decay
    return (
        final + (current - final) * decay,
        integral,
        pending,
        applied,
        mean,
        final * mean,
        1 if saturated else 0,
    )
