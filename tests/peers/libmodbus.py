"""Programs made with libmodbus, and the serial cable between them and us."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.waiting import wait_until


def build(source: str, folder: Path) -> Path:
    """Compile one of the programs beside this file; skip where that cannot be done."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler to build the libmodbus peer with")
    program = folder / "peer"
    code = Path(__file__).with_name(source)
    built = subprocess.run(
        [compiler, "-I/usr/include/modbus", str(code), "-lmodbus", "-o", str(program)],
        capture_output=True,
        text=True,
        check=False,
    )
    if built.returncode and "modbus.h" in built.stderr:
        pytest.skip("libmodbus (Debian: libmodbus-dev) is not installed")
    assert built.returncode == 0, built.stderr
    return program


@contextmanager
def running(*command: str) -> Iterator[subprocess.Popen[str]]:
    """Run a program until the context ends."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        try:
            yield program
        finally:
            program.terminate()


@contextmanager
def ready(*command: str) -> Iterator[None]:
    """Run a server from when it says that it is ready until the context ends."""
    with running(*command) as server:
        assert server.stdout is not None
        assert server.stdout.readline() == "ready\n"
        yield


@contextmanager
def serial_cable(folder: Path) -> Iterator[tuple[str, str]]:
    """Two pseudo-terminals joined by socat."""
    if shutil.which("socat") is None:
        pytest.skip("socat (Debian: socat) is not installed")
    ends = (str(folder / "one"), str(folder / "other"))
    with running("socat", *(f"pty,raw,echo=0,link={end}" for end in ends)):
        wait_until(lambda: all(Path(end).exists() for end in ends), "socat's pseudo-terminals")
        yield ends
