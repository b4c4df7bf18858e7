"""``huddle reproduce``: the paper's figures from our model and estimators, beside the theory."""

from __future__ import annotations

import time
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import typer
from rich.progress import Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sim_devices.errors import ScenarioError
from tui.output.console import check_places, for_people, progress, write_json
from tui.output.extras import require
from tui.page.table import Cell, Table
from tui.studies.laboratory import LABORATORY, laboratory
from tui.studies.numerical import NUMERICAL, Ingredients
from tui.studies.study import TOLERANCE, ProgressCallback, Series, Study

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from rich.console import Console


Studies: TypeAlias = "Callable[[ProgressCallback, float], Mapping[str, Callable[[], Study]]]"
"""Takes what reports progress, and the share of the full length to simulate."""
STUDIES = (*NUMERICAL, *LABORATORY)
ALL = "all"
DEFAULT_FOLDER = Path("reproduced")


def paper(progress: ProgressCallback, length: float) -> Mapping[str, Callable[[], Study]]:
    """Return the studies of the paper by name; they share what they simulate."""
    ingredients = Ingredients(progress, length=length)
    measured = laboratory(progress, length=length)
    return {name: partial(study, ingredients) for name, study in NUMERICAL.items()} | {
        name: partial(study, measured) for name, study in LABORATORY.items()
    }


def reproduce(
    names: Sequence[str],
    *,
    progress: ProgressCallback,
    length: float = 1.0,
    studies: Studies = paper,
) -> Iterator[Study]:
    """Carry out studies, one by one.

    Parameters
    ----------
    names
        Of `studies`; ``all``, or none at all, stands for every one.
    progress
        Takes progress.
    length
        Share of the paper's length to simulate.
    studies
        Those there are.

    Raises
    ------
    ScenarioError
        If there is no study of a name, before anything is simulated.
    """
    known = studies(progress, length)
    unknown = [name for name in names if name not in {*known, ALL}]
    if unknown:
        raise ScenarioError(
            f"no study {', '.join(map(repr, unknown))}; expected {', '.join(known)} or {ALL}"
        )
    wanted = known if ALL in names or not names else dict.fromkeys(names)
    return (known[name]() for name in wanted)


def run(
    names: Sequence[str],
    *,
    out: Path | None = None,
    json: str | None = None,
    length: float = 1.0,
    studies: Studies = paper,
) -> bool:
    """Carry out studies; write figures, print the table, and say whether all agree with theory.

    Parameters
    ----------
    names
        As `reproduce` takes them.
    out
        Folder for the figures, a PNG and an SVG each; made if it is not there.
    json
        File for every point, or ``-``.
    length
        Share of the paper's length to simulate.
    studies
        Those there are.

    Raises
    ------
    typer.BadParameter
        If there is no place for figures or points, before anything is simulated.
    """
    check_places(json)
    require("matplotlib")
    folder = DEFAULT_FOLDER if out is None else out
    started = time.monotonic()
    done: list[Study] = []
    files: list[Path] = []
    with _progress() as report:
        wanted = reproduce(names, progress=report, length=length, studies=studies)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise typer.BadParameter(
                f"--out {folder}: {error.strerror}; expected a folder"
            ) from None
        for study in wanted:
            from tui.studies.figures import save  # noqa: PLC0415 - matplotlib takes a second

            report(f"{study.name}: figure", 1.0)
            files += save(study, folder)
            done.append(study)
    elapsed = time.monotonic() - started
    agrees = all(study.agrees for study in done)
    write_json(
        json,
        {
            "agrees": agrees,
            "tolerance": TOLERANCE,
            "length": length,
            "elapsed": elapsed,
            "figures": [str(file) for file in files],
            "studies": [study.as_json() for study in done],
        },
    )
    _print(for_people(json), done, folder, elapsed)
    return agrees


@contextmanager
def _progress() -> Iterator[ProgressCallback]:
    """Show a bar for what is being simulated, with the time left."""
    left = TimeRemainingColumn(), TextColumn("left,"), TimeElapsedColumn()
    with progress(*Progress.get_default_columns()[:-1], *left) as bar:
        task = bar.add_task("", total=1.0)

        def report(what: str, share: float) -> None:
            if what != bar.tasks[0].description:
                bar.reset(task, description=what, total=1.0)
            bar.update(task, completed=share)

        yield report


def _print(console: Console, studies: list[Study], folder: Path, elapsed: float) -> None:
    rows: list[tuple[str, ...]] = []
    for study in studies:
        rows.append((Cell(f"{study.name}  {study.title}", strong=True),))
        for panel, series in study.series():
            letter = panel.title[:4] if panel.title.startswith("(") else ""
            label = series.title.removeprefix(letter)
            rows.append((f"  {letter}{label}", series.quantity, *_row(series)))
    console.print(Table(("", "", "at", "measured", "theory", "off"), tuple(rows)))
    deviations = np.concatenate([study.deviations for study in studies])
    console.print(
        f"\nEach row shows the point of a curve where theory expects most, ± one standard error;"
        f" 'off' is the curve's furthest point, in standard errors. Where no theory is exact,"
        f" it says what may be missed besides."
        f"\n{np.sum(np.abs(deviations) <= TOLERANCE)} of {deviations.size} points are within"
        f" {TOLERANCE:g} standard errors of theory (rms {np.sqrt(np.mean(deviations**2)):.2f})."
        f" Figures in {folder}; {elapsed:.0f} s."
    )


def _row(series: Series) -> tuple[str, ...]:
    point, worst = series.telling, series.worst
    off = f"{worst.deviation:+.1f}"
    return (
        f"{point.x:.3g}",
        f"{point.measured:.4g} ± {point.error:.1g}",
        (f"{point.theory:.4g}" if abs(point.theory) > 1e-9 else "0")
        + (f" ± {point.allowed:g}" if point.allowed else ""),
        off if worst.agrees else Cell(f"{off} NO", "bad"),
    )
