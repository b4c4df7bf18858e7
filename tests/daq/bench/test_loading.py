"""The bench file: what is read, and every way it can be wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ConfigDict

from daq.bench.durations import format_duration, parse_duration
from daq.bench.loading import dump, load, parse
from daq.bench.model import Bench, Sensor
from daq.bench.response import PolesZeros
from daq.devices import bench_file
from daq.devices.interface import AnyDriver
from daq.errors import BenchFileError


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid")
    baud_rate: int = 9600
    mode: Literal["auto", "manual"] = "auto"


@dataclass(frozen=True)
class _Driver:
    """As much of a driver as a bench file needs."""

    name: str
    shares_clock: bool = False
    settings: type[BaseModel] = _Settings

    def check(self, sensors: Sequence[Sensor]) -> None:
        """Accept all sensors."""


DRIVERS = cast("dict[str, AnyDriver]", {"serial": _Driver("serial"), "scan": _Driver("scan", True)})

HEAD = """\
name = "floor"
sampling_rate = 200
"""


def sensor_text(name: str, *, port: str = "", driver: str = "serial", extra: str = "") -> str:
    return f"""
[[sensors]]
name = "{name}"
driver = "{driver}"
port = "{port or "/dev/" + name}"
{extra}
[[sensors.channels]]
name = "x"
sensitivity = 1e6
[[sensors.channels]]
name = "y"
sensitivity = 1e6
"""


THREE = "".join(sensor_text(name) for name in ("a", "b", "c"))


def read(text: str) -> Bench:
    return parse(text, "bench.toml", drivers=DRIVERS)


def faults(text: str) -> list[str]:
    with pytest.raises(BenchFileError) as caught:
        read(text)
    return str(caught.value).splitlines()


def test_a_small_bench_is_loaded() -> None:
    bench = read(HEAD + THREE)
    assert [sensor.sampling_rate for sensor in bench.sensors] == [200.0] * 3
    assert bench.estimate.segment == 10.0
    assert bench.text == HEAD + THREE
    assert bench.sensor("b").clock_name(shares_clock=DRIVERS["serial"].shares_clock) == "b"
    assert bench.sensor("b").clock_name(shares_clock=DRIVERS["scan"].shares_clock) == "/dev/b"
    assert list(bench.ports()) == ["/dev/a", "/dev/b", "/dev/c"]


def test_relative_directories_are_relative_to_the_file(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(HEAD + THREE, encoding="utf-8")
    loaded = parse(path.read_text(encoding="utf-8"), path, drivers=DRIVERS)
    assert loaded.recording_directory == tmp_path / "recordings"
    assert loaded.source == path


def test_an_absent_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(BenchFileError, match=r"none\.toml: cannot be read: No such file"):
        load(tmp_path / "none.toml")


def test_dump_parses_to_the_same_bench() -> None:
    text = (
        HEAD
        + THREE
        + """
[sensors.channels.response]
poles = [[-1.0, 2.0], -3.0]
zeros = [0]
[estimate]
segment = "20s"
band = [0.5, 50]
method = "all"
reject = false
octaves = true
dimension = "auto"
gains = {b = 1.02, "c.x" = 1}
[recording]
duration = "1h"
[[limits]]
name = "quiet \\"floor\\""
frequency = [1, 10]
psd = [1e-12, 1e-13]
[simulation]
speed = 4
seed = 1
[simulation.motion]
psd = [[1, 2], [3, 4]]
"""
    )
    bench = read(text)
    assert bench.speed == 4.0
    assert read(dump(bench)).model_dump() == bench.model_dump()


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("name = 3", ": expected a text"),
        ('sampling_rate = "200"', ": expected a number"),
        ('estimate.segment = "fast"', ": expected a positive duration"),
        ('estimate.window = "han"', "(did you mean 'hann'?)"),
        ('estimate.window = "kaiser"', "with a parameter above 0, such as kaiser,0.5"),
        ('estimate.method = "three_sensor"', "(did you mean 'three-sensor'?)"),
        ('estimate.segmnt = "1s"', ": unknown key; expected one of method, segment, overlap"),
        ('estimate.reject = "yes"', ": expected true or false"),
        ("estimate.octaves = 1", ": expected true or false"),
        ('estimate.dimension = "all"', 'expected "auto", or a number of dimensions such as 3'),
        ("estimate.dimension = 2", 'with method = "maximum-likelihood" or "all" only'),
        ("estimate.overlap = 1", ": expected a fraction from 0 to less than 1"),
        (
            'recording.duration = "19s"',
            "expected at least 20s: an estimate needs 3 segments of 10s",
        ),
        ('schedule.time_zone = "Mars"', ": expected a time zone"),
        ("simulation.speed = 0", ": expected a positive number"),
    ],
)
def test_each_fault_names_file_key_value_and_what_was_expected(line: str, said: str) -> None:
    key = line.partition("=")[0]
    others = [each for each in HEAD.splitlines() if not each.startswith(key)]
    (found,) = faults("\n".join([*others, line, THREE]))
    assert found.startswith(f"bench.toml: {line}: ")
    assert said in found


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            sensor_text("d").replace("/dev/d", ""),
            'sensors["d"].port = "": expected a port, such as /dev/ttyUSB0',
        ),
        (
            '[estimate]\nsegment = "10ms"\n',
            'estimate.segment = "0.01s": expected at least 0.02s, 4 samples at 200 Hz',
        ),
        (
            "[estimate]\nband = [0.01, 50]\n",
            "estimate.band = [0.01, 50.0]: expected [low, high] in Hz from 0.1",
        ),
        (
            '[estimate]\nmethod = "maximum-likelihood"\ndimension = 4\n',
            'estimate.dimension = "4": expected at most 3: 6 channels cannot separate more',
        ),
        (
            "[estimate]\ngains = {b = 1.1}\n",
            'expected with method = "two-channel" or "all" only, not "auto"',
        ),
        (
            '[estimate]\nmethod = "three-sensor"\nshared_noise = [["a", "b"]]\n',
            'expected with method = "multi-part" or "all" only, not "three-sensor"',
        ),
        (
            '[estimate]\nshared_noise = [["a", "d"]]\n',
            'estimate.shared_noise = "d": expected one of a, b, c',
        ),
        (
            '[estimate]\nmethod = "two-channel"\ngains = {b = 0}\n',
            "expected a number other than 0, such as 1.02, for b",
        ),
        (
            '[estimate]\nmethod = "all"\ngains = {"b.z" = 2}\n',
            'estimate.gains = "b.z=2": expected one of a, b, c, a.x',
        ),
        (
            '[schedule]\ncron = ["every day"]\n',
            'schedule.cron[1] = "every day": expected a cron line',
        ),
        (
            '[[limits]]\nname = "n"\nfrequency = [2, 1]\npsd = [1, 1]\n',
            'limits["n"]: 1 Hz after 2 Hz; expected increasing frequencies',
        ),
        (
            '[[limits]]\nname = "n"\nfrequency = [1, 2]\npsd = [1, 1]\nsensors=["d"]\n',
            'limits["n"].sensors = "d": expected one of a, b, c',
        ),
        (sensor_text("a"), 'sensors["a"].name = "a": used 2 times; expected once'),
        (
            sensor_text("d", driver="seral"),
            ".driver = \"seral\": expected one of serial, scan (did you mean 'serial'?)",
        ),
        (
            sensor_text("d", port="/dev/a", driver="scan"),
            "expected \"serial\", which sensor 'a' uses on the same port /dev/a",
        ),
        (
            sensor_text("d", extra="settings = {mode = 'odd'}"),
            "sensors[\"d\"].settings.mode = \"odd\": expected 'auto' or 'manual'",
        ),
        (
            sensor_text("d", extra="settings = {mood = 1}"),
            "mood = 1: unknown key; expected one of baud_rate, mode (did you mean 'mode'?)",
        ),
        (
            sensor_text("d", extra="sampling_rate = 100"),
            "expected at least 200 Hz, the rate of the bench",
        ),
        (
            sensor_text("d") + "[[sensors.channels]]\nname='z'\nsensitivity=1.0\n",
            'sensors["d"].channels = "3 channels": expected 2',
        ),
        (
            sensor_text("d") + "[[sensors.channels]]\nname='x'\nsensitivity=1.0\nauxiliary=true",
            'sensors["d"].channels["x"].name = "x": used 2 times',
        ),
        (
            sensor_text("d") + "[[sensors.channels]]\nsensitivity=1.0\nauxiliary=true",
            'sensors["d"].channels[3].name: is missing; expected the channel\'s name',
        ),
        (
            sensor_text("d") + "[[sensors.channels]]\nname='t'\nsensitivity=0\nauxiliary=true",
            'sensors["d"].channels["t"]: sensitivity: expected counts per unit, not zero',
        ),
        (sensor_text("d", extra="position = [0.1, 'e', 0]"), "position"),
        (sensor_text("d/e"), "expected a printable name without '/'"),
        (
            sensor_text("d", port="/dev/s", driver="scan")
            + sensor_text("e", port="/dev/s", driver="scan", extra="sampling_rate=400"),
            "expected 200 Hz, as sensor 'd' on the same clock",
        ),
    ],
)
def test_each_fault_of_a_table_names_it_and_what_was_expected(text: str, expected: str) -> None:
    (found,) = faults(HEAD + THREE + text)
    assert found.startswith("bench.toml: ")
    assert expected in found


def test_too_few_sensors_are_refused() -> None:
    two, method = HEAD + sensor_text("a") + sensor_text("b"), '[estimate]\nmethod = "{}"\n'
    found = faults(two + method.format("three-sensor"))
    assert found == [
        'bench.toml: sensors = "2 sensors": expected at least 3 for method three-sensor'
    ]
    found = faults(HEAD + sensor_text("a") + method.format("multi-part"))
    assert found == ['bench.toml: sensors = "1 sensor": expected at least 2 for method multi-part']
    assert len(read(two + method.format("two-channel")).sensors) == 2
    assert len(read(two).sensors) == 2
    assert len(read(HEAD + sensor_text("a")).sensors) == 1


def test_channels_of_another_quantity_are_refused_without_a_unit_for_all() -> None:
    velocity = THREE.replace('name = "x"', 'name = "x"\nunit = "mm/s"', 1)
    assert faults(HEAD + velocity) == [
        (
            'bench.toml: sensors["a"].channels["x"].unit = "mm/s": expected a unit of the quantity'
            " of most channels, such as m/s²; if the sensor measures another motion, set the unit"
            " of [estimate]"
        )
    ]
    assert len(read(HEAD + velocity + '[estimate]\nunit = "m/s²"\n').sensors) == 3
    assert len(read(HEAD + velocity.replace("mm/s", "mg")).sensors) == 3
    volts = HEAD + THREE.replace('name = "x"', 'name = "x"\nunit = "V"', 1)
    assert len(faults(volts + '[estimate]\nunit = "m/s²"\n')) == 1


def test_all_errors_are_reported_together() -> None:
    text = """
sampling_rate = -1
colour = "red"
[estimate]
detrend = "quadratic"
[[sensors]]
name = "a"
driver = "serila"
port = "p"
[[sensors.channels]]
name = "x"
sensitivity = "big"
[[sensors]]
name = "b"
driver = "serial"
port = "q"
settings = {baud_rate = "fast"}
[[sensors.channels]]
name = "x"
sensitivity = 1
"""
    found = "\n".join(faults(text))
    for expected in (
        "name: is missing; expected the bench's name",
        "sampling_rate = -1: expected a number above 0",
        'colour = "red": unknown key',
        'estimate.detrend = "quadratic": expected',
        'sensors["a"].channels["x"].sensitivity = "big": expected a number',
        'sensors["a"].driver = "serila"',
        'sensors["b"].settings.baud_rate = "fast": expected a whole number',
    ):
        assert expected in found


def test_impossible_settings_are_reported_without_the_device() -> None:
    text = HEAD.replace("200", "201") + sensor_text("A", driver="epson")
    with pytest.raises(BenchFileError, match=r'sensors\["A"\]\.sampling_rate = 201'):
        bench_file.parse(text)


def test_errors_in_toml_have_their_position() -> None:
    assert "at line 1, column" in faults("name = = 3")[0]


def test_a_recorded_bench_is_read_without_its_drivers() -> None:
    bench = parse(HEAD + sensor_text("a", driver="elsewhere"), "recording")
    assert bench.sensors[0].driver == "elsewhere"


@given(st.floats(1e-3, 1e7, allow_nan=False))
def test_durations_survive_writing_and_reading(seconds: float) -> None:
    assert parse_duration(format_duration(seconds)) == pytest.approx(seconds, rel=0.01)


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("10s", 10),
        ("90 min", 5400),
        ("3h", 10800),
        ("1d 12h", 129600),
        ("1.5 h", 5400),
        ("7", 7),
        ("250ms", 0.25),
        (2.5, 2.5),
    ],
)
def test_durations_are_parsed(text: str | float, seconds: float) -> None:
    assert parse_duration(text) == pytest.approx(seconds)


def test_zero_is_a_duration_where_it_is_allowed() -> None:
    assert parse_duration("0s", zero=True) == 0


@pytest.mark.parametrize("text", ["", "s", "-1s", "1h 30", "3 parsecs", "0", "1 2", True])
def test_invalid_durations_are_refused(text: str | float) -> None:
    with pytest.raises(ValueError, match="expected a positive duration"):
        parse_duration(text)


def test_poles_and_zeros_have_unit_gain_at_their_frequency() -> None:
    response = PolesZeros(
        zeros=(0j, 0j), poles=(-0.1 + 0.1j, -0.1 - 0.1j, -300 + 0j), frequency=2.0
    )
    assert abs(response.at(np.array([2.0]))[0]) == pytest.approx(1.0, rel=1e-12)
    # Two zeros at the origin over a pair of poles: 12 dB an octave well below the corner.
    low = np.abs(response.at(np.array([1e-4, 2e-4])))
    assert low[1] / low[0] == pytest.approx(4.0, rel=1e-3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (".".join(["a"] * 20_000) + " = 1", "a key of more than 16 parts"),
        ("x = {" + ' . "a"'.join(['"a"'] * 100) + " = 1}", "a key of more than 16 parts"),
        ("a = " + "[" * 20_000 + "]" * 20_000, "nested too deeply"),
        ("# " + "x" * (1 << 20), "expected at most 1048576"),
        ("\n".join(f"a{n}.b.c = 1" for n in range(20_000)), "20000 keys.*at most 10000"),
        ("\n".join(f"a{n}.b = 1" for n in range(500)), r"errors; the first 100 are above$"),
    ],
)
def test_a_file_with_excessive_nesting_is_refused(text: str, said: str) -> None:
    with pytest.raises(BenchFileError, match=said):
        parse(text)


def test_long_lists_of_numbers_are_accepted() -> None:
    numbers = ", ".join(f"{n}.5" for n in range(1, 400))
    with pytest.raises(BenchFileError) as refused:
        parse(f"psd = [{numbers}]\nnote = '''{'.' * 200} 1.2.3'''")
    assert "parts" not in str(refused.value)
