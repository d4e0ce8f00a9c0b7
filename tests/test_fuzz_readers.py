"""A short run of the fuzzers: every reader ends in a result or in an error of our own, soon and in bounds."""

from __future__ import annotations

import pytest

from fuzz.harness import fuzz
from fuzz.readers import READERS, Reader

INPUTS = 150


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_mutated_files_end_in_a_result_or_our_own_error(reader: Reader) -> None:
    outcome = fuzz(reader, range(INPUTS), seed=1)
    assert outcome.bad == 0, "\n".join(outcome.examples)
    assert outcome.inputs == INPUTS
    assert outcome.read > 0


def test_the_harness_notices_what_it_looks_for() -> None:
    def fails(path: object) -> None:
        raise KeyError(path)

    first = READERS[0]
    with pytest.raises(KeyError):
        fuzz(Reader("x", ".x", first.seeds, fails), range(1))
    calls = []

    def fails_later(path: object) -> None:
        calls.append(path)
        if len(calls) > 1:
            raise KeyError(path)

    assert fuzz(Reader("x", ".x", first.seeds, fails_later), range(3)).uncaught == 3
