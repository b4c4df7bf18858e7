"""Records against frozen dataclasses of the same fields."""

from __future__ import annotations

import copy
import pickle
from dataclasses import FrozenInstanceError, dataclass, field, fields, is_dataclass, replace
from typing import Any

import pytest

from estimator import records
from estimator.records import Kind


class ABase(Kind):
    """A kind."""

    level: int
    sensors: tuple[int, ...] = ()


class SpecialKind(ABase):
    """A kind with more fields."""

    share: float
    whole: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class _Usual:
    level: int
    sensors: tuple[int, ...] = ()
    share: float
    whole: bool = False


def test_a_record_is_as_a_frozen_dataclass() -> None:
    made, usual = SpecialKind(level=1, share=0.5), _Usual(level=1, share=0.5)
    assert is_dataclass(made)
    assert [each.name for each in fields(made)] == [each.name for each in fields(usual)]
    assert repr(made).removeprefix("SpecialKind") == repr(usual).removeprefix("_Usual")
    assert made == SpecialKind(level=1, share=0.5, sensors=(), whole=False)
    assert made != SpecialKind(level=1, share=0.25)
    assert made != ABase(level=1)
    assert hash(made) == hash(usual)
    assert replace(made, sensors=(2,)) == SpecialKind(level=1, share=0.5, sensors=(2,))
    assert copy.copy(made) == made
    assert pickle.loads(pickle.dumps(made)) == made  # noqa: S301 - made here
    assert (made.name, ABase.name) == ("special-kind", "a-base")


def test_a_record_cannot_be_changed() -> None:
    made = ABase(level=1)
    with pytest.raises(FrozenInstanceError, match="cannot assign to field 'level'"):
        made.level = 2  # type: ignore[misc]  # what is tested
    with pytest.raises(FrozenInstanceError, match="cannot delete field 'level'"):
        del made.level
    assert made.level == 1


@pytest.mark.parametrize(
    ("values", "message"),
    [({"level": 1}, "SpecialKind without share"), ({"level": 1, "share": 2.0, "x": 3}, "has no x")],
)
def test_fields_are_complete_and_known(values: dict[str, float], message: str) -> None:
    with pytest.raises(TypeError, match=message):
        SpecialKind(**values)  # type: ignore[arg-type]  # what is tested


@pytest.mark.parametrize("eq", [True, False])
def test_the_stand_in_makes_what_dataclasses_makes(eq: bool) -> None:
    class Plain:
        level: int
        own: list[int] = field(default_factory=list, init=False, repr=False)
        sensors: tuple[int, ...] = ()

        def __post_init__(self) -> None:
            if self.level < 0:
                raise ValueError("level")

    kinds: list[Any] = [
        make(frozen=True, slots=True, eq=eq)(type("Plain", (), dict(Plain.__dict__)))
        for make in (records.dataclass, dataclass)
    ]
    made: list[Any] = [kind(1, (2,)) for kind in kinds]
    assert len(set(map(repr, made))) == 1
    assert [one == type(one)(1, (2,)) for one in made] == [eq, eq]
    assert [replace(one, level=3).level for one in made] == [3, 3]
    for kind in kinds:
        with pytest.raises(TypeError):
            kind(1, (2,), 3)
        with pytest.raises(ValueError, match="level"):
            kind(-1)
