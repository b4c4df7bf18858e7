"""The command: help, exit codes, what is loaded, and what is logged."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Mapping
from dataclasses import replace
from importlib import import_module
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from rich.table import Table
from typer.testing import CliRunner

from daq.devices.interface import DeviceInformation
from daq.preflight.device_check import SensorCheck
from daq.python_process import python_command
from docs import reference
from sim_devices.world.paper_scenarios import SCENARIOS
from tests.command import huddle, modules_after, printed, words_of
from tui.commands.check import remarks
from tui.commands.help import COMMANDS, PANELS, subcommand
from tui.commands.main import app, main
from tui.output.plain_console import PlainConsole
from tui.studies.reproduce import STUDIES

ROOT = Path(__file__).parents[3]


def samples(names: Iterable[str] = "ABC", n_channels: int = 3) -> dict[str, NDArray[np.float64]]:
    """Return 60 s of sensors with a common motion."""
    rng = np.random.default_rng(5)
    motion = rng.normal(size=(6000, n_channels))
    return {name: motion + 0.1 * rng.normal(size=motion.shape) for name in names}


def imported(tmp_path: Path, sensors: Mapping[str, NDArray[np.float64]] | None = None) -> Path:
    """Return a recording of samples."""
    source, out = tmp_path / "a.npz", tmp_path / "a.h5"
    np.savez(source, sampling_rate=100.0, **(sensors or samples()))  # type: ignore[arg-type]  # names of arrays
    printed("import", str(source), "--out", str(out))
    return out


# ------------------------------------------------------------------------------ help


def test_help_names_every_command() -> None:
    said = printed("--help")
    for panel, commands in PANELS.items():
        assert f"\n{panel}:\n" in said
        for name, summary in commands.items():
            assert re.search(rf"\n  {name} +{re.escape(summary)}\n", said)
            assert " ".join(subcommand(name).help.split("\n\n")[0].split()) == summary


@pytest.mark.parametrize("arguments", [["--version"], ["--help"], ["estimate", "--help"]])
def test_help_loads_nothing_that_takes_long(arguments: list[str]) -> None:
    """How long it takes is measured by ``make bench``."""
    run = f"import sys; from tui.commands.main import main; sys.argv[1:] = {arguments}"
    loaded = modules_after(f"{run}\ntry:\n    main()\nexcept SystemExit:\n    print()")
    assert "typer" in loaded
    assert not loaded & {
        "numpy", "scipy", "h5py", "pydantic", "serial", "pymodbus", "textual", "matplotlib",
        "asyncio", "rich", "logging", "importlib.metadata",
    }  # fmt: skip


def test_help_is_whole_where_python_drops_docstrings() -> None:
    run = [sys.executable, "-OO", "-m", "huddle", "run", "--help-all"]
    shown = subprocess.run(run, capture_output=True, text=True, check=True).stdout
    assert "huddle run lab.toml --duration 3h" in shown
    assert "Record even where the check list fails" in " ".join(shown.split())


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_examples_and_what_is_needed_first_and_help_all_the_rest(name: str) -> None:
    short, whole = printed(name, "--help"), printed(name, "--help-all")
    assert "Examples" in short
    assert f"huddle {name} " in short or f"huddle {name}\n" in short
    options = re.findall(r"^  (?:-\w, )?(--[\w-]+)", short, re.MULTILINE)
    assert len(set(options) - {"--help", "--help-all"}) <= 10
    assert {*options} - {"--help-all"} <= {
        *re.findall(r"^  (?:-\w, )?(--[\w-]+)", whole, re.MULTILINE)
    }
    shown = [each for each in subcommand(name).params if not getattr(each, "hidden", False)]
    assert [each.name for each in shown if not each.help] == []
    declared = chain.from_iterable(each.opts for each in shown)
    assert [each for each in declared if each.startswith("--") and each not in whole] == []
    assert ("--help-all" in short) is (short != whole)


@pytest.mark.parametrize(
    "name", ["estimate", "run", "record", "report", "check", "plan", "simulate", "import"]
)
def test_main_commands_have_a_worked_example_of_options_that_exist(name: str) -> None:
    text = printed(name, "--help").partition("Worked example:")[2]
    assert f"$ huddle {name} " in text
    assert max(map(len, text.splitlines())) <= 80
    for command, rest in re.findall(r"\$ huddle (\w+)(.*)", text):
        known = {*chain.from_iterable(each.opts for each in subcommand(command).params)}
        assert set(re.findall(r"--[\w-]+", rest)) <= known


@pytest.mark.parametrize("name", COMMANDS)
def test_no_command_has_a_flag_twice(name: str) -> None:
    flags = [flag for each in subcommand(name).params for flag in each.opts]
    assert sorted(set(flags)) == sorted(flags)


def test_a_bare_command_and_help_show_help() -> None:
    assert printed() == printed("--help") == printed("help")
    assert printed("help", "estimate") == printed("estimate", "--help")
    assert "No such command" in CliRunner().invoke(app, ["help", "nothing"]).output
    assert printed("-V") == printed("--version")


def test_shells_complete_commands_and_options() -> None:
    for shell in ("bash", "zsh", "fish"):
        assert "_HUDDLE_COMPLETE" in printed("completion", shell)
    asked = {"_HUDDLE_COMPLETE": "complete_bash", "COMP_WORDS": "huddle estimate --segm"}
    done = subprocess.run(
        python_command("tui"),
        env=os.environ | asked | {"COMP_CWORD": "2"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.split() == ["--segment"]


IN_SHELLS = {
    "bash": "source ./huddle; COMP_WORDS=(huddle estimate --segm); COMP_CWORD=2;"
    " _huddle_completion huddle; echo ${COMPREPLY[@]}",
    # as compinit loads it, which gives the words to the first call
    "zsh": "mkdir f; mv huddle f/_huddle; fpath=(f); autoload -Uz _huddle; compdef() { }"
    "; _arguments() { print -r -- $@ }; words=(huddle estimate --segm); CURRENT=3; _huddle",
    "fish": "source ./huddle; complete -C 'huddle estimate --segm'",
}


@pytest.mark.parametrize("shell", IN_SHELLS)
def test_the_shells_themselves_complete(tmp_path: Path, shell: str) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} here")
    (tmp_path / "huddle").write_text(printed("completion", shell), encoding="utf-8")
    own = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    options = {"bash": ["--norc"], "zsh": ["-f"], "fish": ["--no-config"]}[shell]
    done = subprocess.run(
        [shell, *options, "-c", IN_SHELLS[shell]],
        cwd=tmp_path,
        env=own,
        capture_output=True,
        text=True,
        check=False,
    )
    assert "--segment" in done.stdout, done.stderr


def test_the_manual_has_every_command() -> None:
    page = printed("completion", "man")
    assert re.match(r'\.TH HUDDLE 1 "\d{4}-\d\d-\d\d" "huddle ', page)
    for name in COMMANDS:
        assert f"\n.SS huddle {name}\n" in page
    if shutil.which("mandoc") is not None:
        lint = ["mandoc", "-T", "lint", "-W", "warning"]
        done = subprocess.run(lint, input=page, capture_output=True, text=True, check=False)
        assert (done.stdout + done.stderr, done.returncode) == ("", 0)


@pytest.mark.parametrize(
    "command", ["simulate fig9", "import a.csv", "record a.toml", "run a.toml"]
)
def test_no_recording_is_written_under_the_name_of_another_format(
    tmp_path: Path, command: str
) -> None:
    refused = huddle(*command.split(), "--out", str(tmp_path / "x.txt"), code=2)
    assert "expected a file name that ends in .h5" in " ".join(refused.stderr.split())
    assert not list(tmp_path.iterdir())


def test_a_closed_pipe_is_no_failed_limit(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    printed("simulate", "fig9", "--duration", "40s", "--out", str(path))
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "wb") as pipe:  # noqa: PTH123 - a descriptor
        done = subprocess.run(
            [*python_command("tui"), "estimate", str(path)],
            stdout=pipe,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 141
    assert "error" not in done.stderr.lower()


def test_files_and_pipes_have_a_row_on_a_line() -> None:
    out = io.StringIO()
    screen = PlainConsole(file=out, width=110)
    table = Table("sensor", "noise")
    table.add_row("XX.TST5.00 " * 20, "−120 dB")
    screen.print(table)
    screen.print("a sentence of many words " * 20)
    text = out.getvalue()
    assert "XX.TST5.00 " * 19 in text
    assert "a sentence of many words " * 19 in text


def test_help_names_every_study_and_scenario() -> None:
    said = {
        name: set(re.findall(r"[\w-]+", printed(name, "--help")))
        for name in ("reproduce", "simulate")
    }
    assert set(STUDIES) <= said["reproduce"]
    assert set(SCENARIOS) <= said["simulate"]


@pytest.mark.parametrize(
    "scenario", ["fig9", pytest.param("tui/resources/demo.toml", marks=pytest.mark.long)]
)
def test_an_estimate_loads_no_more_than_it_needs(scenario: str, tmp_path: Path) -> None:
    """``np.median``, ``np.quantile`` and most uses of ``np.unique`` load ``numpy.ma``."""
    path = tmp_path / "short.h5"
    named = str(ROOT / scenario) if scenario.endswith(".toml") else scenario
    printed("simulate", named, "--duration", "4min", "--out", str(path))
    run = f"main(['estimate', {str(path)!r}])"
    loaded = modules_after(
        f"from tui.commands.main import main\ntry:\n    {run}\nexcept SystemExit:\n    print()"
    )
    assert {"daq.estimation.estimation", "estimator.checks.diagnose"} <= loaded
    assert not loaded & {
        "daq.bench.model", "daq.bench.response", "daq.results.decision.limits",
        "importlib.metadata", "matplotlib", "numpy.ma", "numpy.polynomial", "numpy.random",
        "pydantic", "scipy", "serial", "textual", "tomlkit", "tui.output.json_document",
    }  # fmt: skip


def test_only_given_options_are_converted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Typer would make a converter with Pydantic for each of thirty options, which takes long."""
    adapters = import_module("typer._adapters")
    build, made = adapters.try_build_adapter, []

    def counted(annotation: object, parameter_info: object) -> object:
        made.append(annotation)
        return build(annotation, parameter_info)

    monkeypatch.setattr(adapters, "try_build_adapter", counted)
    subcommand.cache_clear()
    given = ["night.h5", "day.h5", "--band", "1:20", "--gain", "A=2", "--gain", "B=3"]
    context = subcommand("estimate").make_context("estimate", given)
    assert context.params["files"] == [Path("night.h5"), Path("day.h5")]
    assert context.params["band"] == "1:20"
    assert context.params["gains"] == ["A=2", "B=3"]
    assert context.params["csv"] is None
    assert not made  # texts and paths need no converter
    context = subcommand("record").make_context("record", ["bench.toml", "--duration", "90s"])
    assert context.params["duration"] == 90.0
    assert made.count(float) == 1


def test_a_report_without_matplotlib_names_the_extra_before_anything_is_estimated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    stderr = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stderr)
    arguments = [["report", str(tmp_path / "absent.h5")], ["reproduce", "fig4"]]
    for each in arguments:
        with pytest.raises(SystemExit) as ended:
            main(each)
        assert ended.value.code == 2
    said = " ".join(stderr.getvalue().split())
    assert said.count("matplotlib is not installed") == len(arguments)
    assert f"run: {sys.executable} -m pip install 'fpdf2>=2.8' 'jinja2>=3.1' 'matplotlib" in said


# ----------------------------------------------------------------------------- names


def test_names_with_punctuation_are_printed_as_they_are(tmp_path: Path) -> None:
    """Neither markup nor emoji, and never taken apart: brackets, colons, dots, spaces."""
    names = ("rack:1", "[red]rack:2", "a. b :x:")
    source, out = tmp_path / "a.npz", tmp_path / "[b]a.h5"
    sensors = samples(names)
    sensors[names[1]][:, 2] *= -1
    np.savez(source, sampling_rate=100.0, **sensors)  # type: ignore[arg-type]  # names of arrays
    assert f"{out} written" in "".join(
        printed("import", str(source), "--out", str(out)).split("\n")
    )
    json_file = tmp_path / "a.json"
    said = printed("estimate", str(out), "--segment", "1s", "--json", str(json_file))
    words = " ".join(said.split())
    for name in names:
        assert name in said.split("▲ ")[0]  # the table
    label = [
        f"{channel['sensor']}.{channel['channel']}"
        for channel in json.loads(json_file.read_text(encoding="utf-8"))["channels"]
    ]
    reversed_ = f"{label[5]} has the opposite polarity to {label[2]}"
    assert f"▲ {reversed_}: check the wires (and 1 more)" in words
    long = " ".join(printed("estimate", str(out), "--segment", "1s", "--details").split())
    assert f"{names[0]} → {names[1]}" in long
    assert f"{reversed_}, {label[8]} has the opposite polarity to {label[5]}: no bias" in long
    assert f"All of these have {names[1]} in common" in long


# ------------------------------------------------------------------------ exit codes


def test_usage_is_exit_2(tmp_path: Path) -> None:
    for arguments in (
        ("estimate",),
        ("estimate", "x.h5", "--overlap", "3"),
        ("estimate", "x.h5", "--method", "magic"),
        ("estimate", "x.h5", "--segment", "soon"),
        ("estimate", "x.h5", "--json", "--details"),
        ("fly",),
    ):
        printed(*arguments, code=2)
    bench = tmp_path / "bench.toml"
    bench.write_text('name = "x"\nsampling_rat = 200\n')
    result = huddle("check", str(bench), code=2)
    for said in ("bench.toml", "sampling_rat", "sampling_rate", "sensors"):
        assert said in result.stderr
    assert all(line.startswith("huddle: ") for line in result.stderr.splitlines())


def test_files_in_trouble_are_exit_3(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_text("not HDF5")
    assert "a.h5: not a huddle recording" in words_of("estimate", str(tmp_path / "a.h5"), code=3)
    for name, command in (("b.csv", "import"), ("c.toml", "run")):
        (tmp_path / name).write_text("1,2\n")
        result = CliRunner().invoke(app, ["estimate", str(tmp_path / name)])
        assert f"huddle {command} {tmp_path / name}" in result.stderr
    result = huddle("estimate", str(tmp_path / "none.h5"), code=3)
    assert "none.h5" in result.stderr
    assert "Traceback" not in result.output


@pytest.mark.parametrize("command", ["estimate", "report"])
def test_no_estimate_is_exit_3_and_says_what_is_wrong(tmp_path: Path, command: str) -> None:
    sensors = samples(("r:1", "r:2", "r:3"), 1)
    sensors["r:2"] = sensors["r:1"]
    out = imported(tmp_path, sensors)
    options = ("--method", "three-sensor", "--segment", "1s")
    result = huddle(command, str(out), *options, code=3)
    assert "no channel's noise can be estimated at any frequency by three-sensor" in result.stderr
    assert re.search(r"r:2\.\S+ repeats r:1\.\S+, sample for sample", result.stderr)
    assert "One signal is connected or named twice" in result.stderr
    assert all(line.startswith("huddle: ") for line in result.stderr.splitlines())


def test_noise_parameters_on_request(tmp_path: Path) -> None:
    file = str(imported(tmp_path))
    assert "Allan" not in printed("estimate", file, "--segment", "1s")
    said = printed("estimate", file, "--segment", "1s", "--noise-parameters")
    assert re.search(r"channel +random walk +flicker +white +f² +quantisation", said)
    assert "Allan deviation of the self-noise" in said
    found = json.loads(
        printed("estimate", file, "--segment", "1s", "--noise-parameters", "--json", "-")
    )
    first = found["noise_parameters"][0]
    white = first["terms"]["white"]
    assert abs(white["value"] - 0.01 / 50) < 4 * white["error"]
    assert len(first["allan_deviation"]["tau"]) == len(first["allan_deviation"]["deviation"])
    documented = reference.keys("result-2.schema.json")
    assert not [key for key in first if f"`{key}`" not in documented]


def test_options_that_do_not_go_with_a_recording_are_exit_2(tmp_path: Path) -> None:
    file = str(imported(tmp_path))
    result = huddle("estimate", file, "--segment", "1s", "--band", "60:70", code=2)
    assert "no frequency between 60 and 70 Hz" in result.stderr
    assert not result.stdout
    for options in (
        ("--dimension", "2", "--method", "three-sensor"),
        ("--dimension", "many"),
        ("--gain", "Q=2"),
        ("--gain", "A"),
        ("--gain", "A=0"),
        ("--unit", "kg"),
    ):
        printed("estimate", file, "--segment", "1s", *options, code=2)


@pytest.mark.skipif(sys.platform == "win32", reason="locales")
def test_output_survives_a_terminal_that_knows_no_signs(tmp_path: Path) -> None:
    file = str(imported(tmp_path))
    done = subprocess.run(
        python_command("tui", "estimate", file, "--segment", "1s"),
        capture_output=True,
        env=os.environ | {"LC_ALL": "C", "PYTHONIOENCODING": "ascii"},
        check=True,
    )
    assert "(counts)²/Hz" in done.stdout.decode("utf-8")


# --------------------------------------------------------------------------- benches


def test_init_writes_a_bench_file_that_check_accepts(tmp_path: Path) -> None:
    bench = tmp_path / "lab.toml"
    printed("init", "--out", str(bench))
    before = bench.read_text(encoding="utf-8")
    said = printed("check", str(bench), "--no-devices")
    assert ": no errors." in said
    assert "A (3 channels at 200 Hz)" in said
    assert "--force replaces it" in words_of("init", "--out", str(bench), code=2)
    assert bench.read_text(encoding="utf-8") == before


def test_check_names_sensor_and_port_that_are_not_there(tmp_path: Path) -> None:
    bench = tmp_path / "lab.toml"
    printed("init", "--out", str(bench))
    text = bench.read_text(encoding="utf-8").replace("/dev/ttyUSB", f"{tmp_path}/tty")
    bench.write_text(text, encoding="utf-8")
    result = huddle("check", str(bench), "--json", "-", code=3)
    for name, port in (("A", "tty0"), ("B", "tty1"), ("C", "tty2")):
        (line,) = (line for line in result.stderr.splitlines() if port in line)  # once
        assert f"'{name}'" in line
    assert len(json.loads(result.stdout)["errors"]) == 3


def test_check_says_where_a_serial_number_cannot_be_checked() -> None:
    found = SensorCheck(DeviceInformation("A"), 200, 0, 100.0, False, (), ())
    assert list(remarks(found, "")) == []
    (remark,) = remarks(found, "1001")
    assert "'1001' of the bench file cannot be checked" in remark
    known = replace(found, information=DeviceInformation("A", serial_number="1001"))
    assert list(remarks(known, "1001")) == []


def test_serve_lists_the_next_runs_and_wants_cron_lines(tmp_path: Path) -> None:
    bench = tmp_path / "lab.toml"
    printed("init", "--out", str(bench))
    assert "schedule.cron" in words_of("serve", str(bench), "--list", code=2)
    with bench.open("a", encoding="utf-8") as lines:
        lines.write('\n[schedule]\ncron = ["30 22 * * 1-5"]\ntime_zone = "Europe/Berlin"\n')
    times = json.loads(printed("serve", str(bench), "--list", "--json", "-"))["next"]
    assert len(times) == 5
    assert all("T22:30:00" in time for time in times)


def test_plan_says_how_long_to_record(tmp_path: Path) -> None:
    bench = tmp_path / "lab.toml"
    printed("init", "--out", str(bench))
    found = json.loads(printed("plan", str(bench), "--cov", "0.05", "--json", "-"))["methods"]
    plans = {entry["method"]: entry for entry in found}
    # √(2.5 / n) is the c.o.v. of equal, orthogonal channels: 1000 averages, 5 s apart under Hann.
    # The third of an octave from 1 Hz on has three frequencies, worth 1.83 independent ones.
    assert plans["three-sensor"]["duration"] == pytest.approx(1003 * 5.0 * 1.06 / 1.83, rel=0.05)
    assert max(map(abs, plans["three-sensor"]["bias"])) < 1e-3
    assert max(plans["three-channel"]["bias"]) > 1
    assert all(0.9 < share <= 1 for share in plans["three-sensor"]["efficiency"])
    shown = printed("plan", str(bench), "--cov", "0.05")
    assert "3 sensors cannot tell gradients of the motion from noise" in " ".join(shown.split())
    assert "efficiency" in shown
    assert "motion too weak" not in shown
    assert "motion too weak" in printed("plan", str(bench), "--snr", "1e-5")
    for snr in ("inf", "1e30", "nan"):
        huddle("plan", str(bench), "--snr", snr, code=2)


def test_what_is_written_as_json_is_documented(tmp_path: Path) -> None:
    bench, out = str(tmp_path / "lab.toml"), str(tmp_path / "model.h5")
    said = (ROOT / "docs" / "json.md").read_text(encoding="utf-8")
    said += reference.keys("result-2.schema.json")
    printed("init", "--out", bench)
    for command in (
        ("check", bench, "--no-devices"),
        ("plan", bench),
        ("simulate", bench, "--out", out, "--duration", "25s"),
        ("repair", out, "--check"),
        ("estimate", out, "--noise-parameters", "--segment", "2s"),
    ):
        document = json.loads(printed(*command, "--json", "-"))
        missing = [key for key in document if f"`{key}`" not in said]
        assert not missing, command


# --- ``--log-level`` and ``--log-format`` ----------------------------------------------------


LONG = ("run", "record", "watch", "serve", "devices", "demo", "import", "simulate", "reproduce")
pseudo_terminals = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")


def run(bench: Path, folder: Path, duration: str = "6s") -> list[str]:
    """Return the command for a run: by default as short as it may be."""
    out = str(folder / "r.h5")
    return python_command(
        "tui", "run", str(bench), "--duration", duration, "--segment", "0.5s", "--out", out
    )


@pytest.mark.parametrize("command", LONG)
def test_commands_that_run_for_long_have_both_options(command: str) -> None:
    said = CliRunner().invoke(app, [command, "--help-all"]).output
    assert "--log-level" in said
    assert "--log-format" in said


def test_the_application_logs_to_a_file_only() -> None:
    assert "--log-file" in CliRunner().invoke(app, ["tui", "--help-all"]).output


@pytest.mark.long
@pseudo_terminals
def test_json_is_all_there_is_on_standard_error(bench: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [*run(bench, tmp_path), "--log-format", "json"],
        capture_output=True,
        text=True,
        check=True,
    )
    entries = [json.loads(line) for line in done.stderr.splitlines()]
    loggers = {entry["logger"] for entry in entries}
    assert {"daq.recorder.recorder", "tui.commands.record"} <= loggers  # the recorder's process
    connected = {entry["sensor"] for entry in entries if entry.get("kind") == "connected"}
    assert connected == {"A", "B", "C"}
    assert all(entry["time"].endswith("Z") for entry in entries)


@pytest.mark.long
@pseudo_terminals
def test_the_level_holds_for_the_recorder_too(bench: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [*run(bench, tmp_path), "--log-level", "error", "--log-format", "json"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""


@pytest.mark.long
@pseudo_terminals
def test_on_a_terminal_log_lines_stay_whole_beside_the_progress_bar(
    bench: Path, tmp_path: Path
) -> None:
    import pty  # noqa: PLC0415 - not on Windows

    ours, theirs = pty.openpty()
    environment = os.environ | {"TERM": "xterm-256color", "COLUMNS": "60"}
    try:
        with subprocess.Popen(
            run(bench, tmp_path, "20s"),  # simulated time runs fast
            stdout=subprocess.DEVNULL,
            stderr=theirs,
            env=environment,
        ) as process:
            os.close(theirs)
            shown = b""
            try:
                while part := os.read(ours, 1 << 16):
                    shown += part
            except OSError:  # Linux: the other side is closed
                pass
        assert process.returncode == 0
    finally:
        os.close(ours)
    text = re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", shown.decode())
    rows = [row.strip() for row in re.split(r"[\r\n]+", text)]
    logged = [row for row in rows if " INFO " in row]
    assert sum("connected: on " in row for row in logged) == 3
    assert all(re.match(r"\d{4}-\d\d-\d\dT[\d:.]+Z INFO [a-z.]+[a-z_]*: ", row) for row in logged)
    assert any("segments" in row and row not in logged for row in rows)  # the progress bar


@pytest.mark.parametrize(
    "command", [("run", "--bad"), ("--bad",), ("estimate", "x.h5", "--json", "nowhere/x")]
)
def test_wrong_usage_is_said_in_plain_lines_without_boxes(command: tuple[str, ...]) -> None:
    result = huddle(*command, code=2)
    assert result.stderr
    assert all(line.startswith("huddle: ") for line in result.stderr.splitlines())


def test_an_error_is_a_record_where_json_is_wanted(tmp_path: Path) -> None:
    missing = str(tmp_path / "missing.toml")
    result = huddle("record", missing, "--log-format", "json", code=2)
    (line,) = result.stderr.splitlines()
    entry = json.loads(line)
    assert (entry["level"], entry["exit_code"]) == ("error", 2)
    assert missing in entry["errors"][0]
