"""Devices on a CAN bus, from CiA 301 and Epson's data sheet; shares no code with the driver.

Ax of each sample is the number of ticks since the first SYNC, Ay the node. A schedule tells at
which tick a node leaves or comes back; ticks go on while nobody produces SYNC any more.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable

import can

TEXTS = {0x1008: b"A552", 0x1009: b"AC10", 0x100A: b"1.00"}
OPERATIONAL, PRE_OPERATIONAL = 5, 127
Schedule = dict[int, list[Callable[[], None]]]


class Node:
    """One device, with its volatile settings."""

    def __init__(self, bus: Peer, number: int) -> None:
        self._bus, self.number = bus, number
        self.is_there = True
        self.sent: list[int] = []
        """Ticks of its samples."""
        self.reset()

    def reset(self) -> None:
        """Lose all settings."""
        self.state = PRE_OPERATIONAL
        self.counter = 4711
        self.objects: dict[tuple[int, int], bytes] = {
            **{(index, 0): text for index, text in TEXTS.items()},
            (0x1005, 0): struct.pack("<I", 0x80),
            (0x1800, 1): struct.pack("<I", 0x40000180 + self.number),
            (0x1801, 1): struct.pack("<I", 0xC0000280 + self.number),
        }

    def leave(self) -> None:
        """Fall silent."""
        self.is_there = False

    def come(self) -> None:
        """Boot."""
        self.is_there = True
        self.reset()
        self._bus.send(0x700 + self.number, b"\0")

    @property
    def is_on(self) -> bool:
        """Whether it samples."""
        return self.is_there and self.state == OPERATIONAL

    @property
    def produces(self) -> bool:
        """Whether it sends SYNC."""
        return self.is_on and bool(self.objects[0x1005, 0][3] & 0x40)

    def ask(self, request: bytes) -> bytes:
        """Reply to an SDO request; all objects are expedited."""
        command, index, subindex = struct.unpack_from("<BHB", request)
        place = request[1:4]
        if command == 0x40:
            value = self.objects.get((index, subindex))
            if value is None:
                return b"\x80" + place + struct.pack("<I", 0x06020000)
            return bytes([0x43 | (4 - len(value)) << 2]) + place + value.ljust(4, b"\0")
        size = 4 - (command >> 2 & 3)
        self.objects[index, subindex] = request[4 : 4 + size]
        if index == 0x2100:
            self.counter = int.from_bytes(request[4:6], "little")
        return b"\x60" + place + bytes(4)


class Peer:
    """The bus: listens in one thread, and ticks in another."""

    def __init__(self, channel: str, nodes: list[int], rate: float) -> None:
        self.nodes = {number: Node(self, number) for number in nodes}
        self.schedule: Schedule = {}
        self.tick = 0
        self._bus = can.Bus(channel, interface="virtual")
        self.lock = threading.RLock()
        self._ended = threading.Event()
        self._period = 1 / rate
        self._threads = [
            threading.Thread(target=run, daemon=True) for run in (self._listen, self._run)
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End the threads."""
        self._ended.set()
        for thread in self._threads:
            thread.join()
        self._bus.shutdown()

    def send(self, cob_id: int, data: bytes) -> None:
        """Send a message."""
        self._bus.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))

    def _listen(self) -> None:
        while not self._ended.is_set():
            message = self._bus.recv(0.05)
            if message is None:
                continue
            with self.lock:
                self._received(message.arbitration_id, bytes(message.data))

    def _received(self, cob_id: int, data: bytes) -> None:
        if cob_id == 0:
            for node in self.nodes.values():
                if node.is_there and data[1] in (0, node.number):
                    node.state = {1: OPERATIONAL, 128: PRE_OPERATIONAL}[data[0]]
        asked = self.nodes.get(cob_id - 0x600)
        if asked is not None and asked.is_there and (reply := asked.ask(data)):
            self.send(0x580 + asked.number, reply)

    def _run(self) -> None:
        while not self._has_producer and not self._ended.wait(self._period):
            pass
        begin = time.monotonic()
        while not self._ended.wait(max(0.0, begin + self.tick * self._period - time.monotonic())):
            with self.lock:
                for act in self.schedule.get(self.tick, ()):
                    act()
                if self._has_producer:
                    self.send(0x80, b"")
                    for node in self.nodes.values():
                        if node.is_on:
                            self._sample(node)
            self.tick += 1

    @property
    def _has_producer(self) -> bool:
        return any(node.produces for node in self.nodes.values())

    def _sample(self, node: Node) -> None:
        number = node.number
        node.sent.append(self.tick)
        self.send(0x180 + number, struct.pack("<ii", self.tick, number))
        self.send(0x280 + number, struct.pack("<iH", -self.tick, node.counter % 65536))
        node.counter += 1
