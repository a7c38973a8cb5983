"""The examples in docstrings do what they show."""

import doctest
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MODULES = [
    ".".join(("fuselog", *path.relative_to(ROOT).with_suffix("").parts))
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
        "fuselog.recorders.log.writer:write_log",
        "fuselog.recorders.log.opening:open_log",
        "fuselog.recorders.log.reader:read_streams",
        "fuselog.recorders.log.streams:Stream",
        "fuselog.recorders.log.streams:make_stream",
        "fuselog.recorders.recording:record_run",
        "fuselog.replay.engine.vectors.covariances:normalized_error_squared",
        "fuselog.replay.engine.api.functions:batch",
        "fuselog.replay.engine.api.functions:recursive",
        "fuselog.replay.inference.model.model:Model",
    ):
        module, _, name = each.partition(":")
        assert ">>> " in getattr(import_module(module), name).__doc__, each
