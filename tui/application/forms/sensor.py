"""The forms that add a sensor to the bench file, and change one."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

from textual import work

from daq.bench.driver_settings import settings_of
from daq.bench.editing import with_sensor
from daq.devices.bench_file import parse
from daq.devices.registry import driver_names, driver_type
from daq.errors import BenchFileError, FileFault, HuddleError
from daq.preflight.device_check import DiscoveredDevice, search_description
from daq.transport.serial_ports import serial_ports
from estimator.wording import listed
from tui.application.forms.form import Field, Form

SETTING = "setting-"
"""Before the name of a driver's setting, in the id of its field."""
OF_CHANNELS = ("sensitivity", "unit", "direction")
HINTS = {
    "name": "The name of the sensor, unique on the bench.",
    "manufacturer": "Its manufacturer, for certificates. May be empty.",
    "model": "Its model, for the report. May be empty.",
    "serial_number": "Checked when the device is opened. May be empty.",
    "port": "Where it is connected, such as /dev/ttyUSB0 or socket://192.168.0.5:4001.",
    "sampling_rate": "Samples a second. Empty: that of the bench.",
    "channels": "Names of the channels in the order of the device, such as: X Y Z.",
    "sensitivity": "Counts per unit: one number for all channels, or one for each.",
    "unit": "Such as m/s², g or m/s: one for all channels, or one for each. Empty: m/s².",
    "direction": "Such as east north up: one for each channel. May be empty.",
}
KEPT_FIELDS = ("manufacturer", "model", "serial_number", "port", "sampling_rate")


class PortForm(Form[tuple[str, dict[str, Any]]]):
    """Asks for driver and port of a new sensor; looks what is on the port where no driver is given.

    Parameters
    ----------
    find : callable
        Returns the devices on a port. Blocks.
    """

    def __init__(self, find: Callable[[str], Sequence[DiscoveredDevice]]) -> None:
        fields = (
            Field("port", "port", placeholder="/dev/ttyUSB0"),
            Field("driver", "driver", placeholder="empty: look what is on the port"),
        )
        super().__init__("add a sensor", fields, does="goes on")
        self._find = find

    def hint(self, name: str) -> str:
        """Return the ports of this computer, or the drivers."""
        if name == "driver":
            return (
                f"One of {listed(list(driver_names()))}. Empty: what is on the port is found out."
            )
        ports = ", ".join(port.path for port in serial_ports()) or "none"
        return f"Serial ports of this computer: {ports}. {HINTS['port']}"

    def problem(self, name: str) -> str:
        """Return what is wrong with a field; empty if nothing is."""
        value = self.value(name)
        if name == "port":
            return "" if value else "port: expected one, such as /dev/ttyUSB0"
        if value and value not in driver_names():
            return f"{value}: no such driver; expected one of {', '.join(driver_names())}"
        return ""

    def submit(self) -> None:
        """Go on, or look at the port."""
        driver, port = self.value("driver"), self.value("port")
        if driver:
            self.dismiss((driver, {"port": port}))
            return
        self.show_message(f"looking at {port} for {search_description(port)} …")
        self._look(port)

    @work(thread=True, exclusive=True)
    def _look(self, port: str) -> None:
        try:
            found = self._find(port)
        except (HuddleError, OSError) as error:
            self.app.call_from_thread(self.show_message, str(error), is_wrong=True)
            return
        if not found:
            text = f"{port}: found nothing; name the driver, or check cable and power"
            self.app.call_from_thread(self.show_message, text, is_wrong=True)
            return
        first = found[0]
        values: dict[str, Any] = {"port": port, "settings": first.settings}
        if first.information is not None:
            values["model"] = first.information.model
            values["serial_number"] = first.information.serial_number
        self.app.call_from_thread(self.dismiss, (first.driver, values))


class SensorForm(Form[str]):
    """Asks for all of a sensor; returns the text of the bench file with it.

    Parameters
    ----------
    text : str
        Of the bench file.
    driver : str
    values : mapping
        The table of the sensor, or what is known of a new one.
    replaces : str
        Name of the sensor that is changed; empty for a new one.
    """

    def __init__(
        self, text: str, driver: str, values: Mapping[str, Any], *, replaces: str = ""
    ) -> None:
        self._text, self._driver, self._replaces = text, driver, replaces
        self._faults_before = _faults(text)
        self._edited_of = ("", text)
        channels, given = values.get("channels", []), values.get("settings", {})
        self._settings = {
            SETTING + one["name"]: one
            for one in settings_of(driver_type(driver).settings)
            if not _has_tables(given.get(one["name"]))  # they stay as they are
        }
        fields = [
            Field("name", "name", str(values.get("name", ""))),
            *(
                Field(name, name.replace("_", " "), _shown(values.get(name)))
                for name in KEPT_FIELDS
            ),
            Field("channels", "channels", " ".join(str(one.get("name")) for one in channels)),
            *(Field(name, name, _of_channels(channels, name)) for name in OF_CHANNELS),
            *(
                Field(name, one["name"], _shown(given.get(one["name"])), one["default"])
                for name, one in self._settings.items()
            ),
        ]
        what = f"sensor {replaces}" if replaces else "new sensor"
        super().__init__(f"{what}, driver {driver}", fields, does="saves")

    def hint(self, name: str) -> str:
        """Return what a field means."""
        if name not in self._settings:
            return HINTS[name]
        one = self._settings[name]
        default = f"; default {one['default']}" if one["default"] else ""
        return f"{one['meaning'] or one['name']} ({one['values']}{default})"

    def problem(self, name: str) -> str:
        """Return what is wrong with a field; empty if nothing is."""
        names = self.value("channels").split()
        if name in OF_CHANNELS:
            n_given = len(self.value(name).split())
            if n_given not in {0, 1, len(names)}:
                return f"{name}: {n_given} for {len(names)} channels; expected 1 or {len(names)}"
        if name == "sensitivity" and not self.value(name):
            return "sensitivity: expected counts per unit, not zero"
        for fault in _faults(self._edited()):
            if self._field(fault) == name:
                return str(fault)
        return ""

    def submit(self) -> None:
        """Save, unless the file would have errors that it had not before."""
        # Of too few sensors there is one more now.
        known = {fault.key for fault in self._faults_before} & {"sensors"}
        new = [
            fault
            for fault in _faults(self._edited())
            if fault not in self._faults_before and fault.key not in known
        ]
        if new:
            self.show_message(str(new[0]), is_wrong=True)
        else:
            self.dismiss(self._edited())

    def _field(self, fault: FileFault) -> str:
        """Return the field that a fault is about; empty if it is of another sensor."""
        if fault.sensor != self.value("name"):
            return ""
        key, _, rest = fault.key.partition(".")
        if key == "settings":
            return SETTING + rest if SETTING + rest in self._settings else "name"
        if key.startswith("channels"):
            about = {fault.key.rpartition(".")[2], fault.expected.partition(":")[0]}
            return next((name for name in OF_CHANNELS if name in about), "channels")
        return key if key in KEPT_FIELDS else "name"

    def _edited(self) -> str:
        names = self.value("channels").split()
        of_each = {name: _spread(self.value(name).split(), len(names)) for name in OF_CHANNELS}
        sensitivity = [_value(text or "") for text in of_each.pop("sensitivity")]
        values = {
            "name": self.value("name"),
            **{name: self.value(name) or None for name in KEPT_FIELDS},
            "driver": self._driver,
            "sampling_rate": _value(self.value("sampling_rate")),
            "channels": [
                {
                    "name": channel,
                    "sensitivity": sensitivity[n],
                    **{name: of_each[name][n] for name in of_each},
                }
                for n, channel in enumerate(names)
            ],
            "settings": {
                one["name"]: _value(self.value(name)) for name, one in self._settings.items()
            },
        }
        typed = repr(values)  # 1 and 1.0 are equal, and written differently
        if self._edited_of[0] != typed:  # every field asks for it when the form is saved
            self._edited_of = typed, with_sensor(self._text, values, replaces=self._replaces)
        return self._edited_of[1]


def sensor_table(text: str, name: str) -> Mapping[str, Any]:
    """Return the table of a sensor in the text of a bench file; an empty one if there is none."""
    sensors: list[dict[str, Any]] = tomllib.loads(text).get("sensors", [])
    return next((one for one in sensors if str(one.get("name")) == name), {})


@lru_cache(2)  # every field asks for it when the form is saved
def _faults(text: str) -> tuple[FileFault, ...]:
    try:
        parse(text)
    except BenchFileError as error:
        return error.faults
    return ()


def _of_channels(channels: Sequence[Mapping[str, Any]], name: str) -> str:
    """Return a value of each channel, or one if all are alike."""
    found = [_shown(channel.get(name)) for channel in channels]
    return found[0] if len(set(found)) == 1 else " ".join(found)


def _spread(values: list[str], n: int) -> list[str | None]:
    return [*values, *[None] * n][:n] if len(values) != 1 else [values[0]] * n


def _has_tables(value: object) -> bool:
    if isinstance(value, list):
        return any(_has_tables(one) for one in value)
    return isinstance(value, dict)


def _shown(value: object) -> str:
    """Return a value as it is typed."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    return str(value)


def _value(text: str) -> object:
    """Return what was typed: a TOML value, or the text itself; None if it is empty."""
    if not text:
        return None
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
