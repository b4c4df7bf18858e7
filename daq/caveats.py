"""Caveats of recordings: what must be read before the numbers made of them.

A recording says which it has, and what is made of it keeps them: status, snapshot, source, run,
ledger. Nobody asks for a single one. Names end with `Caveats.after`, sentences with
`Caveats.nouns`; files and JSON have `Caveats.keys`; documents begin with the words of each. A
further caveat is one more `Caveat` with its words.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import Any, NamedTuple


class CaveatWords(NamedTuple):
    """How people are told of a caveat.

    Attributes
    ----------
    noun : str
        What is concerned.
    sentence : str
        What it does to the noise.
    warning : str
        First lines of a report.
    scope : str
        First line of a Digital Calibration Certificate.
    refusal : str
        Why no certificate is issued.
    comment : str
        In StationXML, as no part of miniSEED can say so; imports look for it.
    """

    noun: str
    sentence: str
    warning: str
    scope: str
    refusal: str
    comment: str


class Caveat(StrEnum):
    """A caveat; its value is its key in files and JSON."""

    SIMULATED = "simulated"
    """A sensor was simulated: the noise is that of a model."""

    @property
    def words(self) -> CaveatWords:
        """How people are told of it."""
        return _WORDS[self]


_WORDS = {
    Caveat.SIMULATED: CaveatWords(
        noun="simulated sensors",
        sentence="Simulated sensors: the noise is that of a model, not of instruments.",
        warning="SIMULATED SENSORS: the noise is that of a model. No instrument was measured.",
        scope="SIMULATED SENSORS: no instrument was measured.",
        refusal="sensors were simulated: no certificate is issued of a model",
        comment="huddle: simulated sensor",
    )
}


class Caveats(tuple[Caveat, ...]):
    """The caveats of something, each once."""

    __slots__ = ()

    @classmethod
    def of(cls, keys: Mapping[str, Any]) -> Caveats:
        """Return the caveats whose keys hold what is true, in a file or a document."""
        return cls(each for each in Caveat if keys.get(each))

    @classmethod
    def joined(cls, several: Iterable[Iterable[Caveat]]) -> Caveats:
        """Return the caveats that any has."""
        found = {each for one in several for each in one}
        return cls(each for each in Caveat if each in found)

    @property
    def keys(self) -> dict[str, bool]:
        """Whether each caveat holds, by its key."""
        return {each.value: each in self for each in Caveat}

    def after(self, name: str = "") -> str:
        """Return a name with the caveats behind it."""
        return ", ".join(filter(None, (name, *self)))

    def nouns(self, sentence: str = "") -> str:
        """Return a sentence with what they concern behind it."""
        return ", ".join(filter(None, (sentence, *(each.words.noun for each in self))))


NO_CAVEATS = Caveats()
