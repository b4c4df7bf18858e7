"""Blocks of one sensor's three streams, and what decoders make of them."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.devices.guralp import gcf
from daq.devices.guralp.gcf import SampleBlock, SystemId
from daq.protocols.block import Block, DeviceItem, Event, HostTime
from tests.daq.devices.found import blocks_of, events_of

S = 1_000_000_000
START_NS = 1_795_219_200 * S
SYSTEM = SystemId("DEMO")
STREAMS = ("DEMOZ2", "DEMON2", "DEMOE2")
AT = HostTime(5 * S, START_NS)
RATE = 100
SENSORS = {"A": STREAMS}


def samples(stream: int, first: int, n: int) -> NDArray[np.int64]:
    return (np.arange(first, first + n) * 7 + stream * 1000) % 5000


def sample_block(stream: int, second: int, n_seconds: int = 1) -> SampleBlock:
    counts = samples(stream, second * RATE, n_seconds * RATE).astype(np.int32)
    start_ns = START_NS + second * S
    return SampleBlock(SYSTEM, STREAMS[stream], start_ns, Fraction(RATE), counts)


def raw_blocks(n_seconds: int) -> list[bytes]:
    return [gcf.encode_block(sample_block(i, s)) for s in range(n_seconds) for i in range(3)]


def expected(first: int, n: int) -> NDArray[np.int64]:
    return np.column_stack([samples(i, first, n) for i in range(3)])


def joined(found: Iterable[DeviceItem]) -> tuple[NDArray[Any], list[Block], list[Event]]:
    blocks = blocks_of(found)
    counts = np.concatenate([b.counts for b in blocks]) if blocks else np.empty((0, 3))
    return counts, blocks, events_of(found)
