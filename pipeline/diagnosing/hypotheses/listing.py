"""List of all hypotheses on a run and the estimator that is bound to it."""

from collections.abc import Mapping, Sequence

from fuselog.pipeline.diagnosing.hypotheses.components import of_components
from fuselog.pipeline.diagnosing.hypotheses.exchanges import of_numbers
from fuselog.pipeline.diagnosing.hypotheses.hypothesis import Hypothesis
from fuselog.pipeline.diagnosing.hypotheses.origins import of_origin
from fuselog.pipeline.diagnosing.hypotheses.parameters import (
    of_augmentable,
    of_covariances,
    of_declared,
    of_gate,
    of_noises,
)
from fuselog.pipeline.diagnosing.hypotheses.stamps import hold_of, lag_of, of_stamps
from fuselog.pipeline.diagnosing.hypotheses.starts import of_start
from fuselog.pipeline.runs.trials import Trial
from fuselog.recorders.log import Stream
from fuselog.replay.engine.replaying.estimator import Bound, Reading

FEWEST = 20  # fewest messages from which a topic's errors can be found


def hypotheses(
    bound: Sequence[Bound],
    base: Trial,
    innovations: Mapping[str, Stream],
    readings: Mapping[str, Reading],
) -> list[Hypothesis]:
    """List all hypotheses.

    Args:
        bound: the bound estimators.
        base: the unaltered run, and the settings.
        innovations: the innovations of the unaltered run, with an open gate.
        readings: functions that read the measured numbers, by the name of the estimate.
    """
    source, parameters = base.source, bound[0].parameters
    streamed = list(dict.fromkeys(topic for each in bound for topic in each.streams))
    of_topic = {topic: readings.get(each.name) for each in bound for topic in each.streams}
    first_ns = source.extent("publish_time")[0]
    stated = (topic for each in bound for topic in each.priors if topic in source.streams)
    found = [*of_noises(bound, source, readings), *of_gate(parameters)]
    found += of_augmentable(bound, readings) if readings else of_declared(bound, source)
    for topic in streamed:
        stream, reading = source.streams[topic], of_topic[topic]
        if len(stream) < FEWEST:
            continue
        found += of_covariances(stream)
        found += of_origin(stream, reading)
        found += of_components(stream, reading, parameters, first_ns)
        if len(streamed) > 1:
            controls = reading.controls if reading else ()
            lags_s = lag_of(stream, [source.streams[each] for each in controls if each != topic])
            hold_s = hold_of(source.streams, controls)
            found += of_stamps(stream, reading, parameters, first_ns, hold_s, lags_s)
    for topic in dict.fromkeys(stated):
        found += of_start(source.streams[topic])
    return [*found, *of_numbers(bound, source, innovations)]
