"""The simulated ends of wires: an address never leads to somebody else's device."""

from __future__ import annotations

import os
import sys

import pytest

from sim_devices.server.ports import PseudoTerminal

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")


class Deaf:
    """A device that does nothing."""

    def connected(self) -> None:
        """Nobody cares."""

    def disconnected(self) -> None:
        """Nobody cares."""

    def received(self, data: bytes) -> None:
        """Nobody cares."""


async def test_the_address_is_removed_before_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """The number of a closed terminal is given to the next one made, by whatever process."""
    line = PseudoTerminal(Deaf())
    await line.open()
    assert os.path.lexists(line.address)  # noqa: ASYNC240 - at once, by intent
    there: list[bool] = []
    close = os.close

    def watched(descriptor: int) -> None:
        there.append(os.path.lexists(line.address))
        close(descriptor)

    with monkeypatch.context() as patched:
        patched.setattr("sim_devices.server.ports.os.close", watched)
        line.hang_up()
    assert there == [False]  # the terminal's own end, and nothing before it
    line.restore()
    assert os.path.lexists(line.address)  # noqa: ASYNC240 - at once, by intent
    with monkeypatch.context() as patched:
        patched.setattr("sim_devices.server.ports.os.close", watched)
        await line.close()
    assert not any(there)
