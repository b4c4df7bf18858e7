"""Immutable records that cost little to define.

``dataclass(frozen=True)`` compiles six methods for every class, which takes half a millisecond of
processor time. The seventy kinds of advice and facts are defined whenever the program starts, and
few of them are made. `record` makes the same of a class, with the methods of `Record` for all.
Instances take longer to make than those of a frozen dataclass: it is for classes that are many.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import MISSING, Field, FrozenInstanceError, dataclass, fields
from typing import Any, NoReturn, TypeAlias, TypeVar, dataclass_transform

Seconds: TypeAlias = float
Hertz: TypeAlias = float
Share: TypeAlias = float
"""Of the noise, unless its field says of what else."""
Decibels: TypeAlias = float
Degrees: TypeAlias = float
UNITS = {"Seconds": "s", "Hertz": "hz", "Share": "share", "Decibels": "db", "Degrees": "deg"}
"""Of fields with these types: what is behind their names in JSON."""
NOT_IN_JSON: Mapping[str, None] = {"key": None}
"""Metadata of a field that JSON leaves out; "key" is the name of another."""
_UNIT = re.compile(rf"\b({'|'.join(UNITS)})\b")

_Record = TypeVar("_Record", bound="Record")


@dataclass_transform(kw_only_default=True, frozen_default=True)
def record(kind: type[_Record]) -> type[_Record]:
    """Make a subclass of `Record` a frozen dataclass with slots, made by keywords only."""
    return dataclass(slots=True, kw_only=True, init=False, repr=False, eq=False)(kind)


class Record:
    """Base of records: what a frozen dataclass compiles for each class."""

    __slots__ = ()

    def __init__(self, **values: Any) -> None:  # noqa: ANN401 - of the fields
        for each in fields(self):  # type: ignore[arg-type]  # every subclass is a dataclass
            value = values.pop(each.name, each.default)
            if value is MISSING:
                raise TypeError(f"{type(self).__name__} without {each.name}")
            object.__setattr__(self, each.name, value)
        if values:
            raise TypeError(f"{type(self).__name__} has no {', '.join(values)}")

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise FrozenInstanceError(f"cannot assign to field {name!r}")

    def __delattr__(self, name: str) -> NoReturn:
        raise FrozenInstanceError(f"cannot delete field {name!r}")

    def __repr__(self) -> str:
        shown = (f"{name}={value!r}" for name, value in self._items())
        return f"{type(self).__qualname__}({', '.join(shown)})"

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return self._items() == other._items()

    def __hash__(self) -> int:
        return hash(tuple(value for _, value in self._items()))

    def __getstate__(self) -> dict[str, Any]:
        return dict(self._items())

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            object.__setattr__(self, name, value)

    def _items(self) -> list[tuple[str, Any]]:
        names = [each.name for each in fields(self)]  # type: ignore[arg-type]  # as above
        return [(name, getattr(self, name)) for name in names]


def json_key(each: Field[Any]) -> str | None:
    """Return the name of a field in JSON: its own with the unit that its type names, or its "key".

    None of a field that JSON leaves out.
    """
    if "key" in each.metadata:
        name: str | None = each.metadata["key"]
        return name
    found = _UNIT.search(str(each.type))
    return f"{each.name}_{UNITS[found[1]]}" if found else each.name
