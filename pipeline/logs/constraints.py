"""Zero-velocity and non-holonomic pseudo-measurements from the samples of an inertial unit.

They are topics that the model `inertial` uses in addition to the topics of sensors.
"""

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.models.standing import unrest
from fuselog.recorders.parameters import Parameters


class ConstraintParameters(Parameters):
    """Rates of the pseudo-measurements, and thresholds for detecting that the body is at rest.

    Attributes:
        standing_hz: rate of messages that state whether the body is at rest; 0 for no messages.
        rolling_hz: rate of messages that state that the body, like a wheeled one, moves neither sideways
            nor up; 0 for no messages.
        window_s: length of the window, ending at the current time, in which the body is tested for being
            at rest.
        still_mps2: threshold for the standard deviation of the specific force. The body is at rest if
            both quantities are below their thresholds in the window.
        still_radps: threshold for the root mean square of the turn rate.
    """

    standing_hz: NonNegativeFloat = 5.0
    rolling_hz: NonNegativeFloat = 0.0
    window_s: PositiveFloat = 0.5
    still_mps2: PositiveFloat = 0.1
    still_radps: PositiveFloat = 0.05


def constraints_of(inertial: Stream, parameters: ConstraintParameters) -> list[Stream]:
    """Make the topics `standing` and `rolling` next to the topic of a unit.

    A message has the value 1 if its constraint applies, and 0 otherwise.

    Args:
        inertial: the samples of the unit.
        parameters: see `ConstraintParameters`.

    Raises BadInput if there are no samples, or both rates are zero.
    """
    if not len(inertial):
        raise BadInput(f"topic {inertial.topic}: has no samples; give a log with an inertial unit")
    time_ns = inertial.publish_time_ns
    force, rate = inertial["specific_force_mps2"], inertial["turn_rate_radps"]
    for name in ("specific_force_mps2", "turn_rate_radps"):
        if not np.isfinite(inertial[name]).all(axis=1).any():
            raise BadInput(
                f"topic {inertial.topic}: has no {name}; give an inertial unit that measures specific "
                "force and turn rate"
            )
    shaken, turned = unrest(time_ns, force, rate, parameters.window_s)
    stands = (shaken < parameters.still_mps2) & (turned < parameters.still_radps)
    rates_hz = {"standing": parameters.standing_hz, "rolling": parameters.rolling_hz}
    holds = {"standing": stands, "rolling": np.ones(len(stands), bool)}
    beside, found = inertial.topic.rpartition("/")[0], []
    for name, rate_hz in rates_hz.items():
        if rate_hz > 0.0:
            turn = np.floor((time_ns - time_ns[0]) * (1e-9 * rate_hz) + 1e-6)
            rows = np.flatnonzero(np.diff(turn, prepend=-1.0) > 0.0)
            value = holds[name][rows, None].astype(float)
            metadata = {"components": name, "kinds": "linear"}
            stream = make_stream(
                f"{beside}/{name}",
                schemas.VECTOR_MEASUREMENT,
                time_ns[rows],
                metadata=metadata,
                value=value,
            )
            found.append(stream)
    if not found:
        raise BadInput("standing_hz and rolling_hz are both zero; set at least one above zero")
    return found
