"""Tuning: the reference sheet's numbers, what logs cannot tell, and what is refused."""

import pickle
import re
import shlex
import shutil
import tomllib
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import fuselog as fl
from fuselog.pipeline.optimise import DROP_95, Cost, curvature
from fuselog.pipeline.output.results import read_result
from fuselog.pipeline.runs.executors import InlineExecutor, PoolFactory, WorkerPool
from fuselog.pipeline.tuning.confidence import SearchOutcome, confidence
from fuselog.pipeline.tuning.objective import Best, Objective
from fuselog.pipeline.tuning.search import Coordinates, least, scanned
from fuselog.pipeline.tuning.tuning import _confirmed
from fuselog.recorders.log import RunMetadata
from fuselog.recorders.parameters import Parameter
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.sources import memory_source
from fuselog.replay.judging.consistency.whiteness import whitened
from tests.replay.inference.scalar import EPOCH_NS, SCALAR, ScalarParameters, source
from tests.replay.inference.sheet_robot import DENSITY, FREE, of_sigmas, recorded

pytestmark = pytest.mark.usefixtures("blank_figures")

Fuselog = Callable[..., Any]
NILE = (
    "1120 1160 963 1210 1160 1160 813 1230 1370 1140 995 935 1110 994 1020 960 1180 799 958 1140 "
    "1100 1210 1150 1250 1260 1220 1030 1100 774 840 874 694 940 833 701 916 692 1020 1050 969 "
    "831 726 456 824 702 1120 1100 832 764 821 768 845 864 862 698 845 744 796 1040 759 "
    "781 865 845 944 984 897 822 1010 771 676 649 846 812 742 801 1040 860 874 848 890 "
    "744 749 838 1050 918 986 797 923 975 815 1020 906 901 1170 912 746 919 718 714 740 "
)


def test_the_local_level_of_the_nile() -> None:
    """Durbin and Koopman, 2.10: annual flow in 1e8 m^3; a prior of variance p costs 1/2 log p."""
    flow = np.array(NILE.split(), float)
    variance = 1e10
    log = source(flow)
    prior = {"mean": flow[:1, None], "covariance": np.array([[variance]])}
    streams = {
        **log.streams,
        "/prior": fl.make_stream(
            "/prior",
            fl.schemas.GAUSSIAN_ESTIMATE,
            [EPOCH_NS],
            metadata=log.streams["/prior"].metadata,
            **prior,
        ),
    }
    log = replace(log, streams=streams)
    start = {"kept": 1.0, "sigma_moved": 100.0, "sigma_measured": 50.0}
    free = {"sigma_measured": (1.0, 1e4), "sigma_moved": (0.1, 1e3)}  # positive, unlike the model's
    found = fl.tune(log, {"level": fl.modelled(SCALAR, "ekf")}, [*free], set=start, bounds=free)
    variances = found.parameters["value"] ** 2
    assert variances.tolist() == pytest.approx([15098.518, 1469.176], rel=1e-5)
    assert 0.5 * np.log(variance) - found.costs[1] == pytest.approx(-633.464563636, abs=1e-6)
    told = found.found.confidence
    assert told is not None
    assert (2.0 * told.errors).tolist() == pytest.approx([0.2083, 0.8715], abs=5e-5)
    eigenvalues = np.linalg.eigvalsh(told.curvature)
    assert eigenvalues.tolist() == pytest.approx([5.15, 150.0], rel=1e-3)
    assert eigenvalues[1] / eigenvalues[0] == pytest.approx(29.1, abs=0.05)
    assert not found.notes


@pytest.mark.paper
def test_the_robot_of_the_sheet() -> None:
    start = of_sigmas(0.3, 0.02, 0.6, 0.1)
    found = fl.tune(recorded(500, 100.0), "ekf", FREE, set={**start, "gate_probability": 1.0})
    sigmas = found.parameters["value"] / [DENSITY, DENSITY, 1.0, 1.0]
    assert sigmas.tolist() == pytest.approx([0.07487878, 0.04285785, 0.18738070, 0.02942065], rel=1e-4)
    assert -found.costs[1] == pytest.approx(425.88893017, abs=1e-7)
    told = found.found.confidence
    assert told is not None
    assert told.errors.tolist() == pytest.approx([0.442, 0.1724, 0.0526, 0.0598], rel=2e-3)
    assert np.linalg.eigvalsh(told.curvature).tolist() == pytest.approx(
        [5.094, 34.43, 297.4, 365.3], rel=1e-3
    )
    low, high = found.parameters[["low", "high"]].to_numpy().T
    np.testing.assert_allclose(np.log(high / low), 2 * 1.96 * told.errors, rtol=1e-4)
    nis = found.metrics.query("quantity == 'nis_per_component'")["value"]
    assert (400 * nis).tolist() == pytest.approx([63.3, 398.5], abs=0.05)
    white = found.whiteness.set_index(["estimator", "component"])
    for label in ("start", "tuned"):
        innovations = found.replay.estimates[0][f"/estimates/{label}/robot/innovation"]
        for component, column in zip(innovations.components, whitened(innovations).T, strict=True):
            told_of = white.loc[(label, component)]
            off = column - column.mean()
            next_one = np.sum(off[1:] * off[:-1]) / np.sum(off**2)
            assert told_of["next_correlation"] == pytest.approx(next_one, rel=1e-9)
            assert told_of["mean_square"] == pytest.approx(np.mean(column**2), rel=1e-9)


@pytest.fixture(scope="module")
def short() -> fl.MemorySource:
    """Twenty seconds of the sheet's robot, which tell little of its odometry."""
    return recorded(500, 20.0)


def test_the_best_so_far_is_told_with_how_many_points_were_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried, told = [0], list[Best]()
    shared = Objective._shared

    def counted(self: Objective, points: Any) -> Any:
        tried.append(tried[-1] + len(points))
        return shared(self, points)

    monkeypatch.setattr(Objective, "_shared", counted)
    bounds = {"sigma_range_m": (0.05, 0.2)}
    log = fl.record("landmarks", duration_s=3.0)
    found = fl.tune(log, "ekf", "sigma_range_m", bounds=bounds, grid=3, on_best=told.append)
    counts = [each.evaluations for each in told]
    assert {*counts} <= {*tried}
    assert counts == sorted(counts)
    assert 3 < counts[-1] <= tried[-1]
    costs = [each.cost for each in told]
    assert costs == sorted(costs, reverse=True)
    assert told[-1].point == pytest.approx(found.parameters["value"].to_numpy(), rel=1e-3)


@pytest.mark.paper
def test_what_logs_cannot_tell_is_said(short: fl.MemorySource) -> None:
    """Short logs leave the speed's noise open; a value at a bound has no interval."""
    given = {**of_sigmas(0.1, 0.05, 0.2, 0.03), "gate_probability": 1.0}
    found = fl.tune(short, "ekf", FREE, set=given)
    assert any(
        re.match("forward_noise_density: .*(do not determine|factor|bound)", each)
        for each in found.notes
    )
    bounds = {"sigma_range_m": (0.1, 0.15)}
    with pytest.raises(
        fl.BadInput, match=r"--bound sigma_range_m=0.1:0.15: expected .*start value, 0.2"
    ):
        fl.tune(short, "ekf", ["sigma_range_m"], set=given, bounds=bounds)
    given["sigma_range_m"] = 0.12
    bounded = fl.tune(short, "ekf", ["sigma_range_m", "sigma_bearing_rad"], set=given, bounds=bounds)
    assert bounded.notes[0].startswith("sigma_range_m: the best value is its upper bound 0.15")
    intervals = bounded.parameters.set_index("parameter")["low"]
    assert np.isnan(intervals["sigma_range_m"])
    assert intervals["sigma_bearing_rad"] > 0
    assert list(bounded.correlation) == ["sigma_bearing_rad"]


TURN_NOISE = 0.012  # rad/s/sqrt(Hz)


@pytest.fixture(scope="module")
def drive() -> fl.MemorySource:
    """Two minutes of wheels and fixes, without a prior."""
    rng, step_s = np.random.default_rng(7), 0.1
    turn_radps = 0.2 * np.sin(0.05 * np.arange(1200) * step_s)
    heading = np.cumsum(turn_radps) * step_s
    place = np.cumsum(np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0) * 1.5 * step_s
    stamps = EPOCH_NS + np.arange(1200) * 100_000_000
    wheels = fl.make_stream(
        "/car/odometry",
        fl.schemas.ODOMETRY,
        stamps,
        metadata={"forward_noise_density": "0.02"},
        forward_mps=1.5 + 0.02 / step_s**0.5 * rng.normal(size=1200),
        turn_radps=turn_radps + TURN_NOISE / step_s**0.5 * rng.normal(size=1200),
    )
    fixes = fl.make_stream(
        "/car/fix",
        fl.schemas.POSITION_FIX,
        stamps[::10],
        position_m=(place + 0.7 * rng.normal(size=place.shape))[::10],
        covariance_m2=np.tile([0.49, 0.0, 0.0, 0.49], (120, 1)),
    )
    return memory_source(Recording([wheels, fixes]), RunMetadata("drive", epoch_ns=EPOCH_NS))


def test_a_log_without_a_prior_gives_the_same_from_far_and_near(drive: fl.MemorySource) -> None:
    """Where the filter begins depends on the values, and is held in a search; its start is assumed.

    From 0.05 the path between the first fixes is not trusted, and the filter would begin sooner.
    """
    name = "turn_noise_density"
    far = fl.tune(drive, "ekf", name)
    near = fl.tune(drive, "ekf", name, set={name: TURN_NOISE})
    for found in (far, near):
        [row] = found.parameters.to_dict("records")
        assert row["low"] < TURN_NOISE < row["high"]
    assert far.found.optimum == pytest.approx(near.found.optimum, rel=1e-3)
    assert far.parameters["start"].tolist() == [0.05]
    assert any(each.startswith(f"{name}: no channel states its value") for each in far.notes)
    assert any("starts where the path fits the first fixes" in each for each in far.notes)


@pytest.mark.paper
def test_what_the_logs_tell_nothing_of_stays_at_its_start(drive: fl.MemorySource) -> None:
    """A speed's noise of a millimetre in a second, beside fixes of 0.7 m."""
    name, start = (
        "forward_noise_density",
        {"forward_noise_density": 1e-3, "turn_noise_density": TURN_NOISE},
    )
    found = fl.tune(drive, "ekf", [*start], set=start)
    assert found.parameters["value"][0] == 1e-3
    assert found.parameters["low"].isna().tolist() == [True, False]
    assert any(
        each.startswith(f"{name}: the logs do not determine it; it stays") for each in found.notes
    )
    assert tomllib.loads(found.toml)["ekf"][name] == 1e-3


@pytest.mark.parametrize(
    ("free", "options", "sentence"),
    [
        (
            "sigma_rnge_m",
            {},
            "--free sigma_rnge_m: no parameter 'sigma_rnge_m'; did you mean 'sigma_range_m'",
        ),
        ("gate_probability", {}, "--free gate_probability: "),
        ("mode", {}, "--free mode: parameter 'mode' is not a number"),
        ([], {}, "--free: name at least one"),
        (["sigma_range_m"] * 2, {}, "--free sigma_range_m: the parameter is named twice"),
        (
            "turn_noise_density",
            {"set": {"turn_noise_density": 0.0}},
            "the start value is 0; give a positive start value",
        ),
        ("sigma_range_m", {"by": "rmse"}, "has no truth to compare its estimates with"),
        ("sigma_range_m", {"by": "luck"}, "--by luck: available: likelihood, nis"),
        (
            "sigma_range_m",
            {"bounds": {"sigma_bearing_rad": (0.1, 1)}},
            "--bound sigma_bearing_rad: --free does not name it",
        ),
        (
            "sigma_range_m",
            {"folds": 2},
            "--folds 2: expected a number between 2 and the number of logs, 1",
        ),
        ("bias_range_m", {"grid": 3}, "bias_range_m: a grid needs bounds"),
        ("sigma_range_m", {"grid": 10_001}, "--grid 10001: this gives 10001 points for 1 parameters"),
    ],
)
def test_what_cannot_be_searched_is_refused(
    short: fl.MemorySource, free: str, options: dict[str, Any], sentence: str
) -> None:
    given = {"set": of_sigmas(0.1, 0.05, 0.2, 0.03), **options}
    given["set"] = {**of_sigmas(0.1, 0.05, 0.2, 0.03), **given["set"]}
    with pytest.raises(fl.BadInput, match=re.escape(sentence)):
        fl.tune(short, "ekf", free, **given)


@pytest.mark.parametrize("method", ["particles:100", "lrkf:rukf-3"])
def test_a_likelihood_that_is_random_is_not_searched(method: str) -> None:
    with pytest.raises(fl.BadInput, match=f"{method}: draws random numbers, so its likelihood"):
        fl.tune(fl.record("landmarks", duration_s=2.0), method, "sigma_range_m")


def test_a_parameter_that_no_message_depends_on_is_refused(short: fl.MemorySource) -> None:
    given = of_sigmas(0.1, 0.05, 0.2, 0.03)
    sights = short.streams["/robot/range_bearing"]
    blind = {**short.streams, "/robot/range_bearing": sights.take(slice(0, 0))}
    with pytest.raises(fl.BadInput, match="has no innovations with a likelihood"):
        fl.tune(replace(short, streams=blind), "ekf", "sigma_range_m", set=given)
    with pytest.raises(fl.BadInput, match="every_s: the logs do not depend on it"):
        fl.tune(short, "ekf", ["sigma_range_m", "every_s"], set={**given, "every_s": 1e6})


def test_at_an_edge_there_is_no_interval(
    short: fl.MemorySource, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside the best range's sigma a run fails: that is said, the other has its interval."""

    def beside_an_edge(cost: Cost, *where: Any) -> Any:
        def edged(points: Any) -> Any:
            return np.where(points[:, 0] > points[0, 0], np.inf, cost(points))

        return curvature(edged, *where)

    monkeypatch.setattr("fuselog.pipeline.tuning.tuning.curvature", beside_an_edge)
    given = of_sigmas(0.1, 0.05, 0.2, 0.03)
    found = fl.tune(short, "ekf", ["sigma_range_m", "sigma_bearing_rad"], set=given)
    assert found.parameters[["low", "high"]].isna().to_numpy().tolist() == [[True] * 2, [False] * 2]
    assert any(note.startswith("sigma_range_m: no interval, because close to") for note in found.notes)


@pytest.mark.parametrize(("nis", "is_spike"), [(5.0, True), (1.0, False)])
def test_a_spike_that_a_second_start_does_not_find_has_no_interval(
    nis: float, *, is_spike: bool
) -> None:
    """A valley at 5.3, and a narrow one at 0 that is deeper; innovations are too large, or right."""

    class Valleys:
        by, is_corrected, best = "likelihood", False, Best(0, np.zeros(1), 0.0)

        def nis(self, _: np.ndarray) -> float:
            return nis

        def __call__(self, points: np.ndarray) -> np.ndarray:
            x = points[:, 0]
            return np.minimum(0.5 * (x - 5.3) ** 2, 1e6 * x**2 - 50.0)

    free = [Parameter("x", 0.0, low=-100.0, high=100.0, useful=1.0)]
    known = confidence([0], np.ones((1, 1)))
    found = SearchOutcome(Coordinates(free, np.ones(1)), np.zeros(1), 0, known)
    ended = _confirmed(Valleys(), found)  # type: ignore[arg-type]
    assert ended.is_spike == is_spike
    assert (ended.confidence is None) == is_spike


def test_ctrl_c_ends_with_the_best_so_far(short: fl.MemorySource) -> None:
    told: list[Best] = []

    def stop(best: Best) -> None:
        told.append(best)
        if len(told) == 12:
            raise KeyboardInterrupt

    found = fl.tune(short, "ekf", FREE, set=of_sigmas(0.5, 0.5, 0.5, 0.5), on_best=stop)
    assert found.notes[0].startswith("the search was stopped after ")
    assert found.parameters["value"].tolist() == told[-1].point.tolist()
    assert found.costs[1] == told[-1].cost < found.costs[0]
    assert [each.cost for each in told] == sorted((each.cost for each in told), reverse=True)


@pytest.mark.paper
def test_the_worked_example_of_the_page(
    fuselog: Fuselog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its commands give its table, a result folder, and settings that replay, run and tune take."""
    page = (Path(__file__).parents[2] / "docs" / "tune.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r"^fuselog (.*)$", page.replace("\\\n", ""), re.MULTILINE)
    told = [fuselog(*shlex.split(command)) for command in commands]
    assert [(each.code, each.err) for each in told] == [(0, "")] * 4
    shown, printed = (
        re.findall(r"^ (\w+)((?: +[\d.]+){4}) *$", text, re.MULTILINE) for text in (page, told[2].out)
    )
    assert [name for name, _ in printed] == [name for name, _ in shown]
    for (_, expected), (_, values) in zip(shown, printed, strict=True):
        assert [*map(float, values.split())] == pytest.approx([*map(float, expected.split())], rel=2e-3)
    assert re.search("held-out logs: .*: better", told[2].out)
    assert "(of 1 log, gate open; the tables have the mean per log, with the gate)" in told[2].out
    result = read_result(Path("out/tune"))
    for label in ("tuned", "tuned-held-out"):
        assert result.metrics[f"{label}.nis_per_component.robot1"] == pytest.approx(1.0, abs=0.1)
    names = {path.name for path in Path("out/tune").rglob("*")}
    assert names >= {
        "settings.toml",
        "timeline.rrd",
        "profiles.svg",
        "errors-robot1.svg",
        "whiteness.csv",
    }
    tuned = tomllib.loads(Path("out/tune/settings.toml").read_text())
    assert list(tuned["ekf"]) == [name for name, _ in shown]
    settings = ("--settings", "out/tune/settings.toml", "--json")
    again = fuselog("replay", "run.mcap", "-e", "ekf", *settings).json["metrics"]
    assert again["ekf.log_likelihood.robot1"] == result.metrics["tuned.log_likelihood.robot1"]
    over = ("--set", "ekf.sigma_range_m=0.3")
    run = fuselog("run", "run.mcap", "-e", "ekf", *settings, *over, "--out", "run").json
    expected = {**tuned["ekf"], "sigma_range_m": 0.3}
    assert expected.items() <= run["settings"]["parameters"]["ekf"].items()
    further = fuselog(
        "tune", "run.mcap", "-e", "ekf", "--free", "sigma_range_m", *settings, "--out", "further"
    ).json
    [row] = further["parameters"]
    assert row["start"] == tuned["ekf"]["sigma_range_m"] == pytest.approx(row["value"], rel=1e-4)
    report = fuselog("report", "out/tune", "-o", "tune.html")
    assert report.code == 0
    assert "log-likelihood relative to its maximum" in Path("tune.html").read_text(encoding="utf-8")


def test_what_the_command_refuses(world: Path, fuselog: Fuselog, tmp_path: Path) -> None:
    tuned = tmp_path / "settings.toml"
    tuned.write_text("[ekf]\nsigma_range_m = 0.1\n")
    refused = fuselog("replay", world / "log.mcap", "-e", "ukf", "--settings", tuned, "-o", tmp_path)
    assert (refused.code, refused.err) == (
        2,
        f"fuselog: {tuned}: has settings of ekf, which is not replayed; a settings file may only "
        "have tables for the replayed estimators: ukf\n",
    )
    tune = (
        "tune",
        world / "log.mcap",
        "-e",
        "ekf",
        "--free",
        "sigma_range_m",
        "--out",
        tmp_path / "out",
    )
    for options, sentence in (
        (("--bound", "sigma_range_m=1"), "--bound sigma_range_m=1: expected NAME=LOW:HIGH"),
        (("--bound", "a=1:2", "--bound", "a=1:3"), "--bound a=1:3: a has a value already"),
        (("--by", "luck"), "Invalid value for '--by'"),
        (("--settings", world / "garbled.toml"), "cannot be read as TOML"),
    ):
        refused = fuselog(*tune, *options)
        assert (refused.code, len(refused.err.splitlines())) == (2, 1)
        assert sentence in refused.err
    assert not (tmp_path / "out").exists()


@pytest.mark.paper
def test_logs_that_were_meant_to_be_held_out_are_not_tuned_on(
    world: Path, fuselog: Fuselog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of `--validate test/*.mcap` the shell makes many words, of which the option takes the first."""
    monkeypatch.chdir(tmp_path)
    for name in ("train/0", "train/1", "test/2", "test/3", "test/2.estimates"):
        log = tmp_path / f"{name}.mcap"
        log.parent.mkdir(exist_ok=True)
        shutil.copy(world / "log.mcap", log)
    tune = ("tune", "-e", "ekf", "--free", "sigma_range_m", "train/0.mcap", "train/1.mcap")
    leaking = fuselog(*tune, "--validate", "test/2.mcap", "test/3.mcap")
    assert (leaking.code, leaking.err) == (
        2,
        "fuselog: test/3.mcap: would be tuned on, although test/2.mcap in the same folder is held out; "
        "to hold out several logs, give their folder to --validate, or repeat --validate for each log\n",
    )
    both = fuselog(*tune, "--validate", "train/1.mcap")
    assert both.code == 2
    assert "train/1.mcap: is among both the tuned and the held-out logs" in both.err
    assert not Path("out").exists()
    held_out = fuselog("tune", "train", "-e", "ekf", "--free", "sigma_range_m", "--validate", "test")
    assert (held_out.code, held_out.err) == (0, "")
    assert held_out.out.startswith(
        "tuning on 2 logs, train/0.mcap to train/1.mcap; held out: 2 logs, test/2.mcap to test/3.mcap\n"
    )
    assert len(read_result(Path("out/tune")).settings["held_out"]) == 2


@pytest.fixture(scope="module")
def seen() -> list[fl.MemorySource]:
    """Two short runs with truth, in which ranges are told by a single sighting a second."""
    rate = {"range_bearing": {"rate_hz": 2.0}}
    return [fl.record("landmarks", seed=seed, duration_s=20.0, **rate) for seed in (2, 3)]


@pytest.mark.paper
@pytest.mark.parametrize(
    ("by", "begin", "quantity", "best"),
    [
        ("nis", 1.0, "nis_per_component", 1.0),
        ("nees", 0.03, "nees", 3.0),
        ("rmse", 1.0, "position_rmse_m", 0.0),
    ],
)
def test_other_things_can_be_best(
    seen: list[fl.MemorySource], by: Any, begin: float, quantity: str, best: float
) -> None:
    """Of NIS and NEES what they should be, of RMSE the least; without intervals, as is said."""
    found = fl.tune(seen, "ekf", "sigma_range_m", by=by, set={"sigma_range_m": begin})
    start, tuned = found.metrics.query("quantity == @quantity")["value"]
    assert abs(tuned - best) < abs(start - best)
    assert tuned == pytest.approx(best, abs=0.1)
    assert found.parameters[["low", "high"]].isna().all(axis=None)
    assert f"tuning by {by} gives no intervals; other values may be equally good" in found.notes


@pytest.mark.paper
def test_folds_and_a_grid(seen: list[fl.MemorySource]) -> None:
    """Each run judges what the other gives; a grid leads to where the search ends in any case."""
    free = ["sigma_range_m", "sigma_bearing_rad"]
    far = {"sigma_range_m": 1.0, "sigma_bearing_rad": 0.2}
    bounds = {"sigma_range_m": (0.01, 2.0), "sigma_bearing_rad": (0.001, 0.4)}
    found = fl.tune(seen, "ekf", free, set=far, bounds=bounds, grid=4, folds=2)
    for fold, other in enumerate(reversed(seen)):
        alone = fl.tune(other, "ekf", free, set=far, bounds=bounds)
        np.testing.assert_allclose(found.folds[free].iloc[fold], alone.found.optimum, rtol=1e-4)
    assert (found.folds["cost_tuned"] < found.folds["cost_start"]).all()
    assert "2 of 2 folds are explained better with the values from the other folds" in found.notes
    again = fl.tune(seen, "ekf", free, set=far)
    np.testing.assert_allclose(again.found.optimum, found.found.optimum, rtol=1e-4)


@pytest.mark.paper
def test_any_number_of_cores_finds_the_same(
    seen: list[fl.MemorySource], on_cores: Callable[[int], None]
) -> None:
    found = []
    for cores in (1, 5):
        on_cores(cores)
        tuned = fl.tune(seen, "ekf", "sigma_range_m", set={"sigma_range_m": 0.5})
        found.append((tuned.found.optimum.tobytes(), tuned.standard_errors.tobytes()))
    assert found[0] == found[1]


class Away(InlineExecutor):
    """Does the work as another process would: what comes and goes is pickled."""

    def submit(self, work: Callable[..., Any], /, *args: Any) -> Future[Any]:
        """The same on copies of everything."""
        work, args = pickle.loads(pickle.dumps((work, args)))
        return super().submit(lambda: pickle.loads(pickle.dumps(work(*args))))


@pytest.mark.paper
def test_workers_find_the_same(seen: list[fl.MemorySource]) -> None:
    given = {"set": {"sigma_range_m": 0.5}}
    alone = fl.tune(seen, "ekf", "sigma_range_m", **given)
    shared = fl.tune(seen, "ekf", "sigma_range_m", executor=Away(), **given)
    assert shared.found.optimum.tobytes() == alone.found.optimum.tobytes()
    assert shared.profile.equals(alone.profile)  # computed when the workers have gone

    class Own(ScalarParameters):
        """Parameters that only this function knows."""

    with pytest.raises(fl.BadInput, match="level: the estimator cannot be sent to another process"):
        fl.tune(
            source(np.ones(5)),
            {"level": fl.modelled(replace(SCALAR, parameters=Own), "ekf")},
            "sigma_measured",
            executor=Away(),
        )

    class Dying(InlineExecutor):
        def submit(self, *_: Any, **__: Any) -> Future[Any]:
            future: Future[Any] = Future()
            future.set_exception(BrokenExecutor("it was killed"))
            return future

    with pytest.raises(fl.BadInput, match=r"while tuning ekf \(it was killed\); try fewer workers"):
        fl.tune(seen, "ekf", "sigma_range_m", executor=Dying(), **given)


@pytest.mark.paper
def test_processes_tune_as_the_command_says(
    world: Path, tmp_path: Path, fuselog: Fuselog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two are asked for; what would come and go is pickled here."""
    asked: list[int] = []

    def opened(count: int) -> PoolFactory:
        asked.append(count)
        return lambda: nullcontext(WorkerPool(Away(), count))

    monkeypatch.setattr("fuselog.pipeline.runs.executors.processes", opened)
    tune = ("tune", world / "log.mcap", "-e", "ekf", "--free", "sigma_range_m", "--json", "--out")
    shared = fuselog(*tune, tmp_path / "shared", "--workers", "2").json
    assert asked == [2]
    assert shared["parameters"] == fuselog(*tune, tmp_path / "alone").json["parameters"]


@pytest.mark.parametrize(
    "cost",
    [
        lambda x: 0.0 * x,
        lambda x: np.where(x == 1.0, -100.0, 100.0),
        lambda x: np.full_like(x, np.nan),
        lambda x: np.full_like(x, np.inf),
        lambda x: np.where(x > 2.0, np.nan, -x),
        lambda x: np.where(x > 0.5, 0.0, 100.0),
        lambda x: np.log(np.maximum(x, 1e-300)),
        lambda x: np.exp(-x),
    ],
    ids=["flat", "spike", "nan", "infinite", "edge", "step", "without an end", "underflow"],
)
@pytest.mark.parametrize("is_smooth", [True, False])
def test_a_search_ends_whatever_the_cost_is(cost: Callable[[Any], Any], is_smooth: bool) -> None:
    """A search stops within a bounded number of values and stays within its bounds."""
    asked_for = 0

    def counted(values: Any) -> Any:
        nonlocal asked_for
        asked_for += len(values)
        assert asked_for < 10_000
        return cost(values[:, 0])

    coordinates = Coordinates([Parameter("sigma_m", 1.0, low=0.0, is_log=True)], np.ones(1))
    found, _ = least(counted, coordinates, np.zeros(1), is_smooth=is_smooth)
    assert not np.isnan(found).any()


@pytest.mark.paper
def test_what_need_not_be_positive_is_found_too() -> None:
    """Biases and a scale, with the noise ten times off; what was put in lies in the intervals."""
    sensor = {"rate_hz": 2.0, "bias_range_m": 0.2, "bias_bearing_rad": -0.05}
    log = fl.record("landmarks", seed=3, duration_s=30.0, range_bearing=sensor, forward_scale_error=0.1)
    true = {"bias_range_m": 0.2, "bias_bearing_rad": -0.05, "forward_scale": 1.1, "sigma_range_m": 0.1}
    found = fl.tune(log, "ekf", [*true], set={"sigma_range_m": 1.0})
    for row in found.parameters.to_dict("records"):
        assert row["low"] < true[row["parameter"]] < row["high"], row
        assert row["high"] - row["low"] < 0.2


@pytest.mark.parametrize("lowest", [0.1, 10**-0.5, 10**-0.2, 10**0.2, 10**0.5, 10.0])
def test_a_scan_finds_a_lower_minimum_up_to_ten_times_away(lowest: float) -> None:
    coordinates = Coordinates([Parameter("sigma_m", 1.0, low=1e-3, high=1e3, is_log=True)], np.ones(1))

    def cost(values: np.ndarray) -> np.ndarray:
        return np.where(np.abs(np.log(values[:, 0] / lowest)) < 0.05, 0.0, 1.0)

    [found] = scanned(cost, coordinates, np.zeros(1))
    assert np.exp(found) == pytest.approx(lowest)


@pytest.mark.paper
@pytest.mark.parametrize(
    ("scenario", "duration", "estimator", "free", "factor"),
    [
        (
            "landmarks",
            {"duration_s": 30.0, "range_bearing": {"rate_hz": 2.0}},
            "ekf",
            ["forward_noise_density", "turn_noise_density", "sigma_range_m", "sigma_bearing_rad"],
            10.0,
        ),
        (
            "manoeuvres",
            {},
            "imm:ekf",
            ["acceleration_sigma_mps2", "manoeuvring_sigma_mps2", "standing_sigma_mps"],
            0.1,
        ),
        (
            "extended-target",
            {},
            "analytic",
            ["size_drift_m2", "position_drift_m2", "point_variance_m2"],
            10.0,
        ),
    ],
)
def test_a_start_ten_times_off_leads_to_the_same_optimum(
    scenario: str, duration: dict[str, Any], estimator: str, free: list[str], factor: float
) -> None:
    """All parameters together, times or divided by ten: within .01 of the likelihood.

    What logs tell so little of that this leaves it more than its interval is said in words.
    """
    log = fl.record(scenario, seed=1, **duration)
    near = fl.tune(log, estimator, free)
    starts = near.parameters.set_index("parameter")["start"]
    searched = near.found.coordinates.free  # but what the log tells nothing of, which stays
    bounds = {each.name: (each.low, each.high) for each in searched if each.low < each.high}
    far = fl.tune(log, estimator, free, set=dict(factor * starts), bounds=bounds)
    # what a log does not determine stays where it began or goes to its bound, as rounding has it
    is_open = any("do not determine" in note or "bound" in note for note in near.notes_of_search)
    within = DROP_95 if is_open else 0.01
    assert far.costs[1] == pytest.approx(near.costs[1], abs=within)
    for row in near.parameters.assign(far=far.found.optimum).to_dict("records"):
        is_said = any(row["parameter"] in note for note in near.notes_of_search)
        assert row["low"] <= row["far"] <= row["high"] or is_said, row


@pytest.mark.paper
def test_the_experiment_of_tuned_noise(fuselog: Fuselog, tmp_path: Path) -> None:
    """Values of every run and parameter, and over the runs how often their intervals hold the truth."""
    out = tmp_path / "tuning"
    short = ("--set", "options.durations_s=[20.0]", "--runs", "2", "--logs", "0")
    told = fuselog("run", "tuning", *short, "--out", out, "--json")
    assert told.code == 0
    table = pd.read_csv(out / "tables" / "tuned.csv")
    assert len(table) == 2 * len(FREE)
    assert (np.abs(np.log(table["value"] / table["true"])) < 4 * table["standard_error"]).all()
    covered = table.groupby("parameter")["is_covered"].mean()
    for name in FREE:
        assert told.json["metrics"][f"ekf.covered_share.{name}-20s"] == covered[name]


def test_values_of_some_vehicles_are_judged_on_others(fuselog: Fuselog, tmp_path: Path) -> None:
    """Those held out are no part of the search: as if there were two logs."""
    own = tmp_path / "mine.toml"
    experiment = """
        title = "two robots tune, one judges"
        study = "tuning-held-out"
        record = { scenario = "landmarks", parameters = { robots = 3, duration_s = 10.0 } }
        estimators.ekf = { sigma_range_m = 0.5, gate_probability = 1.0 }
        options.free = ["sigma_range_m"]
        options.tuned_by = ["robot1", "robot2"]
        options.held_out = ["robot3"]
    """
    own.write_text(experiment)
    metrics = fuselog("run", own, "--logs", "0", "--out", tmp_path / "r", "--json").json["metrics"]
    assert metrics["start.sigma_range_m"] == 0.5
    assert metrics["tuned.sigma_range_m"] == pytest.approx(0.1, rel=0.1)
    for label in ("start", "tuned"):
        alone = metrics[f"{label}-held-out.log_likelihood.robot3"]
        assert metrics[f"{label}-held-out.open_gate_log_likelihood"] == pytest.approx(alone)
        assert f"{label}.log_likelihood.robot3" not in metrics
        assert f"{label}-held-out.log_likelihood.robot1" not in metrics
    own.write_text(experiment.replace("robot3", "robot7"))
    refused = fuselog("run", own, "--out", tmp_path / "other")
    assert (refused.code, len(refused.err.splitlines())) == (2, 1)
    assert "no topic begins with /robot7/" in refused.err
