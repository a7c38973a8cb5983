"""Lists the messages that a filter skipped, with the reasons."""

import numpy as np

from recorders.log import schemas
from replay.engine.arrays import Booleans
from replay.engine.streams.blocks import Block, Ragged, ragged_rows
from replay.engine.streams.failures import reason_stream
from replay.inference.model.binding import Found
from replay.inference.model.model import Control
from replay.inference.model.settings import complaint_of
from replay.inference.model.stage import Stage
from replay.inference.run.recursion import FilterEvents


def not_driven(name: str, control: Control, found: Found, events: FilterEvents) -> Ragged:
    """List measurements that were skipped in a gap of the control.

    Args:
        name: of the filter.
        control: an interpolated one, which is NaN in its gaps.
        found: its topics.
        events: with the control.
    """
    in_gap = (events.source >= 0) & np.isnan(events.data[:, -1])
    reasons = [
        f"topic {topic.name}: nothing is known while {control.topic} is silent for longer than "
        f"{control.gap}"
        for _, topic in found.sensors
    ]
    stream = reason_stream(
        f"/estimates/{name}/skipped",
        schemas.SKIPPED,
        events.time_ns[in_gap],
        events.source[in_gap],
        reasons,
    )
    return Ragged(stream, ragged_rows(in_gap, events.offsets))


def passed_over(
    name: str, stage: Stage, found: Found, block: Block, without_covariance: Booleans
) -> list[Ragged]:
    """List messages that were skipped since they lack a covariance, if any topic may.

    Args:
        name: of the filter.
        stage: the model with the sensors at hand.
        found: its topics.
        block: their messages.
        without_covariance: which of these (n,) have none.
    """
    control = stage.model.control
    drops_controls = control is not None and control.interpolated
    if not drops_controls and not any(sensor.covariance for sensor in stage.sensors):
        return []
    sensors = {topic.name: sensor for sensor, topic in found.sensors}
    reasons = [
        complaint_of(stage.model, sensors[topic], topic)
        if topic in sensors
        else f"topic {topic}: it is not finite"
        for topic in block.streams
    ]
    merged = block.events
    stream = reason_stream(
        f"/estimates/{name}/skipped",
        schemas.SKIPPED,
        merged.time_ns[without_covariance],
        merged.topic[without_covariance],
        reasons,
    )
    return [Ragged(stream, ragged_rows(without_covariance, merged.offsets))]
