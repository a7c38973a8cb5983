"""Prediction and update of several Gaussians of one state, and of their probabilities."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from fuselog.recorders.log import make_stream, schemas
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.results import ALL_WELL, named
from fuselog.replay.inference.kalman.steps import (
    CoreMemory,
    Gaussian,
    InnovationRecord,
    Interval,
    Measurement,
    Steps,
    UpdateRun,
)
from fuselog.replay.inference.kalman.update import innovation_components, writing_innovation
from fuselog.replay.inference.linear_algebra.gaussian import drop_missing, whiten_kept, wrap
from fuselog.replay.inference.linear_algebra.tuples import range_of
from fuselog.replay.inference.model.bound_model import BoundModel
from fuselog.replay.inference.modes.mixing import MixtureMemory
from fuselog.replay.inference.run.filtering import Filter
from fuselog.replay.inference.run.recursion import EstimateRows, InnovationRows


class ModeBelief(NamedTuple):
    """Belief of all runs (the first axis): one Gaussian for each of M modes.

    Attributes:
        mean, covariance: (runs, M, n), (runs, M, t, t).
        probability, log_probability: (runs, M) probabilities of the modes, and their logarithms.
    """

    mean: Floats
    covariance: Floats
    probability: Floats
    log_probability: Floats


class Mixtures(NamedTuple):
    """Estimates and probabilities that the filter fills; see `recursion.EstimateRows`."""

    end: Integers
    time_ns: Integers
    mean: Floats
    covariance: Floats
    probability: Floats


class MixtureWork(Protocol):
    """Working memory of each Gaussian's filter and of their mixture."""

    @property
    def filters(self) -> tuple[CoreMemory, ...]: ...
    @property
    def mixture(self) -> MixtureMemory: ...


class PredictModes(Protocol):
    """Function that predicts the Gaussian of every mode and returns whether all succeeded."""

    def __call__(
        self, belief: Gaussian, interval: Interval, memories: tuple[CoreMemory, ...], /
    ) -> bool: ...


class UpdateMixture(Protocol):
    """Function that updates several Gaussians and the probabilities (M,) of their modes.

    See `mixture_update`.
    """

    def __call__(
        self,
        gaussians: Gaussian,
        weights: tuple[Floats, Floats],
        measurement: Measurement,
        memory: MixtureWork,
        record: InnovationRecord,
        /,
    ) -> int: ...


def predicting(filters: Sequence[Steps]) -> PredictModes:
    """Make `predict(belief, ...)`, which predicts all modes' Gaussians and returns False on failure.

    Steps of a filter are called with the number of a run, and with Gaussians whose first axis is the
    run. Here and in `mixture_update`, the first axis has the modes of one run, and the steps receive the
    number of the mode instead of the number of the run.
    """
    predictions = tuple(each.predict for each in filters)

    def predict(belief: Gaussian, interval: Interval, memories: tuple[CoreMemory, ...]) -> bool:
        well = True
        for mode in range_of(len(predictions)):
            predict_mode, memory = predictions[mode], memories[mode]
            well = predict_mode(mode, belief, interval, memory) and well
        return well

    return predict


def mixture_update(bound_model: BoundModel, number: int, update_mode: UpdateRun) -> UpdateMixture:
    """Make the update of several Gaussians, and of the probabilities of their modes, by one sensor.

    It is called as `update(gaussians, (probability, log_probability), ...)` and works in place; see
    `Steps.updates`. A measurement within the gate of one mode is accepted by all modes, because
    likelihoods of different measurements cannot be compared. The recorded innovation is the mixture's;
    its covariance includes the spread between the innovations of the modes; the log-likelihood is log
    sum_j mu_j N(v_j; 0, S_j).

    Args:
        bound_model: the bound model, with the sensors of the log.
        number: index of the sensor.
        update_mode: update of one Gaussian by this sensor; see `Steps.updates`.
    """
    components, measured = (
        list(innovation_components(bound_model.sensors)),
        bound_model.sensors[number].measured,
    )
    places = tuple(components.index(name) for name in measured)
    angular = tuple(kind == "angle" for kind in measured.values())
    m, write_innovation = len(measured), writing_innovation(bound_model, number)

    def blend(probability: Floats, memory: MixtureWork, record: InnovationRecord) -> float:
        """Record the innovation of the mixture of all modes, and return its NIS."""
        innovation, records = memory.filters[0].innovations[number], memory.mixture.records
        difference, covariance, _ = innovation
        for i in range(m):
            first = records.difference[0, places[i]]
            difference[i] = first
            for mode in range(1, len(probability)):
                away = wrap(records.difference[mode, places[i]] - first, angular[i])
                difference[i] += probability[mode] * away
        for i in range(m):
            for j in range(i + 1):
                entry, row, column = 0.0, places[i], places[j]
                for mode in range(len(probability)):
                    spread = wrap(records.difference[mode, row] - difference[i], angular[i])
                    spread *= wrap(records.difference[mode, column] - difference[j], angular[j])
                    entry += probability[mode] * (records.covariance[mode, row, column] + spread)
                covariance[i, j] = covariance[j, i] = entry
        write_innovation(innovation, record)
        squared = whiten_kept(innovation, drop_missing(innovation), m)[0]
        if np.isnan(squared):  # singular at the precision of covariances: use the mean NIS of the modes
            squared = 0.0
            for mode in range(len(probability)):
                squared += probability[mode] * records.numbers[mode, 0]
        return squared

    def update(
        gaussians: Gaussian,
        weights: tuple[Floats, Floats],
        measurement: Measurement,
        memory: MixtureWork,
        record: InnovationRecord,
    ) -> int:
        data, parameters, _, event = measurement
        probability, log_probability = weights
        records, taken = memory.mixture.records, 0
        numbers = records.numbers
        numbers[:, 2] = 0.0
        opened = Measurement(data, parameters, memory.mixture.open_gate, event)
        for each in (measurement, opened):
            for mode in range(len(probability)):
                if numbers[mode, 2] == 0.0:
                    own = InnovationRecord(
                        records.difference[mode], records.covariance[mode], numbers[mode]
                    )
                    outcome = update_mode(mode, gaussians, each, memory.filters[0], own)
                    if outcome != ALL_WELL:
                        return outcome
                    taken += int(numbers[mode, 2])
            if taken == 0:
                break
        record.numbers[0] = blend(probability, memory, record)
        record.numbers[1] = 0.0
        record.numbers[2] = 1.0 if taken else 0.0
        if taken:
            record.numbers[1] = reweigh_modes(probability, log_probability, numbers)
        return ALL_WELL

    def reweigh_modes(probability: Floats, log_probability: Floats, numbers: Floats) -> float:
        """Weight the modes by their likelihoods, and return the logarithm of the total likelihood."""
        highest, total = -np.inf, 0.0
        for mode in range(len(probability)):
            log_probability[mode] += numbers[mode, 1]
            highest = max(highest, log_probability[mode])
        for mode in range(len(probability)):
            below = highest - log_probability[mode]
            probability[mode] = 1.0 if below == 0.0 else np.exp(-below)
            total += probability[mode]
        likelihood: float = highest + np.log(total)
        for mode in range(len(probability)):
            log_probability[mode] -= likelihood
            probability[mode] /= total
        return likelihood

    return update


class MixtureFilter(Filter, ABC):
    """Filter whose belief consists of several Gaussians; it also outputs their probabilities."""

    @property
    @abstractmethod
    def names(self) -> Sequence[str]:
        """Names of the Gaussians."""

    def no_results(
        self, due: Integers, recorded: Integers, components: int
    ) -> tuple[Mixtures, InnovationRows]:
        """Make arrays of estimates and innovations to fill."""
        (end, time_ns, mean, covariance), innovations = super().no_results(due, recorded, components)
        probability = np.empty((len(mean), len(self.names)))
        return Mixtures(end, time_ns, mean, covariance, probability), innovations

    def output_streams(self, mixtures: Mixtures, offsets: Integers, /) -> list[Ragged]:
        """Make the streams of the state and of the mode probabilities."""
        modes = self.modes("modes", mixtures.time_ns, mixtures.probability, offsets)
        return [self.states(EstimateRows(*mixtures[:4]), offsets), modes]

    def modes(self, name: str, time_ns: Integers, probability: Floats, offsets: Integers) -> Ragged:
        """Make the stream of the mode probabilities (n, M)."""
        stream = make_stream(
            f"/estimates/{self.name}/{name}",
            schemas.MODE_PROBABILITIES,
            time_ns,
            metadata=named(dict.fromkeys(self.names, "linear")),
            probability=probability,
        )
        return Ragged(stream, offsets)
