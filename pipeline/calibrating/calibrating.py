"""Calibration of mountings, scales, biases and delays of sensors with the search of `tune`.

A model marks its calibration parameters; see `fuselog.replay.inference.model.model.Model`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from fuselog.pipeline.altering.sources import split_settings
from fuselog.pipeline.api.planning import Log, Named, settings_of, sources_of
from fuselog.pipeline.calibrating.kalibr import FILE, kalibr_yaml
from fuselog.pipeline.calibrating.manoeuvres import advice
from fuselog.pipeline.tuning.outcome import Tuning
from fuselog.pipeline.tuning.tuning import tune
from fuselog.recorders.errors import BadInput, without_warnings_of_numbers
from fuselog.recorders.parameters import merge
from fuselog.replay.engine.replaying.estimator import Recursive, bind
from fuselog.replay.foreign.naming import allowed

OPTIONS = ("by", "free")  # options of `tune` that `calibrate` sets itself


@without_warnings_of_numbers()
def calibrate(
    logs: Log | Iterable[Log],
    estimator: Named,
    *,
    set: Mapping[str, Any] | None = None,  # noqa: A002
    fixed: Sequence[str] = (),
    next_motion: bool = False,
    **options: Any,
) -> Tuning:
    """Estimate the parameters of mountings, scales, biases and delays of sensors.

    All calibration parameters of the model that affect the likelihood of the logs are estimated together
    by maximum likelihood. Parameters that the motion does not determine are named, keep their start
    values, and have no interval.

    Args:
        logs: one or several logs with the same topics: paths, opened logs, or recordings.
        estimator: a registered name, or a label of your own mapped to an estimator; see `replay`.
        set: values of other parameters, and start values; see `tune`.
        fixed: calibration parameters that are known and keep the values set for them.
        next_motion: also recommend the next manoeuvre to record, for a robot with wheels and fixes.
        options: as for `tune`, except `free` and `by`.

    Returns:
        The parameters with 95 % intervals, and replays of the logs with the start and the found values.

    Raises BadInput if the model marks no parameter, if the logs do not depend on the marked parameters,
    or if a next motion is requested for logs without wheels and fixes.
    """
    for name in OPTIONS:
        if name in options:
            raise BadInput(f"calibrate: {name} is an option of tune only; calibrate chooses it")
    alterations, given = split_settings(set or {})
    sources = sources_of(logs, alterations)
    [(label, own), *others] = settings_of(estimator).items()
    if others:
        raise BadInput(f"{label}, {others[0][0]}: give one estimator; calibrate takes one at a time")
    bound = bind(label, sources, {"kind": label, **merge(own, allowed(given))})
    marked = [
        name
        for each in bound[:1]
        if isinstance(each, Recursive) and each.reading is not None
        for name in each.reading().calibration
    ]
    if not marked:
        raise BadInput(
            f"estimator {label}: its model marks no calibration parameter on which the logs depend; "
            "choose parameters yourself with fuselog tune --free NAME"
        )
    for name in fixed:
        if name not in marked:
            raise BadInput(
                f"--fixed {name}: not a calibration parameter; choose from {', '.join(marked)}"
            )
    free = [name for name in marked if name not in fixed]
    found = tune(logs, estimator, free, set=set, **options)
    names = [each.name for each in found.found.coordinates.free]
    values = dict(zip(names, found.found.optimum.tolist(), strict=True))
    files = {FILE: kalibr_yaml(values, found.found.held)}
    return replace(found, advice=advice(found) if next_motion else (), files=files)
