"""What estimators read of a log: vectors and priors by name, covariances and priors that are missing."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, make_stream
from fuselog.recorders.recording import record_run
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.failures import sentences_of
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.judging.metrics.measuring import Output
from fuselog.replay.judging.metrics.metrics import COVERAGE

VEHICLES = {"duration_s": 20.0}


def record(scenario: str, run: int = 0, **parameters: object) -> MemorySource:
    return memory_source(*record_run(scenario, parameters, 3, run))


def changed(source: MemorySource, **streams: Stream | None) -> MemorySource:
    """The run with topics replaced, or left out where they are None."""
    given = {f"/{name.replace('__', '/')}": stream for name, stream in streams.items()}
    return replace(
        source, streams={k: v for k, v in {**source.streams, **given}.items() if v is not None}
    )


def replayed(name: str, *sources: MemorySource, **settings: object) -> dict[str, Ragged]:
    return collect(replay(sources, bind(name, sources, settings)))


def assert_equal(ours: Mapping[str, Ragged], theirs: Mapping[str, Ragged], run: int = 0) -> None:
    """Run 0 of theirs is this run of ours, to the last bit; failures are told apart."""
    assert ours.keys() == theirs.keys()
    for topic, ragged in theirs.items():
        for name, column in ragged.of_run(0).columns.items():
            assert_array_equal(ours[topic].of_run(run)[name], column, err_msg=f"{topic} {name}")
    assert any(len(ragged.of_run(0)) for ragged in theirs.values())


# Fixes.


def widened(fix: Stream, order: str) -> Stream:
    """The planar fixes as fixes in space, with these components; z is far away and uncertain."""
    names = order.split(",")
    columns = [names.index(name) for name in ("x_m", "y_m")]
    position = np.full((len(fix), len(names)), 77.0)
    position[:, columns] = fix["position_m"]
    covariance = np.tile(900.0 * np.eye(len(names)), (len(fix), 1, 1))
    covariance[:, np.ix_(columns, columns)[0], columns] = fix["covariance_m2"].reshape(-1, 2, 2)
    return make_stream(
        fix.topic,
        fix.schema,
        fix.publish_time_ns,
        metadata={} if order == "x_m,y_m,z_m" else {"components": order},
        position_m=position,
        covariance_m2=covariance.reshape(len(fix), -1),
    )


@pytest.mark.parametrize("estimator", ["vehicle-kalman", "vehicles:known"])
@pytest.mark.parametrize("order", ["x_m,y_m,z_m", "z_m,y_m,x_m", "y_m,x_m"])
def test_a_planar_filter_takes_x_and_y_of_a_fix_by_their_names(estimator: str, order: str) -> None:
    source = record("vehicles", duration_s=20.0)
    fixes = {f"vehicle{n}__fix": widened(source.streams[f"/vehicle{n}/fix"], order) for n in range(1, 6)}
    assert_equal(replayed(estimator, changed(source, **fixes)), replayed(estimator, source))


@pytest.mark.parametrize("estimator", ["vehicle-kalman", "vehicles:known"])
@pytest.mark.parametrize(
    ("fields", "words"),
    [
        (
            {"components": "range_m,height_m"},
            "position_m: .* no component x_m; it states range_m, height_m",
        ),
        ({"components": "x_m,y_m,z_m"}, "names 3 components .* position_m has 2"),
        ({"width": "9"}, "covariance_m2 has 9 numbers; 4 are needed"),
    ],
)
def test_fixes_that_do_not_say_what_they_are_are_refused(
    estimator: str, fields: dict[str, str], words: str
) -> None:
    source = record("vehicles", duration_s=5.0)
    fix = source.streams["/vehicle1/fix"]
    if "width" in fields:
        fix = replace(fix, columns={**fix.columns, "covariance_m2": np.ones((len(fix), 9))})
    with pytest.raises(BadInput, match=f"/vehicle1/fix: .*{words}"):
        replayed(estimator, changed(source, vehicle1__fix=replace(fix, metadata=fields)))


@pytest.mark.parametrize("estimator", ["vehicle-kalman", "vehicles:known"])
def test_a_fix_without_covariance_is_left_out_and_counted(estimator: str) -> None:
    """As if it had not come, unless the parameter says its sigma: then as if the log had stated that."""
    source = record("vehicles", duration_s=20.0)
    fix = source.streams["/vehicle2/fix"]
    covariance = fix["covariance_m2"].copy()
    covariance[7, 3] = np.nan
    blind = replace(fix, columns={**fix.columns, "covariance_m2": covariance})
    out = replayed(estimator, changed(source, vehicle2__fix=blind))
    absent = replayed(estimator, changed(source, vehicle2__fix=fix.take(np.arange(20) != 7)))
    case = "/estimates/" + (f"{estimator}/vehicle2" if "kalman" in estimator else estimator)
    skipped = out.pop(f"{case}/skipped")
    absent.pop(f"{case}/skipped")
    assert_equal(out, absent)
    assert len(out[f"/estimates/{estimator}/vehicle2/state"]) >= 19
    (sentence,) = sentences_of(skipped.stream)
    assert "/vehicle2/fix" in sentence
    assert "--set sigma_fix_m=" in sentence
    assert COVERAGE.of(Output("", "", "skipped", skipped, [])) == {"skipped_measurements": 1.0}

    stated = covariance.copy()
    stated[7] = [0.25, 0.0, 0.0, 0.25]
    known = replace(fix, columns={**fix.columns, "covariance_m2": stated})
    ours = replayed(estimator, changed(source, vehicle2__fix=blind), sigma_fix_m=0.5)
    assert not len(ours[f"{case}/skipped"])
    assert_equal(ours, replayed(estimator, changed(source, vehicle2__fix=known)))


def test_vectors_of_another_width_are_refused() -> None:
    source = record("batch-reactor")
    pressure = source.streams["/pressure"]
    double = replace(pressure, columns={**pressure.columns, "value": np.ones((len(pressure), 2))})
    with pytest.raises(BadInput, match=r"/pressure: the channel names 1 components .* value has 2"):
        replayed("analytic", changed(source, pressure=double))
    source = record("axis")
    axis = source.streams["/axis"]
    cube = replace(axis, columns={**axis.columns, "axis": np.ones((len(axis), 3))})
    with pytest.raises(BadInput, match="topic /axis: axis has 3 numbers; 2 are needed"):
        replayed("bingham-axis", changed(source, axis=cube))


# Priors.


def reordered(prior: Stream) -> Stream:
    """The same prior with its components the other way round, and one more that nobody asked for."""
    names, kinds = (prior.metadata[key].split(",") for key in ("components", "kinds"))
    size = len(names)
    order = np.arange(size)[::-1]
    mean = np.concatenate([prior["mean"][:, order], np.full((len(prior), 1), 5.0)], axis=1)
    covariance = np.tile(9.0 * np.eye(size + 1), (len(prior), 1, 1))
    covariance[:, :size, :size] = prior["covariance"].reshape(-1, size, size)[:, order][:, :, order]
    stated = {
        "components": ",".join([*(names[i] for i in order), "temperature_k"]),
        "kinds": ",".join([*(kinds[i] for i in order), "linear"]),
    }
    columns = {**prior.columns, "mean": mean, "covariance": covariance.reshape(len(prior), -1)}
    return replace(prior, columns=columns, metadata={**prior.metadata, **stated})


def correlated(prior: Stream) -> Stream:
    """The prior with correlations, so that rows and columns cannot be mistaken."""
    size = prior["mean"].shape[1]
    sigma = np.sqrt(np.diagonal(prior["covariance"].reshape(-1, size, size), axis1=1, axis2=2))
    shared = 0.2 ** np.abs(np.arange(size)[:, None] - np.arange(size))
    covariance = sigma[:, :, None] * shared * sigma[:, None]
    return replace(prior, columns={**prior.columns, "covariance": covariance.reshape(len(prior), -1)})


def with_priors(source: MemorySource, change: Callable[[Stream], Stream | None]) -> MemorySource:
    streams = {k: change(v) if k.endswith("/prior") else v for k, v in source.streams.items()}
    return replace(source, streams={k: v for k, v in streams.items() if v is not None})


STARTERS = {
    "ekf": ("landmarks", {"duration_s": 3.0}),
    "lrkf:ukf": ("batch-reactor", {}),
    "analytic": ("extended-target", {"points": 20}),
    "ukf-torus": ("torus-headings", {}),
    "vehicle-kalman": ("vehicles", VEHICLES),
    "vehicles:hungarian": ("vehicles", VEHICLES),
    "vehicle-particles:associations-20": ("vehicles", VEHICLES),
    "gm-phd": ("vehicles", VEHICLES),
    "cooperative:joint": ("landmarks", {"duration_s": 3.0, "robots": 3}),
}


@pytest.mark.parametrize("estimator", STARTERS)
def test_the_order_of_a_priors_components_never_matters(estimator: str) -> None:
    scenario, parameters = STARTERS[estimator]
    source = with_priors(record(scenario, **parameters), correlated)
    assert_equal(replayed(estimator, with_priors(source, reordered)), replayed(estimator, source))


def test_a_networks_state_is_known_by_its_names() -> None:
    """Its components are the prior's own; a position and its velocity are found wherever they stand."""
    source = with_priors(record("ispace", steps=30), correlated)

    def interleaved(prior: Stream) -> Stream:
        order = [2, 0, 3, 1]  # vx, x, vy, y
        covariance = prior["covariance"].reshape(-1, 4, 4)[:, order][:, :, order].reshape(-1, 16)
        columns = {**prior.columns, "mean": prior["mean"][:, order], "covariance": covariance}
        stated = {"components": ",".join(prior.components[i] for i in order)}
        return replace(prior, columns=columns, metadata={**prior.metadata, **stated})

    assert_equal(replayed("network", with_priors(source, interleaved)), replayed("network", source))
    nameless = with_priors(source, lambda prior: replace(prior, metadata={"components": "a,b,c,d"}))
    with pytest.raises(
        BadInput, match="topic /prior: its channel states a, b, c, d; expected positions"
    ):
        replayed("network", nameless)


@pytest.mark.parametrize("estimator", [name for name in STARTERS if name != "gm-phd"])
def test_a_prior_without_a_component_is_refused(estimator: str) -> None:
    scenario, parameters = STARTERS[estimator]
    source = record(scenario, **parameters)
    missing = next(v for k, v in source.streams.items() if k.endswith("prior")).components[1]

    def renamed(prior: Stream) -> Stream:
        names = prior.metadata["components"].replace(missing, "other")
        return replace(prior, metadata={**prior.metadata, "components": names})

    with pytest.raises(BadInput, match=f"prior: .* no component {missing}; it states .*other"):
        replayed(estimator, with_priors(source, renamed))


@pytest.mark.parametrize("estimator", [*STARTERS, "network"])
@pytest.mark.parametrize("flaw", ["none", "indefinite"])
def test_a_run_without_a_usable_prior_fails_alone(estimator: str, flaw: str) -> None:
    """In every family; where no run has one, the input is bad."""
    scenario, parameters = STARTERS.get(estimator, ("ispace", {"steps": 30}))
    settings = {"sensor": "network"} if estimator == "gm-phd" else {}  # the other one needs no prior
    good, other = record(scenario, **parameters), record(scenario, run=1, **parameters)

    def spoilt(prior: Stream) -> Stream:
        if flaw == "none":
            return prior.take(slice(0, 0))
        return replace(prior, columns={**prior.columns, "covariance": -prior["covariance"]})

    bad = with_priors(other, spoilt)
    out = replayed(estimator, bad, good, **settings)
    alone = replayed(estimator, good, **settings)
    assert_equal(out, alone, run=1)
    told = [each.of_run(0) for topic, each in out.items() if topic.endswith("/failure")]
    sentences = {sentence for each in told for sentence in sentences_of(each)}
    words = {"none": "no prior message", "indefinite": "not positive definite"}[flaw]
    assert sentences
    assert all("prior: " in each and words in each for each in sentences)
    times = [time_ns for each in told for time_ns in each.publish_time_ns.tolist()]
    assert min(times) >= good.run.epoch_ns
    with pytest.raises(BadInput, match=words):
        replayed(estimator, bad, **settings)


@pytest.mark.parametrize("estimator", ["ekf", "cooperative:ci", "cooperative:joint"])
def test_a_robot_whose_prior_does_not_fit_fails_alone(estimator: str) -> None:
    """The others are estimated as without it, and its components are named."""
    source = record("landmarks", duration_s=5.0, robots=3)
    prior = source.streams["/robot2/prior"]
    misfit = replace(prior, metadata={"components": "x_m,y_m,speed_mps"})
    settings = {"anchors": [3]} if "coop" in estimator else {}
    out = replayed(estimator, changed(source, robot2__prior=misfit), **settings)
    (failure,) = sentences_of(out[f"/estimates/{estimator}/robot2/failure"].stream)
    assert (
        "/robot2/prior: the channel has no component heading_rad; it states x_m, y_m, speed" in failure
    )
    without = {k: v for k, v in source.streams.items() if not k.startswith("/robot2/")}
    rest = replayed(estimator, replace(source, streams=without), **settings)
    for robot in (1, 3):
        topic = f"/estimates/{estimator}/robot{robot}/pose"
        assert len(rest[topic]) > 50
        assert_array_equal(out[topic]["mean"], rest[topic]["mean"])
        assert_array_equal(out[topic]["covariance"], rest[topic]["covariance"])
    assert not len(out.get(f"/estimates/{estimator}/robot2/pose", ()))
