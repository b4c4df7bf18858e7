"""Who loads whom, seen from outside: what a fresh interpreter has imported."""

from __future__ import annotations

import ast
import re
from importlib import metadata
from pathlib import Path

import pytest

from sim_devices.server.serve import FAMILIES
from tests.command import modules_after


def test_package_roots_import_nothing() -> None:
    packages = {"daq", "estimator", "sim_devices", "tui"}
    loaded = modules_after(f"import {', '.join(sorted(packages))}") - modules_after("pass")
    assert {name for name in loaded if not name.startswith(("_", "encodings"))} == packages


def test_simulated_devices_need_no_extra() -> None:
    requirements = metadata.requires("huddle-bench") or []
    names = [re.split(r"[^\w.-]", each, maxsplit=1)[0].lower() for each in requirements]
    needed = {n for n, each in zip(names, requirements, strict=True) if "extra ==" not in each}
    modules = {place.partition(":")[0] for name, place in FAMILIES.items() if name != "seedlink"}
    loaded = modules_after(f"import sim_devices.server.fork_server, {', '.join(sorted(modules))}")
    assert {"numpy", "pymodbus"} <= loaded & needed
    assert "canopen" in set(names) - needed
    assert not loaded & (set(names) - needed)


def test_estimator_loads_no_input_or_output() -> None:
    loaded = modules_after(
        "import estimator.methods, estimator.spectra.welch,"
        " estimator.likelihood.maximum_likelihood, estimator.checks.diagnose"
    )
    assert not loaded & {"h5py", "serial", "pymodbus", "textual", "matplotlib", "daq", "tui"}


@pytest.mark.parametrize("command", ["record", "run", "estimate", "report"])
def test_headless_commands_never_load_textual_nor_what_only_terminals_need(command: str) -> None:
    run = (
        "import os; os._exit = sys.exit  # so that it lives to say what it loaded\n"
        f"from tui.commands.main import main; sys.argv[1:] = ['{command}', 'absent.toml']"
    )
    loaded = modules_after(
        f"{run}\ntry:\n    main()\nexcept SystemExit as end:\n    assert end.code\nprint()"
    )
    assert f"tui.commands.{command}" in loaded
    assert "h5py" in loaded
    assert not loaded & {"textual", "scipy", "matplotlib", "jinja2", "fpdf"}
    assert command == "run" or "rich.progress" not in loaded


ARRAYS_IN = {"notebook", "report", "simulation", "studies"}
"""Packages of the front ends that take or draw arrays."""
ARRAYS_OF = {
    "application/bench_view/sensors.py", "application/signal_view/picture.py",
    "application/test_view/braille.py", "application/test_view/clocks.py",
    "application/test_view/curves.py",
    "application/test_view/panels.py", "application/test_view/plot.py",
    "application/test_view/plotted.py", "application/test_view/units.py",
    "output/archive/document.py", "output/json_values.py",
    "output/noise_parameters.py", "output/results.py", "output/standing.py",
    "page/axes.py",
    "web/chart.py", "web/signal.py", "web/traces.py",
}  # fmt: skip
"""Modules that draw curves, count flags, or write arrays as text."""


def test_commands_compute_nothing() -> None:
    """Numbers are computed once, in daq.results or the estimator: no command needs numpy."""
    root = Path(__file__).parents[1] / "tui"
    computing = set()
    for path in root.rglob("*.py"):
        name = path.relative_to(root)
        imports = [
            alias.name
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.Import)
            for alias in node.names
        ]
        if name.parts[0] not in ARRAYS_IN and {"numpy", "scipy"} & set(imports):
            computing.add(name.as_posix())
    assert computing == ARRAYS_OF


OTHER_WRITERS = {
    "daq/recording/storage/journal.py": "the hidden copy of a repair, which is verified",
    "daq/recording/repair.py": "the hidden copy of a repair, which is verified",
    "daq/formats/readers/packed.py": "unpacked files in a temporary folder",
    "daq/recording/extremes.py": "a file that grows with its recording",
    "daq/transport/wire_log.py": "a log that grows while devices are read",
    "tui/output/console.py": "pipes and devices, and lines that `huddle watch` appends",
    "tui/service/processes/finish.py": "a file of the kernel",
    "tui/commands/demo.py": "a bench file in a temporary folder",
}
"""Modules that open files for writing, and why not through `daq.whole_file`."""


def test_every_derived_file_goes_through_the_writer() -> None:
    root = Path(__file__).parents[1]
    writes = re.compile(
        r"""(?<!formatter)\.write_(text|bytes)\(|\.open\("[wax]|\.open\("r\+|h5py\.File\([^)]*"(w|a|r\+)"
        |\.savefig\([^,)]*(path|out|png|svg|pdf)\b|os\.(replace|rename)\(|to_netcdf\([a-z]*path""",
        re.VERBOSE,
    )
    sources = {
        str(each.relative_to(root)): each
        for part in ("daq", "tui")
        for each in (root / part).rglob("*.py")
    }
    found = {
        name for name, each in sources.items() if writes.search(each.read_text(encoding="utf-8"))
    }
    through = {
        "daq/whole_file.py",
        "daq/recording/storage/whole_hdf5.py",
        "daq/recording/writer.py",
    }
    assert found - through == set(OTHER_WRITERS)
