"""A log of known numbers, drawn by schema and read back: colours, units, clocks, and what happened."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from fuselog.recorders.log import RunMetadata, Stream, make_stream, schemas
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.judging.judge import Judge
from fuselog.replay.timeline.drawing.canvas import MUTED, PALETTE, TRUTH, Colour, gap_limit_ns
from fuselog.replay.timeline.show import Drawing
from tests.replay.timeline.test_timeline import Columns, read, told

SECOND = 10**9
BEGIN_NS = 1_800_000_000 * SECOND
STAMPS = BEGIN_NS + SECOND // 2 * np.arange(8)
STATE = {"components": "x_m,heading_rad", "kinds": "linear,angle"}
TRUE = np.stack([np.arange(8.0), np.full(8, 3.1)], axis=1)
COVARIANCE = np.array([[0.04, 0.01], [0.01, 0.09]])
ERRORS = {"one": np.array([0.5, 0.2]), "two": np.array([-0.25, -0.1])}
# Latitudes and longitudes, and standard deviations of fixes with the colours of these.
DEGREES = np.stack([48.0 + 1e-5 * np.arange(4), 11.0 - 2e-5 * np.arange(4)], axis=1)
SIGMAS_M = np.array([0.01, 0.2, 2.0, 20.0])


def state(name: str) -> Stream:
    mean = TRUE + ERRORS[name]
    mean[:, 1] = np.angle(np.exp(1j * mean[:, 1]))
    return make_stream(
        f"/estimates/{name}/state",
        schemas.GAUSSIAN_ESTIMATE,
        STAMPS,
        metadata={**STATE, "truth": "/truth"},
        mean=mean,
        covariance=np.tile(COVARIANCE.ravel(), (8, 1)),
    )


def happened(leaf: str, schema: schemas.Schema, at: int) -> Stream:
    metadata = {"reasons": json.dumps(["for no reason", f"because of {leaf}"])}
    return make_stream(f"/estimates/one/{leaf}", schema, STAMPS[[at]], metadata=metadata, reason=[1])


def sensed() -> list[Stream]:
    spread = np.zeros((4, 9))
    spread[:, [0, 4, 8]] = SIGMAS_M[:, None] ** 2
    quality = np.array([5.0, 5.0, 1.0, 1.0])
    return [
        make_stream("/truth", schemas.TRUTH_STATE, STAMPS, metadata=STATE, state=TRUE),
        make_stream(
            "/gps",
            schemas.GEODETIC_FIX,
            STAMPS[:4],
            latitude_deg=DEGREES[:, 0],
            longitude_deg=DEGREES[:, 1],
            altitude_m=np.zeros(4),
            covariance_m2=spread,
        ),
        make_stream(
            "/receiver",
            schemas.VECTOR_MEASUREMENT,
            STAMPS[:4],
            metadata={"components": "age_s,quality"},
            value=np.stack([np.arange(4.0), quality], axis=1),
        ),
        make_stream(
            "/wheels",
            schemas.ODOMETRY,
            BEGIN_NS + SECOND * np.array([0, 1, 2, 3, 30, 31]),
            forward_mps=np.arange(6.0),
            turn_radps=np.full(6, 0.5),
        ),
    ]


def estimated() -> list[Stream]:
    return [
        *map(state, ERRORS),
        happened("started", schemas.STARTED, 0),
        happened("diagnosed", schemas.DIAGNOSED, 1),
        happened("skipped", schemas.SKIPPED, 2),
        happened("failure", schemas.FAILURE, 3),
        make_stream(
            "/estimates/one/fault",
            schemas.RELATIVE_BEARING,
            STAMPS[[4]],
            first_id=[3],
            second_id=[8],
            angle_rad=[0.5],
        ),
    ]


def drawn(path: Path, source: list[Stream], made: list[Stream], sides: Sequence[str] = ()) -> Path:
    run = RunMetadata("unheard-of", epoch_ns=int(source[0].publish_time_ns[0]))
    log = MemorySource({each.topic: each for each in source}, run, "known")
    outputs = {each.topic: gather([each]) for each in made}
    errors = [each for each in Judge([log], {}, gap_limit_s=1.0).add(outputs).errors if each is not None]
    with Drawing(log, identity="known", save=path, sides=sides) as drawing:
        drawing.add({each.topic: each for each in made}, errors)
    return path


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drawn(tmp_path_factory.mktemp("known") / "run.rrd", sensed(), estimated())


@pytest.fixture(scope="module")
def moving(place: Path) -> dict[str, Columns]:
    return read(place)


def packed(colour: Colour) -> int:
    return int.from_bytes(bytes(colour), "big")


def scalars(columns: Columns) -> np.ndarray:
    return np.ravel(columns["Scalars:scalars"])


def test_truth_has_a_colour_that_no_estimator_has_and_each_has_its_own(place: Path) -> None:
    of = {"truth": TRUTH, **dict(zip(ERRORS, PALETTE, strict=False)), "bounds": MUTED}
    assert len({*of.values()}) == 4
    found: dict[str, set[int]] = {}
    for entity, columns in read(place, static=True).items():
        name = entity.rpartition("/")[2]
        rows = [rows for key, rows in columns.items() if key.endswith(":colors")]
        if name in of and rows:
            found.setdefault(name, set()).update(each >> 8 for each in rows[0][0])
    assert found == {name: {packed(colour)} for name, colour in of.items()}


def test_curves_are_in_the_unit_of_their_panel_at_their_stamps(moving: dict[str, Columns]) -> None:
    for column, (component, scale) in enumerate((("x_m", 1.0), ("heading_rad", 180.0 / np.pi))):
        truth = moving[f"/plots/{component}/truth"]
        np.testing.assert_allclose(scalars(truth), scale * TRUE[:, column])
        for name, error in ERRORS.items():
            mean = scale * state(name)["mean"][:, column]
            curve = moving[f"/plots/{component}/{name}"]
            np.testing.assert_allclose(scalars(curve), mean)
            assert curve["utc"] == STAMPS.tolist()
            assert curve["sim_time"] == (STAMPS - BEGIN_NS).tolist()
            assert curve["step"] == list(range(8))
            off = moving[f"/plots/error_{component}/{name}"]
            values = np.array(off["Measurements:values"])[:, 0]
            np.testing.assert_allclose(values, scale * error[column], rtol=1e-9)
            band = np.sqrt(np.array(off["Measurements:variances"])[:, 1])
            np.testing.assert_allclose(band, 2.0 * scale * np.sqrt(COVARIANCE[column, column]))
    for name, error in ERRORS.items():
        nees = error @ np.linalg.inv(COVARIANCE) @ error
        np.testing.assert_allclose(scalars(moving[f"/plots/nees_2/{name}"]), nees, rtol=1e-9)


def test_each_number_of_a_sensor_is_a_curve_under_its_name(moving: dict[str, Columns]) -> None:
    receiver, wheels = sensed()[2:]
    for column, name in enumerate(("age_s", "quality")):
        curve = moving[f"/plots/receiver/value/{name}"]
        np.testing.assert_allclose(scalars(curve), receiver["value"][:, column])
    forward, turn = (moving[f"/plots/wheels/{each}/{each}"] for each in ("forward_mps", "turn_radps"))
    np.testing.assert_allclose(scalars(forward), wheels["forward_mps"])
    np.testing.assert_allclose(scalars(turn), np.degrees(wheels["turn_radps"]))


def test_fixes_lie_where_they_are_in_the_colour_of_their_deviation(moving: dict[str, Columns]) -> None:
    fixes = moving["/geodetic/gps"]
    np.testing.assert_allclose(np.array(fixes["GeoPoints:positions"])[:, 0], DEGREES)
    colours = [packed((180, 255, 120)), packed((130, 190, 85)), packed((90, 135, 60))]
    assert not {*colours} & {packed(colour) for colour in PALETTE}
    found = [each >> 8 for (each,) in fixes["GeoPoints:colors"]]
    assert found[1:3] == colours[1:]
    assert found[0] == colours[0]
    assert found[3] not in colours


def test_all_that_happens_is_told_at_its_stamp_with_its_level(moving: dict[str, Columns]) -> None:
    """Of a receiver's quality the changes; of a sensor that is silent when that begins."""
    events = moving["/events/one"]
    levels = [level for (level,) in events["TextLog:level"]]
    said = sorted(zip(events["utc"], levels, told(events), strict=True))
    assert said == [
        (STAMPS[0], "INFO", "one: because of started"),
        (STAMPS[1], "WARN", "one: because of diagnosed"),
        (STAMPS[2], "WARN", "one: not used: because of skipped"),
        (STAMPS[3], "ERROR", "one: failed: because of failure"),
        (STAMPS[4], "ERROR", "one: empty set, caused by the pair 3, 8"),
    ]
    quality = moving["/events/receiver"]
    assert quality["utc"] == STAMPS[[0, 2]].tolist()
    assert told(quality) == ["receiver: solution single", "receiver: solution fixed"]
    silent = moving["/events/wheels"]
    assert silent["utc"] == [BEGIN_NS + 3 * SECOND]
    assert told(silent) == ["wheels: no messages for 27.0 s"]


def test_pauses_between_bursts_are_no_silence() -> None:
    """Shots with echoes, four times as long apart once; a sensor with a rate is missed as before."""
    shots = np.cumsum([0, 5, 5, 5, 20, 5, 5, 5]) * SECOND
    echoes = np.array([0, 80, 130, 290]) * 1_000_000
    assert np.diff(shots).max() < gap_limit_ns((shots[:, None] + echoes).ravel()) < 30 * SECOND
    rated = np.delete(np.arange(60), np.arange(20, 50)) * SECOND
    jittered = rated + np.arange(len(rated)) % 3 * 50_000_000
    assert gap_limit_ns(rated) == 5 * SECOND < gap_limit_ns(jittered) < 6 * SECOND


def test_stamps_that_are_no_dates_have_those_of_the_recorder(tmp_path: Path) -> None:
    """Its clock gains a tenth: half a second is 0.55 s there; the run's own time stays."""
    simulated = []
    for stream in [*sensed()[:1], *map(state, ERRORS)]:
        since = stream.publish_time_ns - BEGIN_NS
        columns = {name: stream[name] for name in stream.columns if name != "sensor_time_ns"}
        late = BEGIN_NS + 11 * since // 10
        simulated.append(
            make_stream(
                stream.topic,
                stream.schema,
                since + SECOND,
                log_time_ns=late,
                metadata=stream.metadata,
                **columns,
            )
        )
    path = drawn(tmp_path / "run.rrd", simulated[:1], simulated[1:])
    curve = read(path)["/plots/x_m/one"]
    assert curve["sim_time"] == (SECOND // 2 * np.arange(8)).tolist()
    assert curve["utc"] == (BEGIN_NS + 11 * SECOND // 20 * np.arange(8)).tolist()


def test_beside_each_other_the_second_errs_by_less(tmp_path: Path) -> None:
    path = drawn(tmp_path / "run.rrd", sensed(), estimated(), ("one", "two"))
    curve = read(path)["/plots/difference/two\\ -\\ one"]
    np.testing.assert_allclose(scalars(curve), 0.25 - 0.5)
