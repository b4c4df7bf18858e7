"""The form for what is common to all sensors of a bench: names, limits, end of a test."""

from __future__ import annotations

from pathlib import Path

from textual import on
from textual.widgets import Input

from daq.bench.end_condition import EndCondition
from daq.bench.masks.mask import NOISE_MODELS
from daq.devices.bench_file import parse
from daq.errors import BenchFileError
from tui.application.forms.form import Field, Form
from tui.runs.first_bench import answers_in, with_answers, with_limits

HINTS = {
    "operator": "Who does the tests. Recordings and reports name the operator.",
    "names": "A name for each sensor, in the order of the rows, such as: A B C.",
    "axes": "Where the channels of every sensor point to, such as: east north up. May be empty.",
    "limits": "Most noise: a data sheet (brochure.csv), a model"
    f" ({', '.join(NOISE_MODELS)}), or noise at the ends of the band in µg/√Hz (2 0.5); several:"
    " semicolons between.",
    "end": "decided: when the limits are · 5 %: when the c.o.v. is that · 3h: after this"
    " time · several: the first of them. Empty: x stops a test.",
    "unit": "Of results, such as m/s² or g. Empty: that of the first channel.",
    "name": "The name of the bench, in recordings and reports.",
    "location": "Where the bench is. May be empty.",
}
TITLES = {"names": "sensors", "name": "bench", "unit": "unit of results", "end": "a test ends"}


class BenchForm(Form[str]):
    """Asks for what a bench file says of all sensors; returns its text.

    Parameters
    ----------
    text : str
        Of the bench file. Comments, and what is not asked for, stay.
    path : Path
        Of the bench file: files of limits are beside it.
    is_first : bool
        Whether sensors are named here too: nothing refers to their names yet.
    """

    HINTS = HINTS

    def __init__(self, text: str, path: Path, *, is_first: bool = False) -> None:
        self._text, self._path = text, path
        self._given = answers_in(text)
        self._decided = f"decided, {self._given['end']}".removesuffix(", ")
        if not is_first:
            del self._given["names"]
        fields = [Field(key, TITLES.get(key, key), value) for key, value in self._given.items()]
        super().__init__("first bench" if is_first else "bench", fields, does="saves")

    def problem(self, name: str) -> str:
        """Return what is wrong with a field; empty if nothing is."""
        try:
            if name == "end":
                end = EndCondition.of_text(self.value(name))
                if end.decided and not self.value("limits"):
                    return "decided: without limits; expected a time or a precision"
            elif name == "limits":
                with_limits(self._text, self.value(name))
            elif self.value(name) != self._given[name]:  # to parse comments takes 0.1 s
                with_answers(self._text, {name: self.value(name)})
        except ValueError as error:
            return str(error)
        return ""

    @on(Input.Changed, "#limits")
    def _on_limits(self) -> None:
        """Show the usual end of a test with limits, unless another one was typed."""
        end, given = self.query_one("#end", Input), self._given["end"]
        if not self._given["limits"] and end.value in {given, self._decided}:
            end.value = self._decided if self.value("limits") else given

    def submit(self) -> None:
        """Save what is a bench file without errors."""
        answers = {name: self.value(name) for name in self._given}
        try:
            text = with_answers(self._text, answers)
            parse(text, self._path)
        except BenchFileError as error:
            self.show_message(str(error.faults[0]), is_wrong=True)
        except ValueError as error:
            self.show_message(str(error), is_wrong=True)
        else:
            self.dismiss(text)
