"""The driver contract of huddle, against the simulator: ``pytest`` in this folder."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from typing import ClassVar

from huddle_ax3.driver import DRIVER
from huddle_ax3.sdk_driver import DRIVER as SDK_DRIVER
from huddle_ax3.simulator import COUNTS_PER_UNIT, serve_tcp

from daq.bench.channel import Channel
from daq.bench.model import Sensor
from daq.conformance.suite import DriverConformance, Sent, Served
from daq.devices.interface import AnyDriver


class TestAX3(DriverConformance):
    """Every test of the suite."""

    driver: ClassVar[AnyDriver] = DRIVER
    seconds: ClassVar[float] = 1.0

    @contextlib.asynccontextmanager
    async def serve(self) -> AsyncIterator[Served]:
        """Serve one simulated device."""
        (one,) = await serve_tcp(1, 0)
        number = one.server.sockets[0].getsockname()[1]
        sensor = Sensor(
            name="A",
            driver=self.driver.name,
            port=f"socket://127.0.0.1:{number}",
            sampling_rate=100.0,
            channels=tuple(Channel(name=name, sensitivity=COUNTS_PER_UNIT) for name in "XYZ"),
        )
        yield Served(
            [sensor],
            vanish=one.close,
            truth=lambda _: Sent(*one.device.truth()),
            drop=lambda: one.device.lose(20),
            slip=one.device.slip,
            restart=one.device.restart,
        )
        one.close()


class TestSdk(TestAX3):
    """The same through a library whose calls block."""

    driver = SDK_DRIVER
