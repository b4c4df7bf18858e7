"""Who loads whom, seen from outside: what a fresh interpreter has imported."""

from __future__ import annotations

import subprocess
import sys

import pytest


def modules_after(statement: str) -> set[str]:
    """Names of the modules loaded in a fresh interpreter after the statement."""
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; {statement}; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    return set(done.stdout.split())


@pytest.mark.parametrize("package", ["daq", "estimator", "sim_devices", "tui"])
def test_package_roots_import_nothing(package: str) -> None:
    bare = modules_after("pass")
    loaded = modules_after(f"import {package}") - bare
    assert {name for name in loaded if not name.startswith(("_", "encodings"))} <= {package}


def test_estimator_loads_no_input_or_output() -> None:
    loaded = modules_after(
        "import estimator.methods, estimator.spectra.welch,"
        " estimator.likelihood.maximum_likelihood, estimator.diagnostics.diagnose"
    )
    assert not loaded & {"h5py", "serial", "pymodbus", "textual", "matplotlib", "daq", "tui"}


@pytest.mark.parametrize("command", ["record", "estimate"])
def test_headless_commands_never_load_textual(command: str) -> None:
    run = (
        "import os; os._exit = sys.exit  # so that it lives to say what it loaded\n"
        f"from tui.cli.main import main; sys.argv[1:] = ['{command}', 'absent.toml']"
    )
    loaded = modules_after(
        f"{run}\ntry:\n    main()\nexcept SystemExit as end:\n    assert end.code\nprint()"
    )
    assert "textual" not in loaded
