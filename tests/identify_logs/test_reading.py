"""Reading of logs from files."""

import gzip
import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from codrl_mj.identify.log import Log, find_resolution, gapless_stretches
from codrl_mj.identify.reading import read_log
from codrl_mj.identify.synthetic import write_log

COLUMNS = "time=t:s,current=i:A"


def write(folder, text, name="log.csv"):
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_csv_is_read(tmp_path, separator):
    rows = ["t,i,other", "10,1.5,x", "10.5, 2e0,y", "", "11,-3,z"]
    log = read_log(write(tmp_path, "\n".join(rows).replace(",", separator)), COLUMNS)
    np.testing.assert_array_equal(log.time, [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(log.signals["current"], [1.5, 2.0, -3.0])
    assert log.name == "log"
    assert log.has("current")
    assert not log.has("current", "voltage")
    assert log.findings == ()


BENCH = {
    "comments": "# logged 2026-05-01\n# by us\nt,i\n0,1.5\n0.5,-2\n",
    "a comment of names": "# t,i\n0,1.5\n0.5,-2\n",
    "units": "t,i\ns,A\n0,1.5\n0.5,-2\n",
    "decimal commas": "t;i\n0,0;1,5\n0,5;-2,0\n",
    "decimal commas and units": "t;i\n[s];[A]\n0,0;1,5\n0,5;-2,0\n",
    "stamps": "t,i\n2026-05-01T10:00:00.000,1.5\n2026-05-01T10:00:00.500,-2\n",
    "stamps with a zone": "t,i\n2026-05-01 10:00:00.000Z,1.5\n2026-05-01 10:00:00.500Z,-2\n",
    "times of day": "t\ti\n10:00:00.0\t1.5\n10:00:00.5\t-2\n",
    "Latin-1": "t,i,Winkel [°]\n0,1.5,3\n0.5,-2,3\n",
    "tabs": "t\ti\n0\t1.5\n0.5\t-2\n",
    "blanks": "t   i\n0.0   1.5\n0.5  -2.0\n",
    "an instrument's title": "My oscilloscope\nModel 5\nt,i\n0,1.5\n0.5,-2\n",
}


@pytest.mark.parametrize("suffix", ["csv", "txt", "dat"])
@pytest.mark.parametrize("name", BENCH)
def test_formats_of_instruments_and_spreadsheets_are_read(tmp_path, name, suffix):
    path = tmp_path / f"log.{suffix}"
    path.write_bytes(BENCH[name].encode("latin-1"))
    log = read_log(path, COLUMNS)
    np.testing.assert_allclose(log.time, [0.0, 0.5], atol=1e-6)
    np.testing.assert_array_equal(log.signals["current"], [1.5, -2.0])


ROWS = {"t": [0.0, 1.0, 2.0], "i": [4.0, 5.0, 7.0]}
ENTRIES = [dict(zip(ROWS, row, strict=True)) for row in zip(*ROWS.values(), strict=True)]


@pytest.mark.parametrize("content", [ROWS, ENTRIES, {"entries": ENTRIES, "gain": 2, "name": "x"}])
@pytest.mark.parametrize("packed", [False, True])
def test_json_is_read(tmp_path, content, packed):
    path = tmp_path / ("log.json.gz" if packed else "log.json")
    text = json.dumps(content).encode()
    path.write_bytes(gzip.compress(text) if packed else text)
    log = read_log(path, COLUMNS)
    np.testing.assert_array_equal(log.signals["current"], ROWS["i"])
    assert log.name == "log"
    assert log.constants == ({"gain": 2.0} if "gain" in content else {})


def test_formulas_can_use_constants_of_a_file(tmp_path):
    path = write(tmp_path, json.dumps({"entries": ENTRIES, "gain": 2}), "log.json")
    np.testing.assert_array_equal(
        read_log(path, "time=t:s,current=i*gain:A").signals["current"], [8.0, 10.0, 14.0]
    )


def test_unusable_rows_are_left_out_and_reported(tmp_path):
    lines = ["t,i"] + [f"{k},{k}" for k in range(20)]
    # One row is incomplete, one is earlier than the row before, and one has a missing value.
    lines[4], lines[8], lines[12] = ("3", "5.5,7", "11,NA")
    log = read_log(write(tmp_path, "\n".join(lines)), COLUMNS)
    np.testing.assert_array_equal(np.setdiff1d(np.arange(1, 21), log.row_numbers), [4, 8, 12])
    np.testing.assert_array_equal(log.row_numbers, log.time + 1.0)
    assert {(finding.check, finding.row) for finding in log.findings} == {
        ("missing", 4),
        ("stamps", 8),
        ("missing", 12),
    }
    assert [finding.severity for finding in log.findings if finding.check == "stamps"] == ["error"]


def test_rows_left_out_by_only_leave_a_gap(tmp_path):
    lines = ["t,i,on"] + [f"{k},{k},{'false' if 20 <= k < 40 else 'true'}" for k in range(60)]
    log = read_log(write(tmp_path, "\n".join(lines)), f"{COLUMNS},only=on")
    assert len(log.time) == 40
    assert gapless_stretches(log) == [slice(0, 20), slice(20, 40)]


def test_a_register_in_twos_complement_is_reported(tmp_path):
    numbers = np.round(100.0 * np.sin(np.arange(60.0))).astype(np.int16)
    path = write(
        tmp_path, "\n".join(["t,i"] + [f"{k},{n.astype(np.uint16)}" for k, n in enumerate(numbers)])
    )
    (finding,) = read_log(path, COLUMNS).findings
    first = 1 + int(np.argmax(numbers < 0))
    assert (finding.check, finding.row) == ("register", first)
    lines = path.read_text().splitlines()
    # A row with a missing value and an incomplete row count as rows of the file, too.
    lines[1:1] = ["-2,", "-1"]
    finding, *_ = read_log(write(tmp_path, "\n".join(lines), "less.csv"), COLUMNS).findings
    assert (finding.check, finding.row) == ("register", first + 2)
    log = read_log(path, "time=t:s,current=twos_complement(i, 16):A")
    assert log.findings == ()
    np.testing.assert_array_equal(log.signals["current"], numbers)


@pytest.mark.parametrize(
    ("signal", "bits"), [("duty", 11), ("voltage", 11), ("current", 16), ("velocity", 16)]
)
def test_a_register_with_a_sign_bit_is_reported(tmp_path, signal, bits):
    numbers = np.round(300.0 * np.sin(0.2 * np.arange(200.0))).astype(int)
    register = [abs(number) | (int(number < 0) << (bits - 1)) for number in map(int, numbers)]
    path = write(
        tmp_path, "\n".join(["t,x"] + [f"{row},{number}" for row, number in enumerate(register)])
    )
    unit = {"duty": "1", "voltage": "V", "current": "A", "velocity": "rad/s"}[signal]
    (finding,) = read_log(path, f"time=t:s,{signal}=x:{unit}").findings
    assert (finding.severity, finding.check, finding.row) == (
        "error",
        "register",
        1 + int(np.argmax(numbers < 0)),
    )
    assert finding.remedy == f"write sign_magnitude(x, {bits})"
    log = read_log(path, f"time=t:s,{signal}=sign_magnitude(x, {bits}):{unit}")
    assert log.findings == ()
    np.testing.assert_array_equal(log.signals[signal], numbers)
    # The counts of an encoder may have these values.
    assert read_log(path, "time=t:s,position=x:rad").findings == ()


def test_a_voltage_in_whole_millivolts_is_not_a_register(tmp_path):
    numbers = np.round(700.0 + 600.0 * np.sin(0.2 * np.arange(200.0))).astype(int)
    path = write(
        tmp_path, "\n".join(["t,x"] + [f"{row},{number}" for row, number in enumerate(numbers)])
    )
    assert read_log(path, "time=t:s,voltage=x:mV").findings == ()


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        ("t,i\n1,2\n2,a\n", "log.csv", "column i in line 3 is 'a'"),
        ('t,i\n1,"2,5"\n2,"3,5"\n', "log.csv", "decimal point"),
        ("t,t\n1,2\n", "log.csv", "name the columns"),
        (
            "t,i\n1,2\n",
            "log.csv",
            "1 of 1 rows can be used, must be at least 2 and 80% of all: there are no more",
        ),
        ("t,i\n3,2\n2,2\n1,2\n", "log.csv", "1 of 3 rows"),
        ("t,j\n1,2\n2,2\n", "log.csv", "unknown column i"),
        ("", "log.csv", "name the columns"),
        ("[1]", "a.mat", "must be .csv"),
        ("[1]", "a.json", "JSON must be"),
        ("[1]", "a.csv.gz", "gzip"),
        (None, "nowhere.csv", r"no log at .*nowhere"),
    ],
)
def test_invalid_files_raise_an_error_with_the_reason(tmp_path, text, name, message):
    if text is not None:
        write(tmp_path, text, name)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        read_log(tmp_path / name, COLUMNS)


def test_parquet_is_read_by_pyarrow_or_raises_an_error(tmp_path, monkeypatch):
    path = write(tmp_path, "", "log.parquet")
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(ValueError, match="pip install pyarrow"):
        read_log(path, COLUMNS)
    tables = {path: SimpleNamespace(to_pydict=lambda: ROWS)}
    monkeypatch.setitem(
        sys.modules, "pyarrow.parquet", SimpleNamespace(read_table=tables.__getitem__)
    )
    np.testing.assert_array_equal(read_log(path, COLUMNS).signals["current"], ROWS["i"])


@pytest.mark.parametrize("name", ["log.csv", "log.csv.gz"])
@pytest.mark.parametrize("mean", [False, True])
def test_a_written_log_is_read_back(tmp_path, name, mean):
    random = np.random.default_rng(0)
    signals = {
        signal: random.standard_normal(50)
        for signal in ("voltage", "current", "duty", "temperature")
    }
    log = Log("log", np.cumsum(random.uniform(0.5, 1.5, 50)) * 1e-3, signals, mean_voltage=mean)
    copy = read_log(tmp_path / name, write_log(tmp_path / name, log))
    assert copy.mean_voltage is mean
    np.testing.assert_allclose(copy.time, log.time - log.time[0], atol=1e-9)
    for signal, values in signals.items():
        np.testing.assert_allclose(copy.signals[signal], values, rtol=1e-8)


TIME = np.arange(5.0)


@pytest.mark.parametrize(
    ("time", "signal", "values", "message"),
    [
        (TIME, "currant", TIME, "unknown signal"),
        (TIME, "current", TIME[1:], "shape"),
        (TIME, "current", np.where(TIME == 2.0, np.nan, TIME), "finite"),
        (np.array([0.0, 1.0, 2.0, 2.0, 3.0]), "current", TIME, r"time\[3\]"),
    ],
)
def test_invalid_signals_raise_an_error(time, signal, values, message):
    with pytest.raises(ValueError, match=message):
        Log("x", time, {signal: values})
    part = Log("x", TIME, {"current": TIME}).slice_rows(slice(2, 4))
    np.testing.assert_array_equal(part.row_numbers, [3, 4])
    np.testing.assert_array_equal(part.signals["current"], [2.0, 3.0])


def test_stretches_have_no_gap_and_at_least_two_rows():
    time = np.array([0.0, 1.0, 2.0, 4.0, 5.0, 20.0, 40.0, 41.0, 42.0])
    log = Log("x", time, {"current": time})
    assert gapless_stretches(log) == [slice(0, 5), slice(6, 9)]


@pytest.mark.parametrize("step", [2.0 * np.pi / 4096, 0.0088, 3.0])
@pytest.mark.parametrize("multiple", [1, 2])
def test_the_resolution_is_detected(step, multiple):
    levels = np.round(np.random.default_rng(1).normal(0.0, 40.0, 500)) * multiple
    # With a single odd level no two neighboring levels occur.
    levels[0] += multiple > 1
    assert find_resolution(0.1 + step * levels) == pytest.approx(step, rel=1e-9)


def test_continuous_and_constant_signals_have_no_resolution():
    assert find_resolution(np.random.default_rng(0).standard_normal(1000)) == 0.0
    assert find_resolution(np.zeros(9)) == 0.0
    assert find_resolution(np.array([-1.0, 1.0, 1.0])) == 0.0
