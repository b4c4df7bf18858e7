"""What is wanted of a test when it is started. No Textual here."""

from __future__ import annotations

from dataclasses import dataclass

from daq.bench.end_condition import NEVER, EndCondition


@dataclass(frozen=True, slots=True)
class TestPlan:
    """What was entered when a test was started.

    Attributes
    ----------
    operator : str or None
        None: that of the bench file.
    note : str
        Recorded as a mark at the start.
    end : EndCondition
        When the recording ends by itself; its recorder sees to it.
    """

    operator: str | None = None
    note: str = ""
    end: EndCondition = NEVER

    __test__ = False  # for pytest
