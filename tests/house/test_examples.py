"""The examples in docstrings do what they show."""

import doctest
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for room in ("recorders", "replay", "pipeline")
    for path in sorted((ROOT / room).rglob("*.py"))
    if ">>> " in path.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("name", MODULES)
@pytest.mark.paper
def test_examples(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    failed, tried = doctest.testmod(import_module(name), optionflags=doctest.ELLIPSIS)
    assert (failed, tried > 0) == (0, True)


def test_what_one_begins_with_has_an_example() -> None:
    for each in (
        "recorders.log.writer:write_log",
        "recorders.log.opening:open_log",
        "recorders.log.reader:read_streams",
        "recorders.log.streams:Stream",
        "recorders.log.streams:make_stream",
        "recorders.recording:record_run",
        "replay.engine.vectors.covariances:normalized_error_squared",
        "replay.engine.api.functions:batch",
        "replay.engine.api.functions:recursive",
        "replay.inference.model.model:Model",
    ):
        module, _, name = each.partition(":")
        assert ">>> " in getattr(import_module(module), name).__doc__, each
