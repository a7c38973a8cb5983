"""Python in the pages: that of every page is run, here what no other test runs."""

import ast
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fuselog as fl
from tests.docs.test_worked_pages import WORKED

DOCS = Path(__file__).parents[2] / "docs"
WORKED_THROUGH = {each if isinstance(each, str) else each.values[0] for each in WORKED}
BY_OTHERS = {"python", "your-estimator", "your-model"}  # tests/pipeline
HERE = {"compare", "many-runs", "your-model-more"}


def python_of(name: str) -> list[str]:
    """The blocks of Python of a page."""
    page = (DOCS / f"{name}.md").read_text(encoding="utf-8")
    return re.findall(r"^```python[^\n]*\n(.*?)^```", page, re.DOTALL | re.MULTILINE)


def test_the_python_of_every_page_is_run() -> None:
    pages = [path.relative_to(DOCS).with_suffix("").as_posix() for path in DOCS.rglob("*.md")]
    assert {name for name in pages if python_of(name)} <= WORKED_THROUGH | BY_OTHERS | HERE


def test_the_sweep_of_many_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a run at each of three points; the other block needs a cluster, and is parsed alone."""
    monkeypatch.chdir(tmp_path)
    sweep, cluster = python_of("many-runs")
    names: dict[str, Any] = {}
    exec(
        sweep.replace("0.8, 9)", "0.8, 3)").replace("runs=50", "runs=1, set={'duration_s': 5.0}"), names
    )
    assert names["best"]["value"].item() < 0.2
    ast.parse(cluster)


def test_the_golden_of_compare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is written on request, is the same again, and is not with other settings."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tests").mkdir()
    fl.write("drive.mcap", fl.record("landmarks", seed=7, duration_s=5.0))
    names: dict[str, Any] = {"MINE": {"kind": "ekf"}}
    [test] = python_of("compare")
    exec(test, names)
    with monkeypatch.context() as asked:
        asked.setenv("FUSELOG_UPDATE_GOLDENS", "1")
        names["test_my_estimator"]()
    names["test_my_estimator"]()
    names["MINE"] = {"kind": "ekf", "sigma_range_m": 0.5}
    with pytest.raises(AssertionError, match=r"drive\.mcap"):
        names["test_my_estimator"]()


def test_the_correction_of_your_model_more() -> None:
    """A heading corrected by a quarter turn turns the velocity with it; a small step adds to each."""
    names: dict[str, Any] = {}
    [code] = python_of("your-model-more")
    exec(code, names)
    turned = names["turn_with_heading"]((1.0, 2.0, 0.0, 3.0, 0.0), (0.0, 0.0, np.pi / 2, 0.0, 0.0))
    assert_allclose(turned, (1.0, 2.0, np.pi / 2, 0.0, 3.0), atol=1e-12)
    moved = names["turn_with_heading"]((1.0, 2.0, 0.0, 0.0, 0.0), (0.1, 0.2, 0.3, 0.4, 0.5))
    assert_allclose(moved, (1.1, 2.2, 0.3, 0.4, 0.5))
