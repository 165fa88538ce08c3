"""Every verdict on the paper from the published rows alone: no package of ours, only csv, math and statistics."""

import csv
import math
import sys
from pathlib import Path
from statistics import mean, variance

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/results/reproduction")
claims, runs = (
    list(csv.DictReader((folder / name).read_text().splitlines()))
    for name in ("claims.csv", "runs.csv")
)


def student(freedom: float) -> float:
    """Student's t at 97.5 %: its density is integrated by Simpson's rule, and the bound found by halving."""
    scale = math.exp(math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2)) / math.sqrt(
        freedom * math.pi
    )
    low, high = 0.0, 700.0
    for _ in range(50):
        x = (low + high) / 2
        at = [(1 + (x * k / 2000) ** 2 / freedom) ** (-(freedom + 1) / 2) for k in range(2001)]
        area = scale * x / 6000 * (at[0] + at[-1] + 4 * sum(at[1::2]) + 2 * sum(at[2:-1:2]))
        low, high = (x, high) if area < 0.475 else (low, x)
    return low


def values(arm: str, column: str) -> dict[str, str]:
    """What there is of an arm, first seeds first: seed (a second training of it too) -> text."""
    found: dict[str, str] = {}
    for row in runs:
        if (
            ", ".join(row[name] for name in ("task", "settings", "motor", "physics")) == arm
            and row[column]
        ):
            found[row["seed"] + " again" * (row["seed"] in found)] = row[column]
    return found


def interval(*samples: list[float], spread: float = 0.0) -> tuple[float, float]:
    """95 % by Student's t, of a mean or of a difference of means (Welch); with spread 1 of one more value."""
    parts = [variance(one) * (1 / len(one) + spread) for one in samples]
    middle = mean(samples[0]) - (mean(samples[1]) if len(samples) > 1 else 0)
    if not sum(parts):
        return middle, middle
    freedom = sum(parts) ** 2 / sum(
        part**2 / (len(one) - 1) for part, one in zip(parts, samples, strict=True)
    )
    half = student(freedom) * math.sqrt(sum(parts))
    return middle - half, middle + half


def verdict(claim: dict[str, str]) -> str:
    """By the one rule: inside, outside or across; of one run or one episode by the range of ours."""
    least, most, rule = float(claim["least"]), float(claim["most"]), claim["rule"]
    texts = [values(arm, claim["column"]) for arm in (claim["arm"], claim["against"]) if arm]
    if not all(len(one) > (rule not in ("one episode", "every seed")) for one in texts):
        return "not testable"
    if rule == "one episode":
        times = sorted(
            float(time) for one in texts[0].values() for time in one.split() if time != "-"
        )
        ends = (
            [times[math.ceil(share * len(times)) - 1] for share in (0.025, 0.975)]
            if times
            else [math.inf] * 2
        )
        return "compatible" if ends[0] <= least <= ends[1] else "not confirmed"
    samples = [[float(text) for text in one.values()] for one in texts]
    if rule == "every seed":
        return "confirmed" if max(samples[0]) <= most else "not confirmed"
    if rule == "paired":
        seeds = [seed for seed in texts[0] if "again" not in seed and seed in texts[1]]
        samples = [[float(texts[0][seed]) - float(texts[1][seed]) for seed in seeds]]
    low, high = interval(*samples, spread=float(rule == "one run"))
    if rule == "one run":
        return "compatible" if low <= least <= high else "not confirmed"
    inside, outside = least <= low and high <= most, high < least or low > most
    return "confirmed" if inside else "not confirmed" if outside else "open"


for claim in claims:
    print(
        f"{claim['task']}: {claim['statement']}: {claim['says']} ({claim['settings']}):"
        f" {verdict(claim)}"
    )
