"""Examples in the help of subcommands."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

Command = TypeVar("Command", bound="Callable[..., object]")

EXAMPLES: dict[str, tuple[str, ...]] = {}
"""Example lines by the name of the function of a subcommand."""


def examples(*lines: str) -> Callable[[Command], Command]:
    """Add examples to the help of a subcommand."""

    def keep(command: Command) -> Command:
        EXAMPLES[command.__name__] = lines
        return command

    return keep
