"""ObsPy's SeedLink client reads our simulated server: every sample, in its place."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest

from sim_devices.devices.interface import Source
from sim_devices.server.serve import device_spec
from sim_devices.world.scenario import Scenario
from tests.devices import paced_clock, serving
from tests.sim_devices.simulated_bench import device, spec
from tests.waiting import limit

pytestmark = [pytest.mark.peer, pytest.mark.devices]

RATE = 200.0
N_RECORDS = 12


class EnoughError(Exception):
    """Ends the client: it has no other end."""


def test_obspy_reads_our_server() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        easy = pytest.importorskip("obspy.clients.seedlink.easyseedlink")
    settings = {"network": "XX", "station": "STA", "channels": ["HNZ", "HNN", "HNE"]}
    table = device("A", "seedlink", port="tcp", settings=settings, axes="ZNE", sensitivity=1e6)
    world = spec(table, speed=4.0)
    traces: list[Any] = []

    with serving(world) as (one,):
        address = one.port.removeprefix("seedlink://")
        client = easy.EasySeedLinkClient(address, autoconnect=False)
        client.conn.timeout = limit(60)
        client.connect()

        def on_data(trace: Any) -> None:  # noqa: ANN401 -- ObsPy has no types
            traces.append(trace)
            if len(traces) >= N_RECORDS:
                raise EnoughError

        client.on_data = on_data
        client.select_stream("XX", "STA", "HN?")
        with pytest.raises(EnoughError):
            client.run()
        client.conn.disconnect()
    described = device_spec(world["devices"][0])
    utc_ns = paced_clock().utc_of(int(world["epoch_ns"]))
    scenario = Scenario.from_dict(world["scenario"], sampling_rate=RATE)
    felt = Source(scenario, described).disciplined(-utc_ns % 10**9 / 1e9).counts("A", 0, 20_000)
    begin = {trace.stats.channel: trace for trace in reversed(traces)}
    assert sorted(begin) == ["HNE", "HNN", "HNZ"]
    first = float(begin["HNZ"].stats.starttime.timestamp)
    offset = round((first - utc_ns / 1e9 - (-utc_ns % 10**9 / 1e9)) * RATE)
    for trace in traces:
        column = "ZNE".index(trace.stats.channel[-1])
        place = offset + round((trace.stats.starttime.timestamp - first) * RATE)
        expected = np.rint(felt[place : place + trace.stats.npts, column])
        np.testing.assert_array_equal(trace.data, expected)
        assert trace.stats.sampling_rate == RATE
