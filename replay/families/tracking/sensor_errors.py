"""Persistent errors of sensors, as additional components of the state of every track.

A registration error is constant and shared by all tracks. A correlated error belongs to one track (for
example, because any point of a hull may be detected); it is a first-order Gauss-Markov process with the
time constant `correlation_s`.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.vectors.components import Components
from fuselog.replay.families.tracking.association.scans import ScanSensor
from fuselog.replay.families.tracking.association.tracker import Newborn
from fuselog.replay.families.tracking.targets import Targets
from fuselog.replay.inference.linear_algebra.manifold import is_flat
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.model.model import Model, Motion
from fuselog.replay.inference.model.validation import trial_state

BY_SORT = ("registration", "correlated")


class Errors(NamedTuple):
    """Errors of sensors, with the registration errors first.

    Attributes:
        names: names of the components.
        sigma, correlation_s: (errors,), standard deviation and time constant of each error;
            `correlation_s` is infinite for a constant error.
        shared: the number of registration errors.
        places: for each sensor, the indices of its errors by kind of error and measured component, such
            as `registration_at_0`; -1 for no error.
    """

    names: tuple[str, ...]
    sigma: Floats
    correlation_s: Floats
    shared: int
    places: list[dict[str, float]]


def errors_of(sensors: Sequence[str], kinds: Sequence[ScanSensor], settings: Sequence[Any]) -> Errors:
    """Collect the errors for which the settings of a sensor have a sigma."""
    names: list[str] = []
    sigmas, times, shared = [], [], 0
    places = [{f"{sort}_at_{i}": -1.0 for sort in BY_SORT for i in range(2)} for _ in sensors]
    for sort in BY_SORT:
        is_constant = sort == "registration"
        for sensor, kind, values, own in zip(sensors, kinds, settings, places, strict=True):
            for i, (component, of_kind) in enumerate(kind.measured.items()):
                sigma = values[f"{sort}_sigma_{'rad' if of_kind == 'angle' else 'm'}"]
                if sigma > 0.0:
                    own[f"{sort}_at_{i}"] = len(names)
                    names.append(f"{sensor.replace('-', '_')}_{sort}_{component}")
                    sigmas.append(sigma)
                    times.append(np.inf if is_constant else values["correlation_s"])
                    shared += is_constant
    return Errors(tuple(names), np.array(sigmas), np.array(times), shared, places)


def with_errors(where: str, targets: Targets, errors: Errors) -> Targets:
    """Extend the state of the targets by the errors.

    Raises BadInput, with a message that begins with `where`, if the model cannot be extended.
    """
    if not errors.names:
        return targets
    bound_model, (mean, covariance, mode) = targets.bound_model, targets.newborn
    if not is_flat(bound_model.model.kinds) or any(
        each.noises for each in bound_model.modes or (bound_model.motion,)
    ):
        raise BadInput(
            f"{where}: sensor errors require a model with additive noise and without rotations in its "
            "state; use another model"
        )
    if errors.shared and bound_model.modes:
        raise BadInput(
            f"{where}: registration errors require targets with one motion; set mode=..., or use "
            "correlated errors"
        )
    size, longer = len(mean), len(mean) + len(errors.names)
    wider = np.zeros((longer, longer))
    wider[:size, :size], wider[range(size, longer), range(size, longer)] = covariance, errors.sigma**2
    newborn = Newborn(np.append(mean, np.zeros(longer - size)), wider, mode)
    lengths = tuple(
        len(each.noise(trial_state(bound_model.model.kinds), 1.0, targets.parameters))
        for each in (bound_model.motion, *bound_model.modes)
        if each.noise is not None
    )
    return Targets(_longer(bound_model, errors.names, lengths), targets.parameters, newborn)


@lru_cache(maxsize=64)
def _longer(bound_model: BoundModel, names: tuple[str, ...], lengths: tuple[int, ...]) -> BoundModel:
    motion, *modes = (
        _moving(bound_model.model, each, names, length)
        for each, length in zip((bound_model.motion, *bound_model.modes), lengths, strict=True)
    )
    state: Components = {**bound_model.model.state, **dict.fromkeys(names, "linear")}
    model = Model(
        bound_model.model.summary,
        state,
        bound_model.model.parameters,
        (),
        motion,
        bound_model.model.modes,
    )
    return BoundModel(model, motion, (), tuple(modes))


def _moving(model: Model, motion: Motion, names: tuple[str, ...], noises: int) -> Motion:
    """Extend a motion by correlated errors; the motion itself has `noises` noise components."""
    n, is_triangle = model.size, noises > model.size
    move_own, noise_own = motion.move, motion.noise
    assert noise_own is not None

    def move(state: Any, control: Any, duration_s: Any, parameters: Any) -> Any:
        moved = list(move_own(state[:n], control, duration_s, parameters))
        for row, name in enumerate(names):
            share = np.exp(-duration_s / getattr(parameters, f"{name}_s"))
            moved.append(state[n + row] * share)
        return tuple(moved)

    def noise(state: Any, duration_s: Any, parameters: Any) -> Any:
        found = list(noise_own(state[:n], duration_s, parameters))
        for row, name in enumerate(names):
            found += [0.0] * (n + row) if is_triangle else []
            variance = getattr(parameters, f"{name}_sigma") ** 2
            found.append(-variance * np.expm1(-2.0 * duration_s / getattr(parameters, f"{name}_s")))
        return tuple(found)

    return Motion(move, noise, linear=motion.linear)
