"""The form that starts a test: who, what, and until when."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daq.bench.end_condition import EndCondition
from tui.application.forms.form import Field, Form
from tui.application.plan import TestPlan

if TYPE_CHECKING:
    from daq.bench.model import Bench

HINTS = {
    "operator": "Who does the test. It stands in the recording and in the report.",
    "note": "What is special about this test. Recorded as a mark at its start.",
    "end": "3h: after this time · 5 %: when the noise is known to 5 % · decided: when the limits"
    " are · several: the first of them · empty: x stops it. The recorder sees to it: this"
    " application may be closed.",
}


class StartForm(Form[TestPlan]):
    """Asks what is wanted of a test; None if it is not to be started.

    Parameters
    ----------
    bench : Bench or None
        Fills the fields.
    kept : str
        Name of the recording that is shown now; empty for none.
    """

    def __init__(self, bench: Bench | None, kept: str) -> None:
        self._operator = "" if bench is None else bench.operator
        duration = None if bench is None else bench.recording.duration
        self._has_limits = bench is not None and bool(bench.limits)
        fields = (
            Field("operator", "operator", self._operator),
            Field("note", "note"),
            Field("end", "ends", EndCondition(duration).text, "when x stops it"),
        )
        title = f"start a test; {kept} is kept" if kept else "start a test"
        super().__init__(title, fields, does="starts")

    def hint(self, name: str) -> str:
        """Return what a field means."""
        return HINTS[name]

    def problem(self, name: str) -> str:
        """Return what is wrong with the end; empty if nothing is."""
        if name != "end":
            return ""
        try:
            end = EndCondition.of_text(self.value("end"))
        except ValueError as error:
            return str(error)
        if end.decided and not self._has_limits:
            return "decided: the bench file has no limits; expected a time or a precision"
        return ""

    def submit(self) -> None:
        """Start."""
        operator = self.value("operator")
        self.dismiss(
            TestPlan(
                operator=operator if operator != self._operator else None,
                note=self.value("note"),
                end=EndCondition.of_text(self.value("end")),
            )
        )
