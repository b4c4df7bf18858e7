"""How our own modules are started as processes, and how packages that they lack are installed."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path


def python_command(module: str, *arguments: str) -> list[str]:
    """Return the command that runs a module in a new Python interpreter.

    ``-P`` keeps the working directory off ``sys.path``. Bench files and recordings lie in folders
    that also hold scripts; without it, a ``random.py`` beside the bench file would be imported by
    the recorder in place of the standard library's.
    """
    return [sys.executable, "-P", "-m", module, *arguments]


def install_command(extra: str) -> str:
    """Return the command that installs the packages of an extra beside this copy of huddle.

    The packages are named, not the extra: the copy may be of an index, a wheel or a folder that
    this environment cannot reach any more.
    """
    from importlib.metadata import PackageNotFoundError, distribution  # noqa: PLC0415 - seldom needed

    try:
        own = distribution("huddle-bench")
    except PackageNotFoundError:  # a source tree that is not installed
        tree = Path(__file__).resolve().parents[1]
        return shlex.join([sys.executable, "-m", "pip", "install", f"{tree}[{extra}]"])
    needed = (each.partition(";") for each in own.requires or [])
    own_marker = {f"extra == '{extra}'", f'extra == "{extra}"'}
    packages = [each.strip() for each, _, marker in needed if marker.strip() in own_marker]
    prefix = Path(sys.prefix)
    if prefix.parent.name == "venvs" and (prefix / "pipx_metadata.json").exists():
        start = ["pipx", "inject", prefix.name]
    elif (own.read_text("INSTALLER") or "").strip() == "uv":
        start = ["uv", "pip", "install", "--python", sys.executable]
    else:
        start = [sys.executable, "-m", "pip", "install"]
    return shlex.join([*start, *(packages or [f"huddle-bench[{extra}]"])])
