"""Traces of functions at weighted samples as graphs; see `fuselog.replay.inference.kalman.regression`.

Loops over samples, and over iterations of a mean, are not traced: a graph computes one sample or one
iteration.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.vectors.tangent import WIDTHS
from fuselog.replay.inference.kalman.regression import axes_of, has_joint_moments
from fuselog.replay.inference.kalman.wide_angles import turning, unsuspected_rad
from fuselog.replay.inference.linear_algebra.manifold import (
    boxminus,
    boxplus,
    curved_blocks,
    manifold_blocks,
    recentring,
    tangent_size,
)
from fuselog.replay.inference.linear_algebra.tuples import tuple_of
from fuselog.replay.inference.sampling.sets import SampleSets
from fuselog.replay.inference.step_graphs import Step, StepFunction, TracedValue, traced_step
from fuselog.replay.tracing.functions import Argument, Shape, TracedFunction

Kinds = tuple[str, ...]
SETTLING = (3,)  # index of the argument of `SampledFunction.recentre` that differs by sample


class SampledFunction(NamedTuple):
    """Function of a state, noise and other arguments, with v values, evaluated at weighted samples.

    The arguments of each graph are those of the step, (mean, covariance, ...), and those listed below.

    Attributes:
        points, weights: samples (L, t + noises) of N(0, I), and their weights (L,).
        axes: (L,) index of each point's axis, if the moments are computed from points on axes; otherwise
            empty.
        kept: tangent components of the values that are unchanged components of the state.
        variances: returns `variance` (noises), the variances of the noise.
        centre: returns `centre`, the values of the function at the mean without noise.
        value: has the arguments (..., away, centre) and returns `value` (v), the tangent vector from the
            centre to the function's value at one sample. `away` (t + noises) is a tangent vector from
            the mean, followed by the noise.
        move: has the arguments (mean, covariance, shift, centre) and returns `centre`, moved by the
            shift (v).
        recentre: has the arguments (mean, covariance, shift, value) and returns `value` relative to the
            moved centre, and `again`, whether another iteration may be necessary. None if all values are
            linear.
        given: number of arguments of the step.
        curved, curved_values: components and tangent components of the values that are not linear.
        turns: angles and rotations of the state, which limit the spread of the samples; see
            `wide_angles`.
        unsuspected: largest standard deviation at which the spread is not limited.
    """

    points: Floats
    weights: Floats
    axes: Integers
    kept: tuple[int, ...]
    variances: Step
    centre: Step
    value: Step
    move: Step
    recentre: Step | None
    given: int
    curved: tuple[int, ...]
    curved_values: tuple[int, ...]
    turns: tuple[tuple[int, int, float], ...]
    unsuspected: float

    @property
    def steps(self) -> list[Step]:
        """All graphs."""
        found = [self.variances, self.centre, self.value, self.move]
        return found if self.recentre is None else [*found, self.recentre]

    @property
    def varying(self) -> tuple[int]:
        """Index of the argument of `value` that differs between samples: away."""
        return (self.given,)

    @property
    def noises(self) -> int:
        """Number of noise components."""
        return len(self.variances.outputs)

    @property
    def size(self) -> int:
        """Number of tangent components of the values."""
        return len(self.value.outputs)


class Sampled(NamedTuple):
    """Function to sample, and its arguments.

    Attributes:
        what: name of the function, for errors.
        function: function of (state, noise, arguments).
        variances: returns the variances of the noise for the state and the arguments of the step.
        arguments: returns the arguments of the function, given the arguments of the step.
        kinds, outputs: kinds of the components of the state, and of the function's values.
        kept: tangent components of the state that the function returns unchanged, in the same place.
    """

    what: str
    function: StepFunction
    variances: StepFunction
    arguments: StepFunction
    kinds: Kinds
    outputs: Kinds
    kept: tuple[int, ...] = ()


def sampled_function(sampled: Sampled, sets: SampleSets, given: tuple[Argument, ...]) -> SampledFunction:
    """Trace a function at weighted samples.

    Args:
        sampled: the function.
        sets: sample sets; the first set is used for every step.
        given: arguments of the step, mean and covariance first.
    """
    what, function, variances, arguments, kinds, outputs, kept = sampled
    points, weights = sets.points[0], sets.weights[0]
    t, size = tangent_size(kinds), points.shape[1]
    values, components, read_state = tangent_size(outputs), len(outputs), tuple_of(len(kinds))
    axes = axes_of(points)
    axes = axes if has_joint_moments(axes, t, values) else axes[:0]
    add_state, add = boxplus(kinds), boxplus(outputs)
    gaussian = given[:2]

    def spread(mean: TracedValue, _: TracedValue, *others: TracedValue) -> TracedValue:
        return {"variance": variances(read_state(mean), others)}

    def at_mean(mean: TracedValue, _: TracedValue, *others: TracedValue) -> TracedValue:
        return {"centre": function(read_state(mean), (0.0,) * (size - t), arguments(others))}

    def at_sample(mean: TracedValue, _: TracedValue, *others: TracedValue) -> TracedValue:
        *own, away, centre = others
        add_state(mean, away)
        value = function(read_state(mean), tuple(away[t:]), arguments(own))
        return {"value": _by_block(_difference, outputs, value, centre)}

    def move(_: TracedValue, __: TracedValue, shift: TracedValue, centre: TracedValue) -> TracedValue:
        add(centre, shift)
        return {"centre": centre}

    def recentre(_: TracedValue, __: TracedValue, shift: TracedValue, value: TracedValue) -> TracedValue:
        found, again = [value[i] for i in range(values)], False
        for kind, _component, first, width in curved_blocks(outputs):
            own = slice(first, first + width)
            still, *found[own] = _recentred(kind)(tuple(value[own]), tuple(shift[own]))
            again = still if again is False else again | still
        return {"value": found, "again": [again]}

    shift, centre = Shape((values,)), Shape((components,))
    straight = set(outputs) <= {"linear"}
    return SampledFunction(
        points,
        weights,
        axes,
        kept,
        traced_step(what, spread, given),
        traced_step(what, at_mean, given),
        traced_step(what, at_sample, (*given, Shape((size,)), centre)),
        traced_step(what, move, (*gaussian, shift, centre)),
        None if straight else traced_step(what, recentre, (*gaussian, shift, shift)),
        len(given),
        tuple(c + i for kind, c, _, _ in curved_blocks(outputs) for i in range(WIDTHS[kind])),
        tuple(t + i for _, _, t, width in curved_blocks(outputs) for i in range(width)),
        turning(kinds),
        unsuspected_rad(points),
    )


def _by_block(
    function_of: StepFunction, kinds: Kinds, first: TracedValue, second: TracedValue
) -> list[TracedValue]:
    """Apply a function to two states, one linear component, angle, axis or orientation at a time."""
    found: list[TracedValue] = []
    for kind, component, _, _ in manifold_blocks(kinds):
        own = slice(component, component + WIDTHS[kind])
        found += function_of(kind)(tuple(first[own]), tuple(second[own]))
    return found


@lru_cache(maxsize=8)
def _difference(kind: str) -> TracedFunction:
    """Trace the difference for one kind as a separate function, to limit the number of paths."""
    width = WIDTHS[kind]
    subtract = boxminus((kind,) * width)

    def difference(first: TracedValue, second: TracedValue) -> TracedValue:
        row = np.empty((1, tangent_size((kind,) * width)), object)
        subtract(first, second, row, 0)
        return tuple(row[0])

    return TracedFunction(difference, (width, width))


@lru_cache(maxsize=8)
def _recentred(kind: str) -> TracedFunction:
    """Trace how a tangent vector changes with its centre; the first output is whether to iterate."""
    kinds = (kind,) * WIDTHS[kind]
    move, size = recentring(kinds), tangent_size(kinds)

    def recentred(value: TracedValue, shift: TracedValue) -> TracedValue:
        values = np.array([value], object)
        again = move(values, shift)
        return (again, *values[0])

    return TracedFunction(recentred, (size, size))
