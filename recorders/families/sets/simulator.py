"""A stationary robot that measures relative bearings whose errors have a known bound.

The scene is taken from Briechle and Hanebeck (2004), section V, or is drawn at random. Every look
measures all pairs of landmarks, or the given pairs.
"""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from fuselog.recorders.common_streams import truth_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.families.sets.models import relative_bearing
from fuselog.recorders.log import make_stream, schemas
from fuselog.recorders.models.planar import wrap_angle
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import SIMULATION_EPOCH_NS, Recording, Simulator, simulation_stamps_ns

PAPER_LANDMARKS_M = np.array([[0.0, 1.0], [1.0, 1.0], [-1.0, 0.0]])
PAPER_PAIRS = ((3, 1), (1, 2), (2, 3))


class RelativeBearingsParameters(Parameters):
    """The scene of section V of the paper (its first pairs, without noise), or random scenes.

    Attributes:
        scene: the paper's scene or random scenes.
        paper_pairs: number of the paper's landmark pairs to measure in the paper's scene.
        bound_deg: bound of the error of a relative bearing; the channel states it.
        error_share: errors are uniformly distributed within this share of the bound.
        landmarks: number of landmarks of a random scene.
        arena_m: side length of the square arena that the log states, centred on the origin.
        spread_m: largest distance of a random scene's landmarks from the centre in x and in y.
        robot_spread_m: largest distance of a random scene's robot from the centre in x and in y.
        looks: number of times that all pairs are measured.
        rate_hz: looks per second.
        misidentified_probability: probability that the first landmark of a pair is confused with another
            one in a measurement.
        start_s: time of the first look, since the run's epoch.
    """

    scene: Literal["section-v", "random"] = "section-v"
    paper_pairs: Annotated[int, Field(ge=1, le=3)] = 3
    bound_deg: Annotated[float, Field(gt=0, lt=90)] = 4.0
    error_share: Annotated[float, Field(ge=0, le=1)] = 1.0
    landmarks: Annotated[int, Field(ge=2)] = 3
    arena_m: PositiveFloat = 10.0
    spread_m: PositiveFloat = 3.0
    robot_spread_m: PositiveFloat = 2.0
    looks: PositiveInt = 1
    rate_hz: PositiveFloat = 1.0
    misidentified_probability: Annotated[float, Field(ge=0, le=1)] = 0.0
    start_s: NonNegativeFloat = 0.0


def simulate(parameters: RelativeBearingsParameters, rng: np.random.Generator) -> Recording:
    """Record one run: /landmarks, /robot1/truth, /robot1/relative_bearing."""
    bound_rad = np.radians(parameters.bound_deg)
    if parameters.scene == "section-v":
        places, robot, error_rad = PAPER_LANDMARKS_M, np.zeros(2), 0.0
        first, second = np.array(PAPER_PAIRS[: parameters.paper_pairs]).T - 1
    else:
        widest = 0.5 * parameters.arena_m
        half, robot_half = (
            min(spread, widest) for spread in (parameters.spread_m, parameters.robot_spread_m)
        )
        places = rng.uniform(-half, half, (parameters.landmarks, 2))
        robot = rng.uniform(-robot_half, robot_half, 2)
        first, second = np.triu_indices(parameters.landmarks, 1)
        error_rad = parameters.error_share * bound_rad
    if np.any(np.all(places == robot, axis=1)):
        raise BadInput(
            "scenario relative-bearings: the robot is at the position of a landmark; move the robot "
            "or the landmark"
        )
    count = len(first)
    looks = np.repeat(np.arange(parameters.looks), count)
    wrong = rng.uniform(size=len(looks)) < parameters.misidentified_probability
    seen = np.where(wrong, rng.integers(0, len(places), len(looks)), np.tile(first, parameters.looks))
    other = np.tile(second, parameters.looks)
    error = rng.uniform(-1, 1, len(looks)) * error_rad
    angle = wrap_angle(relative_bearing(robot, places[seen].T, places[other].T) + error)
    stamps = simulation_stamps_ns(parameters.start_s + np.arange(parameters.looks) / parameters.rate_hz)
    return Recording(
        [
            make_stream(
                "/landmarks",
                schemas.LANDMARK,
                np.full(len(places), SIMULATION_EPOCH_NS),
                metadata={"arena_m": ",".join(map(repr, _arena(parameters)))},
                landmark_id=np.arange(1, len(places) + 1),
                position_m=places,
            ),
            truth_stream("/robot1/truth", stamps, ("x_m", "y_m"), np.tile(robot, (parameters.looks, 1))),
            make_stream(
                "/robot1/relative_bearing",
                schemas.RELATIVE_BEARING,
                stamps[looks],
                metadata={"bound_rad": repr(float(bound_rad))},
                first_id=np.tile(first, parameters.looks) + 1,
                second_id=other + 1,
                angle_rad=angle,
            ),
        ]
    )


def _arena(parameters: RelativeBearingsParameters) -> tuple[float, float, float, float]:
    """Return the rectangle's low x, low y, high x, high y."""
    half = 0.5 * parameters.arena_m
    return (-half, -half, half, half)


RELATIVE_BEARINGS = Simulator(
    "a robot that measures bounded relative bearings to landmarks; the paper's or random scenes",
    RelativeBearingsParameters,
    simulate,
)
