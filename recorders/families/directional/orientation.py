"""Axes in the plane and orientations in space that rotate at random, measured with noise.

x+ = x (+) w and z = x (+) v, with Bingham noise or Gaussian noise scaled to unit length: the evaluation
in Kurz, Gilitschenski, Julier, Hanebeck, "Recursive Bingham Filter", JAIF 9(2), 2014, section 7. The
measurements' channel states the noise and the prior as JSON.
"""

from collections.abc import Mapping
from functools import partial
from typing import Self

import numpy as np
from pydantic import PositiveFloat, PositiveInt, model_validator

from fuselog.recorders.families.directional.noise import DirectionalNoise
from fuselog.recorders.log import Schema, make_stream, schemas
from fuselog.recorders.models.orientation import AXIS_KINDS, ORIENTATION_KINDS, compose
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording, Simulator, simulation_stamps_ns


class AxisParameters(Parameters):
    """The paper's two-dimensional evaluation, (54)-(56); the initial truth is not the prior's mode.

    Attributes:
        steps: number of time steps.
        step_s: length of a time step.
        start: true initial orientation, a unit vector.
        prior: distribution of the initial orientation, as filters assume it.
        system: distribution of the rotation in a step.
        measurement: distribution of the rotation error of a measurement.
    """

    steps: PositiveInt = 100
    step_s: PositiveFloat = 0.1
    start: tuple[float, ...] = (1.0, 0.0)
    prior: DirectionalNoise = DirectionalNoise(diagonal=(-1.0, 0.0))
    system: DirectionalNoise = DirectionalNoise(diagonal=(0.0, -200.0))
    measurement: DirectionalNoise = DirectionalNoise(diagonal=(0.0, -2.0))

    @model_validator(mode="after")
    def _has_one_dimension(self) -> Self:
        sizes = [len(self.start), *(len(each.diagonal) for each in (self.prior, self.system))]
        if sizes != [len(self.measurement.diagonal)] * 3 or sizes[0] != self.dimension():
            raise ValueError(
                f"start, prior, system and measurement must have {self.dimension()} numbers each"
            )
        if not np.isclose(np.linalg.norm(self.start), 1.0, rtol=0.0, atol=1e-9):
            raise ValueError("start must have unit length")
        return self

    @classmethod
    def dimension(cls) -> int:
        """Return the number of components."""
        return 2


class OrientationParameters(AxisParameters):
    """The paper's four-dimensional evaluation, (61)-(65)."""

    start: tuple[float, ...] = (0.0, 1.0, 0.0, 0.0)
    prior: DirectionalNoise = DirectionalNoise(diagonal=(-1.0, -1.0, -1.0, 0.0))
    system: DirectionalNoise = DirectionalNoise(diagonal=(0.0, -2.0, -200.0, -200.0))
    measurement: DirectionalNoise = DirectionalNoise(diagonal=(0.0, -500.0, -500.0, -500.0))

    @classmethod
    def dimension(cls) -> int:
        """Return the number of components."""
        return 4


def simulate(
    schema: Schema, kinds: Mapping[str, str], parameters: AxisParameters, rng: np.random.Generator
) -> Recording:
    """Record one run: the truth after every step, and its measurement."""
    system_rng, measurement_rng = rng.spawn(2)
    turns = parameters.system.sample(parameters.steps, system_rng)
    truth = np.empty(turns.shape)
    x = np.array(parameters.start)
    for step, turn in enumerate(turns):
        x = compose(x, turn)
        truth[step] = x = x / np.linalg.norm(x)
    measured = compose(truth, parameters.measurement.sample(parameters.steps, measurement_rng))
    elapsed_s = parameters.step_s * np.arange(1, parameters.steps + 1)
    time_ns = simulation_stamps_ns(elapsed_s)
    named = {"components": ",".join(kinds), "kinds": ",".join(kinds.values())}
    stated = {
        each: getattr(parameters, each).model_dump_json() for each in ("prior", "system", "measurement")
    }
    (field,) = (entry.name for entry in schema if entry.kind == "vector")
    return Recording(
        [
            make_stream("/truth", schemas.TRUTH_STATE, time_ns, metadata=named, state=truth),
            make_stream(f"/{field}", schema, time_ns, metadata=stated, **{field: measured}),
        ]
    )


AXIS = Simulator(
    "an axis in the plane, equal to its negative, that rotates at random; noisy measurements of it",
    AxisParameters,
    partial(simulate, schemas.AXIS, AXIS_KINDS),
)
ORIENTATION = Simulator(
    "an orientation in space that rotates at random; noisy quaternions of it",
    OrientationParameters,
    partial(simulate, schemas.ORIENTATION, ORIENTATION_KINDS),
)
