"""Short logs in which each parameter of estimator, model and method counts, or why it counts nowhere."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from fuselog.recorders.parameters import merge
from fuselog.recorders.recording import Simulator
from fuselog.recorders.registry import load
from tests.pipeline.moves import switched_on


class Situation(NamedTuple):
    """A scenario with its settings, and those of the estimator."""

    scenario: str
    recorded: Mapping[str, Any] = {}
    settings: Mapping[str, Any] = {}


@dataclass(frozen=True)
class Case:
    """An estimator by its name, and where its parameters count.

    Attributes:
        kind: the estimator's name.
        usual: where nearly all count.
        values: of parameters for which a number beside the usual one is not enough.
        under: where others count.
        nothing: parameters that count in no scenario, and why.
    """

    kind: str
    usual: Situation
    values: Mapping[str, Any] = field(default_factory=dict)
    under: Mapping[str, Situation] = field(default_factory=dict)
    nothing: Mapping[str, str] = field(default_factory=dict)


def all_sensors(scenario: str) -> dict[str, Any]:
    """A scenario's settings under which every sensor measures that has a rate."""
    return switched_on(load("recorders", scenario, Simulator).parameters, endings=["rate_hz"])


SEEN = merge(all_sensors("landmarks"), {"duration_s": 8.0, "fix": {"sigma_m": 0.2}})
ADVERSE = merge(SEEN, {"range_bearing": {"outlier_probability": 0.4, "bias_bearing_rad": 0.3}})
DRIVE = merge(
    all_sensors("navigation"),
    {"duration_s": 15.0, "rest_s": 1.0, "leg_s": 2.0, "unit": {"rate_hz": 50.0}},
)
WITHOUT_PRIOR = merge(DRIVE, {"carried": {"compass_rate_hz": 0.0}, "prior": {"is_told": False}})
WITHOUT_SPEEDS = merge(WITHOUT_PRIOR, {"gnss": {"velocity_rate_hz": 0.0}})
LINEAR = "the vehicles' motion and fixes are linear, so that every filter is the same one"
STATES_IT = "every simulated fix states its covariance"
WITH_PRIOR = "every log of the scenario has a prior"
OF_PARTICLES = "particles alone have outliers of their own"


def robot(recorded: Mapping[str, Any] = SEEN, **settings: Any) -> Situation:
    """A robot among landmarks."""
    return Situation("landmarks", recorded, settings)


def body(recorded: Mapping[str, Any] = DRIVE, **settings: Any) -> Situation:
    """A vehicle with an inertial unit."""
    return Situation("navigation", recorded, settings)


def drive(**settings: Any) -> Situation:
    """A vehicle that drives, turns and stands."""
    return Situation("manoeuvres", {"duration_s": 20.0}, settings)


def vehicles(**settings: Any) -> Situation:
    """Five vehicles, with scans."""
    clutter = {"clutter_per_scan": 3.0}
    return Situation(
        "vehicles", {"duration_s": 20.0, "network": clutter, "infrastructure": clutter}, settings
    )


def targets(**settings: Any) -> Situation:
    """Two targets that cross, with clutter."""
    usual = {"acceleration_density": 1.0, "birth_sigma_mps": 8.0, "birth_distance_m": 5.0}
    return Situation("crossing", {"duration_s": 20.0}, {**usual, **settings})


def scores(**settings: Any) -> Situation:
    """A few users."""
    return Situation("biometric-scores", {"users": 20, "low_galleries": 3}, settings)


def nodes(**settings: Any) -> Situation:
    """A network."""
    return Situation("ispace", {"steps": 20}, settings)


def directional(name: str, scenario: str, diagonal: list[float]) -> Case:
    """A filter of directions: each of its noises is a table, none unless it is given."""
    noises = ("prior", "system", "measurement")
    return Case(
        name,
        Situation(scenario, {"steps": 10}),
        {each: {"distribution": "gaussian", "diagonal": diagonal} for each in noises},
    )


MOTION = {"turn_rate_radps": 0.0, "acceleration_sigma_mps2": 0.1}
HITS = targets(association="jpda", management="hits")
GAP = body(inertial_gap_s=0.01)
MODELS = {
    "batch-reactor": Case("ekf", Situation("batch-reactor", {"steps": 10})),
    "extended-target": Case("lrkf:ukf", Situation("extended-target", {"points": 10})),
    "inertial": Case(
        "ekf",
        body(),
        {"inertial_gap_s": 0.01, "course_mps": 4.0, "still_mps": 4.0},
        {
            **dict.fromkeys(("gap_acceleration_mps2", "gap_turn_radps", "gap_tilt_rad"), GAP),
            **dict.fromkeys(
                (
                    *("level_s", "still_mps", "rest_margin_s", "course_mps", "course_s"),
                    *("start_sigma_m", "start_sigma_mps", "tilt_sigma_rad", "heading_sigma_rad"),
                    *("gyro_bias_sigma_radps", "force_bias_sigma_mps2"),
                ),
                body(WITHOUT_PRIOR),
            ),
            "unmeasured_sigma_mps": body(WITHOUT_SPEEDS),
        },
        {
            **dict.fromkeys(
                ("field_east_ut", "field_north_ut", "field_up_ut", "sigma_field_ut"),
                "the scenario has no magnetometer",
            ),
            **dict.fromkeys(("range_delay_s", "sigma_range_m"), "the scenario has no beacons"),
            **dict.fromkeys(
                ("standing_delay_s", "sigma_standing_mps"), "nothing tells that the vehicle stands"
            ),
            "sigma_velocity_mps": "every simulated velocity states its covariance",
        },
    ),
    "moving-shooter": Case(
        "ekf",
        Situation("shot-sequence", {"shots": 5}),
        nothing={
            "outlier_probability": OF_PARTICLES,
            "longest_s": OF_PARTICLES,
            "start_s": WITH_PRIOR,
        },
    ),
    "moving-sights": Case("ekf", Situation("moving-los", {"duration_s": 10.0})),
    "ranging-pose": Case(
        "ekf",
        Situation("ranging", {"duration_s": 10.0}),
        nothing=dict.fromkeys(
            (
                *("start_reach_m", "start_s", "start_sigma_m", "start_sigma_mps"),
                *("start_sigma_rad", "start_sigma_radps"),
            ),
            WITH_PRIOR,
        ),
    ),
    "ranging-position": Case(
        "ekf",
        Situation("ranging", {"duration_s": 10.0}),
        nothing=dict.fromkeys(
            ("start_reach_m", "start_s", "start_sigma_m", "start_sigma_mps"), WITH_PRIOR
        ),
    ),
    "robot": Case(
        "ekf",
        robot(),
        nothing={
            "sigma_heading_rad": "no robot has a compass",
            "bias_heading_rad": "no robot has a compass",
        },
    ),
    "sound-source": Case("ekf", Situation("sound-source")),
    "vehicle": Case("imm:ekf", drive()),
}
AUGMENTED = robot(estimate=["bias_range_m"], estimate_sigma={"bias_range_m": 0.5})
METHODS = {
    "common": Case(
        "ekf",
        robot(ADVERSE),
        {
            "mode": "drive",
            "estimate": ["bias_range_m"],
            "estimate_sigma": {"bias_range_m": 0.3},
            "estimate_drift": {"bias_range_m": 0.3},
            "estimate_time_s": {"bias_range_m": 3.0},
            "topics": {"range_bearing": ""},
            "of_topics": {"/robot1/range_bearing": {"sigma_range_m": 0.3}},
        },
        {
            "mode": drive(mode="manoeuvre"),
            **dict.fromkeys(("estimate_sigma", "estimate_drift", "estimate_time_s"), AUGMENTED),
        },
        {
            "sigma_fix_m": STATES_IT,
            "estimate": "it needs `estimate_sigma`, which is moved",
        },
    ),
    "ukf": Case("ukf", robot()),
    "lrkf": Case("lrkf", robot(), {"sampling": "gf-25"}, {"seed": robot(sampling="rukf-10")}),
    "sqrt:ukf": Case("sqrt:ukf", robot()),
    "smoother": Case(
        "smoother",
        robot(),
        {"forward": "ukf", "sampling": "gf-25"},
        {
            "kappa": robot(forward="ukf"),
            "sampling": robot(forward="lrkf"),
            "seed": robot(forward="lrkf", sampling="rukf-10"),
        },
    ),
    "smoother:iterated": Case(
        "smoother:iterated",
        robot(),
        {"iterations": 1},
        {"loss_scale": robot(loss="huber")},
        {
            "forward": "the name says it",
            **dict.fromkeys(("kappa", "sampling", "seed"), "it samples nothing"),
        },
    ),
    "imm": Case(
        "imm",
        drive(),
        {"filter": "ukf"},
        nothing=dict.fromkeys(("filter", "kappa", "sampling", "seed"), LINEAR),
    ),
    "bank": Case(
        "bank",
        body(WITHOUT_PRIOR, members=9),
        {"filter": "iekf", "members": 11},
        nothing=dict.fromkeys(
            ("kappa", "sampling", "seed"), "its filter is `ekf`; a smoother has them too"
        ),
    ),
    "particles": Case("particles", robot()),
    "bound": Case(
        "bound",
        robot(),
        {"gap_limit_s": 0.001},
        nothing={"gap_limit_s": "the truth is known at every stamp"},
    ),
}
FINGERS = {"subsets": ["finger"], "folds": 3}
BOUNDS = {
    "bound_deg": 2.5,
    "bearing_bound_rad": 0.05,
    "position_error_m": 0.1,
    "position_error_mps": 0.03,
    "heading_error_rad": 0.4,
    "heading_error_radps": 0.02,
}
FEW = {"duration_s": 2.0, "landmarks": 5, "range_bearing": {"rate_hz": 2.0}}
LOOKS = {"scene": "random", "looks": 2}
L4 = Situation("relative-bearings", {**LOOKS, "looks": 1}, {"shape": "l4"})
OWN = {
    "bingham-axis": directional("bingham-axis", "axis", [0.01, 0.02]),
    "bingham-orientation": directional("bingham-orientation", "orientation", [0.01, 0.02, 0.02, 0.03]),
    "cooperative": Case(
        "cooperative", robot({**SEEN, "robots": 3, "robots_see_each_other": True}), {"anchors": [1, 2]}
    ),
    "gm-phd": Case(
        "gm-phd",
        vehicles(),
        {"sensor": "network", "prune_weight": 0.01, "most_components": 5},
        nothing={"variance_m2": "it is the square of sigma_m, which the case states"},
    ),
    "kalman-axis": directional("kalman-axis", "axis", [0.01, 0.02]),
    "kalman-orientation": directional("kalman-orientation", "orientation", [0.01, 0.02, 0.02, 0.03]),
    "los-biases": Case(
        "los-biases", Situation("optical-los", {"passes": 3}), {"known_bias_deg": {"sensor_2_roll": 0.0}}
    ),
    "los-positions": Case("los-positions", Situation("optical-los", {"passes": 3})),
    "network": Case(
        "network",
        nodes(),
        {"liar": 1},
        dict.fromkeys(("lie_m", "lie_after_s"), nodes(liar=1)),
    ),
    "score-classifier": Case(
        "score-classifier",
        scores(**FINGERS),
        {"subsets": ["face"], "logarithmic": ["finger"], "impostor_limit": 100},
        {
            "impostor_limit": scores(**FINGERS, pairs="all"),
            "neighbours": scores(**FINGERS, classifier="knn"),
            "failures": scores(subsets=["face"], folds=3),
        },
    ),
    "score-mixture": Case(
        "score-mixture",
        scores(**FINGERS, iterations=4),
        {
            "subsets": ["face"],
            "logarithmic": ["finger"],
            "impostor_limit": 100,
            "components_of": {"finger": 1},
        },
        {
            "impostor_limit": scores(**FINGERS, pairs="all"),
            "failures": scores(subsets=["face"], folds=3),
            "topology": scores(subsets=["all"], folds=2, iterations=2),
        },
    ),
    "score-rule": Case("score-rule", scores(), {"subsets": ["face"]}),
    "set-filter": Case(
        "set-filter",
        robot(FEW, **BOUNDS),
        {"arena_m": [-2.0, -2.0, 2.0, 2.0], "most_edges": 1, "anchor_s": 0.5, "weighting": "equal"},
        {
            **dict.fromkeys(("weighting", "sweeps"), robot(FEW, **BOUNDS, shape="l4")),
            "most_edges": robot(FEW, **BOUNDS, anchor_s=0.5),
        },
    ),
    "set-membership": Case(
        "set-membership",
        Situation("relative-bearings", LOOKS),
        {"arena_m": [-1.0, -1.0, 1.0, 1.0]},
        dict.fromkeys(("weighting", "sweeps"), L4),
    ),
    "shooter": Case(
        "shooter",
        Situation("acoustic-shots", {"shots": 2}),
        under={
            "cross_covariances": Situation("acoustic-shots", {"shots": 2}, {"mode": "local-estimates"})
        },
    ),
    "torus": Case("torus", Situation("torus-headings", {"steps": 10})),
    "tracker": Case(
        "tracker",
        targets(),
        {
            "birth_distance_m": 500.0,
            "mode": "drive",
            "motion": {"turn_rate_radps": 0.2},
            "silence_s": 1.5,
            "false_confirmation": 0.2,
            "sensors": ["radar"],
            "model": "vehicle",
            "same_within_m": 500.0,
            "same_within_mps": 100.0,
            "most_tracks": 1,
            "joined_within_m": 60.0,
            "interval_s": 2.0,
        },
        {
            **dict.fromkeys(("mode", "motion"), targets(model="vehicle", motion=MOTION)),
            **dict.fromkeys(("management", "hits_needed", "chances"), HITS),
            **dict.fromkeys(
                ("false_confirmation", "missed_confirmation"),
                targets(association="jpda", management="score"),
            ),
            **dict.fromkeys(
                ("far_range_m", "far_detection_probability", "far_clutter_factor"),
                targets(
                    near_range_m=50.0,
                    far_range_m=600.0,
                    far_detection_probability=0.5,
                    far_clutter_factor=2.0,
                ),
            ),
            **dict.fromkeys(
                (
                    *("sector_from_rad", "sector_to_rad"),
                    *("sector_detection_factor", "sector_clutter_factor"),
                ),
                targets(
                    sector_from_rad=-2.0,
                    sector_to_rad=1.0,
                    sector_detection_factor=0.5,
                    sector_clutter_factor=2.0,
                ),
            ),
            **dict.fromkeys(
                ("blind_from_rad", "blind_to_rad"), targets(blind_from_rad=-2.0, blind_to_rad=1.0)
            ),
            "correlation_s": targets(correlated_sigma_m=5.0),
        },
        {
            "sensors": "the scenario has one",
            "model": "it needs `motion`, which is moved",
            **dict.fromkeys(
                (
                    *("sigma_rad", "sigma_across_m", "bias_rad", "clutter_per_rad"),
                    *("registration_sigma_rad", "correlated_sigma_rad"),
                ),
                "the scenario's radar measures places, not bearings",
            ),
            "bias_range_m": "the scenario's radar measures places, not ranges",
        },
    ),
    "ukf-torus": Case("ukf-torus", Situation("torus-headings", {"steps": 10})),
    "vehicle-particles": Case("vehicle-particles", vehicles(), {"method": "set-50"}),
    "vehicles": Case(
        "vehicles",
        vehicles(),
        {"method": "set", "registration_scan": 3},
        {"registration_scan": vehicles(method="hungarian-registration")},
        {"sigma_fix_m": STATES_IT},
    ),
}
