"""What tests of models and methods share."""

from collections.abc import Iterator

import pytest

from replay.inference import estimators, iterated, rewinding


@pytest.fixture
def uncompiled(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Loops in plain Python, of which none is left to the next test."""
    loops = estimators._compiled, rewinding._compiled, iterated._search
    monkeypatch.setenv("FUSELOG_UNCOMPILED", "1")
    for each in loops:
        each.cache_clear()
    yield
    for each in loops:
        each.cache_clear()
