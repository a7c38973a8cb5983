"""Python in the pages: that of every page is run, here what no other test runs."""

import ast
import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import fuselog as fl
from fuselog.replay.judging.metrics.measuring import find_metrics
from tests.docs.test_worked_pages import WORKED

DOCS = Path(__file__).parents[2] / "docs"
WORKED_THROUGH = {each if isinstance(each, str) else each.values[0] for each in WORKED}
BY_OTHERS = {"python", "your-estimator", "your-model"}  # tests/pipeline
HERE = {"compare", "deploy", "many-runs"}
pytestmark = pytest.mark.usefixtures("blank_figures")


def python_of(name: str) -> list[str]:
    """The blocks of Python of a page."""
    page = (DOCS / f"{name}.md").read_text(encoding="utf-8")
    return re.findall(r"^```python[^\n]*\n(.*?)^```", page, re.DOTALL | re.MULTILINE)


def test_the_python_of_every_page_is_run() -> None:
    pages = [path.relative_to(DOCS).with_suffix("").as_posix() for path in DOCS.rglob("*.md")]
    assert {name for name in pages if python_of(name)} <= WORKED_THROUGH | BY_OTHERS | HERE


def test_every_metric_has_a_meaning() -> None:
    """What metrics return, by their sources, is on the page Judge."""
    page = (DOCS / "judge.md").read_text(encoding="utf-8")
    modules = {metric.finish.__module__ for metric in find_metrics().values()}
    named = {name for module in modules for name in _quantities_of(import_module(module))}
    assert {"estimates_without_nees", "gospa_m", "switches", "eer_percent", "over_ensemble"} <= named
    assert {name for name in named if f"`{name}`" not in page} == set()


def _quantities_of(module: ModuleType) -> Iterator[str]:
    """The constant names in all functions of a module that return numbers by name."""
    for function in ast.walk(ast.parse(inspect.getsource(module))):
        if not (isinstance(function, ast.FunctionDef) and function.returns is not None):
            continue
        if ast.unparse(function.returns) != "dict[str, float]":
            continue
        for node in ast.walk(function):
            if isinstance(node, ast.Dict):
                keys = [key for key in node.keys if key is not None]
            else:
                stored = isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Store)
                keys = [node.slice] if stored else []
            yield from (key.value for key in keys if isinstance(key, ast.Constant))


@pytest.mark.paper
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


@pytest.mark.paper
def test_a_model_of_ones_own_is_tuned_and_deployed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page Deploy goes on where the page Your model has its pendulum and its log."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for code in (*python_of("your-model")[:2], *python_of("deploy")):
        exec(code, names)
    assert 0.03 < names["found"].settings["tuned"]["sigma_m"] < 0.07
    tuned = repr(names["found"].settings["tuned"]["sigma_m"])
    assert f".sigma_m = {tuned}," in (tmp_path / "pendulum_ekf/pendulum_ekf.c").read_text()
