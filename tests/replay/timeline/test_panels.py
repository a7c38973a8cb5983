"""What panels of a timeline show first and at their edges, as any reader of the file gets it."""

from pathlib import Path

import numpy as np
import pytest
import rerun.blueprint as rrb
import rerun.chunk as rc

from fuselog.recorders.log import RunMetadata, Stream, make_stream, schemas
from fuselog.recorders.models.states import state_metadata
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.judging.errors.evaluation import chi_square_interval
from fuselog.replay.judging.judge import Judge
from fuselog.replay.timeline.drawing.plots import in_strips
from fuselog.replay.timeline.show import show
from tests.replay.timeline.test_timeline import read, told, views

SECONDS = np.arange(50)
STAMPS = SECONDS * 10**9
LOW, BAND = chi_square_interval(1, 1)


def layout(path: Path) -> dict[str, dict[str, list]]:
    """The parts of a file's layout by their path, each with what is stated of it."""
    reader = rc.RrdReader(str(path))
    found: dict[str, dict[str, list]] = {}
    for chunk in reader.stream(store=reader.blueprints()[0]):
        batch = chunk.to_record_batch()
        part = found.setdefault("/".join(chunk.entity_path.strip("/").split("/")[:2]), {})
        part |= {name: batch.column(name)[0].as_py() for name in batch.schema.names}
    return found


def range_of(path: Path, plot: str) -> tuple[float, float]:
    """The range of the plot of an entity."""
    origin = "ViewBlueprint:space_origin"
    [part] = [part for part in layout(path).values() if part.get(origin) == [plot]]
    return tuple(part["ScalarAxis:range"][0])


def innovations(squared: np.ndarray, accepted: np.ndarray) -> Stream:
    return make_stream(
        "/estimates/ekf/innovation",
        schemas.INNOVATION,
        STAMPS,
        metadata={**state_metadata(["room_degC"]), "truth": "/truth"},
        target_id=np.zeros(50, np.int64),
        accepted=accepted.astype(np.int64),
        innovation=np.ones((50, 1)),
        covariance=np.ones((50, 1)),
        normalised_innovation_squared=squared,
        log_likelihood=np.zeros(50),
    )


def a_room(path: Path, inside: int = 50) -> Path:
    """The timeline of a room's temperature, 20 to 24 degrees; so many innovations are as they should."""
    squared = np.where(inside > SECONDS, 0.5, 5062.0)
    degrees = 20.0 + 4.0 * SECONDS[:, None] / 49.0
    estimate = make_stream(
        "/estimates/ekf/state",
        schemas.GAUSSIAN_ESTIMATE,
        STAMPS,
        metadata={**state_metadata(["room_degC"]), "truth": "/truth"},
        sensor_time_ns=STAMPS,
        mean=degrees,
        covariance=np.ones((50, 1)),
    )
    truth = make_stream(
        "/truth", schemas.TRUTH_STATE, STAMPS, metadata=state_metadata(["room_degC"]), state=degrees
    )
    sensors = [
        make_stream(
            f"/{name}",
            schemas.VECTOR_MEASUREMENT,
            stamps,
            metadata={"components": "room_degC"},
            value=degrees[: len(stamps)],
        )
        for name, stamps in (("window", STAMPS), ("door", STAMPS[:45] + 1))
    ]
    source = MemorySource(
        {each.topic: each for each in (truth, *sensors)}, RunMetadata("own", epoch_ns=0), "own"
    )
    outputs = [estimate, innovations(squared, squared < 1.0)]
    show(source, {each.topic: gather([each]) for each in outputs}, [], save=path)
    return path


def test_what_is_above_a_panel_is_marked_and_counted(tmp_path: Path) -> None:
    """The values themselves are all there; who zooms out sees them."""
    path = a_room(tmp_path / "nis.rrd", inside=40)
    found = read(path)
    assert np.ravel(found["/plots/nis_1/ekf"]["Scalars:scalars"]).max() == 5062.0
    above = found["/plots/nis_1/ekf\\ above"]
    assert above["sim_time"] == STAMPS[40:].tolist()
    assert np.ravel(above["Scalars:scalars"]) == pytest.approx(0.98 * 2.5 * BAND)
    assert f"NIS of 1 component (-); above {2.5 * BAND:.3g}: ekf 10 of 50" in views(path)
    assert range_of(path, "plots/nis_1")[1] == pytest.approx(2.5 * BAND)


def test_a_panel_ends_above_what_is_beyond_the_band_throughout(tmp_path: Path) -> None:
    path = a_room(tmp_path / "nis.rrd", inside=5)
    assert "/plots/nis_1/ekf\\ above" not in read(path)
    assert f"NIS of 1 component (-); 95 % within {LOW:.3g} to {BAND:.3g}" in views(path)
    assert range_of(path, "plots/nis_1")[1] == 10_000.0


def test_what_an_own_model_estimates_comes_first_below_its_legend(tmp_path: Path) -> None:
    path = a_room(tmp_path / "room.rrd")
    low, high = range_of(path, "plots/room_degC")
    assert low == pytest.approx(20.0 - 0.05 * 4.0)
    assert high - 24.0 > 0.25 * (high - low)
    parts, contents = layout(path), "ContainerBlueprint:contents"
    boards = [[parts[each] for each in part[contents]] for part in parts.values() if contents in part]
    named = [[each.get("ContainerBlueprint:display_name") for each in board] for board in boards]
    assert [["state"], ["window"], ["door"]] in named


def test_events_name_the_topic_of_what_was_gated(tmp_path: Path) -> None:
    """That with a message of its stamp; a sensor has no target 0."""
    said = told(read(a_room(tmp_path / "room.rrd", inside=48))["/events/ekf"])
    assert said == ["ekf: rejected window: NIS 5062.0"] * 2


def test_many_components_are_in_tabs_by_quantity() -> None:
    """The axes of a vector are together, single numbers up to four; six fit without tabs."""
    vectors = [f"{stem}{axis}_{unit}" for stem, unit in (("", "m"), ("v", "mps")) for axis in "xyz"]
    biases = [f"sensor_1_{angle}_bias_rad" for angle in ("yaw", "pitch", "roll")]
    sizes = ["half_x_m", "half_y_m"]
    rooms = [f"{room}_degC" for room in ("room", "door", "window", "wall", "roof")]
    names = [*vectors, *biases, *sizes, *rooms]
    views = {name: rrb.TimeSeriesView(name=name) for name in names}
    few = in_strips({name: views[name] for name in names[:6]}, "state")
    assert [each.name for each in few.contents] == names[:6]
    tabs = in_strips(views, "state")
    assert [(tab.name, [view.name for view in tab.contents]) for tab in tabs.contents] == [
        ("position", names[:3]),
        ("velocity", names[3:6]),
        ("sensor 1 bias", biases),
        ("half size", sizes),
        ("room to wall", rooms[:4]),
        ("roof", rooms[4:]),
    ]


@pytest.mark.parametrize(
    ("named", "axis"),
    [
        # a refuted estimator does not set the range, although its errors are smaller
        ({"right": (30.0, 900.0), "sure": (5.0, 0.01)}, "axis to ±100, bands ±2 sigma"),
        # of two that are not refuted, the more accurate one does, and the other is said to be outside
        (
            {"right": (3.0, 9.0), "wide": (30.0, 900.0)},
            "axis to ±10, bands ±2 sigma; outside: wide 50 of 50",
        ),
    ],
)
def test_an_error_plot_has_room_for_who_is_right(
    named: dict[str, tuple[float, float]], axis: str, tmp_path: Path
) -> None:
    told = state_metadata(["x_m"])
    truth = make_stream("/truth", schemas.TRUTH_STATE, STAMPS, metadata=told, state=np.zeros((50, 1)))
    outputs = {
        f"/estimates/{name}/state": gather(
            [
                make_stream(
                    f"/estimates/{name}/state",
                    schemas.GAUSSIAN_ESTIMATE,
                    STAMPS,
                    metadata={**told, "truth": "/truth"},
                    mean=np.full((50, 1), error),
                    covariance=np.full((50, 1), variance),
                )
            ]
        )
        for name, (error, variance) in named.items()
    }
    source = MemorySource({truth.topic: truth}, RunMetadata("own", epoch_ns=0), "own")
    errors = [each for each in Judge([source], {}, gap_limit_s=2.0).add(outputs).errors if each]
    show(source, outputs, errors, save=tmp_path / "two.rrd")
    assert f"Error of x (m), {axis}" in views(tmp_path / "two.rrd")


def test_many_nis_without_errors_leave_no_empty_container(tmp_path: Path) -> None:
    """Each of the seven sets of measured components has a plot, which is more than are seen at once."""
    patterns = np.array(
        [[1.0 if number >> axis & 1 else np.nan for axis in range(3)] for number in range(1, 8)]
    )
    names = ["room_degC", "door_degC", "wall_degC"]
    innovation = make_stream(
        "/estimates/ekf/innovation",
        schemas.INNOVATION,
        STAMPS[:7],
        metadata=state_metadata(names),
        target_id=np.zeros(7, np.int64),
        accepted=np.ones(7, np.int64),
        innovation=patterns,
        covariance=np.tile(np.eye(3).ravel(), (7, 1)),
        normalised_innovation_squared=np.ones(7),
        log_likelihood=np.zeros(7),
    )
    told = state_metadata(names)
    truth = make_stream("/truth", schemas.TRUTH_STATE, STAMPS, metadata=told, state=np.zeros((50, 3)))
    source = MemorySource({truth.topic: truth}, RunMetadata("own", epoch_ns=0), "own")
    show(source, {innovation.topic: gather([innovation])}, [], save=tmp_path / "nis.rrd")
    contents = "ContainerBlueprint:contents"
    assert sum("NIS" in name for name in views(tmp_path / "nis.rrd")) == 7
    assert all(part.get(contents, True) for part in layout(tmp_path / "nis.rrd").values())


def test_a_long_scatter_of_nis_keeps_its_middle(tmp_path: Path) -> None:
    """Three measurements a stamp: extremes of spans of time would leave out the middle one."""
    count = 3 * 4000
    innovation = make_stream(
        "/estimates/ekf/innovation",
        schemas.INNOVATION,
        np.repeat(np.arange(4000) * 10**8, 3),
        metadata={**state_metadata(["room_degC"]), "truth": "/truth"},
        target_id=np.zeros(count, np.int64),
        accepted=np.ones(count, np.int64),
        innovation=np.ones((count, 1)),
        covariance=np.ones((count, 1)),
        normalised_innovation_squared=np.tile([0.1, 1.0, 4.0], 4000),
        log_likelihood=np.zeros(count),
    )
    truth = make_stream(
        "/truth",
        schemas.TRUTH_STATE,
        STAMPS,
        metadata=state_metadata(["room_degC"]),
        state=np.zeros((50, 1)),
    )
    source = MemorySource({truth.topic: truth}, RunMetadata("own", epoch_ns=0), "own")
    show(source, {innovation.topic: gather([innovation])}, [], save=tmp_path / "nis.rrd")
    drawn = np.ravel(read(tmp_path / "nis.rrd")["/plots/nis_1/ekf"]["Scalars:scalars"])
    for value in (0.1, 1.0, 4.0):
        assert np.mean(drawn == value) == pytest.approx(1 / 3, abs=0.03)


def test_a_single_estimate_is_a_point_between_the_ends_of_its_band(tmp_path: Path) -> None:
    told = state_metadata(["x_m", "y_m"])
    truth = make_stream("/truth", schemas.TRUTH_STATE, STAMPS[:1], metadata=told, state=[[2, 7]])
    told = {**told, "truth": "/truth"}
    estimate = make_stream(
        "/estimates/ekf/state",
        schemas.GAUSSIAN_ESTIMATE,
        STAMPS[:1],
        metadata=told,
        mean=[[5, 8]],
        covariance=[[4, 0, 0, 4]],
    )
    source = MemorySource({truth.topic: truth}, RunMetadata("own", epoch_ns=0), "own")
    outputs = {estimate.topic: gather([estimate])}
    errors = [each for each in Judge([source], {}, gap_limit_s=2.0).add(outputs).errors if each]
    show(source, outputs, errors, save=tmp_path / "one.rrd")
    moving = read(tmp_path / "one.rrd")
    assert moving["/plots/error_x_m/ekf"]["Scalars:scalars"] == [[3.0, -4.0, 4.0]]
    assert moving["/close/ekf/place"]["Points2D:positions"] == [[[3.0, 1.0]]]  # seen close up
    for name, place in (("truth", [2.0, 7.0]), ("ekf", [5.0, 8.0])):  # which has no path on the map
        assert moving[f"/map/{name}/place"]["Points2D:positions"] == [[place]]
    still = read(tmp_path / "one.rrd", static=True)
    judged = still["/close/judged"]["Points2D:labels"]
    assert judged == [["ekf: NEES 2.5, 95 % within 0.0506 to 7.38"]]
    assert "SeriesPoints:markers" in still["/plots/error_x_m/ekf"]
    assert "SeriesPoints:names" in still["/plots/nees_2/ekf"]
