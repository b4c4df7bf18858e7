"""The Recordings view: lists, filters, opens, estimates again and deletes recordings."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, ClassVar

from rich.text import Text
from textual import on, work
from textual.binding import Binding, BindingType
from textual.widgets import DataTable, Input, Static

from estimator.wording import clock_time
from tui.application import messages
from tui.application.dialogs import QuestionScreen, on_answer
from tui.application.forms.estimate import SettingsForm
from tui.application.state import RECORDINGS, RESULT, TEST, State
from tui.application.view import BAD, MUTED, View
from tui.runs.catalogue import Entry, catalogue
from tui.wording.formatting import is_known
from tui.wording.verdict_text import STYLES, WORDS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from textual.app import ComposeResult


COLUMNS = ("started, UTC", "verdict", "length", "bench", "size", "file")
"""What matters most comes first: a narrow terminal cuts the others."""


def row(entry: Entry, *, shown: bool = False, is_reference: bool = False) -> tuple[Text, ...]:
    """Return the cells of a recording; the one that is shown in the other views is marked."""
    started = "?" if entry.created is None else f"{entry.created:%Y-%m-%d %H:%M}"
    if entry.created is not None and not is_known(entry.created):
        started = "no date"
    mark = "▸" if shown else "≈" if is_reference else " "
    return (
        Text(f"{mark} {started}"),
        verdict(entry),
        Text(clock_time(entry.length) if entry.length else "–", justify="right"),
        Text(entry.place or "–", "bold"),
        Text(size(entry.size), justify="right"),
        Text(entry.path.name, MUTED),
    )


def verdict(entry: Entry) -> Text:
    """Return the verdict of the stored result, or why there is none."""
    if entry.problem:
        return Text("unreadable", BAD)
    if entry.is_growing:
        return Text("● recording", BAD)
    if entry.part_of or (entry.goes_on_in and not entry.has_result):
        return Text("part" if entry.part_of else "in parts", MUTED)
    if not entry.is_closed and entry.created is not None and not entry.has_result:
        return Text("left open", "yellow")
    if entry.verdict is not None:
        return Text(WORDS[entry.verdict], STYLES[entry.verdict])
    why = "not judged" if entry.has_limits else "no limits"
    return Text(why if entry.has_result else "no result", MUTED)


def about(entry: Entry) -> Text:
    """Return a line on a recording: what its row has no room for."""
    if entry.problem:
        return Text(entry.problem, BAD)
    parts = [str(entry.path)]
    if entry.operator:
        parts.append(f"operator {entry.operator}")
    if entry.part_of:
        parts.insert(0, f"continues {entry.part_of}: open that one for the result of all parts")
    elif entry.goes_on_in:
        parts.insert(0, f"goes on in {entry.goes_on_in}, the disk refused this file: one result")
    elif not (entry.is_closed or entry.is_growing) and entry.created is not None:
        parts.insert(0, f"its recorder did not close it: huddle repair {entry.path.name}")
    return Text(" · ".join(parts), MUTED)


def matches(entry: Entry, wanted: str) -> bool:
    """Return whether each word is in the row of a recording, in upper or lower case."""
    text = " ".join(cell.plain for cell in row(entry)).lower() + f" {entry.operator.lower()}"
    return all(word in text for word in wanted.lower().split())


def size(n_bytes: int) -> str:
    """Return a size of a file in its unit."""
    value, unit = float(n_bytes), "B"
    for larger in ("kB", "MB", "GB", "TB"):
        if value < 1000:
            break
        value, unit = value / 1000, larger
    return f"{value:.0f} {unit}" if value >= 10 or unit == "B" else f"{value:.1f} {unit}"


class RecordingTable(DataTable[Text]):
    """The list; enter opens a recording."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("enter", "select_cursor", "Open")]


class FilterLine(Input):
    """Words that a recording must have; escape forgets them."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape", "screen.clear_filter", "Clear")]


class RecordingsView(View):
    """What is in the folder of the bench."""

    VIEW = RECORDINGS
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("slash", "filter", "Filter", key_display="/"),
        Binding("e", "estimate", "Estimate"),
        Binding("c", "compare", "Compare"),
        Binding("p", "pin", "Pin", show=False),
        Binding("delete", "delete", "Delete", key_display="del"),
        Binding("r", "read", "Read again", show=False),
    ]
    TASKS = (
        ("Find a recording by words", "filter"),
        ("Keep the chosen recording of a service", "pin"),
        ("Delete the chosen recording", "delete"),
        ("Read the folder again", "read"),
    )
    KEYS = (
        ("↑ ↓ enter", "choose and open a recording: its result, or its test while it grows"),
        ("/", "show only recordings with these words: bench, date, verdict, file, operator"),
        ("e", "open it and estimate with other settings"),
        ("c", "compare it with what is shown: curves in 2, differences in 3"),
        ("p", "keep a recording of huddle serve whatever its limits of storage, or no longer"),
        ("del", "delete it with its results and reports; asked before"),
        ("r", "read the folder again"),
    )

    def __init__(self, state: State) -> None:
        super().__init__(state)
        self._entries: tuple[Entry, ...] = ()
        self._known: dict[object, Entry] = {}
        self._listed: list[Entry] = []
        self._gone = threading.Event()
        self._is_read = False

    def parts(self) -> ComposeResult:
        """Yield the list, the filter, and one line on the chosen recording."""
        yield RecordingTable(id="recordings", cursor_type="row", zebra_stripes=False)
        yield FilterLine(id="filter", placeholder="words, such as: lab pass 2026-11", compact=True)
        yield Static(id="about")

    def on_mount(self) -> None:
        """Name the columns."""
        self.query_one(RecordingTable).add_columns(*COLUMNS)
        super().on_mount()

    def on_screen_resume(self) -> None:
        """Read what has changed in the folder."""
        self.action_read()

    def on_unmount(self) -> None:
        """End reading."""
        self._gone.set()

    def draw(self) -> None:
        """Mark the recording that is shown."""
        self._list()

    # --------------------------------------------------------------------- reading

    def action_read(self) -> None:
        """Read the folder."""
        self._read()

    @work(thread=True, exclusive=True, group="catalogue")
    def _read(self) -> None:
        folder = self.state.folder
        known = {entry.path: entry for entry in self._entries}
        found = (
            []
            if folder is None
            else catalogue(folder, known, besides=self.state.path, cancelled=self._gone.is_set)
        )
        if not self._gone.is_set():
            self.post_message(messages.CatalogueRead(tuple(found)))

    @on(messages.CatalogueRead)
    def _on_read(self, message: messages.CatalogueRead) -> None:
        self._entries, self._is_read = message.entries, True
        self._list()

    def _list(self) -> None:
        """Write the rows; the cursor stays on its recording."""
        table, chosen = self.query_one(RecordingTable), self._chosen()
        wanted = self.query_one(FilterLine).value
        self._listed = [entry for entry in self._entries if matches(entry, wanted)]
        reference = self.state.reference
        table.clear()
        for entry in self._listed:
            table.add_row(
                *row(
                    entry,
                    shown=entry.path == self.state.path,
                    is_reference=reference is not None and entry.path == reference.path,
                )
            )
        paths = [entry.path for entry in self._listed]
        if chosen is not None and chosen.path in paths:
            table.move_cursor(row=paths.index(chosen.path), animate=False)
        self._write_about()
        self.refresh_bindings()

    def _chosen(self) -> Entry | None:
        row = self.query_one(RecordingTable).cursor_row
        return self._listed[row] if 0 <= row < len(self._listed) else None

    @on(DataTable.RowHighlighted)
    def _on_highlighted(self) -> None:
        self._write_about()
        self.refresh_bindings()

    def _write_about(self) -> None:
        chosen = self._chosen()
        if chosen is not None:
            text = about(chosen)
        elif self._entries:
            text = Text(f"none of {len(self._entries)} recordings has these words", MUTED)
        else:
            text = Text(f"no recordings in {self.state.folder}" if self._is_read else "reading …")
        self.query_one("#about", Static).update(text)

    # -------------------------------------------------------------------- filtering

    def action_filter(self) -> None:
        """Ask for words."""
        self.add_class("-filter")
        self.query_one(FilterLine).focus()

    def action_clear_filter(self) -> None:
        """Show all recordings again."""
        self.query_one(FilterLine).value = ""
        self.remove_class("-filter")
        self.query_one(RecordingTable).focus()

    @on(Input.Changed)
    def _on_words(self) -> None:
        self._list()

    @on(Input.Submitted)
    def _on_words_done(self) -> None:
        self.query_one(RecordingTable).focus()

    # -------------------------------------------------------------------- recordings

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Offer only what can be done with the chosen recording."""
        del parameters
        if action not in {"estimate", "delete", "compare"}:
            return True
        chosen = self._chosen() if self._entries else None
        if chosen is None or chosen.is_growing:
            return False
        if action == "compare" and chosen.path == self.state.path:
            return False
        return action == "delete" or not chosen.problem

    @on(DataTable.RowSelected)
    def _on_selected(self) -> None:
        self._open({})

    def _open(self, changes: Mapping[str, object]) -> None:
        chosen = self._chosen()
        if chosen is not None and not chosen.problem:
            view = TEST if chosen.is_growing else RESULT
            self.post_message(messages.OpeningRequested(chosen.path, changes, view))

    def action_estimate(self) -> None:
        """Ask for settings, and open the recording with them."""
        chosen = self._chosen()
        if chosen is not None:
            form = SettingsForm(chosen.path.name, None)
            self.app.push_screen(form, on_answer(self._open))

    def action_compare(self) -> None:
        """Compare the chosen recording with what is shown."""
        chosen = self._chosen()
        if chosen is not None:
            self.post_message(messages.ReferenceRequested(chosen.path))

    def action_pin(self) -> None:
        """Keep the chosen recording, or no longer."""
        chosen = self._chosen()
        if chosen is not None:
            self.post_message(messages.PinRequested(chosen.path))

    def action_delete(self) -> None:
        """Delete the chosen recording, once that has been confirmed."""
        chosen = self._chosen()
        if chosen is None:
            return
        question = f"Delete {chosen.path.name} ({size(chosen.size)}), its results and its reports?"
        dialog = QuestionScreen("delete", question, does="deletes")
        deletion = messages.DeletionRequested(chosen.path)
        self.app.push_screen(dialog, on_answer(lambda _: self.post_message(deletion)))
