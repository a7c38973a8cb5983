"""An estimator that is bound again with other numbers, and one that is bound from the start."""

from typing import Any

import pytest

import fuselog as fl
from fuselog.pipeline.diagnosing.battery.car import drive, recorded
from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.replaying import estimator
from fuselog.replay.engine.replaying.estimator import Recursive, bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.ensembles import Ensemble

FIX = "/car/fix"
BEFORE = {"forward_noise_density": 0.05, "turn_noise_density": 0.01}
AFTER = {"forward_noise_density": 0.3, "turn_noise_density": 0.02}


@pytest.fixture(scope="module")
def log() -> fl.MemorySource:
    """Ten seconds of a car with fixes and a compass, without a prior."""
    return recorded(drive(1, duration_s=10.0, rest_s=0.0))


@pytest.mark.parametrize(
    ("label", "before", "after", "times"),
    [
        ("ekf", {}, {}, 1),
        ("ekf", {"lever_x_m": 0.5}, {"lever_x_m": 0.5}, 1),
        ("ukf", {"lever_x_m": 0.0}, {"lever_x_m": 0.5}, 1),
        ("ekf", {"gate_probability": 0.99}, {"gate_probability": 0.5}, 1),
        ("ekf", {"fix_delay_s": 0.0}, {"fix_delay_s": 0.3}, 1),
        ("ekf", {"every_s": 1.0}, {"every_s": 0.5}, 2),  # of the method
        ("ekf", {}, {"lever_x_m": 0.5}, 2),
        ("ekf", {f"{FIX}.lever_x_m": 0.0}, {f"{FIX}.lever_x_m": 0.5}, 2),
        ("ekf", {f"{FIX}.lever_x_m": 0.5}, {f"{FIX}.lever_x_m": 0.5}, 2),
        ("smoother", {}, {}, 2),
    ],
)
def test_they_are_the_same(
    log: fl.MemorySource,
    monkeypatch: pytest.MonkeyPatch,
    label: str,
    before: dict[str, float],
    after: dict[str, float],
    times: int,
) -> None:
    bound_from_start = [0]
    whole = estimator._bound

    def counted(*arguments: Any) -> list[estimator.Bound]:
        bound_from_start[0] += 1
        return whole(*arguments)

    monkeypatch.setattr(estimator, "_bound", counted)
    known, settings = Ensemble([log]), AFTER | after
    bind(label, known, BEFORE | before)
    [again] = bind(label, known, settings)
    assert bound_from_start == [times]
    [wanted] = bind(label, Ensemble([log]), settings)
    assert isinstance(again, Recursive)
    assert isinstance(wanted, Recursive)
    assert again.parameters == wanted.parameters
    assert (again.alike and again.alike.key) == (wanted.alike and wanted.alike.key)
    found, expected = (collect(replay(known, [each])) for each in (again, wanted))
    assert found.keys() == expected.keys()
    for topic, rows in expected.items():
        for name, column in rows.stream.columns.items():
            assert column.tobytes() == found[topic].stream.columns[name].tobytes(), (topic, name)


def test_numbers_that_cannot_be_are_refused_alike(log: fl.MemorySource) -> None:
    known, wrong = Ensemble([log]), {**BEFORE, "turn_noise_density": -0.1}
    bind("ekf", known, BEFORE)
    sentences = []
    for runs in (known, Ensemble([log])):
        with pytest.raises(BadInput) as told:
            bind("ekf", runs, wrong)
        sentences.append(str(told.value))
    assert sentences[0] == sentences[1]
    assert "turn_noise_density" in sentences[0]
