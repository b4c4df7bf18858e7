"""Every fuzzing target on the inputs it begins with, and on some made from them."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fuzz.targets import TARGETS


@pytest.mark.parametrize("name", TARGETS)
@settings(max_examples=100, deadline=None)
@given(fuzzed=st.binary(max_size=1500))
def test_any_bytes(name: str, fuzzed: bytes) -> None:
    target, _ = TARGETS[name]
    target(fuzzed)


@pytest.mark.parametrize("name", TARGETS)
def test_seeds_and_their_mutations(name: str) -> None:
    target, seeds = TARGETS[name]
    target(b"")
    chance = random.Random(name)
    for seed in seeds:
        target(seed)
        for _ in range(20):
            mutated = bytearray(seed)
            for _ in range(chance.randint(1, 8)):
                place = chance.randrange(len(mutated))
                match chance.randrange(3):
                    case 0:
                        mutated[place] ^= 1 << chance.randrange(8)
                    case 1:
                        del mutated[place : place + chance.randint(1, 9)]
                    case _:
                        mutated[place:place] = chance.randbytes(chance.randint(1, 9))
                if not mutated:
                    break
            target(bytes(mutated))
