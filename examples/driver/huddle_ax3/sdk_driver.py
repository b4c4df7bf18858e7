"""Driver for the AX3 through a vendor's SDK whose calls block."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Sequence

from daq.bench.model import Sensor
from daq.devices.blocking import BlockingSource, Samples
from daq.devices.interface import DeviceInformation
from daq.devices.port_rules import only, port_label
from daq.errors import NotConnectedError, WrongDeviceError
from daq.host_clock import HostClock
from daq.transport.address import host_and_port
from huddle_ax3.driver import AX3Driver
from huddle_ax3.sdk import Device, SdkError


class SdkDriver(AX3Driver):
    """See `daq.devices.interface.Driver`."""

    name = "ax3-sdk"
    summary = "AX3 through its SDK (an example of a library that blocks)"

    @contextlib.asynccontextmanager
    async def open(  # type: ignore[override]  # another session
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AsyncIterator[BlockingSource]:
        """Open the device in a thread; each of its calls is made in one."""
        sensor = only(sensors, "an AX3 needs a port of its own")
        n_samples = round(0.1 * sensor.sampling_rate)
        try:
            device = await asyncio.to_thread(Device, *host_and_port(sensor.port))
            with contextlib.closing(device):
                model, serial_number, firmware = await asyncio.to_thread(_identify, device, sensor)

                def read() -> Samples | None:
                    counts = device.read(n_samples, timeout=0.5)
                    return None if counts is None else Samples(counts, device.counter)

                yield BlockingSource(
                    sensors,
                    clock,
                    start=lambda: device.ask("START"),
                    read=read,
                    information=[DeviceInformation(sensor.name, model, serial_number, firmware)],
                )
        except SdkError as error:
            raise NotConnectedError(f"{port_label(sensors)}: {error}") from error


def _identify(device: Device, sensor: Sensor) -> list[str]:
    device.ask(f"RATE {sensor.sampling_rate:g}")
    words = device.ask("ID").split()
    if words[:2] != ["ID", "AX3"]:
        raise WrongDeviceError(f"{port_label([sensor])}: {words!r}; expected an AX3")
    return words[1:]


DRIVER = SdkDriver()
