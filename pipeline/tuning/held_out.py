"""A study of tuning with unknown noise; the tuned values are judged on vehicles not used for tuning.

The experiment's only estimator is tuned by likelihood on some of the log's vehicles, starting from its
settings or from values in the log. Held-out vehicles are replayed with the start values and the tuned
values.
"""

from collections.abc import Collection
from dataclasses import replace

from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.output.summary import summarise
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.runner import Runner
from fuselog.pipeline.tuning.outcome import START, TUNED
from fuselog.pipeline.tuning.tuning import tune
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.streams.sources import MemorySource


class HeldOutOptions(Parameters):
    """Options of the study: the free parameters, and the vehicles for tuning and for judging.

    Attributes:
        free: names of the parameters that are searched for.
        tuned_by: vehicles on which to tune, by the first word of their topics.
        held_out: vehicles on which to judge the values, by the first word of their topics.
    """

    free: tuple[str, ...] = ()
    tuned_by: tuple[str, ...] = ()
    held_out: tuple[str, ...] = ()


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: HeldOutOptions = setting.options
    if not (options.free and options.tuned_by and options.held_out and len(experiment.estimators) == 1):
        raise BadInput(
            f"experiment '{experiment.title}': give one estimator, and options.free, tuned_by, held_out"
        )
    [source] = Runner(experiment, setting).obtain()
    found = tune(
        _without(source, options.held_out),
        dict(experiment.estimators),
        options.free,
        validate=_without(source, options.tuned_by),
        gap_limit_s=experiment.gap_limit_s,
    )
    outcome = Outcome(tables={"parameters": found.parameters}, input_sha256=hash_streams([source]))
    for each in found.replays:
        judged = summarise(each.judge)
        outcome.metrics |= judged.metrics
        outcome.bounds |= judged.bounds
    for row in found.parameters.to_dict("records"):
        outcome.metrics[f"{TUNED}.{row['parameter']}"] = row["value"]
        outcome.metrics[f"{START}.{row['parameter']}"] = row["start"]
    assert found.held_out_costs is not None
    for label, cost in zip((START, TUNED), found.held_out_costs, strict=True):
        outcome.metrics[f"{label}-held-out.open_gate_log_likelihood"] = -cost
    return outcome


def _without(source: MemorySource, vehicles: Collection[str]) -> MemorySource:
    """Copy a log without some vehicles' topics; raise BadInput for a vehicle that has no topics."""
    found = {topic.split("/")[1] for topic in source.streams}
    for vehicle in vehicles:
        if vehicle not in found:
            raise BadInput(
                f"{source.name}: no topic begins with /{vehicle}/; the vehicles are "
                f"{', '.join(sorted(found))}"
            )
    kept = {
        topic: stream for topic, stream in source.streams.items() if topic.split("/")[1] not in vehicles
    }
    return replace(source, streams=kept)


TUNING_HELD_OUT = Study(
    "noise tuned by maximum likelihood on some vehicles of a log and judged on others",
    study,
    HeldOutOptions,
)
