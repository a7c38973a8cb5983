"""A filter is diagnosed and tuned alike as a model, a recursion, a library and a program."""

import json
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import fuselog as fl
from fuselog.pipeline.command_line.process import main
from tests.docs.test_worked_pages import blocks_of
from tests.replay.foreign.conftest import EXAMPLES, Compile

STATE = {"x_m": "linear", "y_m": "linear"}
STATED = 20.0
TOO_LARGE = 6.8
TOPICS: Mapping[str, Any] = {
    "streams": {"fix": fl.schemas.POSITION_FIX},
    "static": {"prior": fl.schemas.GAUSSIAN_ESTIMATE},
    "components": STATE,
    "truth": "truth",
}


class DrifterParameters(fl.ModelParameters):
    """Says how the drifter of the page moves.

    Attributes:
        drift_density: random walk of the position, in m/sqrt(s).
    """

    drift_density: fl.ProcessNoise = STATED


def stay(state: Any, *_: Any) -> Any:
    return state


def drift(_: Any, duration_s: float, parameters: Any) -> tuple[float, float]:
    variance = parameters.drift_density**2 * duration_s
    return variance, variance


FIX = fl.Sensor(
    "fix",
    fl.schemas.POSITION_FIX,
    STATE,
    stay,
    vector="position_m",
    covariance="covariance_m2",
    linear=True,
)
DRIFTER = fl.Model(
    "a drifter with position fixes",
    STATE,
    DrifterParameters,
    (FIX,),
    fl.Motion(stay, drift, linear=True),
)


class RecursionParameters(fl.Parameters):
    """Says how the drifter moves, with the current.

    Attributes:
        drift_density: random walk of the position, in m/sqrt(s).
        current_mps: of the water, along both axes.
    """

    drift_density: fl.ProcessNoise = STATED
    current_mps: float = 0.0


class Drifter(NamedTuple):
    """The state of the recursion: (runs, 2) means and variances, (runs,) times."""

    mean: fl.Floats
    variance: fl.Floats
    time_ns: fl.Integers


def start(given: fl.Given[RecursionParameters]) -> tuple[tuple[float, float], Drifter]:
    time_ns, mean, covariance = given.prior("prior")
    state = Drifter(mean.copy(), np.diagonal(covariance, axis1=1, axis2=2).copy(), time_ns.copy())
    return (given.parameters.drift_density, given.parameters.current_mps), state


def follow(
    run: int,
    settings: tuple[float, float],
    messages: fl.Messages,
    state: Drifter,
    results: fl.Results,
) -> None:
    drift_density, current_mps = settings
    for row in range(messages.offsets[run], messages.offsets[run + 1]):
        duration_s = 1e-9 * (messages.time_ns[row] - state.time_ns[run])
        state.time_ns[run] = messages.time_ns[row]
        results.covariance[row] = results.innovation_covariance[row] = 0.0
        results.squared[row] = 0.0
        for i in range(2):
            variance = state.variance[run, i] + drift_density**2 * duration_s
            spread = variance + messages.value[row, 2 + 3 * i]
            predicted = state.mean[run, i] + current_mps * duration_s
            difference = messages.value[row, i] - predicted
            state.mean[run, i] = predicted + variance / spread * difference
            state.variance[run, i] = variance - variance / spread * variance
            results.mean[row, i], results.covariance[row, i, i] = (
                state.mean[run, i],
                state.variance[run, i],
            )
            results.innovation[row, i], results.innovation_covariance[row, i, i] = difference, spread
            results.squared[row] += difference**2 / spread


def recursion(**changed: Any) -> fl.Estimator[RecursionParameters]:
    given = {"parameters": RecursionParameters, "measured": STATE, "start": start, "follow": follow}
    return fl.recursive("a drifter", **TOPICS, **{**given, **changed})


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A log of a drifter that drifts less than the filters state, in the folder where the test runs."""
    monkeypatch.chdir(tmp_path)
    rng, steps, step_s, sigma_m = np.random.default_rng(3), 120, 0.1, 0.5
    truth = np.cumsum(rng.normal(0.0, STATED / TOO_LARGE * step_s**0.5, (steps, 2)), axis=0)
    stamps_ns = fl.simulation_stamps_ns(step_s * np.arange(steps))
    state = {"components": "x_m,y_m", "kinds": "linear,linear"}
    streams = [
        fl.make_stream(
            "/buoy/prior",
            fl.schemas.GAUSSIAN_ESTIMATE,
            stamps_ns[:1],
            metadata=state,
            mean=np.zeros((1, 2)),
            covariance=np.eye(2).reshape(1, 4),
        ),
        fl.make_stream(
            "/buoy/fix",
            fl.schemas.POSITION_FIX,
            stamps_ns,
            position_m=truth + rng.normal(0.0, sigma_m, truth.shape),
            covariance_m2=np.tile((sigma_m**2 * np.eye(2)).ravel(), (steps, 1)),
        ),
        fl.make_stream("/buoy/truth", fl.schemas.TRUTH_STATE, stamps_ns, metadata=state, state=truth),
    ]
    fl.write("run.mcap", streams)
    return "run.mcap"


def library(compile_filter: Compile, said: str = "", instead: str = "") -> dict[str, Any]:
    """The page's filter, with another description."""
    [source] = [block for block in blocks_of("your-filter") if block.file == "drifter.c"]
    assert said in source.text
    Path("drifter.c").write_text(source.text.replace(said, instead), encoding="utf-8")
    made = compile_filter(Path("drifter.c").resolve(), f"drifter-{len(instead)}-{len(said)}")
    return {"kind": "lib", "path": str(made), "in_process": True}


@pytest.mark.paper
def test_a_noise_is_named_alike_however_the_filter_is_written(
    log: str, compile_filter: Compile, capsys: pytest.CaptureFixture[str]
) -> None:
    if shutil.which("c++") is None:
        pytest.skip("there is no compiler: c++")
    command = ["c++", "-std=c++17", "-O2", str(EXAMPLES / "drifter.cpp"), "-o", "drifter"]
    subprocess.run(command, check=True)
    ways: dict[str, Any] = {
        "model": fl.modelled(DRIFTER, "ekf"),
        "recursion": recursion(),
        "lib": library(compile_filter),
        "exec": {"kind": "exec", "command": "./drifter"},
    }
    causes = [
        fl.diagnose(log, {label: given}).causes.to_dict("records")
        for label, given in ways.items()
        if label != "exec"
    ]
    assert main(["diagnose", log, "-e", "exec:./drifter", "--json"]) == 0
    causes.append(json.loads(capsys.readouterr().out)["sentences"])
    [first] = causes[0]
    assert (first["kind"], first["topic"]) == ("process noise", "drift_density")
    assert first["low"] < 1.0 / TOO_LARGE < first["high"]
    for [own] in causes:
        numbers = ("value", "low", "high", "gain")
        assert [own[each] for each in numbers] == pytest.approx([first[each] for each in numbers], 1e-6)
        assert own["sentence"].partition("; try")[0] == first["sentence"].partition("; try")[0]
    advice = f"--set drift_density={first['setting'].partition('=')[2]}"
    tuning = "fuselog tune LOG -e exec:./drifter --free drift_density"
    assert f"try {advice}, or {tuning}" in causes[-1][0]["sentence"]
    tuned = [fl.tune(log, {label: given}, "drift_density") for label, given in ways.items()]
    values = [each.parameters.loc[0, ["value", "low", "high"]].tolist() for each in tuned]
    for found in values:
        assert found == pytest.approx(values[0], rel=1e-4)


ROLE = '\\"role\\": \\"process noise\\",'


def test_what_a_parameter_is_says_its_role(log: str, compile_filter: Compile) -> None:
    """One without a role has another value; how a filter is run is not tried."""
    found = fl.diagnose(log, {"mine": library(compile_filter, ROLE)})
    assert found.causes["kind"].tolist() == ["parameter"]
    assert "drift_density (random walk of the position) is 6" in found.told[0]
    assert "Q is too large" not in found.told[0]
    setting = ROLE.replace("process noise", "setting")
    untried = fl.diagnose(log, {"mine": library(compile_filter, ROLE, setting)}).tried
    assert "drift_density" not in untried["topic"].tolist()
    wrong = ROLE.replace("process noise", "noise")
    with pytest.raises(fl.BadInput, match="role' is 'noise'; it should be 'process noise', 'measure"):
        fl.diagnose(log, {"mine": library(compile_filter, ROLE, wrong)})


def test_a_parameter_of_a_recursion_has_another_value(log: str) -> None:
    given = {"mine": {"kind": recursion(), "drift_density": STATED / TOO_LARGE, "current_mps": 3.0}}
    cause = fl.diagnose(log, given).causes.iloc[0]
    assert (cause["kind"], cause["topic"]) == ("parameter", "current_mps")
    assert cause["low"] < -3.0 < cause["high"]


def test_a_filter_that_diverged_is_not_told_to_give_innovations(log: str) -> None:
    def diverging(run: int, settings: Any, messages: Any, state: Any, results: fl.Results) -> None:
        follow(run, settings, messages, state, results)
        results.squared[-1] = np.inf

    given = {"mine": recursion(follow=diverging, compiled=False)}
    with pytest.raises(fl.BadInput, match="mine diverges with the start values of the search"):
        fl.tune(log, given, "drift_density")
    assert any(
        "mine diverged: its log-likelihood is -inf" in each for each in fl.diagnose(log, given).notes
    )


@pytest.mark.parametrize("field", ["squared", "innovation_covariance"])
def test_without_a_likelihood_it_is_said_what_to_fill(log: str, field: str) -> None:
    def lacking(run: int, settings: Any, messages: Any, state: Any, results: fl.Results) -> None:
        follow(run, settings, messages, state, results)
        getattr(results, field)[:] = np.nan

    fill = (
        "fill results.innovation, results.innovation_covariance and results.squared, and name the "
        "components in `measured`"
    )
    mine = {"mine": recursion(follow=lacking, compiled=False)}
    if field == "squared":
        with pytest.raises(fl.BadInput, match="mine gives no innovations, which a diagnosis") as told:
            fl.diagnose(log, mine)
        assert fill in str(told.value)
    else:
        assert any(fill in note for note in fl.diagnose(log, mine).notes)
    with pytest.raises(fl.BadInput, match="no innovations with a likelihood on this log") as told:
        fl.tune(log, mine, "drift_density", by="likelihood")
    assert fill in str(told.value)
