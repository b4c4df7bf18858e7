"""A disk that refuses for a moment ends no recording; one that refuses for good does."""

from __future__ import annotations

import pytest

from daq.recording.storage.retries import PAUSES, repeated


@pytest.mark.parametrize("n_failures", [0, 1, len(PAUSES)])
def test_a_write_is_repeated_until_it_succeeds(
    n_failures: int, caplog: pytest.LogCaptureFixture
) -> None:
    calls: list[str] = []

    def write() -> None:
        calls.append("write")
        if calls.count("write") <= n_failures:
            raise OSError(28, "No space left on device")

    slept: list[float] = []
    repeated(write, before=lambda: calls.append("before"), sleep=slept.append)
    assert calls == ["write"] + ["before", "write"] * n_failures
    assert slept == list(PAUSES[:n_failures])
    said = "a write to the recording failed and is repeated: No space left on device"
    assert caplog.messages == [said] * n_failures


def test_a_persistent_error_is_raised() -> None:
    def write() -> None:
        raise OSError(5, "Input/output error")

    with pytest.raises(OSError, match="Input/output error"):
        repeated(write, sleep=lambda _: None)
