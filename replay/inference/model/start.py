"""Defines how a model begins in a log that has no prior."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from fuselog.recorders.log import Stream
from fuselog.replay.engine.arrays import Floats, Settings
from fuselog.replay.engine.renamed import renamed


class Align(Protocol):
    """Finds a state from the path that the control leads along and from fixes, see `Start.align`."""

    def __call__(
        self, path: Floats, places: Floats, covariances: Floats, span_s: float, parameters: Settings, /
    ) -> tuple[Floats, Floats] | None: ...


@renamed(suspect="check_prior")
@dataclass(frozen=True, eq=False)
class Start:
    """Describes what is assumed of a log that has no prior: it was not made for the model.

    It begins at the first message that measures components of the state by their names, a fix or a pose
    with its covariance. What that does not measure is zero, and as uncertain as is stated here. With no
    sensor at all the thing begins at zero, which is where its frame is. Sensors that do not measure the
    state itself need a prior.

    Attributes:
        sigmas: standard deviations of the state's components, linear ones and angles.
        parameters: numbers that no channel of such a log states.
        align: (path, places, covariances, span_s, parameters) -> mean and covariance of the state, or
            None where these do not determine it yet. The path (k, n) is where the control alone leads
            from zero, at the first k fixes (k, 2) with their covariances (k, 2, 2), which span so much
            time. The state is that at the last of them, and begins just after it: they are used up. For
            a state that a position does not determine.
        find: (streams, parameters) -> `Started`, in place of all that, of the first messages of a run by
            the model's names for their topics, and the maps; for a state that is found from several
            messages together. Raises BadInput where they do not determine it. Such a model needs a
            sensor.
        check_prior: (streams, parameters) -> sentences: what looks wrong in these messages where the log
            has a prior. It is only reported.
    """

    sigmas: Mapping[str, float]
    parameters: Mapping[str, float] = field(default_factory=dict)
    align: Align | None = None
    find: "Callable[[Mapping[str, Stream], Settings], Started] | None" = None
    check_prior: Callable[[Mapping[str, Stream], Settings], list[str]] | None = None


class Started(NamedTuple):
    """Holds the start of a run: its stamp, mean (n,), covariance (t, t), and how it was found."""

    time_ns: int
    mean: Floats
    covariance: Floats
    how: str
