"""The first bench file: of devices that answered, and of answers."""

from __future__ import annotations

from pathlib import Path

import pytest

from daq.bench.end_condition import EndCondition
from daq.devices.bench_file import load, parse
from daq.devices.interface import DeviceInformation
from daq.preflight.device_check import DiscoveredDevice
from tui.runs.first_bench import (
    answers_in,
    draft,
    is_first,
    limit_table,
    with_answers,
    with_device,
    with_limits,
)


def found(number: int) -> DiscoveredDevice:
    about = DeviceInformation("", "A352AD10", f"S{number}", "1.4", 200.0, 25.0)
    return DiscoveredDevice("epson", f"/dev/ttyUSB{number}", {"baud_rate": 460800}, about)


def three(path: Path) -> str:
    text = draft(path)
    for number in range(3):
        text = with_device(text, found(number))
    return text


def test_a_file_without_sensors_is_a_first_bench_and_keeps_what_it_says(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    assert is_first(path)
    path.touch()
    assert is_first(path)
    path.write_text("# mine\n[simulation]\nspeed = 2.0\n", encoding="utf-8")
    assert is_first(path)
    text = three(path)
    bench = parse(text)
    assert (bench.name, bench.speed) == ("lab", 2.0)
    assert "# mine" in text
    path.write_text(text, encoding="utf-8")
    assert not is_first(path)
    path.write_text("name = ", encoding="utf-8")  # its error is told, and it is not overwritten
    assert not is_first(path)


def test_answers_are_in_the_file_beside_the_comments_of_the_template(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    (tmp_path / "brochure.csv").write_text("frequency (Hz), noise (µg/√Hz)\n1,3\n50,2\n")
    answers = {
        "operator": "Ann",
        "names": "B A left",  # names that others had before
        "axes": "north east up",
        "limits": "brochure.csv; nlnm; 2 0.5",
        "end": "decided, 2h",
        "unit": "g",
    }
    text = with_answers(three(path), answers)
    path.write_text(text, encoding="utf-8")
    bench = load(path)
    assert [(s.name, s.serial_number) for s in bench.sensors] == [
        ("B", "S0"),
        ("A", "S1"),
        ("left", "S2"),
    ]
    assert [c.direction for c in bench.sensors[2].channels] == ["north", "east", "up"]
    assert (bench.operator, bench.estimate.unit) == ("Ann", "g")
    assert bench.end == EndCondition(7200.0, decided=True)
    assert [limit.name for limit in bench.limits] == ["brochure", "nlnm", "limit"]
    assert bench.limits[0].psd == (9.0, 4.0)  # (µg)²/Hz
    assert bench.limits[2].psd == (2.0, 0.5)
    assert "# sets the frequency resolution" in text
    assert text.count("until = ") == 2  # one of the schedule's comments
    assert answers_in(text) == {**answers, "limits": "brochure; nlnm; limit", "name": "lab"} | {
        "location": ""
    }
    assert with_answers(text, answers_in(text)) == text


def test_limits_that_are_named_stay_as_they_are_and_others_go(tmp_path: Path) -> None:
    text = with_limits(three(tmp_path / "lab.toml"), "nlnm; 2")
    text = text.replace('name = "limit"', 'name = "limit"  # of the contract')
    changed = with_limits(text, "limit; 3 1 ng/√Hz")
    bench = parse(changed)
    assert [(each.name, each.psd) for each in bench.limits] == [
        ("limit", (2.0, 2.0)),
        ("limit 2", (3.0, 1.0)),
    ]
    assert "# of the contract" in changed
    assert parse(with_limits(changed, "")).limits == ()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("quiet", "expected one of nlnm"),
        ("0", "above 0"),
        ("2 0.5 apples", "expected a unit of noise density"),
    ],
)
def test_what_is_no_limit_says_what_was_expected(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        limit_table(text)


@pytest.mark.parametrize(
    ("answers", "said"),
    [
        ({"names": "A B"}, "2 names for 3 sensors"),
        ({"names": "A A B"}, "a name of its own"),
        ({"axes": "up"}, "1 directions for the 3 channels"),
        ({"end": "soon"}, "expected"),
    ],
)
def test_answers_that_do_not_fit_say_why(
    tmp_path: Path, answers: dict[str, str], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        with_answers(three(tmp_path / "lab.toml"), answers)
