"""Counts with singular or plural nouns."""

from __future__ import annotations


def several(count: int, one: str, rest: str = "") -> str:
    """Return a count with its noun, such as "1 frame lost" or "2 frames lost"."""
    return f"{count} {one}{'s' * (count != 1)}{' ' * bool(rest)}{rest}"
