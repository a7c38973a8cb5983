"""Options of every model, and the numerical parameters that its functions read."""

from collections import namedtuple
from collections.abc import Mapping
from functools import cache, lru_cache
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, Literal, Union, get_args, get_origin

from pydantic import Field, PositiveFloat

from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.arrays import Settings

# Combined parameters of a model and a method, in a class that is made when both are known; see
# `fuselog.replay.inference.estimators.combined`.
CombinedParameters = Any  # type: ignore[explicit-any]


@cache
def number_fields(parameters: type[Parameters]) -> tuple[str, ...]:
    """List the parameters that a model's functions can read: all parameters that are numbers."""
    fields = parameters.model_fields.items()
    return tuple(name for name, field in fields if _is_number(field.annotation))


def _is_number(accepted: object) -> bool:
    """Test whether a parameter accepts only numbers and None."""
    kind = get_origin(accepted)
    if kind is Annotated:
        return _is_number(get_args(accepted)[0])
    if kind in (Union, UnionType):
        return all(map(_is_number, get_args(accepted)))
    if kind is Literal:
        return all(_is_number(type(choice)) for choice in get_args(accepted))
    return accepted in (float, int, bool, None, NoneType)


@lru_cache(maxsize=64)
def settings_type(names: tuple[str, ...]) -> type[Settings]:
    """Make the NamedTuple type of the parameters that model functions receive."""
    return namedtuple("Settings", names)


class ModelParameters(Parameters):  # type: ignore[explicit-any]
    """Options of every model.

    A parameter that is not set is read from the channels of the log: first from the sensor's own
    channel, then from the channels of the control, the prior and the other sensors.

    Attributes:
        gate_probability: measurements whose NIS exceeds this quantile of the chi-square distribution are
            rejected; 1 accepts all.
        gate_reopens_s: time since a sensor's last accepted measurement after which its gate opens, so
            that a filter that has drifted, for example in an outage, accepts the measurements that
            correct it.
        inflate_nis: NIS above which the innovation covariance is inflated until the NIS has this value.
        student_freedom: degrees of freedom of the Student's t-distribution that is assumed for
            innovations.
        switch_nis: NIS above which measurements are increasingly down-weighted, as in dynamic covariance
            scaling.
        sigma_fix_m: standard deviation of each component of a fix whose message states no covariance.
    """

    OWNED: ClassVar[Mapping[str, tuple[str, str]]] = {}  # see `Model.owned`

    gate_probability: Annotated[float, Field(gt=0, le=1)] = 1.0
    gate_reopens_s: PositiveFloat | None = None
    inflate_nis: PositiveFloat | None = None
    student_freedom: PositiveFloat | None = None
    switch_nis: PositiveFloat | None = None
    sigma_fix_m: PositiveFloat | None = None
