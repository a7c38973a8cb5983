"""Names of samplings, as on a command line, and their parsing.

ukf  ukf:kappa=0              unscented
gf-25                         25 Gaussian-filter points on each axis
rukf-12                       randomised unscented, 12 iterations
s2kf-50  s2kf-50:symmetric    50 LCD samples
s2kf-50:seed=3:rotation=7     from another optimisation, and rotated at random
"""

import re
from abc import ABC, abstractmethod
from functools import lru_cache
from typing import ClassVar

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    NonNegativeInt,
    PositiveInt,
    ValidationError,
)

from fuselog.recorders.errors import BadInput
from fuselog.replay.inference.sampling.cache import SetName, cached_set
from fuselog.replay.inference.sampling.lcd import Report, silent
from fuselog.replay.inference.sampling.samplers import (
    Sampler,
    Samples,
    axis_points,
    fixed,
    randomised,
    rotated,
    unscented,
)

PROBLEMS = {"missing": "is missing", "extra_forbidden": "is not known"}
PATTERN = re.compile(r"(?P<family>[a-z0-9]+)(-(?P<number>\d+))?(?P<options>(:[a-z]+(=[^:=]+)?)*)")


class Sampling(BaseModel, ABC):  # type: ignore[explicit-any]
    """Method of sampling N(0, I) in any dimension; `str` returns its name."""

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)
    family: ClassVar[str]
    number: ClassVar[str | None] = None
    """Field that is set by the number after the family's name."""

    def at(self, dimension: int, report: Report = silent) -> Sampler:
        """Make the sampler for one dimension; `report` is called if samples must be computed first.

        Raises:
            BadInput: the dimension is below 1, or this sampling does not support it.
        """
        if dimension < 1:
            raise BadInput(f"{self}: a sampling needs a dimension of 1 or more, found {dimension}")
        return self._at(dimension, report)

    @abstractmethod
    def _at(self, dimension: int, report: Report, /) -> Sampler: ...

    def __str__(self) -> str:
        """Return the name, without options that have their default values."""
        number = "" if self.number is None else f"-{getattr(self, self.number)}"
        options = [
            f":{key}" if value is True else f":{key}={value}"
            for key, value in self.model_dump(exclude_defaults=True).items()
            if key != self.number
        ]
        return "".join([self.family, number, *options])


class Unscented(Sampling):  # type: ignore[explicit-any]
    """Points of the unscented transform; with equal weights by default."""

    family = "ukf"
    kappa: FiniteFloat = 0.5

    def _at(self, dimension: int, _: Report, /) -> Sampler:
        return fixed(unscented(dimension, self.kappa))


class GaussianFilter(Sampling):  # type: ignore[explicit-any]
    """Points on the axes only, with `per_axis` points on each."""

    family = "gf"
    number = "per_axis"
    per_axis: int = Field(ge=2)

    def _at(self, dimension: int, _: Report, /) -> Sampler:
        return fixed(axis_points(dimension, self.per_axis))


class RandomisedUnscented(Sampling):  # type: ignore[explicit-any]
    """Unscented sets with random rotations and radii, drawn for every run and step."""

    family = "rukf"
    number = "iterations"
    iterations: PositiveInt

    def _at(self, dimension: int, _: Report, /) -> Sampler:
        return randomised(dimension, self.iterations)


class SmartSampling(Sampling):  # type: ignore[explicit-any]
    """LCD samples of the S2KF; with rotation 0, the set is not rotated."""

    family = "s2kf"
    number = "count"
    count: PositiveInt
    symmetric: bool = False
    seed: NonNegativeInt = 0
    rotation: NonNegativeInt = 0

    def _at(self, dimension: int, report: Report, /) -> Sampler:
        points = cached_set(SetName(dimension, self.count, self.symmetric, self.seed), report)
        samples = Samples(points, np.full(self.count, 1 / self.count))
        if self.rotation:
            samples = rotated(samples, np.random.default_rng(self.rotation))
        return fixed(samples)


FAMILIES = {
    each.family: each for each in (Unscented, GaussianFilter, RandomisedUnscented, SmartSampling)
}


@lru_cache(maxsize=64)
def parse_sampling(name: str) -> Sampling:
    """Return the sampling that a name denotes; see the module's docstring for the names.

    Raises:
        BadInput: the family is unknown, or a number or option is missing, unknown or out of bounds.
    """
    match = PATTERN.fullmatch(name)
    family = FAMILIES.get(match["family"]) if match else None
    if match is None or family is None:
        known = ", ".join(FAMILIES)
        raise BadInput(
            f"'{name}' is not a sampling; give one of {known}, as in gf-25 or s2kf-50:symmetric"
        )
    given = [option.partition("=") for option in match["options"].split(":")[1:]]
    pairs = [(key, value or "true") for key, _, value in given]
    if match["number"]:
        pairs.append((family.number or "number", match["number"]))
    values = dict(pairs)
    if len(values) < len(pairs):
        raise BadInput(f"sampling '{name}' has an option twice; give it once")
    try:
        return family.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        option = first["loc"][0]
        problem = PROBLEMS.get(first["type"]) or first["msg"].lower()
        fields = ", ".join(key for key in family.model_fields)
        raise BadInput(
            f"sampling '{name}': {option}: {problem}; {family.family} takes {fields}"
        ) from error
