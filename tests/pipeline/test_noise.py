"""Noise of sensors: the reference sheet's numbers, what is found, said, written and refused."""

import io
import json
import math
import re
import tarfile
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import fuselog as fl
from fuselog.pipeline.sensing import exports, study
from fuselog.pipeline.sensing.allan import allan_deviation, degrees_of_freedom
from fuselog.pipeline.sensing.fitting import choose, fit, intervals, walk_below
from fuselog.pipeline.sensing.likelihood import Samples, likelihood
from fuselog.pipeline.sensing.noise import _drifts, parse_sheet
from fuselog.pipeline.sensing.preparing import (
    Drift,
    check_at_rest,
    find_drift,
    find_vibration,
    samples_of,
    white_block,
)
from fuselog.pipeline.sensing.terms import Terms
from tests.claims.pages import stored
from tests.goldens import keeping
from tests.pipeline.conftest import Said

STEP_S = 0.02
ALL = Terms(1e-3, 1e-4, 4e-4, 20.0, 2e-5)


def unit(seed: int, size: int = 65536, terms: Terms = ALL, step_s: float = STEP_S) -> np.ndarray:
    """The sheet's simulated unit (n,)."""
    return study.unit(seed, size, terms, step_s)


@pytest.fixture(scope="module")
def walking() -> np.ndarray:
    """Unit WK, seed 1."""
    return unit(1, terms=Terms(1e-3, 1e-4))


def test_samples_that_follow_each_other_are_averaged_until_they_are_white() -> None:
    """How many and for how long is said, and of the white noise nothing is lost."""
    rng, step_s = np.random.default_rng(0), 0.02
    smooth = np.convolve(rng.normal(size=8_002), [0.25, 0.5, 0.25], "valid")
    stamps = np.rint(1e9 * step_s * np.arange(len(smooth))).astype(np.int64)
    columns = {"target_id": np.ones(len(smooth)), "range_m": smooth}
    stream = fl.make_stream("/range", fl.schemas.RANGE, stamps, **columns)
    source = fl.MemorySource({stream.topic: stream}, fl.RunMetadata("made", {}), "made")
    [found] = fl.noise(source).columns
    assert found.block > 2
    said = f"samples are correlated; means of {found.block} samples ({found.block * step_s:.3g} s) are"
    assert any(said in note for note in found.notes)
    assert found.numbers["white"].value == pytest.approx(step_s**0.5, rel=0.1)


def test_allan_deviation_is_the_sheets() -> None:
    multiples = np.array([1, 2, 5, 10, 50, 100, 500, 1000, 5000, 10000, 20000])
    found = allan_deviation(unit(1), STEP_S, multiples)
    expected = [
        *(0.00728406572105, 0.00506446640573, 0.00317272205932, 0.00225764014447, 0.00104432521182),
        *(0.000715291270883, 0.000424044094043, 0.000445851425601, 0.000530059636167),
        *(0.000786141278771, 0.0013542075859),
    ]
    assert found.deviations == pytest.approx(expected, rel=1e-9)
    degrees = [
        degrees_of_freedom(ALL, STEP_S, int(m), int(pairs))
        for m, pairs in zip(multiples, found.pairs, strict=True)
    ]
    expected = [
        *(43137.5, 37545.9, 18957.4, 9796.35, 1974.92, 994.66, 190.765, 81.8306, 11.9316),
        *(4.75428, 1.62958),
    ]
    assert degrees == pytest.approx(expected, rel=5e-6)


@pytest.mark.parametrize(
    ("terms", "expected"),
    [
        (Terms(white=1.0), [43690.2, 9706.96, 980.683, 96.0613, 7.67306]),
        (Terms(walk=1.0), [65535, 6107.13, 606.122, 59.2264, 4.56379]),
        (Terms(quantisation=1.0), [33704, 33697.1, 33628.4, 32942.8, 26400.7]),
    ],
)
def test_degrees_of_freedom_are_exact(terms: Terms, expected: list[float]) -> None:
    found = [degrees_of_freedom(terms, STEP_S, m, 65537 - 2 * m) for m in (1, 10, 100, 1000, 10000)]
    assert found == pytest.approx(expected, rel=5e-6)


def test_gaps_count_whole_windows_by_stamps(walking: np.ndarray) -> None:
    lost = np.random.Generator(np.random.Philox(key=77)).random(65536) < 0.1
    lost[0] = False
    values = np.where(lost, np.nan, walking)
    found = allan_deviation(values, STEP_S, np.array([5]))
    assert found.pairs[0] == 22797
    assert found.deviations[0] == pytest.approx(0.00313284159734, rel=1e-9)
    fitted = fit(samples_of(values, STEP_S), ("walk",))
    assert fitted.terms[:2] == pytest.approx([9.99584e-4, 1.10109e-4], rel=1e-4)


def test_likelihood_is_the_dense_one() -> None:
    values, steps = unit(1)[:, None].copy(), np.ones(65536, np.int64)
    found = likelihood(Samples(values, steps, STEP_S), ALL).log_likelihood
    assert found == pytest.approx(230127.207494, abs=1e-4)
    without = ALL._replace(quantisation=0.0)
    found = likelihood(Samples(values, steps, STEP_S), without).log_likelihood
    assert found == pytest.approx(230088.170998, abs=1e-4)
    first = likelihood(Samples(values[:200].copy(), steps[:200], STEP_S), ALL)
    assert first.log_likelihood == pytest.approx(683.303488791, abs=1e-7)


@pytest.mark.paper
def test_the_likeliest_noise_and_its_interval(walking: np.ndarray) -> None:
    samples = samples_of(walking, STEP_S)
    found = choose(samples)
    assert found.free == ("white", "walk")
    assert (
        np.log(found.terms[:2]) == pytest.approx(np.log([9.99815291e-4, 1.119811e-4]), abs=1e-4 * 0.0028)
        or abs(found.terms.walk / 1.119811e-4 - 1) < 1e-4 * 0.1175
    )
    assert found.log_likelihood == pytest.approx(231458.393072, abs=1e-4)
    assert found.sigmas == pytest.approx([0.002765, 0.117495], rel=1e-3)
    ends = intervals(samples, found)
    assert ends["white"] == pytest.approx((9.9442081e-4, 1.0052586e-3), rel=1e-5)
    assert ends["walk"] == pytest.approx((8.9022984e-5, 1.4102172e-4), rel=1e-4)


def test_a_walk_that_is_not_there_has_a_bound() -> None:
    samples = samples_of(unit(3, 8192, Terms(1e-3)), STEP_S)
    found = choose(samples)
    assert found.free == ("white",)
    assert 1e-6 < walk_below(samples, found) < 3e-4


@pytest.mark.paper
def test_bic_tells_a_walk_from_gauss_markov_noise() -> None:
    kinds = {
        ("white",): Terms(1e-3),
        ("white", "walk"): Terms(1e-3, 1e-4),
        ("white", "markov", "markov_time_s"): Terms(1e-3, 0.0, 6e-4, 60.0),
    }
    for free, terms in kinds.items():
        assert choose(samples_of(unit(7000, 16384, terms, 0.2), 0.2)).free == free


def test_warming_up_is_found_and_taken_out(walking: np.ndarray) -> None:
    times_s = STEP_S * np.arange(len(walking))
    assert find_drift(walking, STEP_S) is None
    warming = walking + 0.02 * np.exp(-times_s / 200)
    assert fit(samples_of(warming, STEP_S), ("walk",)).terms.walk == pytest.approx(1.6267e-4, rel=1e-4)
    drift = find_drift(warming, STEP_S)
    assert drift is not None
    assert drift.gain > 4.6
    rest = warming - drift.over(times_s)
    assert fit(samples_of(rest, STEP_S), ("walk",)).terms.walk < 1.3e-4


def test_a_filtered_sensor_is_averaged_until_white(walking: np.ndarray) -> None:
    assert white_block(walking, STEP_S) == 1
    filtered = np.convolve(walking, [0.25, 0.5, 0.25], "valid")
    assert white_block(filtered, STEP_S) > 2


def test_vibration_is_noticed(walking: np.ndarray) -> None:
    assert find_vibration(walking, STEP_S) is None
    shaken = walking + 1e-3 * np.sin(2 * np.pi * 7.3 * STEP_S * np.arange(len(walking)))
    frequency_hz, amplitude = find_vibration(shaken, STEP_S) or (0.0, 0.0)
    assert (frequency_hz, amplitude) == pytest.approx((7.3, 1e-3), rel=0.1)


@pytest.mark.parametrize("words", ["rad deg mdeg", "g mg ug", "m"])
def test_units_of_sheets_are_what_their_words_multiply_to(words: str) -> None:
    """Beside the column's unit white noise has s to the half, and a walk s to minus the half."""
    degree, g = np.pi / 180, 9.80665
    sizes = {"deg": degree, "mdeg": degree / 1e3, "g": g, "mg": g / 1e3, "ug": g / 1e6}
    field, power, rests = {
        "rad deg mdeg": (
            "turn_rate_radps",
            -1,
            "/s/sqrt(Hz) /sqrt(s) /sqrt(h) /h/sqrt(Hz) /s^2/sqrt(Hz) /s/sqrt(s) /s*sqrt(Hz) /h/sqrt(h)",
        ),
        "g mg ug": ("specific_force_mps2", -2, "/sqrt(Hz) /sqrt(s)"),
        "m": (
            "specific_force_mps2",
            -2,
            "/s^2/sqrt(Hz) /s/sqrt(s) /s/sqrt(h) /s^3/sqrt(Hz) /s^2/sqrt(s) /s^2*sqrt(Hz)",
        ),
    }[words]
    for word, rest in product(words.split(), rests.split()):
        by_seconds = []
        for s in (1.0, 4.0):
            known = {"s": s, "h": 3600 * s, "Hz": 1 / s, "sqrt": math.sqrt}
            acceleration = s**-2 if word in ("g", "mg", "ug") else 1.0
            by_seconds.append(acceleration * eval(f"1.0{rest.replace('^', '**')}", known))
        value = 3 * sizes.get(word, 1.0) * by_seconds[0]
        left = math.log(by_seconds[1] / by_seconds[0], 4.0) - power
        term = {0.5: "white", -0.5: "walk"}[round(left, 9)]
        for name in (field, "value"):  # of a field without a unit both quantities are tried
            assert parse_sheet(name, f"3 {word}{rest}") == (term, pytest.approx(value, rel=1e-12))
    half = parse_sheet("turn_rate_radps", "1 deg/s/sqrt(Hz) one-sided")
    assert half == ("white", pytest.approx(degree / np.sqrt(2)))


def rest(size: int = 4096, seconds: float = STEP_S, **changed: np.ndarray) -> fl.Stream:
    """A unit at rest."""
    stamps = np.rint(np.arange(size) * seconds * 1e9).astype(np.int64)
    force = np.stack([unit(seed, size, Terms(1e-2, 1e-3)) for seed in (4, 5, 6)], axis=1)
    turn = np.stack([unit(seed, size, Terms(1e-3)) for seed in (7, 8, 9)], axis=1)
    columns = {
        "specific_force_mps2": force + np.array([0, 0, 9.81]),
        "turn_rate_radps": turn,
        "magnetic_field_ut": np.full((size, 3), np.nan),
    }
    return fl.make_stream("/imu", fl.schemas.INERTIAL_SAMPLE, stamps, **columns | changed)


@pytest.mark.paper
@pytest.mark.usefixtures("blank_figures")
def test_the_command_writes_what_others_read(
    fuselog: Callable[..., Said], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    fl.write("rest.mcap", [rest()])
    said = fuselog(
        *("noise", "rest.mcap", "--topic", "/imu", "--json", "--out", "noise", "--tau", "1"),
        *("--sheet", "turn_rate_radps=0.05 deg/s/sqrt(Hz)"),
    )
    assert said.code == 0, said.err
    numbers = {(row["column"], row["term"]): row["value"] for row in said.json["numbers"]}
    white = max(
        numbers[f"/imu.turn_rate_radps.{axis}", "white noise N (rad/s/sqrt(Hz))"] for axis in "xyz"
    )
    assert white == pytest.approx(1e-3, rel=0.05)
    assert sum("times this value" in note for note in said.json["notes"]) == 3
    none_found = [note for note in said.json["notes"] if "no random walk found; K <" in note]
    assert sum("turn_rate" in note for note in none_found) == 3
    lines = Path("noise/px4.params").read_text().splitlines()
    px4 = dict(line.split() for line in lines if not line.startswith("#"))
    assert float(px4["EKF2_GYR_NOISE"]) == pytest.approx(10 * white, rel=1e-5)
    kalibr = Path("noise/kalibr-imu.yaml").read_text()
    assert f"gyroscope_noise_density: {white:.6g}" in kalibr
    walks = (row for row in said.json["numbers"] if row["term"] == "random walk K (rad/s/sqrt(s))")
    assert f"gyroscope_random_walk: {max(row['high'] for row in walks):.6g}" in kalibr  # no zero
    assert "# turn_rate_radps: no walk was found; K is its 95 % upper limit" in kalibr
    assert f"setGyroscopeCovariance(I_3x3 * {white**2:.6g})" in Path("noise/gtsam.cpp").read_text()
    shown = fuselog("info", "noise/timeline.rrd", "--json").json["entities"]
    drawn = {name.rpartition("/")[2].replace("\\", "") for name in shown if "/curves/5/" in name}
    assert {"measured", "95 % from", "95 % to", "fitted model"} <= drawn
    assert json.loads(Path("noise/result.json").read_text())["experiment"] == "noise"


def test_every_file_has_each_density_where_its_program_looks_for_it() -> None:
    """Force and rate, white noise and walk: four numbers, and a fifth for the rate of the samples."""
    force, rate = exports.Density(2.0, 3.0, 0.01), exports.Density(5.0, 7.0, 0.01)
    fields = {"specific_force_mps2": force, "turn_rate_radps": rate}
    told = exports.Densities("/imu", fields, ["doubtful"])
    texts = {name: write(told) for name, write in exports.FILES.items()}
    wanted = {
        "settings.toml": {
            "force_noise_density": 2, "force_bias_density": 3,
            "gyro_noise_density": 5, "gyro_bias_density": 7,
        },
        "kalibr-imu.yaml": {
            "update_rate": 100,
            "accelerometer_noise_density": 2, "accelerometer_random_walk": 3,
            "gyroscope_noise_density": 5, "gyroscope_random_walk": 7,
        },
        "px4.params": {
            "EKF2_ACC_NOISE": 20, "EKF2_ACC_B_NOISE": 30, "EKF2_GYR_NOISE": 50, "EKF2_GYR_B_NOISE": 70,
        },
        "gtsam.cpp": {
            "setAccelerometerCovariance": 4, "setBiasAccCovariance": 9,
            "setGyroscopeCovariance": 25, "setBiasOmegaCovariance": 49,
        },
        "robot_localization.yaml": {
            "linear_acceleration_covariance": 400, "angular_velocity_covariance": 2500,
            "turn rate": 49, "specific force": 9,
        },
    }  # fmt: skip
    assert texts.keys() == wanted.keys()
    for name, numbers in wanted.items():
        assert "doubtful" in texts[name].splitlines()[0]
        for word, value in numbers.items():
            [found] = re.findall(rf"\b{word}\W+(?:I_3x3 \* )?([\d.]+)", texts[name])
            assert float(found) == value, (name, word)


@pytest.mark.paper
def test_a_real_unit_is_compared_with_its_sheet_and_its_misfit_said(real_data: Path) -> None:
    """An ADIS16405 at rest, 10,000 s; read where it lies, and left there: its licence is CC BY-NC-SA."""
    archive = real_data / "sensors" / "sensors-data.tar.xz"
    if not archive.exists():
        pytest.skip(f"no {archive}")
    with tarfile.open(archive) as members:
        file = members.extractfile("./adis16405/imu1_blocks_of_20.npy")
        assert file is not None
        turn_radps = np.radians(np.load(io.BytesIO(file.read()))[:, 1].astype(float))
    found = fl.noise(study.at_rest(turn_radps, 0.2), study.TURN, sheet={"turn_radps": "2 deg/sqrt(h)"})
    assert any("the estimate is 1.28 (" in note for note in found.notes)
    assert len(found.densities.doubts) == 1


def test_noise_is_no_motion_and_a_slow_turn_is() -> None:
    """Whether a unit moves is told by means over a second."""
    noise = np.random.default_rng(1).normal(0.0, 0.6, 5000)  # m/s^2, twice what means may vary by
    check_at_rest("/imu", "specific_force_mps2", noise, STEP_S)
    turning = 0.6 * np.sin(0.3 * STEP_S * np.arange(5000))
    with pytest.raises(fl.BadInput, match="the unit moves"):
        check_at_rest("/imu", "specific_force_mps2", 0.1 * noise + turning, STEP_S)


@pytest.mark.paper
def test_bad_input_is_a_sentence() -> None:
    def refused(stream: fl.Stream, **options: object) -> str:
        with pytest.raises(fl.BadInput) as raised:
            fl.noise(fl.Recording([stream]), **options)  # type: ignore[arg-type]
        return str(raised.value)

    size = 2000
    moved = rest(size)["turn_rate_radps"].copy()
    moved[800:900] += 0.5 * np.sin(np.arange(100)[:, None])
    assert "the unit moves" in refused(rest(size, turn_rate_radps=moved))
    assert "an estimate of noise needs at least 500 in 20 s" in refused(rest(250))
    assert "is constant" in refused(rest(size, turn_rate_radps=np.zeros((size, 3))))
    rows = np.r_[0:500, 1500:2000]
    assert "% of the messages are lost" in refused(rest(size).take(rows))
    stamps = rest(size).publish_time_ns.copy()
    stamps[1000:] -= 1_000_000_007
    assert "stamps go backwards" in refused(replace(rest(size), publish_time_ns=stamps))
    assert "(a third of its length)" in refused(rest(size), taus=[30.0])
    assert "ug/sqrt(Hz) is not rad/s/sqrt(Hz) or rad/s/sqrt(s)" in refused(
        rest(size), sheet={"turn_rate_radps": "1 ug/sqrt(Hz)"}
    )


def test_the_study_counts_the_intervals_that_hold_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of four units; their deviation is the true one, 5 % above it, and twice it."""

    def looked_at(source: object, _: str) -> SimpleNamespace:
        place = stds.index(float(np.std(source.streams["/wheels"]["turn_radps"])))
        white = SimpleNamespace(low=1e-3 if place < 3 else 1.1e-3, high=2e-3, value=1e-3 * (1 + place))
        curve = SimpleNamespace(taus_s=taus_s, deviations=true * np.array([1.0, 1.05, 2.0]))
        numbers = {"white": white}  # no walk is found
        column = SimpleNamespace(curve=curve, degrees=np.full(3, 100.0), numbers=numbers)
        return SimpleNamespace(columns=[column])

    taus_s = np.array(study.TAUS_S)
    true = np.sqrt(study.TERMS.allan_variance(taus_s, study.STEP_S))
    monkeypatch.setattr(study, "noise", looked_at)
    monkeypatch.setattr(study, "SIZE", 100)
    units = [unit(seed, 100, study.TERMS, study.STEP_S) for seed in (5, 6, 7, 8)]
    stds = [float(np.std(each)) for each in units]
    experiment = SimpleNamespace(runs=4)
    setting = SimpleNamespace(options=study.NoiseOptions(seeds=(5,)), progress=lambda each, *_: each)
    outcome = study.study(experiment, setting)
    keeping.hold_outcome("sensor-noise", {}, outcome)
    found = outcome.metrics
    assert found["noise.covered.0-white"] == 3.0
    assert found["noise.covered.0-walk"] == 0.0
    assert [found[f"noise.covered.0-deviation-{each:g}s"] for each in taus_s] == [4.0, 4.0, 0.0]
    assert found["noise.spread.0-white"] == pytest.approx(np.std(np.log([1, 2, 3, 4]), ddof=1))


@pytest.mark.parametrize("name", ["sensor-noise", "calibration", "ellipsoid"])
def test_of_a_hundred_intervals_ninety_to_ninety_nine_hold_the_truth(name: str) -> None:
    covered = {key: each for key, each in stored()[name].metrics.items() if ".covered." in key}
    assert len(covered) == {"sensor-noise": 10, "calibration": 14, "ellipsoid": 36}[name]
    assert {key: each for key, each in covered.items() if not 90 <= each <= 99} == {}


def test_a_drift_is_said_with_what_decays_if_something_does() -> None:
    drift = Drift(2e-6, 1e-7, 0.0, 1.0, 40.0)
    taken = "removed from all numbers (log-likelihood +40)"
    assert _drifts(drift, "rad/s") == f"drifts by 2e-06 rad/s/s; this is {taken}"
    warm = drift._replace(offset=0.01, time_s=30.0)
    decays = "warms up: 0.01 rad/s decays with a time constant of 30 s, plus 2e-06 rad/s/s"
    assert _drifts(warm, "rad/s") == f"{decays}; both are {taken}"
