"""A golden's file is believed nothing but what was looked at."""

import json
import lzma
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fuselog.pipeline.checking.stored import MOST_BYTES, read, write
from fuselog.recorders.errors import BadInput
from tests.pipeline.conftest import Said

COLUMN = {"kept": [[1.0, 2.0]], "missing": [0, 0], "sum": [1.0, 2.0], "sum_of_squares": [1.0, 4.0]}
STREAM = {
    "rows": 1,
    "publish_times": "a",
    "log_times": "b",
    "metadata": {},
    "checksums": "AAA=",
    "columns": {"mean": COLUMN},
}
SETTINGS = {"estimators": {"ekf": {}}, "late": None, "arrival_order": False, "columns": ["*"]}
WHOLE: dict[str, Any] = {
    "format": 1,
    "arithmetic": "x",
    "settings": SETTINGS,
    "tolerances": {},
    "metrics": {"a": [1.0]},
    "runs": {"run.mcap": {"input": "x", "recorded": False, "streams": {"/estimates/ekf/pose": STREAM}}},
}


def with_part(value: Any, *path: str) -> dict[str, Any]:
    """A whole golden with one part that is another."""
    changed = json.loads(json.dumps(WHOLE))
    at = changed
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    return changed


MEAN = ("runs", "run.mcap", "streams", "/estimates/ekf/pose", "columns", "mean")


@pytest.mark.paper
@pytest.mark.parametrize(
    "golden",
    [
        with_part("1", "format"),
        with_part(1.5, "format"),
        with_part(True, "format"),
        with_part(None, "format"),
        with_part([], "runs"),
        with_part({"run.mcap": 3}, "runs"),
        with_part({"a": {}}, "metrics"),
        with_part({"a": [1, [2]]}, "metrics"),
        with_part({"*": {"relative": "x"}}, "tolerances"),
        with_part({"estimators": 3}, "settings"),
        with_part(-1, *MEAN[:4], "rows"),
        with_part(2, *MEAN[:4], "rows"),
        with_part("!", *MEAN[:4], "checksums"),
        with_part({"kept": []}, *MEAN),
        with_part([[1.0], [2.0, 3.0]], *MEAN, "kept"),
        with_part([["x", "y"]], *MEAN, "kept"),
        with_part([10**400, 1], *MEAN, "sum"),
        with_part([1.0], *MEAN, "sum"),
    ],
)
@pytest.mark.parametrize("update", [False, True])
def test_a_golden_of_another_form_is_refused(
    golden: Any, update: bool, world: Path, tmp_path: Path, fuselog: Callable[..., Said]
) -> None:
    path = tmp_path / "own.golden.xz"
    write(path, golden)
    before = path.read_bytes()
    said = fuselog(
        "check", world / "log.mcap", "--against", path, *(["--update", "-e", "ekf"] if update else [])
    )
    assert said.code == 2
    assert said.err.startswith(f"fuselog: {path}: ")
    assert said.err.count("\n") == 1
    assert path.read_bytes() == before


def test_what_was_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "own.golden.xz"
    write(path, WHOLE)
    assert read(path) == WHOLE
    write(path, {**WHOLE, "settings": {}})
    assert read(path)["settings"] == {**SETTINGS, "estimators": {}}


@pytest.mark.paper
@pytest.mark.parametrize(
    "content",
    [
        lambda: lzma.compress(bytes(MOST_BYTES + 1), preset=0),
        lambda: lzma.compress(b"[" + b"[]," * (1 << 22) + b"[]]", preset=0),
        lambda: lzma.compress(b"[" * (1 << 20)),
        lambda: lzma.compress(b"{}") + lzma.compress(b"{}"),
        lambda: lzma.compress(json.dumps(WHOLE).encode())[:-20],
        bytes,
    ],
    ids=["zeros", "lists", "deep", "two", "cut", "empty"],
)
def test_an_archive_of_anything_else_is_refused(content: Callable[[], bytes], tmp_path: Path) -> None:
    path = tmp_path / "own.golden.xz"
    path.write_bytes(content())
    with pytest.raises(BadInput, match="is not a golden, or is damaged"):
        read(path)
