"""``huddle web``: the pages of a bench in the browser."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import getpass
import secrets
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from daq.errors import BenchFileError, FileFault
from tui.commands.options import command, with_logging
from tui.output.console import console
from tui.output.extras import require


@command()
@with_logging
def web(
    bench: Path | None = None,
    *,
    address: str | None = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535)] = None,
    insecure: bool = False,
    password: bool = False,
    token: bool = False,
) -> None:
    """Show a bench in the browser, until Ctrl-C.

    Pages: the running test, all tests with curves, facts, reports and data,
    sensors over months, and an archive. Without a table [web] in the bench
    file, only this computer reaches them, and they start and stop nothing
    (docs/web.md).

    Parameters
    ----------
    bench : BENCH
        Bench file (TOML).
    address : IP
        Address to listen at (default: from the bench file, or 127.0.0.1).
    port : N
        Port (default: from the bench file, or 8040; 0: any free one).
    insecure
        Serve beyond this computer without TLS: others may read passwords.
    password
        Ask for a password, and print its hash.
    token
        Make a random token, and print it with its hash.

    Examples
    --------
    huddle web lab.toml
    huddle web lab.toml --address 192.168.1.20 --port 8443
    huddle web --password   (print a line for read or steer in the table [web])
    """
    if [bench is not None, password, token].count(True) != 1:
        raise typer.BadParameter("expected a bench file, or --password, or --token")
    if password:
        _print_password()
    elif token:
        _print_token()
    elif bench is not None:
        _serve(bench, {"address": address, "port": port, "insecure": insecure or None})


def _serve(path: Path, changes: dict[str, Any]) -> None:
    """Serve the pages of a bench until SIGINT or SIGTERM.

    Raises
    ------
    BenchFileError
        If others reach the address and no secret is in the bench file.
    AccessError, OSError
        If a secret, the port or a certificate cannot be used.
    """
    require("starlette", "uvicorn", "jinja2", "matplotlib")
    from pydantic import ValidationError

    from daq.bench.tables.unattended import Web
    from daq.devices.bench_file import load
    from daq.estimation.settings import Settings
    from daq.recorder.schedule import utc_now
    from tui.commands.tui_controls import BenchControls
    from tui.service.processes.steps import ProcessSteps
    from tui.service.records.store import RunStore
    from tui.service.status import service_status
    from tui.web.server import Server

    bench = load(path)
    given = {} if bench.web is None else bench.web.model_dump()
    given |= {name: value for name, value in changes.items() if value is not None}
    try:
        table = Web.model_validate(given)
    except ValidationError as error:
        faults = (str(each["msg"]).removeprefix("Value error, ") for each in error.errors())
        raise BenchFileError(FileFault("web", "; ".join(faults)), source=path) from None
    controls = BenchControls(path, bench, Settings.of(bench))

    def status() -> dict[str, Any]:
        bench.recording_directory.mkdir(parents=True, exist_ok=True)
        runs = RunStore(bench.recording_directory).current(bench.name)
        return service_status(bench, runs, utc_now())

    def ready(url: str) -> None:
        console().print(f"{bench.name}: {url}", soft_wrap=True)

    try:
        Server(controls, bench, table, status, ProcessSteps(bench, path).check).run(ready)
    finally:
        controls.release()


def _print_password() -> None:
    """Ask for a password, and print the line of a bench file for it.

    Raises
    ------
    typer.BadParameter
        If it is too short, or was not repeated.
    """
    from tui.web.access import SHORTEST_PASSWORD, password_hash

    if sys.stdin.isatty():
        given = getpass.getpass("Password: ")
        if getpass.getpass("Again: ") != given:
            raise typer.BadParameter("the two passwords differ")
    else:
        given = sys.stdin.readline().rstrip("\n")
    if len(given) < SHORTEST_PASSWORD:
        raise typer.BadParameter(
            f"the password has {len(given)} characters; expected {SHORTEST_PASSWORD} or more"
        )
    console().print(f'"{password_hash(given)}"', soft_wrap=True)


def _print_token() -> None:
    """Make a token, and print it with the line of a bench file for it."""
    from tui.web.access import token_hash

    token = secrets.token_urlsafe(32)
    console().print(f"token  {token}", soft_wrap=True)
    console().print(f'line   "{token_hash(token)}"', soft_wrap=True)
