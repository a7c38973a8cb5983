"""Directional filters on streams: what the channel states, consistency, and the replay's contract."""

import numpy as np
import pytest

from fuselog.pipeline.runs.recorded import record_ensemble, replay_ensemble
from fuselog.recorders.errors import BadInput
from fuselog.recorders.recording import record_run
from fuselog.replay.engine.streams.sources import memory_source
from fuselog.replay.judging.metrics.metrics import CONSISTENCY

FILTERS = {
    "axis": {"bingham-axis": {}, "kalman-axis": {}},
    "orientation": {"bingham-orientation": {}, "kalman-orientation": {}},
    "torus-headings": {"torus": {}, "ukf-torus": {}},
}


@pytest.mark.parametrize("scenario", FILTERS)
def test_ensemble_equals_single_runs(scenario):
    """Bit for bit, through recorder, replay and evaluation."""
    sources = record_ensemble(scenario, {"steps": 15}, 3, 3)
    together = replay_ensemble(sources, FILTERS[scenario], gap_limit_s=0.2)
    for run, source in enumerate(sources):
        alone = replay_ensemble([source], FILTERS[scenario], gap_limit_s=0.2)
        for topic, ragged in together.outputs.items():
            for name, column in ragged.of_run(run).columns.items():
                assert np.array_equal(column, alone.outputs[topic].stream[name]), topic


def test_the_covariance_of_an_orientation_is_that_of_its_error():
    """NEES of three components, over 60 runs from the truth's own noise."""
    sources = record_ensemble("orientation", {"steps": 40}, 0, 60)
    replayed = replay_ensemble(sources, {"bingham-orientation": {}}, gap_limit_s=0.2)
    assert CONSISTENCY.of(replayed.errors[0])["nees"] == pytest.approx(3.0, abs=0.15)


def test_the_covariance_of_headings_is_that_of_their_error():
    sources = record_ensemble("torus-headings", {"measurement_sigma_rad": 0.3}, 0, 60)
    replayed = replay_ensemble(sources, {"torus": {}}, gap_limit_s=0.2)
    assert CONSISTENCY.of(replayed.errors[0])["nees"] == pytest.approx(2.0, abs=0.15)


def test_a_parameter_goes_before_what_the_channel_states():
    """A filter that is told of useless measurements stays at its prior's mode, (0, 1)."""
    source = memory_source(*record_run("axis", {"steps": 5}, 0))
    deaf = {"measurement": {"diagonal": [0.0, 0.0]}}
    replayed = replay_ensemble([source], {"bingham-axis": deaf}, gap_limit_s=0.2)
    (state,) = (each for topic, each in replayed.outputs.items() if topic.endswith("/state"))
    np.testing.assert_allclose(np.abs(state["mean"]), [[0.0, 1.0]] * 5, atol=1e-12)


@pytest.mark.parametrize(
    ("scenario", "values", "message"),
    [
        ("axis", {"system": {"diagonal": [0.0, 3.0]}}, "at most 0"),
        ("axis", {"system": {"diagonal": [0.0, -1.0, -1.0]}}, "2 numbers"),
        ("axis", {"start": [1.0, 1.0]}, "unit length"),
        ("axis", {"start": [0.0, 0.0]}, "unit length"),
        ("orientation", {"prior": {"diagonal": [-1.0, 0.0]}}, "4 numbers each"),
        (
            "orientation",
            {"system": {"distribution": "gaussian", "diagonal": [1.0, 1.0, 1.0, -1.0]}},
            "must not be negative",
        ),
        ("torus-headings", {"system_correlation": 1.0}, "less than 1"),
    ],
)
def test_bad_parameters_are_told(scenario, values, message):
    with pytest.raises(BadInput, match=message):
        record_run(scenario, values, 0)


def test_a_filter_of_another_dimension_is_refused():
    source = memory_source(*record_run("orientation", {"steps": 5}, 0))
    with pytest.raises(BadInput, match="does not fit"):
        replay_ensemble([source], {"bingham-axis": {}}, gap_limit_s=0.2)
    flat = {"bingham-orientation": {"system": {"diagonal": [0.0, -1.0]}}}
    with pytest.raises(BadInput, match="2 numbers for 4 components"):
        replay_ensemble([source], flat, gap_limit_s=0.2)
