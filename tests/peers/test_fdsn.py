"""``huddle import fdsn://…`` from a server that speaks the services, in a process of its own."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from daq.recording.reader import Recording
from tests.daq.formats.test_sources import counts
from tui.commands.main import app
from tui.output.exit_codes import ExitCode

obspy: Any = pytest.importorskip("obspy", reason="ObsPy is an extra")
START = obspy.UTCDateTime("2026-11-01T23:59:00") if obspy else None
N = 6000
"""Samples of a channel at 50 Hz: one minute on either side of midnight."""


def response(gain: float) -> Any:  # noqa: ANN401 - ObsPy has no types
    """Return a response that is flat: 2·`gain` counts per m/s."""
    inventory = obspy.core.inventory
    stages = [
        inventory.ResponseStage(1, gain, 1.0, "M/S", "V"),
        inventory.ResponseStage(2, 2.0, 1.0, "V", "COUNTS"),
    ]
    stated = inventory.InstrumentSensitivity(2 * gain, 1.0, "M/S", "COUNTS")
    return inventory.Response(instrument_sensitivity=stated, response_stages=stages)


def fill(folder: Path) -> None:
    """Write two sensors of two channels, their responses, and a station that nobody asks for."""
    inventory = obspy.core.inventory
    stations = []
    for station in ("ABC", "XYZ"):
        channels = []
        for location in ("00", "10"):
            for number, code in enumerate(("BHN", "BHZ")):
                gain = 100.0 * (number + 1) + float(location)
                channels.append(
                    inventory.Channel(
                        code, location, 0, 0, 0, 0, response=response(gain), sample_rate=50.0
                    )
                )
                trace = obspy.Trace(
                    counts(N, number + int(location)),
                    {
                        "network": "XX",
                        "station": station,
                        "location": location,
                        "channel": code,
                        "sampling_rate": 50.0,
                        "starttime": START,
                    },
                )
                trace.write(str(folder / f"{station}{location}{code}.mseed"), format="MSEED")
        stations.append(inventory.Station(station, 0, 0, 0, channels=channels))
    whole = inventory.Inventory([inventory.Network("XX", stations)], source="test")
    whole.write(str(folder / "all.xml"), format="STATIONXML")


@pytest.fixture(scope="module")
def centre(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Serve the folder; return host and port."""
    folder = tmp_path_factory.mktemp("centre")
    fill(folder)
    with subprocess.Popen(
        [sys.executable, "-W", "ignore", "-m", "tests.peers.fdsn_server", str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    ) as process:
        assert process.stdout is not None
        yield f"127.0.0.1:{int(process.stdout.readline())}"
        assert process.stdin is not None
        process.stdin.close()


def imported(out: Path, source: str, *options: str) -> Any:  # noqa: ANN401 - as typer has it
    """Run the command."""
    span = ("--start", "2026-11-01T23:59:10", "--end", "2026-11-02T00:00:30")
    return CliRunner().invoke(app, ["import", source, "-o", str(out), *(options or span)])


def test_data_and_responses_come_in_one_line(tmp_path: Path, centre: str) -> None:
    url = f"fdsn://{centre}/XX.ABC.{{00,10}}.BH?"
    found = imported(tmp_path / "a.h5", url)
    assert found.exit_code == ExitCode.DONE, found.output
    assert "XX.ABC.00 BHN: response, 200 counts per m/s" in found.output
    with Recording.open(tmp_path / "a.h5") as recording:
        assert [sensor.name for sensor in recording.sensors] == ["XX.ABC.00", "XX.ABC.10"]
        for sensor, location in zip(recording.sensors, (0, 10), strict=True):
            assert [each.sensitivity for each in sensor.channels] == [
                pytest.approx(2 * (100 + location)),
                pytest.approx(2 * (200 + location)),
            ]
            expected = np.stack([counts(N, location), counts(N, location + 1)], 1)
            np.testing.assert_array_equal(sensor.counts(), expected[500:4500])
            assert len(sensor.gaps) == 0  # across midnight
        assert recording.bench is not None
        assert {each.port for each in recording.bench.sensors} == {url}


def test_what_a_centre_lacks_is_said(tmp_path: Path, centre: str) -> None:
    cases = {
        f"fdsn://{centre}/XX.ABC.00.HH?": "has no data of these channels from 2026-11-01T23:59:10",
        f"fdsn://{centre}/XX.ABC.BHZ": "expected fdsn://CENTRE/NETWORK.STATION.LOCATION.CHANNEL",
        "fdsn://NOWHERE/XX.ABC.00.BHZ": "unknown centre 'NOWHERE'; expected a host, or one of",
    }
    for url, message in cases.items():
        found = imported(tmp_path / "a.h5", url)
        assert found.exit_code != ExitCode.DONE
        assert message in " ".join(found.output.split()), found.output
        assert not (tmp_path / "a.h5").exists()
    found = imported(tmp_path / "a.h5", f"fdsn://{centre}/XX.ABC.00.BHZ", "--start", "2026-11-01")
    assert "expected --start and --end" in " ".join(found.output.split()).lower()


def test_a_centre_that_does_not_answer(tmp_path: Path) -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))  # and does not listen
        url = f"fdsn://127.0.0.1:{closed.getsockname()[1]}/XX.ABC.00.BHZ"
        found = imported(tmp_path / "a.h5", url)
    assert found.exit_code != ExitCode.DONE
    assert "the centre gives no answer" in " ".join(found.output.split())


def test_a_response_at_hand_has_precedence(tmp_path: Path, centre: str) -> None:
    own = obspy.core.inventory
    channel = own.Channel("BHZ", "00", 0, 0, 0, 0, response=response(7.0), sample_rate=50.0)
    station = own.Station("ABC", 0, 0, 0, channels=[channel])
    whole = own.Inventory([own.Network("XX", [station])], source="test")
    whole.write(str(tmp_path / "own.xml"), format="STATIONXML")
    span = ("--start", "2026-11-01T23:59:10", "--end", "2026-11-01T23:59:50")
    options = (*span, "--response", str(tmp_path / "own.xml"))
    found = imported(tmp_path / "a.h5", f"fdsn://{centre}/XX.ABC.00.BHZ", *options)
    assert found.exit_code == ExitCode.DONE, found.output
    assert "response, 14 counts per m/s" in found.output
