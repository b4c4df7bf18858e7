"""Self-noise of accelerometers that stand side by side, in scripts and notebooks.

>>> import huddle
>>> sensors = huddle.simulate("fig9", duration="2min")
>>> result = huddle.self_noise(sensors, fs=sensors.fs, sample_unit="m/s²")
>>> result.noise_psd.shape
(1001, 6)

`self_noise` estimates arrays and what `read` finds in files of other programs, `estimate`
recordings; `open` reads a recording, `simulate` makes samples whose noise is known, `plan` says how
long to record. `calibrate`, `export`, `report` and `archive` do what the commands of that name do.
``python -m huddle`` is the command.

Nothing heavy is imported before it is used. Types are visible to type checkers.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # as in tui/resources/huddle.pyi
    from daq.errors import HuddleError
    from estimator.errors import EstimatorError
    from tui.notebook.archives import archive
    from tui.notebook.estimates import estimate, self_noise
    from tui.notebook.options import EstimateOptions
    from tui.notebook.planning import RecordingPlan, plan
    from tui.notebook.recording import (
        RecordingFile,
        Waveforms,
        open,  # noqa: A004 - huddle.open
        read,
    )
    from tui.notebook.result import Result
    from tui.notebook.simulation import Simulation, simulate
    from tui.notebook.verbs import calibrate, export, load, noise_model, report

__all__ = [
    "EstimateOptions",
    "EstimatorError",
    "HuddleError",
    "RecordingFile",
    "RecordingPlan",
    "Result",
    "Simulation",
    "Waveforms",
    "archive",
    "calibrate",
    "estimate",
    "export",
    "load",
    "noise_model",
    "open",
    "plan",
    "read",
    "report",
    "self_noise",
    "simulate",
]

_MODULES = {
    "EstimateOptions": "tui.notebook.options",
    "EstimatorError": "estimator.errors",
    "HuddleError": "daq.errors",
    "RecordingFile": "tui.notebook.recording",
    "RecordingPlan": "tui.notebook.planning",
    "Result": "tui.notebook.result",
    "Simulation": "tui.notebook.simulation",
    "Waveforms": "tui.notebook.recording",
    "archive": "tui.notebook.archives",
    "calibrate": "tui.notebook.verbs",
    "estimate": "tui.notebook.estimates",
    "export": "tui.notebook.verbs",
    "load": "tui.notebook.verbs",
    "noise_model": "tui.notebook.verbs",
    "open": "tui.notebook.recording",
    "plan": "tui.notebook.planning",
    "read": "tui.notebook.recording",
    "report": "tui.notebook.verbs",
    "self_noise": "tui.notebook.estimates",
    "simulate": "tui.notebook.simulation",
}
__version__: str
_PACKAGES = ("daq", "estimator", "sim_devices", "tui")


def __dir__() -> list[str]:
    return [*__all__, "__doc__", "__file__", "__name__"]


if not TYPE_CHECKING:  # type checkers see the imports above

    def __getattr__(name: str) -> object:
        if name == "__version__":
            from importlib.metadata import version  # noqa: PLC0415 - seldom needed

            return version("huddle-bench")
        if name not in _MODULES:
            raise AttributeError(f"module 'huddle' has no attribute {name!r}")
        _check_packages()
        found = globals()[name] = getattr(import_module(_MODULES[name]), name)
        return found


def _check_packages() -> None:
    """Refuse other packages of these names, which hide ours or were installed over them.

    Raises
    ------
    ImportError
        With the place of the other package.
    """
    here = Path(__file__).resolve().parent
    for name in _PACKAGES:
        spec = find_spec(name)
        found = None if spec is None or spec.origin is None else Path(spec.origin).resolve()
        if found is None or found.parent.parent != here:
            raise ImportError(
                f"{found or name}: hides the package {name!r} of huddle; expected"
                f" {here / name}: run Python with -P (or PYTHONSAFEPATH=1), which keeps the"
                " folder of the script off sys.path, or rename the file or folder",
                name=name,
            )
        try:
            import_module(name)  # ours imports nothing
        except Exception as error:
            from importlib.metadata import packages_distributions  # noqa: PLC0415 - seldom needed

            others = {*packages_distributions().get(name, ())} - {"huddle-bench"}
            culprit = " ".join(sorted(others)) or "PACKAGE"
            raise ImportError(
                f"{found}: replaced by another package that is called {name!r} ({error}); run:"
                f" python -m pip uninstall {culprit}, then install huddle again, in an"
                " environment of its own if you need both",
                name=name,
            ) from error


def main() -> None:
    """Run the command ``huddle``."""
    try:
        _check_packages()
    except ImportError as error:
        print(f"huddle: {error}", file=sys.stderr)
        sys.exit(2)
    from tui.commands.main import main as run  # noqa: PLC0415 - a script needs no command

    run()


if __name__ == "__main__":
    # No module in the working directory is imported from here on. Before, Python itself looks there
    # for this one: python -m huddle runs a huddle.py of the user's, if there is one.
    if not sys.flags.safe_path:
        del sys.path[0]
    sys.argv[0] = "huddle"  # as help and messages call the command
    main()
