"""Assembly of a tracker from the model of its targets, its kinds of sensors, and track motion."""

from collections.abc import Callable
from typing import Concatenate, NamedTuple, ParamSpec, TypeVar, cast

from fuselog.replay.engine.arrays import AnyArgument, Floats
from fuselog.replay.engine.vectors.tangent import tangent_components
from fuselog.replay.families.tracking.association.scans import ScanSensor
from fuselog.replay.families.tracking.association.tracks import Tracks
from fuselog.replay.inference.kalman.predict import linear_motion
from fuselog.replay.inference.kalman.steps import Belief, Gaussian, Steps, gaussian_filter
from fuselog.replay.inference.linear_algebra.tuples import range_of
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.modes.imm import interacting_steps
from fuselog.replay.inference.modes.mixture import ModeBelief


class Tracker(NamedTuple):
    """Parts of a tracker.

    Attributes:
        bound_model: the targets' bound model, with one of its motions or with all modes.
        kinds: the kinds of sensors.
        association, management: by name, see `ASSOCIATIONS` and `MANAGEMENTS`.
        names: the parameters that the parts read, in the order of the columns of the settings.
        shared: index in the state of the first sensor error, and the number of errors that all tracks
            share, see `fuselog.replay.families.tracking.association.shared_bias`.
    """

    bound_model: BoundModel
    kinds: tuple[ScanSensor, ...]
    association: str
    management: str
    names: tuple[str, ...]
    shared: tuple[int, int]

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Return the number of modes, and the sizes of the state and of its tangent space."""
        return (
            max(1, len(self.bound_model.modes)),
            self.bound_model.model.size,
            self.bound_model.model.tangent,
        )


class Newborn(NamedTuple):
    """New target of which only the position is known.

    Attributes:
        mean, covariance: mean (n,) and covariance (t, t); the entries of the position are placeholders.
        mode: (modes,), the modes' probabilities.
    """

    mean: Floats
    covariance: Floats
    mode: Floats


def moving(bound_model: BoundModel) -> Steps:
    """Make the prediction of tracks; with several modes, a track is an interacting multiple model."""
    if not bound_model.modes:
        return gaussian_filter(bound_model, linear_motion(bound_model), ())
    alone = (bound_model._replace(motion=motion, modes=()) for motion in bound_model.modes)
    return interacting_steps(
        bound_model, [gaussian_filter(each, linear_motion(each), ()) for each in alone]
    )


# (run, tracks) -> the tracks of a run as the belief of filters; the first axis is the place.
BeliefOf = Callable[[int, Tracks], Belief]


def believing(bound_model: BoundModel) -> BeliefOf:
    """Make `belief(run, tracks)`, which returns the tracks of a run in the form that filters process.

    The first axis of the result is the track.
    """

    def of_one(run: int, tracks: Tracks) -> Gaussian:
        return Gaussian(tracks.mean[run, :, 0], tracks.covariance[run, :, 0])

    def of_modes(run: int, tracks: Tracks) -> ModeBelief:
        return ModeBelief(
            tracks.mean[run], tracks.covariance[run], tracks.mode[run], tracks.log_mode[run]
        )

    return of_modes if bound_model.modes else of_one


Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def choosing(
    functions: list[Callable[Arguments, Result]],
) -> Callable[Concatenate[int, Arguments], Result]:
    """Make `call(kind, ...)`, which calls the function of this kind, given its index."""

    def call(kind: int, *arguments: AnyArgument) -> AnyArgument:
        for number in range_of(1, len(functions)):
            if kind == number:
                return functions[number](*arguments)  # type: ignore[call-arg]
        return functions[0](*arguments)  # type: ignore[call-arg]

    return cast(Callable[Concatenate[int, Arguments], Result], call)


def place_of(model: Model) -> tuple[int, int]:
    """Return the indices of the position in the state."""
    names = list(model.state)
    return names.index("x_m"), names.index("y_m")


def corner_of(model: Model) -> tuple[int, int]:
    """Return the indices of the position in the tangent space."""
    tangent = [name for name, _ in tangent_components(list(model.state), model.kinds)]
    return tangent.index("x_m"), tangent.index("y_m")
