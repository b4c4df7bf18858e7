"""The Bench view: the sensors before a test, live, and whether all is ready."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from rich.text import Text
from textual import on, work
from textual.binding import Binding, BindingType
from textual.command import CommandPalette
from textual.containers import VerticalScroll
from textual.widgets import Static

from daq.bench.editing import without_sensor
from daq.bench.masks.mask import NOISE_MODELS
from daq.errors import HuddleError
from tui.application.bench_view.sensors import (
    channel_traces,
    checks,
    sensor_states,
    sensors_of_bench,
    spectra,
)
from tui.application.dialogs import QuestionScreen, TextScreen, on_answer
from tui.application.forms.bench import BenchForm
from tui.application.forms.certificate import CertificateForm
from tui.application.forms.sensor import PortForm, SensorForm, sensor_table
from tui.application.messages import BenchEdited, ErrorReported, PreviewUpdated
from tui.application.state import BENCH, State
from tui.application.test_view.plot import PsdPlot
from tui.application.test_view.units import SpectrumUnit
from tui.application.view import BAD, MUTED, View

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from textual.app import ComposeResult

    from daq.preflight.preview import SensorPreview
    from tui.application.controls import Controls, Preview
    from tui.application.forms.form import Form


SITES = tuple(NOISE_MODELS[name] for name in ("nlnm", "nhnm"))
"""Noise models beside the spectra, if no others were chosen."""
OVER_LIVE = (TextScreen, CommandPalette)
"""Screens over the view under which the sensors are read on."""
RESUMES_AFTER = 0.3
"""Seconds in which the answer of a dialog becomes the state: a test that starts needs the ports."""
MOST_LINES = 6
"""Lines of findings that are shown."""
CHECKED_EVERY = 2
"""Updates of the traces from one check to the next: both take as long."""


class BenchView(View):
    """The sensors of the bench, and why a recording could not be started."""

    VIEW = BENCH
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("p", "preview", "Check sensors"),
        Binding("s", "app.start", "Start test"),
        Binding("f", "freeze", "Freeze"),
        Binding("g", "spectra", "Spectra"),
        Binding("down", "choose_next(1)", "Choose", key_display="↑↓", show=False),
        Binding("up", "choose_next(-1)", "Choose", show=False),
        Binding("a", "add", "Add"),
        Binding("e", "edit", "Edit"),
        Binding("l", "limits", "Limits", show=False),
        Binding("c", "certificate", "Certificate", show=False),
        Binding("delete", "remove", "Remove", key_display="del", show=False),
        Binding("x", "app.stop", "Stop"),
        Binding("m", "app.mark", "Mark"),
    ]
    TASKS = (
        ("Start a test", "app.start"),
        ("Stop the test", "app.stop"),
        ("Mark this moment with a remark", "app.mark"),
        ("Check the sensors, live", "preview"),
        ("Show the spectra of all channels before a test", "spectra"),
        ("Add a sensor", "add"),
        ("Change the chosen sensor", "edit"),
        ("Remove the chosen sensor", "remove"),
        ("Change limits, end of a test, operator, and what else the bench file says", "limits"),
    )
    KEYS = (
        ("p", "check the sensors: read them live without recording; p again ends it"),
        ("f", "freeze the traces; f again lets them go on"),
        ("g", "spectra of all channels beside noise models, in place of traces: hum, and siting"),
        ("↑ ↓, click", "choose a sensor"),
        ("a", "add a sensor: huddle looks what is on its port, if you do not name a driver"),
        ("e", "change the chosen sensor in the bench file; comments there stay"),
        ("del", "remove the chosen sensor from the bench file; asked before"),
        ("l", "limits, end of a test, operator, axes, unit of results; kept in the bench file"),
        ("c", "what certificates say of laboratory, customer and order; kept in the bench file"),
        ("s", "start a test: operator, note, and when it ends by itself"),
    )

    def __init__(self, state: State, controls: Controls) -> None:
        super().__init__(state)
        self._controls = controls
        self._sensors: Sequence[SensorPreview] = ()
        self._ended: threading.Event | None = None
        self._is_frozen = self._shows_spectra = self._resumes = False
        self._chosen = ""
        self._n_lines, self._alert = (-1, -1), ""
        self._findings: list[Text] = []
        self._n_updates = 0

    def parts(self) -> ComposeResult:
        """Yield the sensors, what is wrong, and one line on what to do."""
        with VerticalScroll(id="bench", can_focus=False):
            yield Static(id="table")
        yield PsdPlot(id="spectra")
        yield Static(id="alert")
        yield Static(id="progress")

    def draw(self) -> None:
        """Draw the state."""
        state = self.state
        if (state.is_starting or state.is_recording) and self._ended is not None:
            self.end_preview()
        is_live = self._ended is not None and bool(self._sensors)
        table = self.query_one("#table", Static)
        if is_live:
            width = self.app.size.width - 4
            shown = sensor_states(
                self._sensors, width=width, chosen=self._chosen, is_frozen=self._is_frozen
            )
            if not self._shows_spectra:
                traces = channel_traces(self._sensors, width=width)
                shown = Text("\n\n", no_wrap=True).join((shown, traces))
        else:
            shown = sensors_of_bench(state, chosen=self._chosen)
        has_spectra = is_live and self._shows_spectra
        self.set_class(has_spectra, "-spectra")
        if has_spectra:
            self.call_after_refresh(self._draw_spectra)  # when the plot has its room
        lines = [Text(f"▲ {line}", BAD) for line in state.failure.splitlines()]
        lines += self._findings if is_live else []
        self.set_class(bool(lines), "-alert")
        if len(lines) > MOST_LINES:
            more = Text(f"and {len(lines) - MOST_LINES + 1} more", MUTED)
            lines = [*lines[: MOST_LINES - 2], more, lines[-1]]
        n_lines = shown.plain.count("\n"), len(lines)
        table.update(shown, layout=n_lines != self._n_lines)
        alert = Text("\n").join(lines)
        self.query_one("#alert", Static).update(alert, layout=alert.plain != self._alert)
        todo = Text(state.note or self._todo(), MUTED)
        self.query_one("#progress", Static).update(todo, layout=False)
        self._n_lines, self._alert = n_lines, alert.plain

    def _draw_spectra(self) -> None:
        shown = spectra(self._sensors, self.state.models or SITES)
        self.query_one("#spectra", PsdPlot).show(shown, unit=SpectrumUnit("dB", is_db=True))

    def _todo(self) -> str:
        if self._ended is not None:
            frozen = "frozen: f goes on · " if self._is_frozen else ""
            return f"{frozen}reading the sensors, nothing is recorded · p ends it"
        if self.check_action("preview", ()):
            return "p checks the sensors · s starts a test · l limits and end · ? helps"
        if self.state.can_start and not self.state.is_recording:
            return "s starts a test · ? helps"
        return "2 shows the test · ? helps"

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Offer only what can be done now."""
        del parameters
        state = self.state
        is_busy = state.is_recording or state.is_starting
        if action in {"add", "edit", "remove", "certificate", "limits"}:
            return state.can_start and not is_busy and state.bench is not None
        if action == "preview":
            return self._controls.preview is not None and state.can_start and not is_busy
        return self._ended is not None if action in {"freeze", "spectra"} else True

    def on_screen_suspend(self) -> None:
        """Release the ports, unless help or the palette lies over this view."""
        if self._ended is not None and not isinstance(self.app.screen, OVER_LIVE):
            self.end_preview()
            self._resumes = True
            self.show(self.state)

    def on_screen_resume(self) -> None:
        """Read the sensors again, if they were read before and no test is to start."""
        if self._resumes:
            self._resumes = False
            self.set_timer(RESUMES_AFTER, self._read_on)

    def _read_on(self) -> None:
        if self.is_current and self._ended is None and self.check_action("preview", ()):
            self.action_preview()

    def on_unmount(self) -> None:
        """Release the ports."""
        self.end_preview()

    def end_preview(self) -> None:
        """End reading the sensors; the ports are free a moment later."""
        if self._ended is not None:
            self._ended.set()
        self._ended, self._sensors, self._is_frozen = None, (), False

    def action_preview(self) -> None:
        """Read the sensors, or end that."""
        if self._ended is not None:
            self.end_preview()
        elif (preview := self._controls.preview) is not None:
            self._ended, self._n_updates = threading.Event(), 0
            self._read(preview, self._ended)
        self.show(self.state)
        self.refresh_bindings()

    # ------------------------------------------------------------ sensors of the file

    def action_choose(self, name: str) -> None:
        """Choose a sensor."""
        self._chosen = name
        self.show(self.state)

    def action_choose_next(self, step: int) -> None:
        """Choose the sensor below, or above."""
        names = [] if self.state.bench is None else [one.name for one in self.state.bench.sensors]
        if names:
            at = names.index(self._chosen) + step if self._chosen in names else min(0, step)
            self.action_choose(names[at % len(names)])

    def action_add(self) -> None:
        """Ask for a new sensor."""
        self.end_preview()

        def ask(found: tuple[str, dict[str, Any]]) -> None:
            self._ask(*found)

        self.app.push_screen(PortForm(self._controls.find_devices), on_answer(ask))

    def action_edit(self) -> None:
        """Ask for what is to change of the chosen sensor."""
        bench = self.state.bench
        sensor = (
            None
            if bench is None
            else next((one for one in bench.sensors if one.name == self._chosen), None)
        )
        if sensor is None:
            self.action_choose_next(1)
            return
        self.end_preview()
        self._ask(sensor.driver, None, replaces=sensor.name)

    def _ask(self, driver: str, values: Mapping[str, Any] | None, *, replaces: str = "") -> None:
        try:
            text = self._controls.read_bench()
        except (HuddleError, OSError) as error:
            self.app.post_message(ErrorReported(str(error)))
            return
        known = sensor_table(text, replaces) if values is None else values
        form = SensorForm(text, driver, known, replaces=replaces)
        self.app.push_screen(form, on_answer(self._save))

    def action_limits(self) -> None:
        """Ask for limits, and what else is common to all sensors."""
        path = self.state.bench.source if self.state.bench is not None else None
        self._fill_in(lambda text: BenchForm(text, path or Path("bench.toml")))

    def action_certificate(self) -> None:
        """Ask for what certificates say."""
        self._fill_in(CertificateForm)

    def _fill_in(self, form_of: Callable[[str], Form[str]]) -> None:
        try:
            form = form_of(self._controls.read_bench())
        except (HuddleError, OSError, ValueError) as error:
            self.app.post_message(ErrorReported(str(error)))
            return
        self.end_preview()
        self.app.push_screen(form, on_answer(self._save))

    def action_remove(self) -> None:
        """Remove the chosen sensor, once that has been confirmed."""
        name = self._chosen
        if self.state.bench is None or name not in {one.name for one in self.state.bench.sensors}:
            return

        def remove(_: bool) -> None:
            self._save(without_sensor(self._controls.read_bench(), name))

        question = f"Remove sensor {name} from the bench file?"
        dialog = QuestionScreen("remove", question, does="removes")
        self.app.push_screen(dialog, on_answer(remove))

    def _save(self, text: str) -> None:
        self.end_preview()
        self.app.post_message(BenchEdited(text))

    def action_freeze(self) -> None:
        """Keep the traces as they are, or let them go on."""
        self._is_frozen = not self._is_frozen
        self.show(self.state)

    def action_spectra(self) -> None:
        """Show the spectra of all channels, or their traces again."""
        self._shows_spectra = not self._shows_spectra
        self.show(self.state)

    @work(thread=True, group="preview")
    def _read(self, preview: Preview, ended: threading.Event) -> None:
        def post(sensors: tuple[SensorPreview, ...]) -> None:
            if not ended.is_set():
                self.post_message(PreviewUpdated(sensors))

        try:
            preview(post, ended)
        except (HuddleError, OSError) as error:
            self.post_message(ErrorReported(str(error)))
            self.call_later(lambda: self.action_preview() if self._ended is ended else None)

    @on(PreviewUpdated)
    def _on_preview(self, message: PreviewUpdated) -> None:
        if self._ended is not None and not self._is_frozen:
            self._sensors = message.sensors
            bench = self.state.bench
            if self._n_updates % CHECKED_EVERY == 0 and bench is not None:
                self._findings = checks(bench, self._sensors)
            self._n_updates += 1
            self.show(self.state)
