"""The ``huddle`` command: its subcommands, and the one place where errors become exit codes.

Each subcommand imports its modules when it runs, so ``huddle --help`` loads neither numpy nor HDF5,
and ``huddle record`` does not load Textual.

Exit codes are in :mod:`tui.output.exit_codes`. The type of an error decides its code.
"""

from __future__ import annotations

import atexit
import gc
import io
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib import import_module
from typing import Any, NoReturn

import typer

from tui import __version__
from tui.commands.help import ASKED_BY_SHELL, LazyGroup
from tui.output.exit_codes import ExitCode


class HuddleGroup(LazyGroup):
    """Runs a subcommand; converts its exceptions into messages and exit codes."""

    def main(self, args: Sequence[str] | None = None, *rest: Any, **options: Any) -> Any:  # noqa: ANN401 - the library's own
        """Run the command, and its help without any. Usage errors are plain lines."""
        args = list(sys.argv[1:] if args is None else args)
        if args[:1] == ["help"]:  # as of git and others
            args = [*args[1:2], "--help"]
        args = args or ["--help"]
        if not options.get("standalone_mode", True):
            return super().main(args, *rest, **options)
        try:
            code = super().main(args, *rest, **options | {"standalone_mode": False})
        except typer.Abort:  # the end of standard input where an answer is expected
            code = ExitCode.TROUBLE
        except typer.TyperException as error:  # a usage error
            from tui.output.logs.lines import report_failure  # noqa: PLC0415 - seldom needed

            context = getattr(error, "ctx", None)
            lines = [error.format_message()]
            if context is not None:
                lines.append(f"see {context.command_path} --help")
            report_failure(lines, exit_code=ExitCode.USAGE)
            code = ExitCode.USAGE
        sys.exit(code)

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401 - the context is the library's own
        """Run the subcommand."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise typer.Exit(ExitCode.INTERRUPTED) from None
        except BrokenPipeError:  # | head
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(ExitCode.CLOSED_PIPE) from None
        except (typer.Exit, typer.Abort, typer.TyperException):
            raise  # of the library, which shows usage errors itself
        except Exception as error:  # noqa: BLE001 -- the one place where errors become exit codes
            from tui.output.logs.lines import COMMAND, report_failure  # noqa: PLC0415 - seldom needed

            code = exit_code(error)
            lines = list(messages(error))
            if code is None:
                COMMAND.critical("unexpected error", exc_info=True)
                code = ExitCode.TROUBLE
                lines = ["this is an error in huddle itself; please report it"]
            with suppress(OSError):  # standard error may be a file on a full disk
                report_failure(lines, exit_code=code)
            raise typer.Exit(code) from None


def exit_code(error: BaseException) -> ExitCode | None:
    """Return the exit code of an error; None for an error of the program itself."""
    from daq.errors import HuddleError  # noqa: PLC0415 - seldom needed
    from estimator.errors import EstimatorError  # noqa: PLC0415
    from sim_devices.errors import SimulationError  # noqa: PLC0415

    if isinstance(error, BaseExceptionGroup):
        codes = [exit_code(inner) for inner in error.exceptions]
        return None if None in codes else max(code for code in codes if code is not None)
    if isinstance(error, (HuddleError, EstimatorError, SimulationError)):
        return ExitCode.USAGE if error.is_usage_error else ExitCode.TROUBLE
    return ExitCode.TROUBLE if isinstance(error, OSError) else None


def messages(error: BaseException) -> Iterator[str]:
    """Yield the message of an error, line by line."""
    if isinstance(error, BaseExceptionGroup):
        for inner in error.exceptions:
            yield from messages(inner)
    elif isinstance(error, OSError) and error.strerror:
        yield ": ".join(str(part) for part in (error.filename, error.strerror) if part)
    else:
        yield from (str(error) or type(error).__name__).splitlines()
        loaded = sys.modules.get("daq.estimation.snapshot")
        if loaded is not None and isinstance(error, loaded.NoResultError):
            from daq.estimation.settings import Settings  # noqa: PLC0415 - seldom needed
            from daq.results.result import Result  # noqa: PLC0415

            refused = error.snapshot.refused  # in the message already
            for each in Result(error.snapshot, Settings()).facts:
                if each.needs_action and each.method not in refused:
                    yield str(each)


app = typer.Typer(
    name="huddle",
    cls=HuddleGroup,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    help=(
        "Measure the self-noise of accelerometers placed side by side (huddle test): read them, "
        "record, estimate. The sensors may point in any direction.\n\n"
        "Without hardware, huddle demo runs a complete test on simulated sensors."
    ),
)


def _version(requested: bool) -> None:
    if requested:
        typer.echo(f"huddle {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(
        False,
        "--version",
        "-V",
        callback=_version,
        is_eager=True,
        help="Show the version and exit.",
    ),
) -> None:
    del version


def _spare_the_processor() -> None:
    """Set what libraries read when they are imported."""
    # The matrices are small: BLAS's own threads would only wait for each other, at full load.
    for variable in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    import_module("daq.estimation.blas_threads")  # which sees that they are set
    # Plug-ins would be looked for in every installed package.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    # Imports make many objects, all of which stay: cycles are not searched for among them, neither
    # now nor when the process ends.
    gc.set_threshold(100_000)
    atexit.register(gc.freeze)


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command and exit with its code."""
    _spare_the_processor()
    if ASKED_BY_SHELL in os.environ:
        import_module("typer.completion").completion_init()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # files and pipes hold UTF-8 everywhere
            stream.reconfigure(
                encoding=stream.encoding if stream.isatty() else "utf-8", errors="replace"
            )
    try:
        app(arguments, prog_name="huddle")
    except SystemExit as ended:
        writer = sys.modules.get("daq.recording.writer")
        code = ExitCode.DONE if ended.code is None else ended.code
        unsafe = code == ExitCode.TROUBLE or (writer is not None and writer.BROKEN)
        is_program = arguments is None
        if is_program and unsafe and "h5py" in sys.modules and isinstance(code, int):
            # HDF5 can crash on exit after an error of the disk; all files of ours are closed.
            with suppress(OSError):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(code)
        raise
    raise SystemExit(ExitCode.DONE)
