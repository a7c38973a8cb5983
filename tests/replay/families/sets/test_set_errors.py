"""Set estimates against the truths of an ensemble: which elements, which truths, at what time."""

import numpy as np
import pytest

from fuselog.recorders.log import RunMetadata, Stream, make_stream, schemas
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.families.sets.judging.errors import SETS, set_errors
from fuselog.replay.judging.errors.truths import Truths
from fuselog.replay.judging.judge import Judge
from fuselog.replay.judging.metrics.measuring import measure

SECOND = 1_000_000_000
PLANE = {"components": "x_m,speed_mps,y_m", "kinds": "linear,linear,linear"}


def estimates(times_s: list[float], sets: list[list[tuple[float, float]]]) -> tuple[Stream, Stream]:
    """Sizes and elements of sets of places; speeds tell nothing of a distance."""
    stamps = (np.array(times_s) * SECOND).astype(np.int64)
    counts = [len(each) for each in sets]
    mean = np.array([(x, 1e6, y) for each in sets for x, y in each])
    size = make_stream(
        "/estimates/e/set", schemas.ESTIMATE_SIZE, stamps, metadata=PLANE, elements=counts
    )
    element = make_stream(
        "/estimates/e/element",
        schemas.DENSITY_ESTIMATE,
        np.repeat(stamps, counts),
        metadata=PLANE,
        weight=np.ones(len(mean)),
        mean=mean,
        covariance=np.zeros((len(mean), 9)),
    )
    return size, element


def run(epoch_s: float, **truths: dict[float, tuple[float, float]]) -> MemorySource:
    """A run with targets of a name at (x, y) at times."""
    streams = [
        make_stream(
            f"/{name}/truth",
            schemas.TRUTH_STATE,
            (np.array(list(at)) * SECOND).astype(np.int64),
            metadata=PLANE,
            state=np.array([(x, 0.0, y) for x, y in at.values()]),
        )
        for name, at in truths.items()
    ]
    odd = make_stream(
        "/odd/truth", schemas.TRUTH_STATE, [0], metadata={"components": "x_m"}, state=[[0.0]]
    )
    return memory_source(Recording([*streams, odd]), RunMetadata("test", epoch_ns=int(epoch_s * SECOND)))


def test_sets_of_changing_size_are_judged_element_by_element():
    """Two runs of other epochs; sizes 2, 0, 1 and 1; one target is known for the first second only."""
    first = run(10.0, a={10.0: (0.0, 0.0), 12.0: (20.0, 0.0)}, b={10.0: (100.0, 0.0)})
    second = run(0.0, a={5.0: (7.0, 7.0)})
    parts = [
        estimates([10.0, 11.0, 12.0], [[(100.0, 4.0), (3.0, 0.0)], [], [(20.0, 50.0)]]),
        estimates([5.0], [[(7.0, 7.0)]]),
    ]
    outputs = {pair[0].topic: gather(pair) for pair in zip(*parts, strict=True)}
    [found] = set_errors(outputs, [Truths(first), Truths(second)], gap_limit_s=3.0).values()
    assert (found.estimator, found.case) == ("e", "")
    np.testing.assert_array_equal(found.run, [0, 0, 0, 1])
    np.testing.assert_allclose(found.elapsed_s, [0.0, 1.0, 2.0, 5.0])
    np.testing.assert_array_equal(found.estimated, [2, 0, 1, 1])
    np.testing.assert_array_equal(found.true, [2, 1, 1, 1])
    # pairs 3 and 4 m apart; one of one missed; a pair beyond the cutoff is one missed and one false
    np.testing.assert_allclose(found.localisation, [25.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(found.missed, [0.0, 50.0, 50.0, 0.0])
    np.testing.assert_allclose(found.false, [0.0, 0.0, 50.0, 0.0])
    np.testing.assert_allclose(found.gospa, [5.0, np.sqrt(50.0), 10.0, 0.0])
    np.testing.assert_allclose(found.ospa, [np.sqrt(12.5), 10.0, 10.0, 0.0])
    assert measure([found], {"sets": SETS}) == pytest.approx(
        {
            "e.ospa_m": (np.sqrt(12.5) + 20.0) / 4,
            "e.gospa_m": (15.0 + np.sqrt(50.0)) / 4,
            "e.gospa_localisation_m": 2.5,
            "e.missed_targets": 0.5,
            "e.false_targets": 0.25,
            "e.cardinality_error_targets": -0.25,
        }
    )


def test_the_cutoff_is_that_which_is_asked_for():
    outputs = {stream.topic: gather([stream]) for stream in estimates([0.0], [[(0.0, 4.0)]])}
    source = run(0.0, a={0.0: (0.0, 0.0)})
    for cutoff_m, expected in ((3.0, 3.0), (5.0, 4.0)):
        [found] = set_errors(outputs, [Truths(source)], cutoff_m=cutoff_m).values()
        assert found.gospa[0] == pytest.approx(expected)


def test_regions_have_their_area_and_hold_the_truth_or_not() -> None:
    """A square about the truth, one with a hole there, an empty one, and one of unknown truth."""
    square = np.array([(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0)])
    hole = 0.5 + 0.5 * square[::-1]
    stamps = SECOND * np.arange(4)
    plane = {"components": "x_m,y_m", "kinds": "linear,linear", "truth": "/robot/truth"}
    rings = np.concatenate([square, square, hole, square])
    region = make_stream(
        "/estimates/e/robot/set",
        schemas.SET_ESTIMATE,
        stamps[[0] * 4 + [1] * 8 + [3] * 4],
        metadata=plane,
        ring_id=[0] * 8 + [1] * 4 + [0] * 4,
        vertex=rings,
    )
    size = make_stream(
        "/estimates/e/robot/size", schemas.ESTIMATE_SIZE, stamps, metadata=plane, elements=[4, 8, 0, 4]
    )
    truth = make_stream(
        "/robot/truth", schemas.TRUTH_STATE, stamps[:3], metadata=plane, state=np.full((3, 2), 1.2)
    )
    source = memory_source(Recording([truth]), RunMetadata("test"))
    judge = Judge([source], gap_limit_s=2.0)
    judge.add({stream.topic: gather([stream]) for stream in (region, size)})
    assert judge.metrics == pytest.approx(
        {"e.area_mean_m2.robot": (4.0 + 3.0 + 0.0 + 4.0) / 4, "e.containment_share.robot": 1 / 3}
    )
