"""The page of a recording against time: a picture of each span, drawn here and replaced there."""

from __future__ import annotations

import base64
import io
import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
from markupsafe import Markup
from PIL import Image
from starlette.datastructures import QueryParams

from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.recording.reader import Recording
from daq.results.signal import Signal, Spectrogram, Waveforms, fitting, panned, zoomed
from estimator.types import FloatArray
from tui.output.results import averages_line
from tui.runs.estimate_settings import settings_for
from tui.web.html import page
from tui.web.tests import exclude_of
from tui.web.work import check_wanted
from tui.wording.signal import (
    DAY,
    extent,
    loudest,
    most_first,
    scale,
    sign,
    stretch_text,
    time_of,
    time_ticks,
    title,
    words,
)

WIDTH, LEFT, ROW, TOP, LANE, AXIS = 1000, 110, 44, 6, 18, 24
"""Of a picture in its own units: width, room for names, height of a waveform, and of the rest."""
COLUMNS, SPECTRUM, BANDS = 445, 264, 66
TICKS, FREQUENCIES = 7, 5
MARKS = 40
"""Marks that are listed below a picture."""
AROUND = 300.0
"""Seconds before and after a time that is asked for."""
SPECTRA = {"": "waveforms", "recorded": "spectrogram, recorded", "noise": "spectrogram, noise"}
_RAMP = ((17, 21, 28), (40, 60, 110), (45, 130, 160), (120, 200, 120), (253, 231, 76))
"""Colours of levels from 0 to 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Opened:
    """A recording whose signal is drawn by one visitor at a time."""

    signal: Signal
    settings: Settings
    lock: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def of(cls, path: Path) -> Opened:
        """Open a recording. Blocks.

        Raises
        ------
        HuddleError
            If it cannot be read.
        """
        settings, _ = settings_for(path)
        return cls(Signal(Recording.open(path), check_wanted), settings)


@dataclass(frozen=True, slots=True)
class SignalLook:
    """What a request asks to see.

    Attributes
    ----------
    span : (float, float)
        In s of UTC.
    channel : int
        Number of a trace.
    spectrum : str
        A key of `SPECTRA`.
    exclude : tuple of str
        Stretches that the estimate leaves out.
    is_changed : bool
        Whether these are not those of the settings of the test.
    """

    span: tuple[float, float]
    channel: int
    spectrum: str
    exclude: tuple[str, ...]
    is_changed: bool

    @classmethod
    def of(cls, opened: Opened, asked: QueryParams) -> SignalLook:
        """Return what is asked for.

        Raises
        ------
        ValueError
            If that is nothing of the recording.
        """
        signal = opened.signal
        whole = signal.span
        begin, end = (
            float(asked.get(name, at)) for name, at in zip(("from", "to"), whole, strict=True)
        )
        if not (math.isfinite(begin) and math.isfinite(end) and begin < end):
            raise ValueError("no such span")
        span = zoomed(fitting((begin, end), whole), whole, 1.0)
        if wanted := asked.get("at", "").strip():
            at = time_of(wanted, span[0], whole)
            if at is None:
                raise ValueError(f"{wanted}: expected a time as 03:12, within the recording")
            span = fitting((at - AROUND, at + AROUND), whole)
        channel, spectrum = int(asked.get("channel", 0)), asked.get("spectrum", "")
        if spectrum not in SPECTRA or channel < 0:
            raise ValueError("no such channel or spectrum")
        signal.channel(channel)
        own, chosen = opened.settings.exclude, exclude_of(asked)
        exclude = list(own if chosen is None else chosen)
        if "shown" in asked:
            exclude.append(stretch_text(*span))
        elif wanted := asked.get("add", "").strip():
            exclude.append(_stretch(wanted, span[0], whole))
        for mark in signal.excluded(None, exclude):
            if not (mark.begin < whole[1] and mark.end > whole[0]):
                raise ValueError(f"{words(mark)}: not within the recording")
        used = tuple(dict.fromkeys(exclude))
        return cls(span, channel, spectrum, used, is_changed=used != own)

    @property
    def query(self) -> list[tuple[str, str]]:
        """What an address needs so that it leaves out the same stretches."""
        return exclusions(self.exclude) if self.is_changed else []

    def address(self, begin: float, end: float, exclude: tuple[str, ...] | None = None) -> str:
        """Return the address of another span, or of the same one without other stretches."""
        chosen = self.query if exclude is None else exclusions(exclude)
        shown = [("from", begin), ("to", end), ("channel", self.channel)]
        return "?" + urlencode([*shown, ("spectrum", self.spectrum), *chosen])


def exclusions(exclude: Sequence[str]) -> list[tuple[str, str]]:
    """Return fields of an address that leave out these stretches, and no others."""
    return [("exclude", each) for each in exclude or ("",)]


def _stretch(text: str, near: float, whole: tuple[float, float]) -> str:
    """Return a stretch between two times as people write them, as the settings take it."""
    around = whole[0] - 1, whole[1] + 1  # as far as a browser rounds
    ends = [time_of(each, near, around) for each in text.split("/")]
    begin, end = ends if len(ends) == 2 else (None, None)
    if begin is None or end is None or begin == end:
        raise ValueError(f"{text}: expected two times as 03:10/03:15, within the recording")
    return stretch_text(begin, end if end > begin else end + DAY)


def drawn(opened: Opened, look: SignalLook, snapshot: Snapshot | None) -> dict[str, Any]:
    """Return what the page shows of a look. Blocks."""
    with opened.lock:
        signal = opened.signal
        chosen = signal.excluded(None, look.exclude)
        waves = signal.view(*look.span, COLUMNS, signal.excluded(snapshot, look.exclude))
        found = None
        if look.spectrum:
            is_noise = look.spectrum == "noise"
            found = signal.spectrogram(
                look.channel, look.span, COLUMNS // 3, BANDS, snapshot=snapshot, noise=is_noise
            )
    body = SPECTRUM if look.spectrum else ROW * len(waves.traces)
    values = {
        "title": title(waves),
        "width": WIDTH,
        "left": LEFT,
        "bottom": TOP + body,
        "height": TOP + body + LANE + AXIS,
        "row": ROW,
        "top": TOP,
        "look": look,
        "traces": [] if look.spectrum else _traces(waves),
        "spectrum": None if found is None else _spectrum(found, look.span),
        "marks": _marks(waves),
        "ticks": [(_x(waves, at), label) for at, label in time_ticks(*look.span, TICKS)],
        "listed": [f"{sign(mark)} {words(mark)}" for mark in most_first(waves.marks)[:MARKS]],
        "n_marks": len(waves.marks),
    }
    return {
        "picture": Markup(page("signal_picture", **values)),  # noqa: S704 - it escapes all text
        "look": look,
        "whole": signal.span,
        "channels": [trace.name for trace in waves.traces],
        "spectra": SPECTRA,
        "left": LEFT / WIDTH,
        "excluded": [
            (words(mark), look.address(*look.span, look.exclude[:n] + look.exclude[n + 1 :]))
            for n, mark in enumerate(chosen)
        ],
        "averages": "" if snapshot is None else averages_line(snapshot),
        "caveats": signal.recording.caveats,
    }


def steps(look: SignalLook, whole: tuple[float, float]) -> list[tuple[str, str]]:
    """Return what leads on from a look without a script: names and addresses."""
    span = look.span
    found = {
        "Earlier": panned(span, whole, -0.5),
        "Later": panned(span, whole, 0.5),
        "Closer": zoomed(span, whole, 0.5),
        "Further": zoomed(span, whole, 2.0),
        "All": whole,
    }
    return [(name, look.address(*ends)) for name, ends in found.items()]


def _x(waves: Waveforms, at: float) -> float:
    return LEFT + (WIDTH - LEFT) * (at - waves.begin) / (waves.end - waves.begin)


def _traces(waves: Waveforms) -> list[tuple[str, str, str]]:
    """Return name, extent, and a path of each channel: down and up in each column."""
    x = LEFT + (np.arange(waves.n_columns) + 0.5) * (WIDTH - LEFT) / max(waves.n_columns, 1)
    found = []
    for number, trace in enumerate(waves.traces):
        middle = TOP + ROW * (number + 0.5)
        low, high = (middle - 0.46 * ROW * each for each in trace.scaled)
        ends = zip(x, high, low, strict=True)
        path = "".join(f"M{at:.1f} {a:.1f}V{b + 0.6:.1f}" for at, a, b in ends if math.isfinite(a))
        found.append((trace.name, extent(trace), path))
    return found


def _marks(waves: Waveforms) -> list[tuple[float, float, str, str]]:
    """Return begin and width of each mark, whether it is a moment, and its words."""
    found = []
    for mark in waves.marks:
        begin, end = max(LEFT, _x(waves, mark.begin)), min(WIDTH, _x(waves, mark.end))
        found.append((begin, max(2.0, end - begin), sign(mark), words(mark)))
    return found


def _spectrum(found: Spectrogram, span: tuple[float, float]) -> dict[str, Any]:
    frequency, share = found.grid(*span, COLUMNS, BANDS)
    rows = np.linspace(0, BANDS - 1, FREQUENCIES).round().astype(int).tolist()
    return {
        "image": base64.b64encode(png(share[::-1])).decode(),
        "height": SPECTRUM,
        "rows": [
            (TOP + SPECTRUM * (1 - (row + 0.5) / BANDS), f"{frequency[row]:.3g} Hz") for row in rows
        ],
        "scale": f"{scale(found)}{loudest(found)}",
    }


def png(share: FloatArray) -> bytes:
    """Return values from 0 to 1, shape (n_rows, n_columns), as a picture in colours.

    What is not known is transparent.
    """
    ramp = np.array(_RAMP, dtype=np.float64)
    place = np.nan_to_num(share) * (len(ramp) - 1)
    below = np.minimum(place.astype(int), len(ramp) - 2)
    part = (place - below)[..., None]
    colour = ramp[below] * (1 - part) + ramp[below + 1] * part
    alpha = np.where(np.isfinite(share), 255, 0)[..., None]
    pixels = np.concatenate([colour, alpha], axis=2).round().astype(np.uint8)
    picture = io.BytesIO()
    Image.fromarray(pixels).save(picture, "png")
    return picture.getvalue()
