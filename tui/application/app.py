"""The Textual application: starts, stops and marks recordings, and writes reports."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar

from textual import work
from textual.binding import Binding, BindingType

from daq.bench.end_condition import NEVER, EndCondition
from daq.errors import HuddleError
from daq.whole_file import write_whole
from estimator.wording import clock_time
from tui.application.dialogs import MarkScreen, QuestionScreen, StopScreen, on_answer
from tui.application.following import FollowingApp
from tui.application.forms.form import Field, Form
from tui.application.forms.issue import IssueForm
from tui.application.messages import ErrorReported, RecordingOpened
from tui.application.plan import TestPlan
from tui.application.reference import can_open
from tui.application.state import TITLES, VIEWS
from tui.application.view import COMMON_KEYS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from textual.driver import Driver

    from daq.bench.masks.mask import Mask
    from daq.bench.model import Bench
    from daq.results.result import Result
    from tui.application.controls import Controls

HINTS = {
    "operator": "Who does the test. Recording and report name the operator.",
    "note": "What is special about this test. Recorded as a mark at its start.",
    "end": "3h: after this time · 5 %: when the c.o.v. is 5 % · decided: when the limits"
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

    HINTS = HINTS

    def __init__(self, bench: Bench | None, kept: str) -> None:
        self._operator = "" if bench is None else bench.operator
        usual = NEVER if bench is None else bench.usual_end
        self._has_limits = bench is not None and bench.has_limits
        fields = (
            Field("operator", "operator", self._operator),
            Field("note", "note"),
            Field("end", "ends", usual.text, "when x stops it"),
        )
        title = f"start a test; {kept} is kept" if kept else "start a test"
        super().__init__(title, fields, does="starts")

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


CONNECTING = "connecting to the sensors …"
SLOW_REMARK = 2.0  # seconds that writing a remark may take before the mark says so


class HuddleApp(FollowingApp):
    """One bench or one recording.

    Parameters
    ----------
    controls : Controls
        Starts, stops, marks and finds recorders; knows the bench.
    path : Path, optional
        Recording to follow from the start.
    start : bool
        Whether to start a recording when the application opens.
    models : tuple of Mask
        Noise models to show beside the curves; in a unit of motion.
    driver : type, optional
        Of the terminal; Textual's own, if not given.
    """

    CSS_PATH = "huddle.tcss"
    TITLE = "huddle"
    BINDINGS: ClassVar[list[BindingType]] = [
        *(
            Binding(str(number), f"view('{name}')", TITLES[name], show=False)
            for number, name in enumerate(VIEWS, start=1)
        ),
        *COMMON_KEYS,
    ]

    def __init__(
        self,
        controls: Controls,
        *,
        path: Path | None = None,
        start: bool = False,
        models: tuple[Mask, ...] = (),
        driver: type[Driver] | None = None,
    ) -> None:
        super().__init__(controls, models, driver)
        self._given = path
        self._authority = ""
        self._asked_of: dict[Path, Mapping[str, str]] = {}
        self._start_at_once = start

    def on_mount(self) -> None:
        """Follow a recording that is given or already runs."""
        if self._given is not None:
            self.post_message(RecordingOpened(self._given))
        elif self._start_at_once:
            bench = self._controls.bench
            duration = None if bench is None else bench.recording.duration
            self._begin(TestPlan(end=EndCondition(duration)))
        else:
            self._find_running()

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Offer only what can be done now."""
        del parameters
        if action == "start":
            state = self.state
            return state.can_start and not state.is_recording and not state.is_starting
        if action in {"stop", "mark"}:
            return self.state.is_recording and self.state.now is not None
        if action == "save":
            return self.state.snapshot is not None and self.state.path is not None
        if action in {"report", "open_report", "issue"}:
            return self.state.has_result
        return True

    def action_start(self) -> None:
        """Ask what is wanted of a test, and start a recorder."""
        kept = "" if self.state.path is None else self.state.path.name
        form = StartForm(self._controls.bench, kept)
        self.push_screen(form, on_answer(partial(self._begin, checked=True)))

    def _note(self, note: str) -> None:
        self.state = replace(self.state, note=note)

    def _confirm(self, plan: TestPlan, wrong: Sequence[str]) -> None:
        """Start what the check list forbids, once that has been confirmed."""

        def begin(really: bool | None) -> None:
            if really:
                self._begin(plan)
            else:
                failure = "\n".join(wrong)
                self.state = replace(self.state, is_starting=False, note="", failure=failure)

        lines = "\n".join(f"✗ {line}" for line in wrong)
        question = QuestionScreen(
            "not ready", f"{lines}\n\nStart the test all the same?", does="starts it anyway"
        )
        self.push_screen(question, begin)

    def _begin(self, plan: TestPlan, *, checked: bool = False) -> None:
        note = "checking the sensors …" if checked else CONNECTING
        self.state = replace(self.state, is_starting=True, failure="", note=note)
        self._start(plan, checked=checked)

    @work(thread=True, group="control", exclusive=True)
    def _start(self, plan: TestPlan, *, checked: bool) -> None:
        if checked:
            wrong = self._try(partial(self._controls.check, plan))
            if wrong is None:
                return
            if wrong:
                self.call_from_thread(self._confirm, plan, wrong)
                return
            self.call_from_thread(self._note, CONNECTING)
        path = self._try(partial(self._controls.start, plan))
        if path is not None:
            self.post_message(RecordingOpened(path))
            if plan.note:
                self._try(partial(self._controls.mark, path, plan.note))

    @work(thread=True, group="control", exclusive=True)
    def _find_running(self) -> None:
        path = self._try(self._controls.find_running)
        if path is not None:
            self.post_message(RecordingOpened(path))

    def action_stop(self) -> None:
        """Stop the recorder, once that has been confirmed."""
        if self.state.path is None or self.state.now is None:
            return
        path = self.state.path

        def stop(_: bool) -> None:
            self.state = replace(self.state, note="stopping …")
            self._control(path, "stop")

        self.push_screen(StopScreen(clock_time(self.state.now.elapsed)), on_answer(stop))

    def action_mark(self) -> None:
        """Ask for a remark and mark the moment."""
        if self.state.path is None:
            return
        path, began = self.state.path, time.monotonic()

        def mark(text: str) -> None:
            ago = time.monotonic() - began
            self._control(path, "mark", text + (f" ({ago:.0f} s ago)" * (ago >= SLOW_REMARK)))

        self.push_screen(MarkScreen(), on_answer(mark))

    @work(thread=True, group="control")
    def _control(self, path: Path, what: str, text: str = "") -> None:
        def send() -> bool:
            if what == "stop":
                self._controls.stop(path)
            else:
                self._controls.mark(path, text)
            return True

        if self._try(send) and what == "mark":
            self.call_from_thread(self.notify, f"marked: {text}", timeout=3, markup=False)

    def action_report(self) -> None:
        """Write the report of the test that has ended."""
        self._write_report(is_opened=False)

    def action_open_report(self) -> None:
        """Open the report of the test that has ended."""
        self._write_report(is_opened=True)

    def _write_report(self, *, is_opened: bool) -> None:
        path, result = self.state.path, self.state.result
        if path is None or result is None or not result.snapshot.closed:
            return
        self.notify("writing the report …", timeout=3)
        self._report(path, result, is_opened=is_opened)

    @work(thread=True, group="control", description="a report is written")
    def _report(self, path: Path, result: Result, *, is_opened: bool) -> None:
        with self._reading:
            report = self._try(lambda: self._controls.report(path, result))
        if report is None:
            return
        notify = partial(self.call_from_thread, self.notify, f"{report}", timeout=15, markup=False)
        if is_opened and not can_open():
            notify(title="Report written; this terminal has no browser to open it in")
        elif is_opened:
            self.call_from_thread(self.open_url, report.resolve().as_uri())
        else:
            notify(title="Report written")

    def action_issue(self) -> None:
        """Ask who authorises a certificate, and issue it; without anybody, make a specimen."""
        path, result = self.state.path, self.state.result
        if path is None or result is None or not result.snapshot.closed:
            return

        def issue(wanted: Mapping[str, str]) -> None:
            self._asked_of[path] = wanted
            self.notify("verifying the recording, making the certificate …", timeout=5)
            self._issue(path, result, wanted)

        usual = {"by": self._authority} if self._authority else {}
        form = IssueForm(path.name, self._asked_of.get(path, usual))
        self.push_screen(form, on_answer(issue))

    @work(thread=True, group="control", description="a certificate is issued")
    def _issue(self, path: Path, result: Result, wanted: Mapping[str, str]) -> None:
        try:
            with self._reading:
                made = self._controls.certify(path, result, wanted)
        except (HuddleError, OSError) as error:
            self.call_from_thread(self._refused, wanted, f"{error}")
            return
        self._authority = wanted["by"] or self._authority
        self._asked_of.pop(path, None)  # a revision has another reason
        what = "Certificate issued" if wanted["by"] else "Specimen made"
        self.call_from_thread(self.notify, f"{made}", title=what, timeout=15, markup=False)

    def _refused(self, wanted: Mapping[str, str], why: str) -> None:
        """Say why there is no certificate, and offer a specimen."""
        if not wanted["by"]:
            self.post_message(ErrorReported(why))
            return

        def make(really: bool | None) -> None:
            path, result = self.state.path, self.state.result
            if really and path and result:
                self._issue(path, result, {**wanted, "by": ""})

        text = f"{why}\n\nMake a specimen instead?"
        question = QuestionScreen("no certificate", text, does="makes a specimen")
        self.push_screen(question, make)

    def action_save(self) -> None:
        """Write the estimate as CSV and JSON, and the screen as a picture (SVG)."""
        if self.state.path is not None and self.state.result is not None:
            picture = self.export_screenshot(title=self.state.path.name)
            self._save(self.state.path, picture, self.state.result)

    @work(thread=True, group="control", description="the result is saved")
    def _save(self, path: Path, picture: str, result: Result) -> None:
        files = self._try(partial(self._controls.save, path, result))
        if files is None:
            return
        drawn = files[0].with_suffix(".svg")
        if self._try(partial(write_whole, drawn, picture.encode())) is not None:
            names = ", ".join(file.name for file in (*files, drawn))
            text = f"{names} in {drawn.parent}"
            self.call_from_thread(self.notify, text, title="Written", timeout=10, markup=False)
