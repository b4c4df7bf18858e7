"""The subcommands: options and help here, what they do elsewhere and loaded when they run."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

Command = TypeVar("Command", bound="Callable[..., object]")

EXAMPLES: dict[str, tuple[str, ...]] = {}
"""Lines that the help of a subcommand shows, by the name of its function."""


def examples(*lines: str) -> Callable[[Command], Command]:
    """Give a subcommand examples."""

    def keep(command: Command) -> Command:
        EXAMPLES[command.__name__] = lines
        return command

    return keep
