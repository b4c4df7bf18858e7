"""What the pages show of months: sensors by serial number, and an archive."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

from daq.archive.answers import Answer, answer
from daq.archive.store import Store
from tui.output.archive.tables import course_table, course_title, remarks
from tui.output.results import averages_line, result_table, result_title
from tui.service.history.ledger import noise_of
from tui.service.history.series import NoiseSeries, history
from tui.service.history.shown import history_figure, history_lines, history_table
from tui.service.records.store import RunStore
from tui.web.work import check_wanted

if TYPE_CHECKING:
    from pathlib import Path

    from daq.bench.model import Bench

_DPI = 110


class Months:
    """What the service of a bench and its archive have found over months.

    Everything here takes long, and is called in the one thread that makes estimates.

    Parameters
    ----------
    bench : Bench
    """

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._answer: tuple[object, Answer] | None = None

    def sensors(self) -> dict[str, Any]:
        """Return what the page of the sensors shows."""
        found = self._series()
        serial_numbers = {each.serial_number for each in self._bench.sensors}
        serial_numbers |= {each.last.serial_number for each in found}
        everywhere = [
            series
            for serial_number in sorted(serial_numbers - {""})
            for series in history(noise_of(serial_number))
        ]
        return {
            "table": history_table(found),
            "lines": list(history_lines(found)),
            "found": found,
            "everywhere": history_table(everywhere) if everywhere else None,
            "everywhere_lines": list(history_lines(everywhere)),
        }

    def _series(self) -> list[NoiseSeries]:
        return history(RunStore(self._bench.recording_directory).noise(self._bench.name))

    def sensors_picture(self) -> bytes:
        """Return the noise of every sensor from run to run as PNG."""
        return _png(history_figure(self._series()))

    @property
    def folder(self) -> Path | None:
        """The archive that the bench file names."""
        web, source = self._bench.web, self._bench.source
        if web is None or web.archive is None or source is None:
            return None
        return source.parent / web.archive

    def archive(self) -> dict[str, Any]:
        """Return what the page of the archive shows; no answer where there is no archive.

        Raises
        ------
        HuddleError
            If the archive cannot be read.
        """
        found = self._answered()
        if found is None:
            return {"answer": None}
        return {
            "answer": found,
            "titles": (str(result_title(found.result)), course_title(found).plain),
            "tables": (result_table(found.result), course_table(found)),
            "averages": averages_line(found.pooled),
            "facts": [each.line for each in found.result.facts],
            "remarks": list(remarks(found, "UTC")),
        }

    def archive_picture(self, name: str) -> bytes:
        """Return the noise by day, or its density, as PNG.

        Raises
        ------
        LookupError
            If there is no archive.
        """
        from tui.page.drawing import look  # noqa: PLC0415
        from tui.report.figures.archive import days_figure, density_figure  # noqa: PLC0415

        found = self._answered()
        if found is None:
            raise LookupError("no archive")
        with look():
            return _png({"days": days_figure, "density": density_figure}[name](found))

    def _answered(self) -> Answer | None:
        """Return the answer of the archive as it is now; made again where files have changed."""
        archive = None if self.folder is None else Store.open(self.folder)
        if archive is None:
            return None
        entries, _ = archive.entries()
        state = tuple((each.path, each.path.stat().st_mtime_ns) for each in entries)
        if self._answer is None or self._answer[0] != state:
            settings = archive.plan.changed({}, None)
            self._answer = state, answer(archive, entries, settings, progress=check_wanted)
        return self._answer[1]


def _png(figure: Any) -> bytes:  # noqa: ANN401 - matplotlib's, which is loaded when it draws
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=_DPI)
    return content.getvalue()
