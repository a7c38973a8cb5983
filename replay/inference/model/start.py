"""Initial state of a model in a log without a prior."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from fuselog.recorders.log import Stream
from fuselog.replay.engine.arrays import Floats, Settings
from fuselog.replay.engine.renamed import renamed


class Align(Protocol):
    """Function that finds a state from fixes and from the control's path; see `Start.align`."""

    def __call__(
        self, path: Floats, places: Floats, covariances: Floats, span_s: float, parameters: Settings, /
    ) -> tuple[Floats, Floats] | None: ...


@renamed(suspect="check_prior")
@dataclass(frozen=True, eq=False)
class Start:
    """Assumptions about the initial state in a log without a prior, such as a log for other purposes.

    The estimate starts at the first message that measures named components of the state and states their
    covariance, such as a fix or a pose. Other components are zero, with the uncertainty given here.
    Without sensors, the estimate starts with a state of zero, which defines the origin of its frame.
    Sensors that do not measure the state itself need a prior.

    Attributes:
        sigmas: standard deviations of the state's components, linear ones and angles.
        parameters: values of parameters that no channel of such a log states.
        align: (path, places, covariances, span_s, parameters) -> mean and covariance of the state at the
            last of k fixes, or None if the fixes do not determine the state yet. The path (k, n) starts
            at zero and is computed only from the control; the fixes (k, 2) have covariances (k, 2, 2)
            and span `span_s`. The estimate starts just after the last fix, so that no fix is used twice.
            `align` is needed for a state that a single position does not determine.
        find: (streams, parameters) -> `Started`, for a state that must be found from several messages;
            it is used instead of `align` and instead of a state that one message measures. The streams
            are the first messages of a run and the maps, by the topic names that the model uses. It
            raises BadInput if these messages do not determine the state. A model with `find` needs a
            sensor.
        check_prior: (streams, parameters) -> sentences on contradictions between the prior and the first
            messages, if the log has a prior. The sentences are reported, but do not end the replay.
    """

    sigmas: Mapping[str, float]
    parameters: Mapping[str, float] = field(default_factory=dict)
    align: Align | None = None
    find: "Callable[[Mapping[str, Stream], Settings], Started] | None" = None
    check_prior: Callable[[Mapping[str, Stream], Settings], list[str]] | None = None


class Started(NamedTuple):
    """Initial state of a run: stamp, mean (n,), covariance (t, t), and how they were found."""

    time_ns: int
    mean: Floats
    covariance: Floats
    how: str
