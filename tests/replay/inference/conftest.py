"""What tests of models and methods share."""

from collections.abc import Iterator

import pytest

from replay.inference import estimators


@pytest.fixture
def uncompiled(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Loops in plain Python, of which none is left to the next test."""
    monkeypatch.setenv("FUSELOG_UNCOMPILED", "1")
    estimators._compiled.cache_clear()
    yield
    estimators._compiled.cache_clear()
