"""SeedLink 4 over TLS: who is trusted, who may read, and what is said if not."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from daq.bench.model import Sensor
from daq.devices.registry import driver_type
from daq.errors import BenchFileError, NotConnectedError, WrongDeviceError
from sim_devices.server.launch import RunningDevice
from tests.daq.devices.reading import record
from tests.devices import host_clock, serving
from tests.sensors import sensor_at
from tests.sim_devices.simulated_bench import device, spec

DRIVER = driver_type("seedlink")
PASSWORD = "4-accelerometers"  # noqa: S105 -- of the simulated server
devices = pytest.mark.devices


def sensor(port: str, **settings: Any) -> Sensor:  # noqa: ANN401 -- whatever settings hold
    own = {"network": "XX", "station": "STA", "patience": 20.0, **settings}
    return sensor_at(port, "seedlink", rate=200.0, channels=("HNZ", "HNN", "HNE"), settings=own)


@pytest.fixture
def credentials(tmp_path: Path, request: pytest.FixtureRequest) -> str:
    path = tmp_path / "credentials"
    path.write_text(getattr(request, "param", f"lab {PASSWORD}\n"), encoding="utf-8")
    return str(path)


@pytest.fixture
def served(credentials: str, request: pytest.FixtureRequest) -> Iterator[RunningDevice]:
    more: dict[str, Any] = getattr(request, "param", {"tls": True})
    settings = {"network": "XX", "station": "STA", "credentials": credentials, **more}
    table = device(
        "A", "seedlink", port="tcp", settings=settings, axes=("HNZ", "HNN", "HNE"), sensitivity=1e6
    )
    with serving(spec(table, speed=4.0)) as (one,):
        yield one


async def refused(chosen: Sensor) -> str:
    """Return why no session begins."""
    with pytest.raises((NotConnectedError, WrongDeviceError)) as caught:
        async with DRIVER.open([chosen], host_clock(4.0)):
            pass
    return str(caught.value)


@devices
@pytest.mark.parametrize("credentials", [f"lab {PASSWORD}\n", "a.token"], indirect=True)
async def test_credentials_are_stated_over_tls(served: RunningDevice, credentials: str) -> None:
    chosen = sensor(served.port, tls=True, credentials=credentials, **served.settings)
    async with DRIVER.open([chosen], host_clock(4.0)) as session:
        assert session.information[0].details["protocol"] == "SeedLink 4, encrypted"
    blocks, _ = await record(DRIVER, chosen, 400, speed=4.0)
    assert blocks[-1].end_sample >= 400


@devices
async def test_a_wrong_password_is_refused_and_not_shown(
    served: RunningDevice, tmp_path: Path
) -> None:
    (tmp_path / "wrong").write_text("lab 5-accelerometers", encoding="utf-8")
    said = await refused(
        sensor(served.port, tls=True, credentials=str(tmp_path / "wrong"), **served.settings)
    )
    assert "expected OK to 'AUTH …', got 'ERROR AUTH" in said
    assert "check credentials" in said
    assert "accelerometers" not in said


@devices
async def test_a_server_that_wants_credentials_says_so(served: RunningDevice) -> None:
    said = await refused(sensor(served.port, tls=True, **served.settings))
    assert "'ERROR UNAUTHORIZED authentication required'; check credentials" in said


@devices
async def test_a_certificate_that_nobody_trusts_ends_the_session(served: RunningDevice) -> None:
    said = await refused(sensor(served.port, tls=True))
    assert "the certificate of the other end is not trusted: self-signed certificate" in said
    assert served.port in said


@devices
async def test_a_certificate_of_another_host_ends_the_session(served: RunningDevice) -> None:
    number = served.port.rpartition(":")[2]
    said = await refused(sensor(f"seedlink://127.1:{number}", tls=True, **served.settings))
    assert "not trusted: IP address mismatch" in said or "not trusted: Hostname mismatch" in said


@devices
@pytest.mark.parametrize("served", [{"tls": False}], indirect=True)
async def test_a_server_without_tls_is_no_encrypted_one(served: RunningDevice) -> None:
    assert not served.settings
    assert "no encrypted connection" in await refused(sensor(served.port, tls=True))


@devices
@pytest.mark.parametrize("served", [{"offers_version_4": False}], indirect=True)
async def test_version_3_has_no_credentials(served: RunningDevice, credentials: str) -> None:
    said = await refused(sensor(served.port, tls=False, credentials=credentials))
    assert "SeedLink 3, which has no credentials" in said


@pytest.mark.parametrize(
    ("port", "settings", "said"),
    [
        ("seedlink://host", {"credentials": "/x"}, "others on the network can read them"),
        ("seedlink://host", {"credentials": "x", "tls": True}, "expected an absolute path"),
        ("seedlink://host:18500", {"credentials": "/x", "protocol": "3"}, "has no credentials"),
    ],
)
def test_impossible_settings_are_refused(port: str, settings: dict[str, Any], said: str) -> None:
    assert hasattr(DRIVER, "check")
    with pytest.raises(BenchFileError, match=said):
        DRIVER.check([sensor(port, **settings)])


@pytest.mark.parametrize(
    ("port", "settings"),
    [
        ("seedlink://host:18500", {"credentials": "/x"}),
        ("seedlink://host", {"credentials": "~/x", "tls": True}),
        ("seedlink://host", {"credentials": "/x", "tls": False}),
    ],
)
def test_credentials_are_allowed(port: str, settings: dict[str, Any]) -> None:
    assert hasattr(DRIVER, "check")
    DRIVER.check([sensor(port, **settings)])


@devices
async def test_unreadable_credentials_are_named(served: RunningDevice, tmp_path: Path) -> None:
    (tmp_path / "long").write_text("three words here", encoding="utf-8")
    for path, said in (("none", "cannot be read"), ("long", "expected a file of one or two words")):
        chosen = sensor(served.port, tls=True, credentials=str(tmp_path / path), **served.settings)
        with pytest.raises(BenchFileError, match=said):
            async with DRIVER.open([chosen], host_clock(4.0)):
                pass
