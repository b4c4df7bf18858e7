"""A part of the torture by faults at every call of a command that changes a file.

`make torture` has all commands, faults and places.
"""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from tests.torture.fault_commands import SPEED, commands, device_commands
from tests.torture.faulty_disk import FAULTS, FOREVER, Command, FaultyDisk, library, torture
from tests.tui.demo_bench import demo_devices

SAMPLE = {"import": 1, "results in a recording": 1, "archive": 1}
"""Commands, and how many of their calls fail."""


def wrong(
    folder: Path, made: dict[str, Command], places: dict[str, int], *faults: str
) -> list[str]:
    """Return what was wrong after faults, and see that something failed at all."""
    built = library(folder)
    if built is None:
        pytest.skip("no gcc, or not Linux: nothing can fail")
    found, refused = [], 0
    with FaultyDisk(built, folder) as disk:
        for name, n_places in places.items():
            for outcome in torture(disk, made[name], n_places=n_places, seed=5, faults=faults):
                found += [f"{name}, {outcome.fault}: {each}" for each in outcome.wrong]
                refused += outcome.counts["refused"]
    assert refused or found
    return found


@pytest.fixture
def inputs(tmp_path: Path) -> Path:
    folder = tmp_path / "inputs"
    folder.mkdir()
    return folder


def test_a_call_that_fails_once_gives_no_wrong_number(tmp_path: Path, inputs: Path) -> None:
    assert wrong(tmp_path, commands(inputs), SAMPLE, "EIO once") == []


@pytest.mark.long
def test_no_fault_of_the_disk_loses_what_devices_sent(tmp_path: Path, inputs: Path) -> None:
    with demo_devices(inputs, speed=SPEED) as bench:
        places = {"record": 1, "run": 1}
        assert wrong(tmp_path, device_commands(bench), places, *FAULTS) == []


@pytest.mark.long
def test_a_recording_that_cannot_begin_ends_with_a_message(tmp_path: Path, inputs: Path) -> None:
    """HDF5 crashed when it freed objects of a new file that the disk had no space for."""
    built = library(tmp_path)
    if built is None:
        pytest.skip("no gcc, or not Linux: nothing can fail")
    with demo_devices(inputs, speed=SPEED) as bench, FaultyDisk(built, tmp_path) as disk:
        command = device_commands(bench)["record"]
        for place in range(1, 9):
            disk.disk.mkdir()
            arguments = command.arguments(disk.disk)
            code, said = disk.run(arguments, first=place, last=FOREVER, error=errno.ENOSPC)
            assert (code, said.count("\n")) == (3, 1), said
            assert said.endswith("r.h5: cannot be written: No space left on device\n")
            assert not list(disk.disk.iterdir())
            disk.disk.rmdir()


def test_a_file_is_on_the_disk_before_and_after_it_has_its_name(tmp_path: Path) -> None:
    """Of each of two files: written, closed, synced, named, and its folder synced."""
    built = library(tmp_path)
    if built is None:
        pytest.skip("no gcc, or not Linux: no call is seen")
    with FaultyDisk(built, tmp_path) as disk:
        disk.disk.mkdir()
        assert disk.run(["sign", "--new-key", str(disk.disk / "key")])[0] == 0
        assert disk.calls == 2 * "wcsns"
