"""Words for numbers."""

from __future__ import annotations

from estimator.wording import span


def test_a_band_that_reads_as_one_frequency_is_one_frequency() -> None:
    """A single bin of a long recording: "at 16 Hz", not "at 16–16 Hz"."""
    assert span(16.0, 16.02) == "16 Hz"
    assert span(0.1, 16.0) == "0.1–16 Hz"
