"""M-A552 accelerometers on a CAN bus, simulated by canopen's own nodes, on any python-can bus.

This simulator runs in a thread of whoever needs it. The device that is told to produces SYNC; at
each SYNC every operational device sends its next sample. The rest is canopen's.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import canopen
import numpy as np
from canopen import objectdictionary
from numpy.typing import NDArray

from daq.devices.epson import canopen as protocol
from sim_devices.devices.epson import temperature_counts

OPERATIONAL = "OPERATIONAL"
HEARTBEAT = 0x1017
MAPPING = {
    (0x1A00, 1): 0x91300120,
    (0x1A00, 2): 0x91300220,
    (0x1A01, 1): 0x91300320,
    (0x1A01, 2): 0x21000010,
}
"""What the two messages hold."""
UNSIGNED, VISIBLE_STRING = {1: 0x5, 2: 0x6, 4: 0x7}, 0x9
"""Data types of CiA 301, numbers by their bytes."""
IDLE = 0.005
"""Interval at which the bus looks whether it is to start, in s."""


def encode_sample(node: int, counts: NDArray[np.int32], counter: int) -> list[protocol.Message]:
    """Return both messages of a sample."""
    ax, ay, az = (int(count).to_bytes(4, "little", signed=True) for count in counts)
    last = az + (counter % protocol.COUNTER_MODULUS).to_bytes(2, "little")
    return list(zip((0x180 + node, 0x280 + node), (ax + ay, last), strict=True))


BUS_CELSIUS = 26.5
"""Temperature of the devices on a bus."""


class SimulatedBus:
    """Devices on a bus.

    Parameters
    ----------
    bus : can.BusABC
    samples : mapping of int to callable
        For each node ID a function of the number of a sample, its counts (3,).
    """

    def __init__(self, bus: Any, samples: Mapping[int, Callable[[int], NDArray[np.int32]]]) -> None:  # noqa: ANN401 -- python-can's
        self.due: list[float] = []
        """Instant of each SYNC, in s of ``time.monotonic``, since SYNC was started."""
        self.lost: set[tuple[int, int, int]] = set()
        """Messages that the bus loses: node, number of TPDO (0, 1), number of the SYNC."""
        self._samples = dict(samples)

        self._network = canopen.Network(bus)
        self._network.connect()
        self.nodes = {node: self._node(node) for node in samples}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="simulated CAN bus", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the devices."""
        self._ended.set()
        self._thread.join()
        self._network.disconnect()

    def _node(self, node_id: int) -> Any:  # noqa: ANN401 -- canopen's
        objects = {
            (protocol.DEVICE_NAME, 0): b"A552",
            (protocol.HARDWARE, 0): b"AC10",
            (protocol.SOFTWARE, 0): b"1.00",
            (protocol.SYNC_COB_ID, 0): (0x80).to_bytes(4, "little"),
            (protocol.SYNC_PERIOD, 0): bytes(4),
            (protocol.SAMPLE_COUNTER, 0): (4711).to_bytes(2, "little"),
            (protocol.TPDO1, 1): (0x40000180 + node_id).to_bytes(4, "little"),
            (protocol.TPDO1, 2): b"\x01",
            (protocol.TPDO2, 1): (0xC0000280 + node_id).to_bytes(4, "little"),
            (protocol.FILTER, 1): b"\x09",
            (HEARTBEAT, 0): bytes(2),
            protocol.TEMPERATURE: int(temperature_counts(np.array(BUS_CELSIUS))).to_bytes(
                4, "little", signed=True
            ),
            **{place: value.to_bytes(4, "little") for place, value in MAPPING.items()},
        }

        dictionary: Any = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
        for (index, subindex), value in objects.items():
            entry: Any = objectdictionary.ODVariable("", index, subindex)
            entry.data_type, entry.access_type = _type_of(index, value), "rw"
            if not subindex:
                dictionary.add_object(entry)
                continue
            if index not in dictionary:
                dictionary.add_object(objectdictionary.ODRecord("", index))
            dictionary[index].add_member(entry)
        node = canopen.LocalNode(node_id, dictionary)
        self._network.add_node(node)
        for (index, subindex), value in objects.items():
            node.set_data(index, subindex, value)
        node.nmt.state = "PRE-OPERATIONAL"
        return node

    def _value(self, node: Any, index: int, subindex: int = 0) -> int:  # noqa: ANN401
        return int.from_bytes(node.get_data(index, subindex), "little")

    def _period(self) -> float:
        """Return the period of SYNC in s; 0 while no device produces it."""
        for node in self.nodes.values():
            is_on = self._value(node, protocol.SYNC_COB_ID) & protocol.PRODUCES_SYNC
            if is_on and node.nmt.state == OPERATIONAL:
                return self._value(node, protocol.SYNC_PERIOD) * 1e-6
        return 0.0

    def _run(self) -> None:
        next_at = 0.0
        while not self._ended.is_set():
            period = self._period()
            if not period:
                next_at = 0.0
                self._ended.wait(IDLE)
                continue
            now = time.monotonic()
            if not next_at:
                next_at = now
                self.due.clear()
            if now < next_at:
                self._ended.wait(next_at - now)
                continue
            self._sync(next_at)
            next_at += period

    def _sync(self, at: float) -> None:
        number = len(self.due)
        self.due.append(at)
        self._network.send_message(protocol.SYNC, b"")
        for node_id, node in self.nodes.items():
            if node.nmt.state != OPERATIONAL:
                continue
            counter = self._value(node, protocol.SAMPLE_COUNTER)
            counts = self._samples[node_id](number)
            messages = encode_sample(node_id, np.asarray(counts, np.int32), counter)
            for k, (cob_id, data) in enumerate(messages):
                is_on = not self._value(node, (protocol.TPDO1, protocol.TPDO2)[k], 1) >> 31
                if is_on and (node_id, k, number) not in self.lost:
                    self._network.send_message(cob_id, data)
            following = (counter + 1) % protocol.COUNTER_MODULUS
            node.set_data(protocol.SAMPLE_COUNTER, 0, following.to_bytes(2, "little"))


def _type_of(index: int, value: bytes) -> int:
    if index in {protocol.DEVICE_NAME, protocol.HARDWARE, protocol.SOFTWARE}:
        return VISIBLE_STRING
    return UNSIGNED[len(value)]
