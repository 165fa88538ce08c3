"""Line plots as inline SVG that takes its colours from the page: legible in light and dark, large and small."""

import html
import math

import numpy as np

from codrl_mj.validation.outcome import Curve, Plot

WIDTH, HEIGHT = 640, 360
LEFT, RIGHT, TOP, BOTTOM = 108, 14, 14, 60
DASHES = ("", "7 4", "2 3", "9 3 2 3", "16 5")
POINTS = 400
"""Most points of a line: more than there are pixels show nothing."""


class _Axis:
    """Maps values to pixels, and chooses ticks."""

    def __init__(self, values: np.ndarray, start: float, end: float, log: bool) -> None:
        finite = values[np.isfinite(values)]
        self.log = log and bool(np.any(finite > 0))
        good = finite[finite > 0] if self.log else finite
        low, high = (float(good.min()), float(good.max())) if len(good) else (0.0, 1.0)
        if self.log:
            low, high = math.log10(low), math.log10(high)
        if high - low < 1e-12 * max(1.0, abs(high)):
            low, high = low - 0.5, high + 0.5
        room = 0.04 * (high - low)
        self.low, self.high = low - room, high + room
        self._start, self._end = start, end

    def __call__(self, values: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            scaled = np.log10(values) if self.log else values
        return self._start + (scaled - self.low) / (self.high - self.low) * (self._end - self._start)

    def ticks(self) -> list[tuple[float, str]]:
        """Positions in pixels, with labels."""
        if self.log and self.high - self.low > 2.2:
            decades = range(math.ceil(self.low), math.floor(self.high) + 1)
            stride = max(1, math.ceil(len(decades) / 7))
            marks = [(10.0**power, _power(power)) for power in decades if power % stride == 0]
        elif self.log and self.high - self.low > 0.6:
            powers = range(math.floor(self.low), math.ceil(self.high))
            every = [step * 10.0**power for power in powers for step in (1, 2, 5)]
            marks = [(value, f"{value:.3g}") for value in every if self.low <= math.log10(value) <= self.high]
        elif self.log:
            low, high = 10**self.low, 10**self.high
            marks = [(value, f"{value:.3g}") for value in _round_numbers(low, high)]
        else:
            marks = [(value, f"{value:.6g}") for value in _round_numbers(self.low, self.high)]
        return [(float(self(np.array(value))), label) for value, label in marks]


def _power(power: int) -> str:
    exponent = str(power).replace("-", "\N{MINUS SIGN}")
    return {0: "1", 1: "10"}.get(power, f'10<tspan dy="-6" font-size="12">{exponent}</tspan>')


def _round_numbers(low: float, high: float) -> list[float]:
    """Some five multiples of 1, 2 or 5 times a power of ten within the bounds."""
    rough = (high - low) / 5
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(step * power for step in (1, 2, 5, 10) if step * power >= rough)
    return [step * index for index in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _thinned(curve: Curve) -> tuple[np.ndarray, np.ndarray]:
    """At most some `POINTS` points: the lowest and the highest of each stretch, so that no peak is lost."""
    x, y = np.asarray(curve.x, dtype=float), np.asarray(curve.y, dtype=float)
    if len(x) <= POINTS:
        return x, y
    kept: set[int] = {0, len(x) - 1}
    for stretch in np.array_split(np.arange(len(x)), POINTS // 2):
        part = np.where(np.isfinite(y[stretch]), y[stretch], 0.0)
        kept |= {int(stretch[np.argmin(part)]), int(stretch[np.argmax(part)])}
    chosen = np.array(sorted(kept))
    return x[chosen], y[chosen]


def _path(x: np.ndarray, y: np.ndarray) -> str:
    """SVG path data; a point that is not finite lifts the pen."""
    words, down = [], False
    for across, up in zip(x.tolist(), y.tolist(), strict=True):
        if not (math.isfinite(across) and math.isfinite(up)):
            down = False
            continue
        words.append(f"{'L' if down else 'M'}{across:.1f} {up:.1f}")
        down = True
    return "".join(words)


def style(index: int, curve: Curve) -> tuple[str, str]:
    """CSS class and dashes of a line: references are grey, results coloured, and dashed where they may hide another."""
    if curve.reference:
        return "ref", DASHES[1 + index % (len(DASHES) - 1)]
    return f"line c{index % 6}", "11 9" if index % 2 else ""


def svg(plot: Plot) -> str:
    """The plot as an `<svg>` element; its legend is `legend`'s."""
    curves = [(curve, *_thinned(curve)) for curve in plot.curves]
    across = np.concatenate([x for _, x, _ in curves])
    results = [y for curve, _, y in curves if not curve.reference] or [y for _, _, y in curves]
    up = np.concatenate([y for _, _, y in curves])
    if plot.y_log and len(results) < len(curves):  # a reference may leave the picture, a result may not
        ceiling = max(float(np.nanmax(y[np.isfinite(y)], initial=0.0)) for y in results)
        up = up[~(up > 1e6 * ceiling)] if ceiling > 0 else up
    x_axis = _Axis(across, LEFT, WIDTH - RIGHT, plot.x_log)
    y_axis = _Axis(up, HEIGHT - BOTTOM, TOP, plot.y_log)
    parts = []
    for at, label in x_axis.ticks():
        parts.append(f'<path class="grid" d="M{at:.1f} {TOP}V{HEIGHT - BOTTOM}"/>')
        parts.append(f'<text x="{at:.1f}" y="{HEIGHT - BOTTOM + 21}" text-anchor="middle">{label}</text>')
    for at, label in y_axis.ticks():
        parts.append(f'<path class="grid" d="M{LEFT} {at:.1f}H{WIDTH - RIGHT}"/>')
        parts.append(f'<text x="{LEFT - 7}" y="{at + 5:.1f}" text-anchor="end">{label}</text>')
    inner = f'x="{LEFT}" y="{TOP}" width="{WIDTH - LEFT - RIGHT}" height="{HEIGHT - TOP - BOTTOM}"'
    lines, pictured = [], f'viewBox="{LEFT} {TOP} {WIDTH - LEFT - RIGHT} {HEIGHT - TOP - BOTTOM}"'
    for index, (curve, x, y) in enumerate(curves):
        name, dashes = style(index, curve)
        points = x_axis(x), y_axis(y)
        lines.append(f'<path class="{name}" stroke-dasharray="{dashes}" d="{_path(*points)}"/>')
        if len(x) <= 25 and not curve.reference:
            lines += [
                f'<circle class="dot c{index % 6}" cx="{a:.1f}" cy="{b:.1f}" r="3.2"/>'
                for a, b in zip(*(axis.tolist() for axis in points), strict=True)
                if math.isfinite(a) and math.isfinite(b)
            ]
    parts.append(f'<svg {inner} {pictured} overflow="hidden">{"".join(lines)}</svg>')
    parts.append(f'<rect class="frame" {inner}/>')
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(
        f'<text class="label" x="{middle}" y="{HEIGHT - 12}" text-anchor="middle">{_text(plot.x_label)}</text>'
    )
    size = min(17.0, 1.85 * HEIGHT / max(1, len(plot.y_label)))  # a long label is smaller, and never cut off
    turned = f'transform="translate(20 {HEIGHT / 2}) rotate(-90)" style="font-size: {size:.1f}px"'
    parts.append(f'<text class="label" {turned} text-anchor="middle">{_text(plot.y_label)}</text>')
    title = f"{plot.title}: {plot.y_label} over {plot.x_label}"
    box = f'viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{_text(title)}"'
    return f'<svg class="plot" {box}>{"".join(parts)}</svg>'


def legend(plot: Plot) -> list[tuple[str, str]]:
    """A small `<svg>` of each line, with its label."""
    entries = []
    for index, curve in enumerate(plot.curves):
        name, dashes = style(index, curve)
        line = f'<path class="{name}" stroke-dasharray="{dashes}" d="M1 6H33"/>'
        entries.append((f'<svg class="swatch" viewBox="0 0 34 12" aria-hidden="true">{line}</svg>', curve.label))
    return entries


def _text(text: str) -> str:
    return html.escape(text, quote=True)
