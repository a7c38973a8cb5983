"""What is asked of a model, and the one sentence where it, the log or the settings do not meet it."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.parameters import build
from fuselog.recorders.recording import Recording, record_run
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.inference import estimators
from fuselog.replay.inference.all_methods import METHODS
from fuselog.replay.inference.model.binding import _common
from fuselog.replay.inference.model.bound_model import BoundModel, bound_model_of
from fuselog.replay.inference.model.model import Control, Model, Motion, Sensor
from fuselog.replay.inference.model.parameters import ModelParameters
from fuselog.replay.inference.model.settings import reading_settings
from tests.replay.inference import vehicle_a
from tests.replay.inference.replays import bound, outputs
from tests.replay.inference.vehicle_a import RANGE_BEARING, SPEED, VEHICLE_A

SOURCE = vehicle_a.source(vehicle_a.simulate(7)[0][:20])


def three(state: Any, *_: Any) -> Any:
    return state[0], state[1], state[2]


def as_list(state: Any, *_: Any) -> Any:
    return list(state)


def misspelt(parameters: Any) -> Any:
    return (parameters.sigma_sped_mps**2,)


class Unstated(ModelParameters):
    """One that the log has to state."""

    sigma_speed_mps: float | None = None
    gate_probability: float = 1.0


def with_sensor(sensor: Sensor, **changes: Any) -> Model:
    return replace(VEHICLE_A, sensors=(replace(sensor, **changes),))


HELD = Control("speed", schemas.VECTOR_MEASUREMENT, ("forward_mps",), read=SPEED.read)

# What a model says, and words that the sentence must have.
WRONG: dict[str, tuple[Model, tuple[str, ...]]] = {
    "move": (
        replace(VEHICLE_A, motion=Motion(three)),
        ("three (test_contract.py, line", "returns 3", "5"),
    ),
    "noise": (
        replace(VEHICLE_A, motion=Motion(vehicle_a.move, three)),
        ("three", "returns 3 components", "5 or 15"),
    ),
    "measure": (with_sensor(SPEED, measure=three), ("sensor speed", "three", "returns 3", "1 are")),
    "list": (replace(VEHICLE_A, motion=Motion(as_list)), ("as_list", "a list", "tuple of 5")),
    "parameter": (
        with_sensor(SPEED, noise=misspelt),
        ("misspelt", "no parameter 'sigma_sped_mps'", "sigma_speed_mps"),
    ),
    "kind of the state": (
        replace(VEHICLE_A, state={**vehicle_a.STATE, "heading_rad": "rotation"}),
        ("kinds linear, linear, rotation", "give linear, angle, axis"),
    ),
    "half a quaternion": (
        replace(VEHICLE_A, state=dict.fromkeys(vehicle_a.STATE, "quaternion")),
        ("quaternion (four in a row)",),
    ),
    "kind of what is measured": (
        with_sensor(SPEED, measured={"speed_mps": "axis"}),
        ("sensor speed", "kind axis", "linear or angle"),
    ),
    "no noise": (
        with_sensor(SPEED, noise=None),
        ("sensor speed", "has no noise", "`covariance`"),
    ),
    "a covariance of nothing": (
        with_sensor(SPEED, covariance="covariance_m2"),
        ("covariance_m2", "give `vector`"),
    ),
    "noise of control beside noise of motion": (
        replace(
            VEHICLE_A, motion=replace(VEHICLE_A.motion, noises=1, control_noise=misspelt, move=three)
        ),
        ("three",),
    ),
    "one component, two kinds": (
        replace(VEHICLE_A, sensors=(RANGE_BEARING, replace(SPEED, measured={"bearing_rad": "linear"}))),
        ("bearing_rad is linear, but angle in another sensor",),
    ),
    "a control of a sensor alone": (
        with_sensor(SPEED, control=HELD),
        ("sensor speed", "reads the control speed (forward_mps)", "model's is none"),
    ),
    "a sensor that reads a control that is held": (
        replace(with_sensor(SPEED, control=HELD), control=HELD),
        ("sensor speed", "constant between messages", "interpolated=True"),
    ),
    "what it reads": (
        with_sensor(SPEED, read=lambda stream: np.zeros((len(stream), 2))),
        ("topic /speed", "shape (9, 2)", "(9, 1)"),
    ),
}


def told(state: Any, *_: Any) -> Any:
    return (float(np.base_repr(int(state[0]))),)


def test_a_model_that_cannot_be_traced_is_named_with_its_line(uncompiled: None) -> None:
    """The estimator, the file and line of the model's function, and what to write instead."""
    line = told.__code__.co_firstlineno + 1
    with pytest.raises(
        BadInput, match=rf"estimator test: told \(test_contract.py, line {line}\): .*int\(\)"
    ):
        outputs(with_sensor(SPEED, measure=told), "ekf", [SOURCE])


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_model_is_one_sentence(case: str, uncompiled: None) -> None:
    model, words = WRONG[case]
    with pytest.raises(BadInput) as caught:
        outputs(model, "ekf", [SOURCE])
    sentence = str(caught.value)
    assert "\n" not in sentence
    for each in words:
        assert each in sentence


def changed(topic: str, change: Mapping[str, str] | None) -> MemorySource:
    """The log with other metadata on one topic, or without it."""
    streams: dict[str, Stream] = dict(SOURCE.streams)
    if change is None:
        del streams[topic]
    else:
        streams[topic] = replace(streams[topic], metadata={**streams[topic].metadata, **change})
    return memory_source(Recording(list(streams.values())), SOURCE.run)


def test_a_number_that_no_channel_states_or_states_as_nonsense() -> None:
    """A sensor's own channel goes first, then that of the prior."""
    model = replace(VEHICLE_A, parameters=Unstated, sensors=(SPEED,))
    with pytest.raises(
        BadInput, match=r"topic /speed does not state sigma_speed_mps; .*--set sigma_spe"
    ):
        bound(model, "ekf", [SOURCE])
    with pytest.raises(
        BadInput, match="topic /speed states sigma_speed_mps = fast, which is not a number"
    ):
        bound(model, "ekf", [changed("/speed", {"sigma_speed_mps": "fast"})])
    with pytest.raises(BadInput, match="topic /speed: parameter 'sigma_speed_mps' is inf"):
        bound(model, "ekf", [changed("/speed", {"sigma_speed_mps": "inf"})])
    for topic in ("/prior", "/speed"):
        (stated,) = bound(model, "ekf", [changed(topic, {"sigma_speed_mps": "0.25"})])
        column = list(Unstated.model_fields).index("sigma_speed_mps")
        assert stated.start.__self__.settings[1, column] == 0.25  # type: ignore[union-attr]


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Model]]:
    """The registered models, to be changed at will."""
    models: dict[str, Model] = {"vehicle-a": VEHICLE_A}

    def load(kind: str, name: str, _: type) -> Model:
        if name not in models:
            raise BadInput(f"no {kind} '{name}'")
        return models[name]

    monkeypatch.setattr(estimators, "load", load)
    monkeypatch.setattr(estimators, "available", lambda _: dict.fromkeys([*models, "broken"]))
    estimators._any_parameters.cache_clear()
    yield models
    estimators._any_parameters.cache_clear()


def fit(source: MemorySource, method: str = "ekf", **settings: Any) -> list[Any]:
    estimator = estimators.of_any_model(METHODS[method])
    return estimator.bind("e", source.topics, build(estimator.parameters, settings, "estimator e"))


def test_the_log_says_which_model_fits(registered: dict[str, Model]) -> None:
    """One that fits is taken, of two the one that is named; one that does not load is no matter."""
    (found,) = fit(SOURCE)
    assert found.name == "e"
    assert set(found.streams) == {"/sighting", "/speed"}
    registered["twin"] = replace(VEHICLE_A, sensors=(SPEED,))
    with pytest.raises(BadInput, match="models vehicle-a and twin fit this log; choose with --model"):
        fit(SOURCE)
    assert fit(SOURCE, model="twin")[0].streams == ("/speed",)
    with pytest.raises(BadInput, match="no models 'zzz'"):
        fit(SOURCE, model="zzz")


def test_a_sensor_that_fits_no_topic(registered: dict[str, Model]) -> None:
    """One is left out; without any, or without the map or the prior, the model does not fit."""
    assert fit(changed("/speed", None))[0].streams == ("/sighting",)
    assert fit(changed("/landmarks", None))[0].streams == ("/speed",)
    with pytest.raises(BadInput, match=r"vehicle-a is the closest one, but lacks /prior .*of x_m, y_m"):
        fit(changed("/prior", None))
    registered["vehicle-a"] = replace(registered["vehicle-a"], by_name=True)
    with pytest.raises(BadInput, match=r"is used only if you name it: --model vehicle-a"):
        fit(SOURCE)
    registered["vehicle-a"] = with_sensor(SPEED, topic="velocity")
    with pytest.raises(BadInput, match=r"does not fit this log: .*vehicle-a"):
        fit(SOURCE)
    with pytest.raises(BadInput, match=r"does not fit this log: .*lacks /velocity.*has .*/sighting"):
        fit(SOURCE, model="vehicle-a")
    registered["vehicle-a"] = with_sensor(SPEED, schema=vehicle_a.SIGHTING)
    with pytest.raises(BadInput, match=r"lacks .*/speed \(test.Sighting\)"):
        fit(SOURCE)


def test_the_sentence_of_a_log_that_no_model_fits() -> None:
    """It names the file and what the log has, and says how a model of one's own is used."""
    with pytest.raises(BadInput) as caught:
        bind("ekf", [changed("/prior", None)], {})
    own = 'use a model of your own from Python, fl.modelled(MODEL, "ekf"), or register it'
    for words in ("vehicle-a", "does not fit this log", "registered model", "/sighting", own):
        assert words in str(caught.value)


def test_a_method_says_what_a_model_lacks_for_it(registered: dict[str, Model]) -> None:
    with pytest.raises(BadInput, match="model vehicle-a lacks exact moments of its motion"):
        fit(SOURCE, "analytic")
    registered["vehicle-a"] = replace(VEHICLE_A, motion=replace(VEHICLE_A.motion, linear=True))
    with pytest.raises(BadInput, match="lacks exact moments of its sensor sighting"):
        fit(SOURCE, "analytic")
    assert fit(changed("/sighting", None), "ekf")
    assert METHODS["analytic"].lacks(with_sensor(SPEED)) == "exact moments of its motion"


def test_parameters_of_other_models_are_refused(registered: dict[str, Model]) -> None:
    """The method knows them before it knows the model; the model has the last word."""
    registered["other"] = replace(VEHICLE_A, prior="start")
    registered["vehicle-a"] = replace(VEHICLE_A, parameters=Unstated)
    with pytest.raises(BadInput, match="estimator e, model vehicle-a: no parameter 'sigma_range_m'"):
        fit(SOURCE, sigma_range_m=0.5)
    with pytest.raises(BadInput, match="no parameter 'sigma_rnage_m'; did you mean 'sigma_range_m'"):
        fit(SOURCE, sigma_rnage_m=0.5)


def calm(state: Any, duration_s: Any, parameters: Any) -> Any:
    return 0.0, 0.0, 0.0, 0.01 * duration_s, 0.01 * duration_s


def test_a_mode_is_one_of_the_models_motions(uncompiled: None) -> None:
    quiet = Motion(vehicle_a.move, calm)
    model = replace(VEHICLE_A, modes={"quiet": quiet, "usual": VEHICLE_A.motion})
    with pytest.raises(BadInput, match="mode = quiet: the model has one motion; leave out `mode`"):
        bound(VEHICLE_A, "ekf", [SOURCE], mode="quiet")
    with pytest.raises(BadInput, match="no mode 'quite'; did you mean 'quiet'"):
        bound(model, "ekf", [SOURCE], mode="quite")
    found = {
        mode: outputs(model, "ekf", [SOURCE], mode=mode)["state"]["mean"]
        for mode in (None, "usual", "quiet")
    }
    assert_array_equal(found["usual"], found[None])
    alone = outputs(replace(VEHICLE_A, motion=quiet), "ekf", [SOURCE])["state"]["mean"]
    assert_array_equal(found["quiet"], alone)
    assert np.abs(alone - found[None]).max() > 1e-3


def test_a_run_without_a_usable_prior_fails_alone(uncompiled: None) -> None:
    prior = SOURCE.streams["/prior"]
    streams = {**SOURCE.streams, "/prior": prior.take(slice(0, 0))}
    without = memory_source(Recording(list(streams.values())), SOURCE.run)
    model = replace(VEHICLE_A)
    filters = bound(model, "ekf", [SOURCE], every_s=0.1)
    found = collect(replay([SOURCE, without, SOURCE], filters))
    assert np.diff(found["/estimates/test/failure"].offsets).tolist() == [0, 1, 0]
    alone = collect(replay([SOURCE], filters))["/estimates/test/state"]
    for run in (0, 2):
        assert_array_equal(found["/estimates/test/state"].of_run(run)["mean"], alone["mean"])


def test_models_are_traced_once_for_all_that_have_the_same_sensors(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Logs may have a thousand robots."""
    traced: list[BoundModel] = []
    monkeypatch.setattr(
        estimators, "bound_model_of", lambda *parts: traced.append(bound_model_of(*parts)) or traced[-1]
    )
    recording, run = record_run("landmarks", {"duration_s": 0.1, "robots": 3}, 0)
    filters = bind("ekf", [memory_source(recording, run)], {"kind": "ekf"})
    assert (len(filters), len(traced)) == (3, 1)


@pytest.mark.parametrize(
    "spaces", [["/a/b", "/a/c"], ["/a/x/c", "/a/y/c"], ["/a"], ["/a/b/c", "/a/b"], ["/a", "/b"]]
)
def test_what_namespaces_share_is_how_all_of_them_begin(spaces: list[str]) -> None:
    assert _common(spaces) == os.path.commonpath(spaces).rstrip("/")


def test_a_row_of_settings_is_read_by_its_names() -> None:
    rows = np.arange(6.0).reshape(2, 3)
    for row in range(2):
        found = reading_settings(("gate", "bias", "age_s"))(rows, row)
        assert (found.gate, found.bias, found.age_s) == tuple(rows[row])
