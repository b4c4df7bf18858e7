"""How many, in words."""

from __future__ import annotations


def several(count: int, one: str, rest: str = "") -> str:
    """Return "1 frame came twice" and "2 frames came twice" alike."""
    return f"{count} {one}{'s' * (count != 1)}{' ' * bool(rest)}{rest}"
