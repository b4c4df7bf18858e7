"""A form for the settings of an estimate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

from daq.bench.estimate_settings import OPTIONS, from_text
from daq.estimation.settings import NEEDED, Settings
from tui.application.forms.form import Field, Form

FIELDS = ("methods", "segment", "overlap", "window", "detrend", "clocks", "band", "unit")


class SettingsForm(Form[Mapping[str, object]]):
    """Asks for settings; returns those that were changed, None if it was left.

    Parameters
    ----------
    name : str
        Of the recording.
    settings : Settings, optional
        What is shown in the empty fields; without it, that they are those of the bench.
    """

    def __init__(self, name: str, settings: Settings | None) -> None:
        self._settings = settings
        asked = [
            Field(field, OPTIONS[field].key or field, placeholder=_placeholder(field, settings))
            for field in FIELDS
        ]
        super().__init__(f"estimate {name} again", asked, does="estimates")

    def hint(self, name: str) -> str:
        """Return what a setting does."""
        return OPTIONS[name].help

    def problem(self, name: str) -> str:
        """Return what is wrong with a value; empty if nothing is, or if there is none."""
        text = self.value(name)
        try:
            if text:
                from_text(name, text)
        except ValueError as error:
            return f"{text}: {error}"
        return ""

    def submit(self) -> None:
        """Estimate with what was given."""
        given = {name: text for name in FIELDS if (text := self.value(name))}
        shown = {} if self._settings is None else as_changes(self._settings)
        if "methods" in given:  # options of one method alone do not fit others
            shown = {name: value for name, value in shown.items() if name not in NEEDED}
        self.dismiss(shown | {n: from_text(n, text) for n, text in given.items()})


def as_changes(settings: Settings) -> dict[str, object]:
    """Return the changes of a bench file's settings by which its recording is estimated so."""
    found = {each.name: getattr(settings, each.name) for each in fields(settings)}
    found |= {name: (end := found[name]) and end.isoformat() for name in ("start", "end")}
    return {name: value for name, value in found.items() if value not in ({}, ())}


def _placeholder(field: str, settings: Settings | None) -> str:
    if settings is None:
        return "as the bench file says"
    value = getattr(settings, field)
    text = "" if value is None else OPTIONS[field].text(value)
    return text if isinstance(text, str) else ", ".join(text)
