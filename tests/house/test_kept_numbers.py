"""Tests of the kept numbers: what a fault is told by, and how numbers are kept on purpose."""

import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from fuselog.pipeline.output.charts import Chart, Panel, Series
from fuselog.pipeline.output.results import Outcome
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.recording import SIMULATION_EPOCH_NS, Recording
from tests.goldens import keeping
from tests.goldens.keeping import FOLDER, MOST_LINES, TESTS, against, capped, kept_of, read, written
from tests.goldens.numbers import Quantities, of_outcome, of_recording

X_M, Y_M = np.array([1.0, 2.0, 4.0, 7.0]), np.array([0.5, 0.0, -0.5, -2.0])


def recorded(x_m: np.ndarray, y_m: np.ndarray) -> Quantities:
    stamps_ns = SIMULATION_EPOCH_NS + 10**9 * np.arange(len(x_m))
    metadata = {"components": "x_m,y_m", "kinds": "linear,linear"}
    state = np.column_stack([x_m, y_m])
    truth = make_stream("/truth", schemas.TRUTH_STATE, stamps_ns, state=state, metadata=metadata)
    return of_recording(Recording([truth]))


FAULTS = {
    "a sign": ((X_M, -Y_M), "/truth | state y_m mean: -0.5 -> 0.5 (difference 1)"),
    "swapped columns": ((Y_M, X_M), "/truth | state x_m last: 7 -> -2 (difference -9)"),
    "a lost row": ((X_M[1:], Y_M[1:]), "/truth | rows: 4 -> 3 (difference -1)"),
    "another order": (
        (X_M[[1, 0, 2, 3]], Y_M),
        "/truth | state x_m step: 2 -> 2.33333 (difference 0.333)",
    ),
    "a missing number": (
        (np.where(X_M == 2.0, np.nan, X_M), Y_M),
        "/truth | state x_m missing: none -> 1",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_a_recording_is_named_with_both_values(fault: str) -> None:
    kept = read(written({"landmarks": recorded(X_M, Y_M)}))
    assert against(kept, "landmarks", recorded(X_M * (1.0 + 1e-9), Y_M)) == []
    columns, line = FAULTS[fault]
    assert f"landmarks | {line}" in against(kept, "landmarks", recorded(*columns))


def judged(nees: float = 2.0, error_m: float = 0.1, drawn: str = "ekf") -> Quantities:
    table = pd.DataFrame({"estimator": ["ekf"], "error_m": [error_m], "sigma_m": [0.2]})
    series = [Series(label=drawn, x=[0.0, 1.0], y=[error_m, 0.3])]
    metrics = {"ekf.nees.robot1": nees, "ekf.cpu_s": np.random.default_rng().random()}
    figures = {"errors": Chart(panels=[Panel(series=series)])}
    return of_outcome(Outcome(metrics=metrics, tables={"runs": table}, figures=dict(figures)))


@pytest.mark.parametrize(
    ("found", "line"),
    [
        (judged(nees=2.001), "metrics ekf | nees robot1: 2 -> 2.001 (difference 0.001)"),
        (judged(nees=np.nan), "metrics ekf | nees robot1: 2 -> nan (difference nan)"),
        (judged(error_m=0.2), "table runs | error_m mean: 0.1 -> 0.2 (difference 0.1)"),
        (judged(drawn="truth"), 'figure errors | panel 1, y: "ekf" -> "truth"'),
    ],
)
def test_a_fault_of_an_outcome_is_named_with_both_values(found: Quantities, line: str) -> None:
    kept = read(written({"run": judged()}))
    assert against(kept, "run", judged()) == []
    assert f"run | {line}" in against(kept, "run", found)


def test_a_run_beside_the_first_is_kept_as_it_differs_and_equals_it_in_all_else() -> None:
    base, moved = recorded(X_M, Y_M), recorded(X_M, Y_M + 1.0)
    runs = {"landmarks": base, "landmarks --set y_m=1": moved}
    text = written({run: kept_of(runs, run, found) for run, found in runs.items()})
    assert text.endswith("[landmarks --set y_m=1]\n/truth\n  state y_m = mean 0.5\n")
    lines = against(read(text), "landmarks --set y_m=1", recorded(X_M + 1.0, Y_M + 1.0))
    assert lines == ["landmarks --set y_m=1 | /truth | more that differ: none -> 1"]


def test_a_long_message_is_cut() -> None:
    lines = capped([str(number) for number in range(MOST_LINES + 5)])
    assert lines[MOST_LINES - 1 :] == [str(MOST_LINES - 1), "... and 5 more"]


MODULE = """
from tests.goldens import keeping
from tests.goldens.numbers import Name

def test_of_two():
    for speed in ({}, {{"speed_mps": 2.0}}):
        keeping.hold("landmarks", speed, {{Name("/truth", "x_m"): {{"mean": {} + len(speed)}}}})
{}
"""
MORE = """
def test_of_one():
    keeping.hold("vehicles", {}, {Name("/truth", "y_m"): {"mean": 5.0}})
"""


@pytest.fixture
def tried(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[int, str]]:
    """Runs pytest within this run, in a folder of its own, with a module that finds this value."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # the module changes within a second
    monkeypatch.setattr(keeping, "TESTS", tmp_path)
    monkeypatch.setattr(keeping, "FOLDER", tmp_path / "numbers")

    def run(value: float, *options: str, more: str = MORE) -> tuple[int, str]:
        (tmp_path / "test_it.py").write_text(MODULE.format("{}", value, more))
        sys.modules.pop("test_it", None)
        keeping.kept.cache_clear()
        plugins = ["no:cacheprovider", "no:unraisableexception", keeping.__name__]
        own = ["-q", *(f"-p{name}" for name in plugins), "--import-mode=importlib"]
        with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as said:
            patch.setattr(keeping, "SESSION", keeping.Session())
            code = pytest.main([*own, f"--rootdir={tmp_path}", str(tmp_path), *options])
        return int(code), said.getvalue()

    return run


@pytest.mark.paper
def test_numbers_are_kept_on_purpose_and_only_then(tried: Callable[..., tuple[int, str]]) -> None:
    assert "landmarks (test_of_two): nothing is kept of this run" in tried(1.0)[1]
    assert tried(1.0, "--keep-numbers")[0] == 0
    assert tried(1.0)[0] == 0
    moved = "landmarks (test_of_two) | /truth | x_m mean: 1 -> 4 (difference 3)"
    code, said = tried(4.0)
    assert (code, moved in said) == (1, True), said
    code, said = tried(4.0, "--keep-numbers", "-k", "two")
    assert (code, moved in said, "removed" in said) == (0, True, False), said
    gone = "vehicles (test_of_one)"
    code, said = tried(4.0, more="")
    assert (code, f"{gone}: is kept, but no test finds it" in said) == (1, True), said
    assert f"{gone}: removed" in tried(4.0, "--keep-numbers", more="")[1]
    assert tried(4.0, more="")[0] == 0


def test_every_file_of_kept_numbers_belongs_to_tests() -> None:
    for path in FOLDER.rglob("*.txt"):
        of = TESTS / path.relative_to(FOLDER).with_suffix("")
        assert of.with_suffix(".py").exists() or of.parent.with_suffix(".py").exists(), path
