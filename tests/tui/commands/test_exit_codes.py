"""Errors become exit codes by their types."""

from __future__ import annotations

import inspect
from types import ModuleType

import pytest

import daq.errors
import estimator.errors
import sim_devices.errors
from daq.errors import (
    ArrayError,
    BenchFileError,
    DeviceError,
    HuddleError,
    WrongArchiveError,
    WrongSettingError,
)
from estimator.errors import BandError, EstimatorError, UnknownMethodError
from sim_devices.errors import ScenarioError, ServeError, SimulationError
from tui.commands.main import exit_code, messages
from tui.output.exit_codes import ExitCode
from tui.runs.recorder_process import RecorderFailedError

USAGE_ERRORS = {
    ArrayError,
    BenchFileError,
    WrongSettingError,
    BandError,
    UnknownMethodError,
    ScenarioError,
    WrongArchiveError,
}


def errors_of(module: ModuleType, root: type[Exception]) -> list[type[Exception]]:
    return [
        found
        for _, found in inspect.getmembers(module, inspect.isclass)
        if issubclass(found, root) and found is not root
    ]


@pytest.mark.parametrize(
    "error",
    [
        *errors_of(daq.errors, HuddleError),
        *errors_of(estimator.errors, EstimatorError),
        *errors_of(sim_devices.errors, SimulationError),
    ],
)
def test_every_error_of_ours_has_an_exit_code(error: type[Exception]) -> None:
    expected = ExitCode.USAGE if error in USAGE_ERRORS else ExitCode.TROUBLE
    assert exit_code(error("it failed")) is expected
    assert list(messages(error("it failed"))) == ["it failed"]


@pytest.mark.parametrize("is_usage_error", [False, True])
def test_a_recorder_passes_on_whose_fault_it_was(is_usage_error: bool) -> None:
    error = RecorderFailedError("it failed", is_usage_error=is_usage_error)
    assert exit_code(error) is (ExitCode.USAGE if is_usage_error else ExitCode.TROUBLE)


def test_several_errors_have_the_code_of_the_worst() -> None:
    wrong, lost = ScenarioError("no such wave"), DeviceError("lost")
    assert exit_code(ExceptionGroup("", [wrong, wrong])) is ExitCode.USAGE
    assert exit_code(ExceptionGroup("", [wrong, lost])) is ExitCode.TROUBLE
    assert exit_code(ExceptionGroup("", [lost, KeyError("name")])) is None
    assert list(messages(ExceptionGroup("", [wrong, lost]))) == ["no such wave", "lost"]


def test_the_operating_system_s_errors_are_trouble() -> None:
    assert exit_code(OSError(28, "No space left on device")) is ExitCode.TROUBLE
    full = OSError(28, "No space left on device", "out.json")
    assert list(messages(full)) == ["out.json: No space left on device"]


def test_the_name_of_a_class_decides_nothing() -> None:
    """An error of somebody else's that is called like one of ours is not foreseen."""
    for name in ("BandError", "ScenarioError", "RecorderFailedError", "HuddleError"):
        assert exit_code(type(name, (Exception,), {"code": 2})("")) is None


def test_a_bench_file_s_faults_are_typed() -> None:
    wrong = daq.errors.FileFault("port", "expected socket://host:port", "socket://x", "A")
    missing = daq.errors.FileFault("name", "is missing; expected the bench's name")
    error = BenchFileError(wrong, missing, wrong, source="bench.toml")
    assert error.faults == (wrong, missing)
    assert str(error).splitlines() == [
        'bench.toml: sensors["A"].port = "socket://x": expected socket://host:port',
        "bench.toml: name: is missing; expected the bench's name",
    ]


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (True, "true"),
        ([1, "x"], '[1, "x"]'),
        ("a\nb\x1b[2J", '"a\\nb\\x1b[2J"'),
        ("x" * 100, f'"{"x" * 56}…'),
    ],
)
def test_values_are_shown_on_one_line_as_toml_has_them(value: object, shown: str) -> None:
    assert (
        str(daq.errors.FileFault("key", "expected more", value)) == f"key = {shown}: expected more"
    )


def test_serving_is_trouble_and_a_scenario_usage() -> None:
    assert not ServeError("no port").is_usage_error
    assert ScenarioError("motion: is missing", "sensors: is missing").problems == (
        "motion: is missing",
        "sensors: is missing",
    )
