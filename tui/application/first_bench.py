"""The first bench: what answers on the ports of this computer, live, until it is a bench file."""

from __future__ import annotations

import threading
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from rich.console import Group, RenderableType
from rich.text import Text
from textual import work
from textual.app import ComposeResult, SystemCommand
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.screen import Screen
from textual.widgets import Static

from daq.bench.editing import without_sensor
from daq.bench.loading import parse
from daq.errors import BenchFileError, HuddleError
from estimator.wording import listed, several
from tui.application.bench_view.sensors import (
    LEAST_TRACE,
    columns,
    motion_of,
    name_cell,
    tail,
    tapped,
    trace,
    width_of,
)
from tui.application.dialogs import COMMON, KEY_STYLE, TextScreen
from tui.application.forms.bench import BenchForm
from tui.application.forms.form import Field, Form
from tui.application.forms.sensor import PortForm, SensorForm, sensor_table
from tui.application.themes import ThemedApp
from tui.application.view import BAD, COMMON_KEYS, MUTED, KeyLine
from tui.page.blocks import KeyValues
from tui.page.terminal import terminal_pairs
from tui.runs.first_bench import is_open, with_device, with_rate

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from textual.driver import Driver

    from daq.bench.model import Bench
    from daq.preflight.device_check import DiscoveredDevice
    from daq.preflight.preview import SensorPreview

KEYS = (
    ("enter", "state a missing sensitivity, then name the bench, and write its file"),
    ("n", "search a port, a host or a network"),
    ("r", "search the serial ports again"),
    ("↑ ↓", "choose a sensor"),
    ("e", "edit the chosen sensor: name, sensitivity, settings"),
    ("a", "add a sensor by its driver, where none answers"),
    ("del", "leave the chosen sensor out"),
)
WIDEST_PORT = 24
"""Columns for the name of a port."""


class FirstBenchControls(Protocol):
    """What the first bench asks of the computer."""

    path: Path
    """The bench file to write."""
    text: str
    """What it has so far."""
    ports: Sequence[str]
    """The serial ports."""

    def listed_ports(self) -> Sequence[tuple[str, str]]:
        """Return ports that drivers list, such as CAN buses, and what they are. Blocks."""

    def network_ports(self, target: str) -> Sequence[str]:
        """Return the ports to search for a port, a host or a network. Blocks."""

    def find_devices(self, port: str) -> Sequence[DiscoveredDevice]:
        """Return the devices on a port. Blocks."""

    def read(
        self,
        bench: Bench,
        show: Callable[[tuple[SensorPreview, ...]], None],
        ended: threading.Event,
    ) -> None:
        """Show the sensors of a bench again and again, until `ended` is set. Blocks."""

    def save(self, text: str) -> None:
        """Write the bench file."""


class NetworkForm(Form[list[str]]):
    """Asks for ports, hosts and networks to search."""

    def __init__(self) -> None:
        fields = (Field("targets", "search", placeholder="192.168.0.0/24 or socket://host:4001"),)
        super().__init__("network", fields, does="searches")

    def hint(self, name: str) -> str:
        """Return what may be searched."""
        del name
        return (
            "Hosts and networks are searched for Modbus and serial servers; a port, such as"
            " socket://192.168.0.5:4001 or /dev/pts/3, for devices. Several: blanks between."
        )

    def problem(self, name: str) -> str:
        """Return what is missing."""
        return "" if self.value(name) else "expected a host, a network or a port"

    def submit(self) -> None:
        """Search."""
        self.dismiss(self.value("targets").split())


class FirstBenchScreen(Screen[None]):
    """A row for each sensor that answers, with its motion; and what else the ports said."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("enter", "go_on", "Go on", key_display="enter"),
        Binding("n", "network", "Network"),
        Binding("r", "search", "Search"),
        Binding("down", "choose_next(1)", "Choose", show=False),
        Binding("up", "choose_next(-1)", "Choose", show=False),
        Binding("e", "edit", "Edit"),
        Binding("a", "add", "Add"),
        Binding("delete", "remove", "Remove", key_display="del"),
    ]

    def __init__(self, controls: FirstBenchControls) -> None:
        super().__init__()
        self._controls = controls
        self._text = controls.text
        self._bench: Bench | None = None
        self._searched: dict[str, str] = {}
        self._devices: dict[str, Sequence[DiscoveredDevice]] = {}
        self._live: dict[str, SensorPreview] = {}
        self._ended: threading.Event | None = None
        self._chosen, self._note = "", ""
        self._stated: set[str] = set()
        self._is_ready = False

    def compose(self) -> ComposeResult:
        """Lay out the rows."""
        yield Static(id="status")
        with VerticalScroll(id="bench", can_focus=False):
            yield Static(id="table")
        yield Static(id="alert")
        yield Static(id="progress")
        yield KeyLine()

    def on_mount(self) -> None:
        """Search the serial ports."""
        self._is_ready = True
        self._use(self._text)
        self.action_search()
        self._list()

    def on_unmount(self) -> None:
        """Release the ports."""
        self._end_reading()

    def on_resize(self) -> None:
        """Fit the terminal's size."""
        self._draw()

    def action_help(self) -> None:
        """Say what the keys do, and what a first bench needs."""
        self.app.push_screen(TextScreen("huddle: first bench", help_of_first_bench))

    # ------------------------------------------------------------------ searching

    @property
    def _is_searching(self) -> bool:
        return any(said == "searching …" for said in self._searched.values())

    @property
    def _known_ports(self) -> set[str]:
        return set() if self._bench is None else {each.port for each in self._bench.sensors}

    def action_search(self) -> None:
        """Search the serial ports that no sensor is known on."""
        used = {port for port, found in self._devices.items() if found} | self._known_ports
        self._begin([port for port in self._controls.ports if port not in used])

    def action_network(self) -> None:
        """Ask what to search."""

        def search(targets: list[str] | None) -> None:
            if targets:
                self._note = f"looking for hosts: {listed(targets)} …"
                self._draw()
                self._expand(targets)

        self.app.push_screen(NetworkForm(), search)

    @work(thread=True, group="list")
    def _list(self) -> None:
        listed = self._controls.listed_ports()
        if listed and self.app.is_running:
            self.app.call_from_thread(self._show_listed, listed)

    def _show_listed(self, ports: Sequence[tuple[str, str]]) -> None:
        self._searched |= {port: f"{about}; a adds it" for port, about in ports}
        self._draw()

    @work(thread=True, group="network")
    def _expand(self, targets: Sequence[str]) -> None:
        found: list[str] = []
        note = ""
        for target in targets:
            try:
                ports = self._controls.network_ports(target)
            except (HuddleError, OSError) as error:
                note = str(error)
                continue
            note = note or ("" if ports else f"{target}: no host answers")
            found += ports
        self.app.call_from_thread(self._begin, found, note)

    def _begin(self, ports: Sequence[str], note: str = "") -> None:
        self._note = note
        new = [port for port in ports if self._searched.get(port) != "searching …"]
        if new:
            self._end_reading()
        for port in new:
            self._searched[port] = "searching …"
            self._search(port)
        self._draw()

    @work(thread=True, group="search")
    def _search(self, port: str) -> None:
        found: Sequence[DiscoveredDevice] = ()
        try:
            found = self._controls.find_devices(port)
            said = "" if found else "no reply"
        except (HuddleError, OSError) as error:
            said = str(error).removeprefix(f"port {port}: ")
        if self.app.is_running:
            self.app.call_from_thread(self._found, port, found, said)

    def _found(self, port: str, devices: Sequence[DiscoveredDevice], said: str) -> None:
        self._searched[port], self._devices[port] = said, devices
        if self._is_searching:
            self._draw()
            return
        text = self._text  # all at once: names follow the ports, whichever answers first
        known = self._known_ports
        for one in self._searched:
            for device in self._devices.get(one, ()):
                before, text = text, (text if one in known else with_device(text, device))
                if text == before and one not in known:
                    about = f"{device.driver}: {device.remark or 'answers'}"
                    self._searched[one] = f"{about}; its channels are not known: a adds it"
        self._use(text)

    # -------------------------------------------------------------------- reading

    def _use(self, text: str) -> None:
        """Take a text as the bench, and read its sensors."""
        self._end_reading()
        self._text = text
        try:
            self._bench = parse(text, self._controls.path)
        except BenchFileError:  # it has no sensors yet
            self._bench = None
        if self._bench is not None and not self._is_searching:
            self._ended = threading.Event()
            self._read(self._bench, self._ended)
        self._draw()

    def _end_reading(self) -> None:
        if self._ended is not None:
            self._ended.set()
        self._ended, self._live = None, {}

    @work(thread=True, group="preview")
    def _read(self, bench: Bench, ended: threading.Event) -> None:
        def show(sensors: tuple[SensorPreview, ...]) -> None:
            if not ended.is_set() and self.app.is_running:
                self.app.call_from_thread(self._show, sensors, ended)

        try:
            self._controls.read(bench, show, ended)
        except (HuddleError, OSError) as error:
            if self.app.is_running:
                self.app.call_from_thread(self._say, str(error))

    def _show(self, sensors: tuple[SensorPreview, ...], ended: threading.Event) -> None:
        if not ended.is_set():
            self._live = {each.sensor.name: each for each in sensors}
            self._draw()

    def _say(self, text: str) -> None:
        self._note = text
        self._draw()

    # -------------------------------------------------------------------- drawing

    def _draw(self) -> None:
        if not self._is_ready:
            return
        width = self.app.size.width
        title = Text.assemble(
            (" first bench ", "bold reverse"), (f" {self._controls.path}", "bold")
        )
        self.query_one("#status", Static).update(title)
        shown = Text("\n\n", no_wrap=True).join(self._parts(width - 4))
        self.query_one("#table", Static).update(shown)
        said = [self._note, *(each.trouble for each in self._live.values())]
        lines = "\n".join(f"▲ {line}" for line in said if line)
        self.set_class(bool(lines), "-alert")
        self.query_one("#alert", Static).update(Text(lines, BAD))
        self.query_one("#progress", Static).update(Text(self._todo(), MUTED))

    def _parts(self, width: int) -> list[Text]:
        parts = []
        if self._bench is not None:
            parts.append(sensor_rows(self._bench, self._live, self._chosen, width=width))
        rows = [
            [Text(tail(port, width // 2)), Text(said, MUTED)]
            for port, said in self._searched.items()
            if said
        ]
        if rows:
            parts.append(columns(("port", "answer"), rows))
        if not parts:
            parts.append(Text("This computer has no serial port. n searches the network."))
        return parts

    def _todo(self) -> str:
        if self._is_searching:
            n_left = sum(said == "searching …" for said in self._searched.values())
            return f"searching {several(n_left, 'port')}: text, Epson, Modbus; up to half a minute"
        if self._bench is None:
            return "no sensor answers · n searches the network · r again · a adds by driver"
        if (name := self._open()) is not None:
            return f"{name}: state its sensitivity (enter)"
        n = len(self._bench.sensors)
        more = {1: "; its noise takes more", 2: " need changing motion"}.get(n, "")
        return f"{several(n, 'sensor')}{more} · tap one: its row lights up · enter goes on"

    # --------------------------------------------------------------------- editing

    def _names(self) -> list[str]:
        return [] if self._bench is None else [each.name for each in self._bench.sensors]

    def _open(self) -> str | None:
        """Return the first sensor whose sensitivity nobody has stated: 1 may be the right one."""
        names = (name for name in self._names() if name not in self._stated)
        return next((name for name in names if is_open(sensor_table(self._text, name))), None)

    def action_choose(self, name: str) -> None:
        """Choose a sensor."""
        self._chosen = name
        self._draw()

    def action_choose_next(self, step: int) -> None:
        """Choose the sensor below, or above."""
        if names := self._names():
            at = names.index(self._chosen) + step if self._chosen in names else min(0, step)
            self.action_choose(names[at % len(names)])

    def action_edit(self, name: str = "") -> None:
        """Ask for what is to change of a sensor."""
        name = name or self._chosen
        if name not in self._names():
            self.action_choose_next(1)
            return
        table, now = sensor_table(self._text, name), self._live.get(name)
        if is_open(table) and now is not None and now.measured_rate is not None:
            self._text = with_rate(self._text, name, float(f"{now.measured_rate:.3g}"))
            table = sensor_table(self._text, name)
        form = SensorForm(self._text, str(table["driver"]), table, replaces=name)
        self.app.push_screen(form, partial(self._edited, name=name))

    def action_add(self) -> None:
        """Ask for a sensor that does not answer by itself."""
        self._end_reading()

        def ask(found: tuple[str, dict[str, Any]] | None) -> None:
            if found is None:
                self._use(self._text)
            else:
                self.app.push_screen(SensorForm(self._text, *found), self._edited)

        self.app.push_screen(PortForm(self._controls.find_devices), ask)

    def action_remove(self) -> None:
        """Leave a sensor out; a search finds it again."""
        if self._chosen in self._names():
            for port, found in list(self._devices.items()):
                if any(port == each.port for each in found):
                    self._devices.pop(port)
            self._use(without_sensor(self._text, self._chosen))

    def _edited(self, text: str | None, *, name: str = "") -> None:
        """Take what was typed for a sensor; it may have another name now."""
        before = set(self._names()) - {name}
        self._use(self._text if text is None else text)
        if text is not None:
            self._stated |= set(self._names()) - before

    def action_go_on(self) -> None:
        """Ask for the sensitivity of a sensor, or for all that is common; then write the file."""
        if self._bench is None or self._is_searching:
            return
        if (name := self._open()) is not None:
            self.action_edit(name)
            return
        form = BenchForm(self._text, self._controls.path, is_first=True)
        self.app.push_screen(form, self._save)

    def _save(self, text: str | None) -> None:
        if text is None:
            return
        try:
            self._controls.save(text)
        except (HuddleError, OSError) as error:
            self._say(str(error))
            return
        self._end_reading()
        self.app.exit(self._controls.path)


class FirstBenchApp(ThemedApp[Path]):
    """Finds sensors, asks for the rest, and writes a bench file; returns its path.

    Parameters
    ----------
    controls : FirstBenchControls
    driver : type, optional
        Of the terminal; Textual's own, if not given.
    """

    CSS_PATH = "huddle.tcss"
    TITLE = "huddle"
    BINDINGS: ClassVar[list[BindingType]] = [*COMMON_KEYS]

    def __init__(self, controls: FirstBenchControls, driver: type[Driver] | None = None) -> None:
        super().__init__(driver)
        self._controls = controls

    def on_mount(self) -> None:
        """Show what answers."""
        self.push_screen(FirstBenchScreen(self._controls))

    def get_system_commands(self, screen: Screen[object]) -> Iterable[SystemCommand]:
        """Yield the commands of the palette: what the keys do, and the common ones."""
        for each in FirstBenchScreen.BINDINGS if isinstance(screen, FirstBenchScreen) else ():
            if isinstance(each, Binding) and each.show:
                does = partial(self.run_action, each.action, screen)
                yield SystemCommand(
                    each.description, dict(KEYS)[each.key_display or each.key], does
                )
        yield from super().get_system_commands(screen)


def help_of_first_bench() -> RenderableType:
    """Return the keys, and how a bench file comes about."""
    return Group(
        "The ports are searched for sensors. What answers is read live: tap a sensor, and its row"
        " lights up. Three sensors make a bench; two need motion that changes. enter writes the"
        " bench file, and the application opens on it.",
        "",
        terminal_pairs(KeyValues((*KEYS, *COMMON)), KEY_STYLE),
    )


def sensor_rows(
    bench: Bench, live: Mapping[str, SensorPreview], chosen: str, *, width: int
) -> Text:
    """Return a row per sensor: name, identity, port, and the size of its motion as a trace.

    The row of the sensor that is tapped lights up.
    """
    hit = tapped(list(live.values()))
    rows = []
    for sensor in bench.sensors:
        answers = f"{sensor.driver} {sensor.model}".strip()
        port = tail(sensor.port, min(WIDEST_PORT, width // 6))
        state = _state(live.get(sensor.name), is_hit=sensor.name == hit)
        cells = [*map(Text, (answers, sensor.serial_number, port)), state]
        if sensor.name == hit:
            cells = [Text(cell.plain, "reverse") for cell in cells]
        rows.append([name_cell(sensor.name, chosen), *cells])
    titles = ("sensor", "answers as", "serial no.", "port", "state")
    room = min(max(LEAST_TRACE, width - width_of(titles, rows)), 2 * WIDEST_PORT)
    for row, sensor in zip(rows, bench.sensors, strict=True):
        now = live.get(sensor.name)
        shown = "" if now is None else trace(motion_of(now), width=room)
        row.append(Text(shown, "bold #e9d86b" if sensor.name == hit else "#4cc9f0"))
    return columns((*titles, "motion, 10 s"), rows)


def _state(now: SensorPreview | None, *, is_hit: bool) -> Text:
    if is_hit:
        return Text("◀ tapped")
    if now is None:
        return Text("○", MUTED)
    if now.trouble:
        return Text("▲ trouble", BAD)
    return Text("● live", "green") if len(now.samples) else Text("○ waiting", "yellow")
