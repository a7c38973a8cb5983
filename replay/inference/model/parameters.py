"""Defines the options of every model, and the numbers that its functions read."""

from collections import namedtuple
from collections.abc import Mapping
from functools import cache, lru_cache
from typing import Annotated, Any, ClassVar

from pydantic import Field, PositiveFloat

from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.arrays import Settings

# The parameters of a model and of a method together: a class that is made when both are known, see
# `fuselog.replay.inference.estimators.combined`.
CombinedParameters = Any  # type: ignore[explicit-any]


@cache
def number_fields(parameters: type[Parameters]) -> tuple[str, ...]:
    """List the parameters that model functions may read: all that are numbers."""
    schema = parameters.model_json_schema()["properties"]
    numeric = ("number", "integer", "boolean", "null")
    return tuple(
        name
        for name, entry in schema.items()
        if all(each.get("type") in numeric for each in entry.get("anyOf", [entry]))
    )


@lru_cache(maxsize=64)
def settings_type(names: tuple[str, ...]) -> type[Settings]:
    """Make the NamedTuple that model functions get as their parameters."""
    return namedtuple("Settings", names)


class ModelParameters(Parameters):  # type: ignore[explicit-any]
    """Defines the options of every model.

    A parameter that is none is what the channels of the log state: the sensor's own first, then those
    of control, prior and the other sensors.

    Attributes:
        gate_probability: a measurement whose NIS is beyond this quantile of chi-square is not used; 1
            uses all.
        gate_reopens_s: the gate is open for a sensor whose last accepted measurement is older, so that a
            filter that has drifted, as in an outage, accepts what brings it back.
        inflate_nis: an innovation with a greater NIS counts with a larger covariance, which gives it
            this NIS.
        student_freedom: innovations count as if they had Student's distribution with so many degrees of
            freedom.
        switch_nis: above this NIS a measurement counts less and less, as in dynamic covariance scaling.
        sigma_fix_m: standard deviation of each component of a fix that does not state its covariance.
    """

    OWNED: ClassVar[Mapping[str, tuple[str, str]]] = {}  # see `Model.owned`

    gate_probability: Annotated[float, Field(gt=0, le=1)] = 1.0
    gate_reopens_s: PositiveFloat | None = None
    inflate_nis: PositiveFloat | None = None
    student_freedom: PositiveFloat | None = None
    switch_nis: PositiveFloat | None = None
    sigma_fix_m: PositiveFloat | None = None
