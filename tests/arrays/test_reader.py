"""The reader means what Python means: functions of all supported constructs, on C and numpy."""

import ctypes
import math
from typing import NamedTuple

import numpy as np
import pytest

from codrl_mj.arrays.array_code import ArrayCode
from codrl_mj.arrays.c_code import CCode
from codrl_mj.arrays.reader import Reader
from codrl_mj.arrays.scalars import Scalar, leaves
from tests.arrays.runs import COMPILER, compile_c

TABLE = (0.0, 0.2, 0.7, 0.9, 1.0)
NUM = 2000


class Pair(NamedTuple):
    x: float
    y: float = 2.0

    def total(self):
        return self.x + self.y


def make_scaled(k):
    def scaled(value, scale=1.5, *, shift=0.25):
        return value * k * scale + shift

    return scaled


tripled = make_scaled(3.0)


def break_and_continue(a, b):
    total, n = 0.0, 0
    for i in range(12):
        if i % 3 == 1:
            continue
        total += b * 0.1
        if total > a:
            break
        for j in range(i):
            if j == 2:
                break
            n += j
    k = 0
    while True:
        k += 1
        if k * 0.3 > abs(b) or k > 7:
            break
    return total, float(n), k + total


def first_above(value, limit):
    for i in range(len(TABLE)):
        if TABLE[i] > limit:
            return i + value
    return -1.0


def early_returns(a, b):
    v = first_above(b, a * 0.3)
    if a > 1.0:
        return v, 1.0
    if a < -1.0:
        w = -1.0
    elif a < 0.0:
        return v, 2.0
    else:
        w = 3.0
    return w, v


def loop_over_tuples(a, b):
    total = 0.0
    for weight, value in ((1.0, a), (2.0, b), (3.0, a * b)):
        if value > 1.5:
            break
        total += weight * value
    for index, value in enumerate((a, b)):
        total += index * value
    for value, weight in zip((a, b), (b, 1.0), strict=True):
        total += value * weight
    return (total,)


def named_tuples(a, b):
    p = Pair(b)
    q = p._replace(y=a)
    for _ in range(3):
        p, q = q, Pair(p.y + 0.1, q.x)
    (u, v), *rest = (p, q.x, q.y, 4.0)
    w = tripled(u, shift=v) + tripled(rest[0], 2.0)
    chosen = p if w > 0 else q
    if (z := chosen.x * 2.0) > 1.0 and not (z > 5.0 or b < 0.0):
        chosen = chosen._replace(x=z)
    return *chosen, w + sum(rest[1:]), float(len(rest)), Pair._make((a, b)).total()


def integers(a, b):
    i, j = int(b * 10.0), int(a * 7.0)
    k = i // 3 + i % 4 - (j // -5) + (j << 2) + ((i & 255) ^ 7) + (~j | 1) + (i >> 1)
    m = math.floor(b) + math.ceil(a) + math.trunc(b) + round(a * 3.3) + 2**3
    t = TABLE[min(max(i, 0), 4)] + TABLE[-1]
    quotient = i / j if j != 0 else 0.5
    return float(k), float(m), t + (-i) // 4 + quotient, float(i % -3), i**2 / 7


def float_divisions(a, b):
    return a // 0.3, a % 0.3, b // -0.7, b % -0.7, (a * 10.0) % 1.0


def numpy_functions(a, b):
    x = np.sqrt(np.abs(b)) + np.exp(-np.abs(a)) + np.arctan2(a, b) + np.tanh(a) + np.floor(b)
    y = np.float64(2.0) * math.hypot(a, b) + math.fabs(a) ** 1.5 + np.pi + a**3
    z = math.fmod(x, 0.7) + math.log1p(abs(a)) + math.copysign(2.0, b) + np.minimum(a, b)
    return x, y if np.isfinite(x) else 0.0, z, pow(abs(a), 0.5)


def values_of_conditions(a, b):
    number = (a > 0.0 and a) or (b < 0.0 and b * 2.0) or 7.0
    chained = 1.0 if -1.0 < a <= b < 2.0 else 0.0
    guarded = b > 0.5 and halvings(b) > 2
    return number, chained, 1.0 if guarded else 0.0, 1.0 if not a else 2.0


def halvings(value):
    """Never end for a value that is not positive."""
    count = 0
    while value <= 0.0 or value < 1.0 or (value >= 1.0 and count < 3):
        value, count = value * 2.0, count + 1
    return count


def names_of_one_side(a, b):
    x = 0
    for _ in range(3):
        x += 0.5 * a
        last = x * 2
    if b > 0.0:
        extra = last
    if b > 0.0:
        x = x + extra
    y = 1 if a > 0 else b
    for k in range(int(abs(a))):
        y += k
    for k in range(3, -int(abs(b)) - 1, -2):
        y -= k
    return x, y, last


FUNCTIONS = (
    *(break_and_continue, early_returns, loop_over_tuples, named_tuples, integers),
    *(float_divisions, numpy_functions, values_of_conditions, names_of_one_side),
)


def numbers():
    rng = np.random.default_rng(0)
    a, b = rng.normal(0.0, 2.0, (2, NUM))
    a[:10], b[5:15] = 0.0, -0.0
    return a, b


def by_python(function):
    # `and` of numpy's bools and of Python's differ in their types only.
    return np.array(
        [function(a, b) for a, b in zip(*(v.tolist() for v in numbers()), strict=True)], float
    )


def by_c(function, folder, portable):
    backend = CCode(portable)
    reader = Reader(backend)
    result = leaves(reader.read(function, (Scalar("float", "a"), Scalar("float", "b"))))
    values = [reader.operand(number, "float") for number in result]
    lines = ["#include <math.h>", "void run(double a, double b, double *out) {", *backend.lines]
    lines += [f"    out[{k}] = {value};" for k, value in enumerate(values)]
    run = compile_c("\n".join([*lines, "}", ""]), folder)
    run.argtypes = [ctypes.c_double, ctypes.c_double, np.ctypeslib.ndpointer(np.float64)]
    rows = np.zeros((NUM, len(values)))
    for a, b, row in zip(*numbers(), rows, strict=True):
        run(a, b, row)
    return rows


def by_numpy(function):
    a, b = numbers()
    backend = ArrayCode(np, a, a.shape)
    reader = Reader(backend)
    with np.errstate(all="ignore"):
        result = leaves(reader.read(function, (Scalar("float", a), Scalar("float", b))))
        return np.stack([backend.full(reader.operand(number, "float")) for number in result], 1)


@pytest.mark.skipif(COMPILER is None, reason="NOT RUN: no C compiler: apt-get install gcc")
@pytest.mark.parametrize("portable", [False, True])
@pytest.mark.parametrize("function", FUNCTIONS)
def test_c_means_what_python_means(function, portable, tmp_path):
    # numpy has its own exp and tanh, which differ from those of C in the last digit.
    tolerance = 1e-12 if portable or function is numpy_functions else 0.0
    results = by_c(function, tmp_path, portable)
    np.testing.assert_allclose(results, by_python(function), rtol=tolerance)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_arrays_mean_what_python_means(function):
    np.testing.assert_allclose(by_numpy(function), by_python(function), rtol=1e-14, atol=1e-15)
