"""What was sent, from the simulators' log, against what was recorded: sample by sample.

The world says exactly what each device's sample n was, so every recorded row has its place in the
world by its value, and every gap a true length. What went onto the wires stands in the log that
``huddle devices --log`` writes; it is read here without the decoders under test.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.protocols.block import BlockFlag
from daq.recording.reader import Recording, SensorRecord
from sim_devices.devices.epson import FULL_SCALE
from sim_devices.devices.interface import Source
from sim_devices.devices.labjack import CENTER
from sim_devices.faults import SampleFaults, parse
from sim_devices.server.serve import device_spec
from sim_devices.world.scenario import Scenario

Counts = NDArray[np.int64]
Indices = NDArray[np.int64]

GCF_EPOCH = 627264000
LOST = {b"disconnected", b"stalled", b"refused"}
"""Reasons of gaps between two sessions."""
MARGIN = 30.0
"""How much of the world beyond the last unit sent is computed, s."""


@dataclass(slots=True)
class Log:
    """What the simulated devices noted."""

    utc_ns: dict[str, int] = field(default_factory=dict)
    """UTC of world time 0, by sensor."""
    struck: list[dict[str, Any]] = field(default_factory=list)
    sent: dict[str, list[tuple[float, bytes]]] = field(default_factory=dict)
    """World time and bytes of every unit that went onto a wire, by sensor."""

    @classmethod
    def read(cls, path: Path) -> Log:
        """Read it; a last line that is still being written is left out."""
        log = cls()
        for line in path.read_text(encoding="utf-8").splitlines(keepends=True):
            if not line.endswith("\n"):
                break
            told = json.loads(line)
            (sensor,) = told["sensors"]
            if "unit" in told:
                sent = log.sent.setdefault(sensor, [])
                sent.append((told["at"], bytes.fromhex(told["unit"])))
            elif "kind" in told:
                log.struck.append(told)
            else:
                log.utc_ns[sensor] = told["utc_ns"]
        return log

    def kinds(self, sensor: str, *, since: float = -math.inf) -> set[str]:
        """Return the kinds of faults that struck a sensor's device after a world time."""
        return {
            told["kind"]
            for told in self.struck
            if told["sensors"] == [sensor] and told["at"] > since
        }


def true_counts(spec: Mapping[str, Any], log: Log, sensor: str) -> Counts:
    """Return what each sample of a sensor's device was, faults of samples included.

    Shape (n_samples, n_channels), from the world's sample 0.
    """
    table = next(d for d in spec["devices"] if d["sensors"] == [sensor])
    device = device_spec(table)
    scenario = Scenario.from_dict(spec["scenario"])
    source = Source(scenario, device, faults=SampleFaults(parse(spec["faults"], (sensor,))))
    if device.driver == "guralp":
        source = source.disciplined(-log.utc_ns[sensor] % 10**9 / 1e9)
    n_samples = round((log.sent[sensor][-1][0] + MARGIN) * device.sampling_rate)
    counts = source.counts(sensor, 0, n_samples)
    if device.driver == "labjack":
        return np.clip(np.rint(counts + CENTER), 0, 65535).astype(np.int64)
    most = FULL_SCALE if device.driver == "epson" else (1 << 23) - 1
    return np.clip(np.rint(counts), -most, most).astype(np.int64)


def sent_by_epson(log: Log, sensor: str, truth: Counts, rate: float) -> Indices:
    """Return the world's index of each sample in a frame that left whole."""
    places: dict[bytes, list[int]] = {}
    for index, row in enumerate(truth.astype(">i4")):
        places.setdefault(row.tobytes(), []).append(index)
    found = []
    for at, unit in log.sent[sensor]:
        # FLAG, TEMP, x, y, z, COUNT, sum
        if len(unit) == 24 and unit[0] == 0x80 and unit[-1] == 0x0D:
            words = np.frombuffer(unit, ">u2", 10, 1)
            if int(words.sum(dtype=np.int64)) % 65536 == int.from_bytes(unit[21:23], "big"):
                candidates = places[unit[7:19]]
                found.append(min(candidates, key=lambda index: abs(index / rate - at)))
    return np.unique(found)


def sent_by_labjack(log: Log, sensor: str, truth: Counts, rate: float) -> Indices:
    """Return the world's index of each scan, by the 40 MHz timer that leads it.

    The timer stands at 0 at world time 0, and again at a sample after each power failure: which one
    shows by the first scans after it.
    """
    ticks, n_columns = round(40e6 / rate), truth.shape[1] + 2
    failures = [told["at"] for told in log.struck if told["sensors"] == [sensor]
                and told["kind"] == "reset"]  # fmt: skip
    begins = {0: 0}
    found = []
    for at, unit in log.sent[sensor]:
        if len(unit) < 16 or unit[6:9] != b"\x01\x4c\x10":
            continue
        scans = np.frombuffer(unit, ">u2", offset=16).astype(np.int64).reshape(-1, n_columns)
        scans = scans[(scans != 0xFFFF).any(axis=1)]
        timer = scans[:, 0] | scans[:, 1] << 16
        n_failures = sum(failure <= at for failure in failures)
        since = at - (failures[n_failures - 1] if n_failures else 0.0)
        wraps = np.rint((since * 40e6 - timer) / 2**32).astype(np.int64)
        index = (timer + wraps * 2**32) // ticks
        if n_failures not in begins:
            begins[n_failures] = _place(truth, scans[:, 2:]) - int(index[0])
        found.append(index + begins[n_failures])
    return np.unique(np.concatenate(found))


def sent_by_guralp(log: Log, sensor: str, truth: Counts, rate: float) -> Indices:
    """Return the world's index of each sample of which all streams left whole, by its UTC."""
    whole_ns = -(-log.utc_ns[sensor] // 10**9) * 10**9
    by_stream: dict[bytes, list[Indices]] = {}
    for _, unit in log.sent[sensor]:
        if unit[:1] != b"G" or len(unit) < 22 or sum(unit[:-2]) % 65536 != _word(unit, -2):
            continue
        block = unit[4:-2]
        if _word(unit, 2) != len(block) or block[13] == 0:
            continue
        date = int.from_bytes(block[8:12], "big")
        start_s = GCF_EPOCH + (date >> 17) * 86400 + (date & 0x1FFFF)
        first = round((start_s - whole_ns // 10**9) * rate)
        n_samples = block[15] * (block[14] & 7)
        by_stream.setdefault(block[4:8], []).append(np.arange(first, first + n_samples))
    streams = [np.unique(np.concatenate(parts)) for parts in by_stream.values()]
    if len(streams) != truth.shape[1]:
        return np.empty(0, np.int64)
    indices, times_seen = np.unique(np.concatenate(streams), return_counts=True)
    return np.asarray(indices[times_seen == len(streams)])


def _word(octets: bytes, at: int) -> int:
    return int.from_bytes(octets[at:][:2], "big")


SENT = {"epson": sent_by_epson, "labjack": sent_by_labjack, "guralp": sent_by_guralp}


@dataclass(frozen=True, slots=True)
class Account:
    """One sensor's samples, counted."""

    sensor: str
    sent: int
    """Left the device whole, between the first and the last sample recorded."""
    recorded: int
    wrong: int
    """Rows whose value is not what the world had at their index."""
    lost: int
    """Sent while a session lasted, and not recorded."""
    between: int
    """Sent while the device was being found, identified and set up again, and not recorded."""
    gaps: int
    """Between samples: not the one at the end of a device that is still lost."""
    exact_gaps: int
    """Of them with a length that the recording calls exact."""
    exact_gaps_off: int
    """Of these, not of their true length."""
    worst_estimate: int
    """Largest error of an estimated length, in samples."""
    missing: int
    """Samples in gaps."""
    sessions: int
    power_failures: int
    """Of the device: what is missing over one is estimated, and over nothing else."""

    @property
    def holds(self) -> bool:
        """Whether all is accounted for, and each gap exact that can be."""
        is_exact = self.gaps - self.exact_gaps <= self.power_failures
        return is_exact and not (self.wrong or self.lost or self.exact_gaps_off)


def account(spec: Mapping[str, Any], log: Log, recording: SensorRecord) -> Account:
    """Compare one sensor's recording with the world and with what its device sent."""
    sensor = recording.name
    truth = true_counts(spec, log, sensor)
    counts = recording.counts().astype(np.int64)
    world = np.empty(len(counts), np.int64)
    blocks, gaps = recording.blocks, recording.gaps
    restarts = np.flatnonzero(blocks["flags"] & BlockFlag.CLOCK_RESTART).tolist()
    for begin, end in zip(restarts, [*restarts[1:], len(blocks)], strict=True):
        row = int(blocks["first_row"][begin])
        anchor = _place(truth, counts[row : row + int(blocks["n_samples"][begin])])
        offset = anchor - int(blocks["first_sample"][begin])
        for block in blocks[begin:end]:
            rows = slice(int(block["first_row"]), int(block["first_row"] + block["n_samples"]))
            first = int(block["first_sample"]) + offset
            world[rows] = np.arange(first, first + int(block["n_samples"]))
    wrong = (truth[world] != counts).any(axis=1)

    starts = {int(b["first_sample"]): int(b["first_row"]) for b in blocks}
    fresh = {int(blocks["first_sample"][k]) for k in restarts}
    errors, in_sessions = [], []
    between: list[Indices] = []
    for gap in gaps:
        following = int(gap["first_sample"] + gap["missing"])
        if following not in starts:  # at the end of a device that is still lost
            continue
        row = starts[following]
        errors.append(int(gap["missing"]) - int(world[row] - world[row - 1] - 1))
        in_sessions.append(not gap["estimated"])
        if following in fresh or gap["reason"] in LOST:
            between.append(np.arange(world[row - 1] + 1, world[row]))
    error, exact = np.array(errors, int), np.array(in_sessions, bool)

    driver = next(d["driver"] for d in spec["devices"] if d["sensors"] == [sensor])
    sent = SENT[driver](log, sensor, truth, recording.sampling_rate)
    sent = sent[(sent >= world[0]) & (sent <= world[-1])]
    missed = np.setdiff1d(sent, world)
    set_up = np.intersect1d(missed, np.concatenate(between)) if between else missed[:0]
    return Account(
        sensor=sensor,
        sent=len(sent),
        recorded=len(counts),
        wrong=int(wrong.sum()),
        lost=len(missed) - len(set_up),
        between=len(set_up),
        gaps=len(errors),
        exact_gaps=int(exact.sum()),
        exact_gaps_off=int(np.count_nonzero(error[exact])),
        worst_estimate=int(np.abs(error[~exact]).max(initial=0)),
        missing=int(gaps["missing"].sum()),
        sessions=len(restarts),
        power_failures=sum(
            told["kind"] == "reset" for told in log.struck if told["sensors"] == [sensor]
        ),
    )


def _place(truth: Counts, counts: Counts) -> int:
    """Return the index of the world's sample from which on the most of these rows agree."""
    counts = counts[:200]
    candidates = np.flatnonzero((truth == counts[0]).all(axis=1))
    agreeing = [
        int((truth[c : c + len(counts)] == counts[: len(truth) - c]).all(axis=1).sum())
        for c in candidates.tolist()
    ]
    return int(candidates[int(np.argmax(agreeing))]) if agreeing else 0


def accounts(spec: Mapping[str, Any], log: Log, path: Path) -> Sequence[Account]:
    """Return the account of every sensor."""
    with Recording.open(path) as recording:
        return [account(spec, log, sensor) for sensor in recording.sensors]
