"""Nine channels on three protocols, a fault of every kind, through the commands: all accounted for.

The run of ten minutes at life's pace, estimate included, is :mod:`tests.acceptance.ten_minutes`.
"""

from __future__ import annotations

import contextlib
import math
import subprocess
import sys
from pathlib import Path

import pytest

from daq.recording.control import ask
from tests.acceptance import fault_script
from tests.acceptance.run_bench import command, served
from tests.acceptance.sample_accounting import Log, accounts
from tests.waiting import limit

pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals"),
]

SPEED = 8.0
BEGIN = 48.0
"""World time by which the recorder will have started, s; on a busy machine a round later."""
SPACING = 4.0
ROUND = 17 * SPACING
ATTEMPTS = 3
"""To start the recorder, should a fault strike just then."""


@pytest.mark.long
def test_every_sample_sent_is_recorded_and_every_gap_has_its_length(tmp_path: Path) -> None:
    faults = fault_script.script(begin=BEGIN, spacing=SPACING, every=ROUND)
    out, log = tmp_path / "r.h5", tmp_path / "log.jsonl"
    with served(tmp_path, faults, speed=SPEED) as devices:
        for _ in range(ATTEMPTS):
            with command("record", str(devices.bench), "--out", str(out)) as recorder:
                if _all_struck(recorder, log):
                    ask(out, "stop")
                _, said = recorder.communicate(timeout=limit())
            if recorder.returncode == 0:
                break
        else:
            pytest.fail(f"the recorder ended: {said}")
    found = {one.sensor: one for one in accounts(devices.spec, Log.read(log), out)}
    for one in found.values():
        assert one.recorded > 0.7 * one.sent + 1000, one
        assert one.holds, one
        # between sessions: what was in the line when the cable came out, or flows before the
        # device has been told to stop
        assert one.between < 0.1 * one.sent, one
        # by the host's clock: the latency of the first block after, at SPEED times life's
        assert one.worst_estimate < 0.25 * SPEED * 200, one
    assert found["E"].exact_gaps >= 5  # dropped, cut, corrupt, checksum, merged, stalled
    assert found["L"].exact_gaps >= 3  # dropped, stalled, overflowed
    assert found["G"].exact_gaps == found["G"].gaps >= 1  # of UTC


def _all_struck(recorder: subprocess.Popen[str], log: Path) -> bool:
    """Return when every kind has struck every device and all have gone on; False if it ended."""
    wanted = {
        s: set(kinds) - set(fault_script.SAMPLES_ONLY) for s, kinds in fault_script.KINDS.items()
    }
    before = {sensor: len(sent) for sensor, sent in Log.read(log).sent.items()}
    until = math.inf
    while True:
        with contextlib.suppress(subprocess.TimeoutExpired):
            recorder.wait(0.3)
            return False
        noted = Log.read(log)
        if until < math.inf:
            if all(sent[-1][0] > until for sent in noted.sent.values()):
                return True
            continue
        begun = max(
            sent[n][0] + SPACING if len(sent) > n else math.inf
            for sensor in wanted
            for n, sent in [(before.get(sensor, 0), noted.sent.get(sensor, []))]
        )  # on a busy machine, faults strike before the recorder listens
        if all(noted.kinds(s, since=begun) >= kinds for s, kinds in wanted.items()):
            until = max(told["at"] for told in noted.struck) + 2 * SPACING
