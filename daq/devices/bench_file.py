"""Bench files, checked against the drivers installed on this computer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from daq.bench import loading
from daq.bench.model import Bench
from daq.caveats import Caveat, Caveats
from daq.devices.interface import AnyDriver
from daq.devices.registry import driver_names, driver_type
from daq.transport import ports


class InstalledDrivers(Mapping[str, AnyDriver]):
    """The installed drivers by name, each imported when it is looked up."""

    def __getitem__(self, name: str) -> AnyDriver:
        if name not in driver_names():
            raise KeyError(name)
        return driver_type(name)

    def __contains__(self, name: object) -> bool:
        return name in driver_names()

    def __iter__(self) -> Iterator[str]:
        return iter(driver_names())

    def __len__(self) -> int:
        return len(driver_names())


def caveats_of(bench: Bench) -> Caveats:
    """Return those of recordings of a bench, by its file and by what serves its ports here now."""
    own = Caveats.of({Caveat.SIMULATED: bench.runs_simulated})
    return Caveats.joined([own, *map(ports.caveats_of, bench.ports())])


def load(path: str | Path) -> Bench:
    """Read a bench file and check it against the installed drivers.

    Raises
    ------
    BenchFileError
        With all errors in the file, one per line.
    """
    return loading.load(path, InstalledDrivers())


def parse(text: str, source: str | Path = "bench") -> Bench:
    """Parse the text of a bench file and check it against the installed drivers.

    Raises
    ------
    BenchFileError
        With all errors in the text, one per line.
    """
    return loading.parse(text, source, InstalledDrivers())
