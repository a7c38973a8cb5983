"""The parameters of a body with an inertial unit and a GNSS receiver."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat

from fuselog.recorders.parameters import Parameters

WayPoint = tuple[float, float, float]


Span = tuple[float, float]


class Unit(Parameters):
    """The errors of an inertial unit; the defaults are a phone's errors.

    Attributes:
        rate_hz: samples per second.
        force_noise_density: white noise of the specific force, in m/s^2/sqrt(Hz).
        gyro_noise_density: white noise of the turn rate, in rad/s/sqrt(Hz).
        force_bias_density: random walk of the accelerometer's bias, in m/s^2/sqrt(s).
        gyro_bias_density: random walk of the gyro's bias, in rad/s/sqrt(s).
        force_bias_sigma_mps2: standard deviation of the accelerometer's bias at the start, per axis.
        gyro_bias_sigma_radps: standard deviation of the gyro's bias at the start, per axis.
        scale_sigma: standard deviation of the scale errors, as a fraction.
        misalignment_sigma_rad: standard deviation of the misalignments of the axes.
        force_quantum_mps2: specific forces are rounded to multiples of this; 0 for no rounding.
        gyro_quantum_radps: turn rates are rounded to multiples of this; 0 for no rounding.
        delay_s: time by which the stamps of samples are late.
    """

    rate_hz: PositiveFloat = 100.0
    force_noise_density: NonNegativeFloat = 0.002
    gyro_noise_density: NonNegativeFloat = 2e-4
    force_bias_density: NonNegativeFloat = 2e-4
    gyro_bias_density: NonNegativeFloat = 5e-6
    force_bias_sigma_mps2: PositiveFloat = 0.1
    gyro_bias_sigma_radps: PositiveFloat = 0.003
    scale_sigma: NonNegativeFloat = 0.0
    misalignment_sigma_rad: NonNegativeFloat = 0.0
    force_quantum_mps2: NonNegativeFloat = 0.0
    gyro_quantum_radps: NonNegativeFloat = 0.0
    delay_s: float = 0.0


class Receiver(Parameters):
    """The output of a GNSS receiver, and its disturbances as spans [start, end] in s since the epoch.

    Attributes:
        rate_hz: positions per second.
        velocity_rate_hz: rate of the messages with a velocity; 0 for no velocities.
        sigma_m: standard deviation of a position, per horizontal axis.
        sigma_up_m: standard deviation of a height.
        sigma_mps: standard deviation of a velocity, per horizontal axis.
        sigma_up_mps: standard deviation of a vertical velocity.
        lever_m: position of the antenna in the body (forward, left, up).
        delay_s: time by which the stamps of positions are late.
        velocity_delay_s: time by which the stamps of velocities are late.
        outages_s: spans without messages.
        floats_s: spans with float solutions.
        float_factor: factor by which the errors of float solutions, and the sigmas stated for them, are
            larger.
        multipath_s: spans in which positions have the offset `multipath_m`, which their covariance
            ignores.
        multipath_m: offset of positions in the spans `multipath_s` (east, north, up).
    """

    rate_hz: PositiveFloat = 5.0
    velocity_rate_hz: NonNegativeFloat = 5.0
    sigma_m: PositiveFloat = 0.5
    sigma_up_m: PositiveFloat = 1.0
    sigma_mps: PositiveFloat = 0.05
    sigma_up_mps: PositiveFloat = 0.1
    lever_m: WayPoint = (0.0, 0.0, 0.0)
    delay_s: float = 0.0
    velocity_delay_s: float = 0.0
    outages_s: list[Span] = []
    floats_s: list[Span] = []
    float_factor: PositiveFloat = 10.0
    multipath_s: list[Span] = []
    multipath_m: WayPoint = (3.0, -2.0, 5.0)


class Carried(Parameters):
    """Further sensors that a body may carry.

    Attributes:
        wheel_rate_hz: rate of the wheels' messages with the forward speed; 0 for no wheels.
        wheel_sigma_mps: standard deviation of a forward speed.
        wheel_scale_sigma: standard deviation of the scale error of the wheels' speed, as a fraction.
        axle_m: position in the body at which the wheels measure the speed (forward, left, up).
        compass_rate_hz: rate of the compass's messages with the orientation; 0 for no compass.
        compass_sigma_rad: standard deviation of the compass's heading.
        barometer_rate_hz: rate of the barometer's messages with the height; 0 for no barometer.
        barometer_sigma_m: standard deviation of a height.
    """

    wheel_rate_hz: NonNegativeFloat = 0.0
    wheel_sigma_mps: PositiveFloat = 0.05
    wheel_scale_sigma: NonNegativeFloat = 0.0
    axle_m: WayPoint = (0.0, 0.0, 0.0)
    compass_rate_hz: NonNegativeFloat = 0.0
    compass_sigma_rad: PositiveFloat = 0.05
    barometer_rate_hz: NonNegativeFloat = 0.0
    barometer_sigma_m: PositiveFloat = 0.5


class Prior(Parameters):
    """The prior in the log; the standard deviations of its biases are those of the inertial unit.

    Attributes:
        is_told: whether the log has a prior.
        sigma_m: standard deviation of the position at the start, per axis.
        sigma_mps: standard deviation of the velocity at the start, per axis.
        tilt_sigma_rad: standard deviation of roll and pitch at the start.
        heading_sigma_rad: standard deviation of the heading at the start.
    """

    is_told: bool = True
    sigma_m: PositiveFloat = 0.5
    sigma_mps: PositiveFloat = 0.2
    tilt_sigma_rad: PositiveFloat = 0.02
    heading_sigma_rad: PositiveFloat = 0.05


class NavigationParameters(Parameters):
    """Parameters of a moving body, its path, and its sensors.

    A person sways and bobs with each step, and turns to both sides of the path; a quadrotor tilts to
    accelerate, and may point in any direction.

    Attributes:
        carrier: type of the moving body.
        duration_s: length of the run.
        rest_s: duration of the initial standstill.
        leg_s: time between random way points.
        speed_mps: speed along the path.
        way_points_m: points of the path (east, north, up); if empty, points are random.
        origin_latitude_deg: latitude of the origin of the local tangent plane.
        origin_longitude_deg: longitude of the origin of the local tangent plane.
        origin_altitude_m: height of the origin above the WGS 84 ellipsoid.
        unit: errors of the inertial unit.
        gnss: GNSS receiver.
        carried: further sensors on board.
        prior: prior in the log.
    """

    carrier: Literal["vehicle", "pedestrian", "quadrotor"] = "vehicle"
    duration_s: Annotated[float, Field(gt=10.0)] = 120.0
    rest_s: PositiveFloat = 5.0
    leg_s: PositiveFloat = 6.0
    speed_mps: PositiveFloat = 10.0
    way_points_m: list[WayPoint] = []
    origin_latitude_deg: Annotated[float, Field(ge=-90, le=90)] = 48.0
    origin_longitude_deg: Annotated[float, Field(ge=-180, le=180)] = 11.0
    origin_altitude_m: float = 500.0
    unit: Unit = Unit()
    gnss: Receiver = Receiver()
    carried: Carried = Carried()
    prior: Prior = Prior()
