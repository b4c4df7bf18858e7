"""The first bench file: of the devices that answer, and of what a person says of them.

The text starts as the commented template without its sensors. Devices and answers are added to the
text, so that comments stay, and what a person has changed meanwhile.
"""

from __future__ import annotations

import re
import string
import tomllib
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomlkit

from daq.bench.durations import format_duration
from daq.bench.editing import with_values
from daq.bench.end_condition import EndCondition
from daq.bench.masks.mask import NOISE_MODELS
from daq.bench.option_values import one_of
from daq.bench.tables.toml_text import to_toml
from daq.bench.units import DensityUnit
from daq.devices.epson.commands import COUNTS_PER_UNIT
from daq.transport.ports import simulation_of
from daq.transport.serial_ports import stable_path

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daq.preflight.device_check import DiscoveredDevice

BAND = (1.0, 50.0)
"""Hz, of limits where the bench file has no band."""
DENSITY = "µg/√Hz"
"""Unit of limits that are typed without one."""
_SENSORS, _ESTIMATE, _SIMULATION = (
    f"# {'-' * (84 - len(name))} {name}\n" for name in ("sensors", "estimate", "simulation")
)
_OF_SIMULATED = "# Of the simulated devices that answered. Remove this table for real ones.\n"
UNKNOWN = 1.0
"""Counts per unit of a channel whose sensitivity no device states."""


def is_first(path: Path) -> bool:
    """Whether a bench file has no sensors yet: it does not exist, or describes none."""
    try:
        return not tomllib.loads(path.read_text(encoding="utf-8")).get("sensors")
    except FileNotFoundError:
        return True
    except (OSError, ValueError):  # reported where the file is read
        return False


def draft(path: Path) -> str:
    """Return the text to add devices to: that of the file, or the template without sensors."""
    text = path.read_text(encoding="utf-8") if path.exists() and is_first(path) else ""
    if text.strip():
        return with_values(text, {"name": path.stem, "sampling_rate": 200.0} | tomllib.loads(text))
    template = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    head, _, rest = template.partition(_SENSORS)
    rest = _ESTIMATE + rest.partition(_ESTIMATE)[2].partition(_SIMULATION)[0].rstrip() + "\n"
    head = head.replace('name = "bench"', to_toml({"name": path.stem}).strip(), 1)
    head = "".join(line for line in head.splitlines(True) if "simulates these" not in line)
    return f"{head}{_SENSORS}{rest}"


def channels_of(device: DiscoveredDevice) -> list[dict[str, Any]]:
    """Return the channels of a device as tables; none where its registers are not known."""
    if device.driver == "epson":
        return [
            {"name": axis, "sensitivity": round(COUNTS_PER_UNIT, 1), "unit": "m/s²"}
            for axis in "XYZ"
        ]
    places = device.settings.get("columns") or device.settings.get("channel_names") or ()
    return [
        {"name": place if isinstance(place, str) else f"c{place}", "sensitivity": UNKNOWN}
        for place in places
    ]


def is_open(sensor: Mapping[str, Any]) -> bool:
    """Whether somebody must still state the sensitivity of a sensor, by its table."""
    return any(each.get("sensitivity") == UNKNOWN for each in sensor.get("channels", ()))


def with_device(text: str, device: DiscoveredDevice) -> str:
    """Return a text with a sensor more, called by the next letter, before the table of estimates.

    A simulated device adds the table of its simulation: its clock decides what a second is.
    The text itself, where the channels of the device are not known.
    """
    channels = channels_of(device)
    if not channels:
        return text
    taken = {str(each.get("name")) for each in tomllib.loads(text).get("sensors", [])}
    letters = (name + number for number in ("", *"123456789") for name in string.ascii_uppercase)
    about = device.information
    table = {
        "name": next(name for name in letters if name not in taken),
        "model": "" if about is None else about.model,
        "serial_number": "" if about is None else about.serial_number,
        "driver": device.driver,
        "port": stable_path(device.port),
        "channels": channels,
        "settings": device.settings,
    }
    comment = f"# {device.port}: {device.remark or 'answered as ' + device.driver}\n"
    if device.information is None:
        comment += "# Fill in sampling_rate and the sensitivities, in counts per unit.\n"
    simulation = simulation_of(device.port)
    if simulation and "simulation" not in tomllib.loads(text):
        text = f"{text}\n{_SIMULATION}{_OF_SIMULATED}{to_toml({'simulation': simulation})}"
    before, mark, rest = text.partition(_ESTIMATE)
    sensor = f"{comment}{to_toml({'sensors': [table]})}\n"
    return f"{before}{sensor}{mark}{rest}" if mark else f"{text}\n{sensor}"


def with_rate(text: str, name: str, rate: float) -> str:
    """Return a text with the sampling rate of a sensor, by which the bench may be slower.

    The estimate has the rate of the slowest sensor, and no frequency above 0.4 of it; the other
    sensors keep theirs.
    """
    document = tomlkit.parse(text)
    usual = float(document["sampling_rate"])
    for table in document["sensors"]:
        if str(table["name"]) == name:
            table["sampling_rate"] = rate
        elif rate < usual and "sampling_rate" not in table:
            table["sampling_rate"] = usual
    if rate < usual:
        document["sampling_rate"] = rate
        band = document.get("estimate", {}).get("band")
        if band and band[1] > 0.4 * rate:
            document["estimate"]["band"] = [min(float(band[0]), 0.1 * rate), 0.4 * rate]
    return tomlkit.dumps(document)


def limit_table(text: str, *, band: Sequence[float] = BAND) -> dict[str, Any]:
    """Return the table of a limit: a data sheet (CSV), a noise model, or one or two numbers.

    Parameters
    ----------
    text : str
        ``brochure.csv``, ``nlnm``, ``2``, or ``2 0.5``: the density at the lower and at the upper
        end of the band, straight in log-log between; in µg/√Hz unless a unit follows.
    band : sequence of float
        Its ends in Hz.

    Raises
    ------
    ValueError
        With what was expected.
    """
    words = text.split()
    numbers: list[float] = []
    while words and len(numbers) < 2 and (number := _number(words[0])) is not None:
        numbers.append(number)
        words.pop(0)
    if numbers:
        unit = " ".join(words) or DENSITY
        if not DensityUnit.parse(unit).is_level and min(numbers) <= 0:
            raise ValueError(f"{text}: expected a noise density above 0")
        psd = [numbers[0], numbers[-1]]
        return {"name": "limit", "unit": unit, "frequency": list(map(float, band)), "psd": psd}
    if Path(text).suffix.lower() in {".csv", ".txt", ".tsv"}:
        return {"name": Path(text).stem, "file": text}
    try:
        return {"name": text.lower(), "model": one_of(text.lower(), tuple(NOISE_MODELS))}
    except ValueError as error:
        raise ValueError(
            f"{text}: {error}; or a CSV file, or noise at the ends of the band such as 2 0.5"
        ) from None


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def with_limits(text: str, wanted: str) -> str:
    """Return the text of a bench file with these limits, separated by semicolons.

    A limit that is there already is called by its name, and stays as it is; others go.

    Raises
    ------
    ValueError
        If one is none.
    """
    table = tomllib.loads(text)
    band = table.get("estimate", {}).get("band", BAND)
    kept = {str(each.get("name")) for each in table.get("limits", [])}
    names = [name for part in wanted.split(";") if (name := part.strip())]
    new = [limit_table(name, band=band) for name in names if name not in kept]
    document = tomlkit.parse(text)
    limits = document.get("limits", tomlkit.aot())
    for number in reversed(range(len(limits))):
        if str(limits[number]["name"]) not in names:
            del limits[number]
    used = {str(each["name"]) for each in limits}
    for limit in new:
        stem, number = limit["name"], 2
        while limit["name"] in used:
            limit["name"], number = f"{stem} {number}", number + 1
        used.add(limit["name"])
        limits.append(tomlkit.item(limit))
    if len(limits):
        document["limits"] = limits
    else:
        document.pop("limits", None)
    return tomlkit.dumps(document)


def _uncommented(text: str, key: str, value: str) -> str:
    """Return the text with a key in place of the line of the template that shows it.

    TOML Kit would write a new key behind all comments of its table.
    """
    line = re.compile(rf'^# {key} = "[^"\n]*"', re.MULTILINE)
    assignment = to_toml({key: value}).strip()
    return line.sub(lambda _: assignment, text) if len(line.findall(text)) == 1 else text


def answers_in(text: str) -> dict[str, str]:
    """Return what `with_answers` would change in a bench file, as it is typed."""
    table = tomllib.loads(text)
    sensors, recording = table.get("sensors", []), table.get("recording", {})
    axes = [[str(c.get("direction", "")) for c in each.get("channels", ())] for each in sensors]
    has_one = bool(axes) and all(each == axes[0] for each in axes) and all(axes[0])
    limits = [str(each.get("name", "")) for each in table.get("limits", [])]
    end = ", ".join(filter(None, (recording.get("until", ""), str(recording.get("duration", "")))))
    if limits and "until" not in recording:
        end = ", ".join(filter(None, ("decided", end)))
    return {
        "operator": str(table.get("operator", "")),
        "names": " ".join(str(each.get("name", "")) for each in sensors),
        "axes": " ".join(axes[0]) if has_one else "",
        "limits": "; ".join(limits),
        "end": end,
        "unit": str(table.get("estimate", {}).get("unit", "")),
        "name": str(table.get("name", "")),
        "location": str(table.get("location", "")),
    }


def with_answers(text: str, answers: Mapping[str, str]) -> str:
    """Return the text of a bench file with what was answered; what is not answered stays.

    Parameters
    ----------
    answers : mapping
        Of `answers_in`: ``names`` of the sensors in the order of the file, ``axes`` the directions
        of the channels of every sensor, ``unit`` that of results.

    Raises
    ------
    ValueError
        If an answer is none, with what was expected.
    """
    document, given = tomlkit.parse(text), answers_in(text)
    sensors = list(document.get("sensors", ()))
    names = answers.get("names", "").split()
    if names and len(names) != len(sensors):
        raise ValueError(f"{len(names)} names for {len(sensors)} sensors")
    if len(set(names)) != len(names):
        raise ValueError("expected a name of its own for each sensor")
    for table, name in zip(sensors, names, strict=False):
        if str(table["name"]) != name:
            table["name"] = name
    axes = answers.get("axes", "").split()
    for table in sensors if axes else ():
        channels = [each for each in table["channels"] if not each.get("auxiliary")]
        if len(channels) != len(axes):
            raise ValueError(
                f"{len(axes)} directions for the {len(channels)} channels of {table['name']}"
            )
        for channel, direction in zip(channels, axes, strict=True):
            channel["direction"] = direction
    unit = answers.get("unit", "")
    values: dict[str, Any] = {
        key: answers[key] for key in ("name", "operator", "location") if key in answers
    }
    if unit:
        values["estimate"] = {"unit": unit}
    if answers.get("end", given["end"]) != given["end"]:
        end = EndCondition.of_text(answers["end"])
        duration = None if end.duration is None else format_duration(end.duration)
        values["recording"] = {"duration": duration, "until": end.estimated.text or None}
    changed = tomlkit.dumps(document)
    for key, value in (("unit", unit), ("until", values.get("recording", {}).get("until"))):
        if value:
            changed = _uncommented(changed, key, value)
    changed = with_values(changed, values)
    return with_limits(changed, answers["limits"]) if "limits" in answers else changed
