"""The parameters of robots among landmarks: drive, sensors and fixes."""

from typing import Annotated

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from fuselog.recorders.parameters import Parameters

Probability = Annotated[float, Field(ge=0, le=1)]


FieldOfView = Annotated[float, Field(gt=0, le=360)]


Latitude = Annotated[float, Field(ge=-90, le=90)]


Longitude = Annotated[float, Field(ge=-180, le=180)]


class Sensor(Parameters):
    """Parameters that all sensors of a robot have in common.

    Attributes:
        rate_hz: measurements per second; 0 switches the sensor off.
        maximum_range_m: largest range at which targets are seen.
        field_of_view_deg: field of view, centred straight ahead.
        outlier_probability: probability that a value is replaced by a random one within the sensor's
            range.
        dropout_probability: probability that a measurement is lost.
        outages_per_minute: mean number of outages per minute.
        outage_s: length of an outage.
        latency_s: shortest delay from measurement to arrival at the recorder.
        latency_jitter_s: mean of the additional random delay (exponential).
        clock_offset_s: offset of the sensor's clock, positive if ahead.
        stamp_offset_s: offset of the stamps of its messages, positive if ahead.
        sigma_range_m: standard deviation of a range.
        sigma_bearing_rad: standard deviation of a bearing.
        bias_range_m: bias of ranges, measured minus true.
        bias_bearing_rad: bias of bearings, measured minus true.
    """

    rate_hz: NonNegativeFloat = 0.0
    maximum_range_m: PositiveFloat = 8.0
    field_of_view_deg: FieldOfView = 360.0
    outlier_probability: Probability = 0.0
    dropout_probability: Probability = 0.0
    outages_per_minute: NonNegativeFloat = 0.0
    outage_s: PositiveFloat = 3.0
    latency_s: NonNegativeFloat = 0.0
    latency_jitter_s: NonNegativeFloat = 0.0
    clock_offset_s: float = 0.0
    stamp_offset_s: float = 0.0
    sigma_range_m: NonNegativeFloat = 0.1
    sigma_bearing_rad: NonNegativeFloat = 0.02
    bias_range_m: float = 0.0
    bias_bearing_rad: float = 0.0


class Fixes(Parameters):
    """A receiver that measures positions.

    Attributes:
        rate_hz: fixes per second; 0 switches the receiver off.
        sigma_m: standard deviation of a fix, per axis.
        outages_per_minute: mean number of outages per minute.
        outage_s: length of an outage.
        origin_deg: latitude and longitude of the origin of the local tangent plane. If they are given,
            fixes are latitudes and longitudes; otherwise fixes are positions in the plane.
    """

    rate_hz: NonNegativeFloat = 0.0
    sigma_m: PositiveFloat = 1.0
    outages_per_minute: NonNegativeFloat = 0.0
    outage_s: PositiveFloat = 10.0
    origin_deg: tuple[Latitude, Longitude] | None = None


class LandmarksParameters(Parameters):
    """Robots with odometry and sensors that drive among landmarks in a square arena.

    Attributes:
        duration_s: length of the run.
        robots: number of robots.
        landmarks: number of landmarks, placed at random.
        arena_m: side of the arena.
        speed_mps: speed of every robot.
        odometry_rate_hz: odometry readings per second.
        odometry_latency_s: time from a reading of the odometry to its arrival at the recorder.
        forward_noise_density: noise of the odometry's forward speed, in m/s/sqrt(Hz).
        turn_noise_density: noise of the odometry's turn rate, in rad/s/sqrt(Hz).
        forward_scale_error: how much faster the robot moves than the odometry reports, as a fraction of
            the reported speed.
        turn_bias_radps: how much faster the robot turns than the odometry reports.
        prior_sigma_m: standard deviation of the position in the prior, per axis.
        prior_sigma_rad: standard deviation of the heading in the prior.
        robots_see_each_other: whether robots are also targets of the sensors.
        range_bearing: sensor of ranges and bearings.
        range: sensor of ranges.
        bearing: sensor of bearings.
        relative_bearing: sensor of angles between pairs of targets.
        fix: receiver of positions.
    """

    duration_s: PositiveFloat = 60.0
    robots: PositiveInt = 1
    landmarks: Annotated[int, Field(ge=0)] = 12
    arena_m: PositiveFloat = 12.0
    speed_mps: PositiveFloat = 0.6
    odometry_rate_hz: PositiveFloat = 20.0
    odometry_latency_s: NonNegativeFloat = 0.0
    forward_noise_density: NonNegativeFloat = 0.02
    turn_noise_density: NonNegativeFloat = 0.01
    forward_scale_error: Annotated[float, Field(gt=-1)] = 0.0
    turn_bias_radps: float = 0.0
    prior_sigma_m: PositiveFloat = 0.1
    prior_sigma_rad: PositiveFloat = 0.05
    robots_see_each_other: bool = False
    range_bearing: Sensor = Sensor(rate_hz=5.0)
    range: Sensor = Sensor()
    bearing: Sensor = Sensor()
    relative_bearing: Sensor = Sensor()
    fix: Fixes = Fixes()
