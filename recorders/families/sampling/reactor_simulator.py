"""A batch reactor whose total pressure is measured once per time step.

Source: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014,
section VI.A. The prior is the paper's, far from the truth and the same in every run.
"""

from typing import Annotated

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from fuselog.recorders.common_streams import prior_stream, stated_numbers, truth_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.sampling.reactor import react, total_pressure
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import Recording, Simulator, simulation_stamps_ns

COMPONENTS = ("pressure_a", "pressure_b")
Pair = Annotated[tuple[float, ...], Field(min_length=2, max_length=2)]


class ReactorParameters(Parameters):
    """Partial pressures of a gas reaction, in the paper's units.

    Attributes:
        steps: number of time steps.
        step_s: length of a time step.
        start: true partial pressures of the two gases at the start.
        process_variance: variance that a step adds to each partial pressure.
        pressure_variance: variance of a measured total pressure.
        prior_mean: mean of the two partial pressures in the prior.
        prior_variance: variance of each partial pressure in the prior.
    """

    steps: PositiveInt = 50
    step_s: PositiveFloat = 0.1
    start: Pair = (3.0, 1.0)
    process_variance: NonNegativeFloat = 1e-5
    pressure_variance: PositiveFloat = 0.1
    prior_mean: Pair = (0.5, 3.5)
    prior_variance: PositiveFloat = 10.0


def simulate(parameters: ReactorParameters, rng: np.random.Generator) -> Recording:
    """Record one run."""
    state = np.empty((parameters.steps + 1, 2))
    state[0] = parameters.start
    noise = rng.normal(size=(parameters.steps, 2)) * np.sqrt(parameters.process_variance)
    with np.errstate(over="ignore", invalid="ignore"):
        for step in range(parameters.steps):
            state[step + 1] = np.array(react(state[step], parameters.step_s)) + noise[step]
    if not np.isfinite(state).all():
        raise BadInput(
            f"start = {parameters.start}, step_s = {parameters.step_s:g}: the pressures "
            "grow without bound; start at nonnegative pressures, and use shorter or fewer steps"
        )
    (total,) = total_pressure(state[1:].T)
    read = total + rng.normal(size=parameters.steps) * np.sqrt(parameters.pressure_variance)
    stamps_ns = simulation_stamps_ns(parameters.step_s * np.arange(parameters.steps + 1))
    return Recording(
        [
            prior_stream(
                "/prior",
                stamps_ns[0],
                COMPONENTS,
                parameters.prior_mean,
                parameters.prior_variance * np.eye(2),
            ),
            truth_stream("/truth", stamps_ns, COMPONENTS, state),
            make_stream(
                "/pressure",
                schemas.VECTOR_MEASUREMENT,
                stamps_ns[1:],
                metadata={"system": "batch-reactor", "components": "total_pressure"}
                | stated_numbers(parameters, "step_s", "process_variance", "pressure_variance"),
                value=read[:, None],
            ),
        ]
    )


BATCH_REACTOR = Simulator(
    "a gas that reacts in a closed vessel; its total pressure is measured", ReactorParameters, simulate
)
