"""Immutable records that cost little to define.

``dataclasses.dataclass(frozen=True)`` compiles six methods for every class, which takes half a
millisecond of processor time. Two hundred classes are defined whenever the program starts, and most
are made seldom. `dataclass` and `Kind` make the same of a class, with the methods of `Record` for
all. Instances take a few microseconds longer to make: hot loops have no use for them.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, FrozenInstanceError
from functools import cache
from threading import RLock
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn, TypeAlias, dataclass_transform

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
_CAPITAL = re.compile(r"(?<!^)(?=[A-Z])")
_UNIT = re.compile(rf"\b({'|'.join(UNITS)})\b")

_MADE = ("__init__", "__repr__", "__getstate__", "__setstate__")
_FROZEN = ("__setattr__", "__delattr__")
_COMPARED = ("__eq__", "__hash__")


_FINDING = RLock()
_fields: Callable[[type], tuple[Field[Any], ...]] = cache(dataclasses.fields)


class Record:
    """Base of records: what a frozen dataclass compiles for each class."""

    __slots__ = ()

    def __init__(self, *given: Any, **named: Any) -> None:  # noqa: ANN401 - of the fields
        placed = iter(given)
        for each in _fields(type(self)):
            value = each.default
            if each.init:
                value = next(placed, MISSING)
                if value is MISSING:
                    value = named.pop(each.name, each.default)
            if value is MISSING and each.default_factory is not MISSING:
                value = each.default_factory()
            if value is not MISSING:
                object.__setattr__(self, each.name, value)
            elif each.init:
                raise TypeError(f"{type(self).__name__} without {each.name}")
        named |= {repr(each): each for each in placed}
        if named:
            raise TypeError(f"{type(self).__name__} has no {', '.join(named)}")
        if check := getattr(self, "__post_init__", None):
            check()

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise FrozenInstanceError(f"cannot assign to field {name!r}")

    def __delattr__(self, name: str) -> NoReturn:
        raise FrozenInstanceError(f"cannot delete field {name!r}")

    def __repr__(self) -> str:
        shown = (f"{e.name}={getattr(self, e.name)!r}" for e in _fields(type(self)) if e.repr)
        return f"{type(self).__qualname__}({', '.join(shown)})"

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return self.__getstate__() == other.__getstate__()

    def __hash__(self) -> int:
        return hash(tuple(self.__getstate__().values()))

    def __getstate__(self) -> dict[str, Any]:
        return {each.name: getattr(self, each.name) for each in _fields(type(self))}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            object.__setattr__(self, name, value)


class _Fields:
    """Fields of a class as `dataclasses` finds them, when they are asked for: most never are.

    `kind` is the class as it is written, `of` the one that has its fields, if that is another.
    """

    def __init__(self, kind: type, of: type, *, kw_only: bool = False) -> None:
        self._kind, self._of, self._kw_only = kind, of, kw_only

    def __get__(self, made: object, owner: type) -> Any:  # noqa: ANN401 - of `dataclasses`
        with _FINDING:  # a class is changed by it: another thread must not begin with that
            found: Any = self._kind.__dict__.get("__dataclass_fields__", self)
            if found is self:
                about = {"init": False, "repr": False, "eq": False, "kw_only": self._kw_only}
                dataclasses.dataclass(**about)(self._kind)
                found = self._kind.__dict__["__dataclass_fields__"]
                self._of.__dataclass_params__ = self._kind.__dataclass_params__
                self._of.__dataclass_fields__ = found
            return found


@dataclass_transform(kw_only_default=True, frozen_default=True)
class Kind(Record):
    """Base of records of which each subclass is a kind, and made by keywords only.

    Attributes
    ----------
    name : str
        Name of the kind in JSON: that of the class, in lower case with hyphens.
    """

    name: ClassVar[str]

    def __init_subclass__(cls) -> None:
        cls.name = _CAPITAL.sub("-", cls.__name__).lower()
        cls.__dataclass_fields__ = _Fields(cls, cls, kw_only=True)  # type: ignore[attr-defined]


if TYPE_CHECKING:
    from dataclasses import dataclass as dataclass  # noqa: PLC0414 - for others, too
else:

    def dataclass(
        *, slots: bool = False, eq: bool = True, frozen: bool = False, **_: bool
    ) -> Callable[[type], type]:
        """Stand in for the one of `dataclasses`, with fields in order."""

        def made(kind: type) -> type:
            for name in _MADE + _FROZEN * frozen + _COMPARED * eq:
                if name not in kind.__dict__:
                    setattr(kind, name, Record.__dict__[name])
            if eq and not frozen:
                kind.__hash__ = None
            found = kind
            if slots:
                types = inspect.get_annotations(kind)
                own = [name for name, of in types.items() if "ClassVar" not in str(of)]
                known = {slot for base in kind.__mro__ for slot in getattr(base, "__slots__", ())}
                lacks = {*own, "__dict__", "__weakref__"}
                members = {name: of for name, of in kind.__dict__.items() if name not in lacks}
                members["__slots__"] = tuple(name for name in own if name not in known)
                found = type(kind)(kind.__name__, kind.__bases__, members)
                found.__qualname__ = kind.__qualname__
            found.__dataclass_fields__ = _Fields(kind, found)
            return found

        return made


def json_key(each: Field[Any]) -> str | None:
    """Return the name of a field in JSON: its own with the unit that its type names, or its "key".

    None of a field that JSON leaves out.
    """
    if "key" in each.metadata:
        name: str | None = each.metadata["key"]
        return name
    found = _UNIT.search(str(each.type))
    return f"{each.name}_{UNITS[found[1]]}" if found else each.name


def json_keys(kind: type[Any]) -> Mapping[str, str]:
    """Return the attributes of a class in JSON, by key: fields, and properties by its `IN_JSON`."""
    keys = {json_key(each): each.name for each in _fields(kind)}
    keys |= getattr(kind, "IN_JSON", {})
    return {key: name for key, name in keys.items() if key is not None}
