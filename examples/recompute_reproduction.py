"""Recompute every verdict on the paper from the published rows, without this package."""

import csv
import math
import sys
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from statistics import mean, median, variance

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/results/reproduction")
claims, runs = (
    list(csv.DictReader((folder / name).read_text().splitlines()))
    for name in ("claims.csv", "runs.csv")
)


def student(degrees_of_freedom: float) -> float:
    """Return Student's t at 97.5 %, from Simpson's rule for its density and bisection."""
    scale = math.exp(
        math.lgamma((degrees_of_freedom + 1) / 2) - math.lgamma(degrees_of_freedom / 2)
    ) / math.sqrt(degrees_of_freedom * math.pi)
    low, high = 0.0, 700.0
    # Every bisection halves the interval: 50 of them reach the precision of a float.
    for _ in range(50):
        x = (low + high) / 2
        density = [
            (1 + (x * k / 2000) ** 2 / degrees_of_freedom) ** (-(degrees_of_freedom + 1) / 2)
            for k in range(2001)
        ]
        area = (
            scale
            * x
            / 6000
            * (density[0] + density[-1] + 4 * sum(density[1::2]) + 2 * sum(density[2:-1:2]))
        )
        low, high = (x, high) if area < 0.475 else (low, x)
    return low


def values(arm: str, column: str) -> dict[str, str]:
    """Return an arm's values by seed, as text; "SEED again" is a second training of a seed."""
    values_by_seed: dict[str, str] = {}
    for row in runs:
        if (
            ", ".join(row[name] for name in ("task", "settings", "motor", "physics")) == arm
            and row[column]
        ):
            values_by_seed[row["seed"] + " again" * (row["seed"] in values_by_seed)] = row[column]
    return values_by_seed


def interval(*samples: list[float], spread: float = 0.0) -> tuple[float, float]:
    """Return the 95 % interval of a mean or of a difference; with spread 1, of another value."""
    parts = [variance(sample) * (1 / len(sample) + spread) for sample in samples]
    middle = mean(samples[0]) - (mean(samples[1]) if len(samples) > 1 else 0)
    # Samples without variance have no statistic.
    if not sum(parts):
        return middle, middle
    degrees_of_freedom = sum(parts) ** 2 / sum(
        part**2 / (len(sample) - 1) for part, sample in zip(parts, samples, strict=True)
    )
    half = student(degrees_of_freedom) * math.sqrt(sum(parts))
    return middle - half, middle + half


def judge_single(
    sample: list[float], single: Sequence[float], low_bound: float, high_bound: float
) -> str:
    """Judge one run or episode: by our mean if a range is stated, then by the range of ours."""
    low, high = interval(sample) if len(sample) > 1 else (sample[0], sample[0])
    if low_bound < high_bound and low_bound <= low and high <= high_bound:
        return "confirmed"
    overlaps = single[0] <= high_bound and low_bound <= single[1]
    return "compatible" if overlaps else "not confirmed"


def verdict(claim: dict[str, str]) -> str:
    """Judge a claim: inside, outside or across; one run or episode by the range of ours."""
    low_bound, high_bound, rule = float(claim["least"]), float(claim["most"]), claim["rule"]
    texts = [values(arm, claim["column"]) for arm in (claim["arm"], claim["against"]) if arm]
    # Ranges of episodes and maxima need one seed, intervals need two.
    if not all(
        len(values_by_seed) > (rule not in ("one episode", "under", "every seed"))
        for values_by_seed in texts
    ):
        return "not testable"
    if rule in ("one episode", "under"):
        episodes = [
            [float(time) for time in values_by_seed.split() if time != "-"]
            for values_by_seed in texts[0].values()
        ]
        times, medians = sorted(chain(*episodes)), [median(times) for times in episodes if times]
        if not times:
            return "not confirmed"
        # The central 95 % of the episodes that arrive, and the interval of the seeds' medians.
        single = [times[math.ceil(share * len(times)) - 1] for share in (0.025, 0.975)]
        if rule == "under":
            # A time that equals the bound is not under it.
            high_bound = math.nextafter(high_bound, -math.inf)
        return judge_single(medians, single, low_bound, high_bound)
    samples = [[float(text) for text in values_by_seed.values()] for values_by_seed in texts]
    if rule == "every seed":
        return "confirmed" if max(samples[0]) <= high_bound else "not confirmed"
    if rule == "paired":
        seeds = [seed for seed in texts[0] if "again" not in seed and seed in texts[1]]
        samples = [[float(texts[0][seed]) - float(texts[1][seed]) for seed in seeds]]
    low, high = interval(*samples)
    if rule == "one run":
        return judge_single(samples[0], interval(*samples, spread=1.0), low_bound, high_bound)
    if rule == "behavior" and low < low_bound:
        return "compatible" if mean(samples[0]) + low_bound >= 1 else "not confirmed"
    inside, outside = low_bound <= low and high <= high_bound, high < low_bound or low > high_bound
    return "confirmed" if inside else "not confirmed" if outside else "open"


for claim in claims:
    print(
        f"{claim['task']}: {claim['statement']}: {claim['says']} ({claim['settings']}):"
        f" {verdict(claim)}"
    )
