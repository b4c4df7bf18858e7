"""BLAS has one thread while an estimate runs, and as many as before afterwards."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Generator
from dataclasses import asdict
from pathlib import Path

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from daq.archive.task import Task, run, software_version
from daq.estimation.blas_threads import VARIABLES, one_blas_thread
from daq.estimation.estimation import Estimation
from tests.daq.clocks.recordings import write
from tests.daq.estimation.test_estimation import SETTINGS, huddle


@pytest.fixture(autouse=True)
def two_threads() -> Generator[None]:
    with threadpool_limits(2, user_api="blas"):
        yield


def n_threads() -> set[int]:
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}


@pytest.mark.parametrize("take", ["update", "finish"])
def test_an_estimate_has_one_thread_and_leaves_the_number(tmp_path: Path, take: str) -> None:
    write(tmp_path / "a.h5", huddle())
    seen: list[set[int]] = []
    with Estimation([tmp_path / "a.h5"], SETTINGS) as estimation:
        getattr(estimation, take)(lambda *_: seen.append(n_threads()))
    assert seen
    assert all(each == {1} for each in seen)
    assert n_threads() == {2}


def test_a_command_begins_with_one_thread_and_looks_for_no_library() -> None:
    program = (
        "import sys; from daq.estimation.blas_threads import one_blas_thread\n"
        "import numpy\n"
        "with one_blas_thread(): print('threadpoolctl' in sys.modules)\n"
        "from threadpoolctl import threadpool_info\n"
        "print({each['num_threads'] for each in threadpool_info()})"
    )
    one = os.environ | dict.fromkeys(VARIABLES, "1")
    shown = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True, env=one
    ).stdout
    assert shown.split() == ["False", "{1}"]


def test_an_archive_task_has_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[set[int]] = []

    def version() -> str:
        seen.append(n_threads())
        return software_version()

    monkeypatch.setattr("daq.archive.task.software_version", version)
    run(json.dumps(asdict(Task("no.h5", "no", "", "of another version"))))
    assert seen
    assert all(each == {1} for each in seen)
    assert n_threads() == {2}


def test_the_last_of_several_estimates_restores_the_number() -> None:
    first, second = one_blas_thread(), one_blas_thread()
    with first:
        second.__enter__()
    assert n_threads() == {1}
    second.__exit__(None, None, None)
    assert n_threads() == {2}


def test_an_estimate_that_fails_restores_the_number() -> None:
    with pytest.raises(ValueError, match="no"), one_blas_thread():
        raise ValueError("no")
    assert n_threads() == {2}
