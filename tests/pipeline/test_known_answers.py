"""What a run of known answers is said to be: the same in every table, file, page, chart and picture.

What is expected follows from `known` alone, with NumPy and SciPy: no number comes from fuselog.
"""

import csv
import io
import json
import re
from collections.abc import Iterator
from contextlib import chdir, redirect_stdout
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2, norm, t

import fuselog as fl
from fuselog.pipeline.diagnosing.consistency import nis_charts
from fuselog.pipeline.exploring.curves import BIN_S, cases_of
from fuselog.pipeline.exploring.session import numbers_of
from fuselog.pipeline.output.terminal import print_metrics, print_pose_errors
from fuselog.recorders.log import RunMetadata
from fuselog.replay.engine.streams.blocks import gather
from fuselog.replay.judging.consistency.consistency import ellipses
from fuselog.replay.judging.judge import Judge
from tests.pipeline import known
from tests.pipeline.conftest import run_here
from tests.pipeline.known import COVARIANCES, ERRORS, ROWS, SIZES, STEP_NS, STEPS
from tests.pipeline.printed import Row, printed

pytestmark = pytest.mark.usefixtures("blank_figures")

RUNS = len(SIZES)
MEAN_SQUARE = float(np.mean(SIZES**2))
DEGREES = 2 * STEPS - int(known.BEARING_LACKS.sum())  # of the innovations of a run
TIMES_S = 0.1 * ROWS


def metrics() -> dict[str, float]:
    """Every metric that the runs have."""
    found = {
        "one.nis_per_component.car": known.NIS * STEPS / DEGREES,
        "one.gated_share.car": float(known.GATED.mean()),
        "one.log_likelihood.car": known.LIKELIHOOD * float((~known.GATED).sum()),
        "one.skipped_measurements.car": 3.0 * RUNS,
        "two.effective_share.car": float(known.EFFECTIVE.mean()) / 50.0,
    }
    for name in ERRORS:
        found |= {
            f"{name}.position_rmse_m.car": known.rmse(name, 0, 1) * np.sqrt(MEAN_SQUARE),
            f"{name}.heading_rmse_rad.car": known.rmse(name, 2) * np.sqrt(MEAN_SQUARE),
            f"{name}.nees.car": known.nees(name) * MEAN_SQUARE,
            f"{name}.position_nees.car": known.position_nees(name) * MEAN_SQUARE,
            f"{name}.nees_steps_within_95.car": 0.0,
            f"{name}.estimates_without_truth.car": 0.0,
            f"{name}.estimate_age_s.car": known.AGE_S,
        }
    return found


def bounds() -> dict[str, tuple[float, float]]:
    """Where 95 % of consistent means lie: of a step over six runs, and of all innovations."""
    sizes = {"nees": (3, RUNS), "position_nees": (2, RUNS)}
    ends = {key: chi2.ppf([0.025, 0.975], size * runs) / runs for key, (size, runs) in sizes.items()}
    found = {f"{name}.{key}.car": tuple(each) for name in ERRORS for key, each in ends.items()}
    degrees = RUNS * DEGREES
    found["one.nis_per_component.car"] = tuple(chi2.ppf([0.025, 0.975], degrees) / degrees)
    return found


def student(values: np.ndarray) -> tuple[float, float]:
    """Where the mean over the runs lies with 95 %."""
    half = float(t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values)))
    return float(values.mean()) - half, float(values.mean()) + half


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, blank_figures: None) -> Iterator[Path]:
    """The runs, and the result of judging them; commands run in this folder."""
    folder = tmp_path_factory.mktemp("known")
    with chdir(folder):
        known.write_runs(Path())
        yield folder


def evaluated(*options: str) -> Any:
    return run_here("evaluate", *(f"estimates{number}.mcap" for number in range(RUNS)), *options)


@pytest.fixture(scope="module")
def result(place: Path) -> tuple[Path, str]:
    """The result folder, and what was printed."""
    said = evaluated("--out", "result")
    assert said.code == 0, said.err
    return place / "result", said.out


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def column(rows: list[dict[str, str]], name: str) -> np.ndarray:
    return np.array([float(each[name]) for each in rows])


def test_the_terminal_has_each_number_under_its_estimator(result: tuple[Path, str]) -> None:
    table = {row.pop(""): row for row in printed(result[1], "car")}
    for key, value in metrics().items():
        label, quantity, _ = key.split(".")
        ends = bounds().get(key)
        within = "" if ends is None else f" ({ends[0]:.4g} to {ends[1]:.4g})"
        assert table[quantity][label] == f"{value:.4g}{within}", key
    for name in ERRORS:
        values = known.nees(name) * SIZES**2
        low, high = student(values)
        assert table["nees_mean_over_runs"][name] == (
            f"{values.mean():.3g} (95 % {low:.3g} to {high:.3g}), aim 3"
        )
    assert sum(map(len, table.values())) == len(metrics()) + 2


def test_json_files_and_tables_hold_the_same_numbers(result: tuple[Path, str]) -> None:
    folder, _ = result
    said = evaluated("--json").json
    kept = json.loads((folder / "result.json").read_text())
    tabled = {
        ".".join((row["estimator"], row["quantity"], row["case"])): float(row["value"])
        for row in rows_of(folder / "tables/summary.csv")
    }
    for found in (said["metrics"], kept["metrics"], tabled):
        assert found == pytest.approx(metrics(), rel=1e-9, abs=1e-12)
    for found in (said["bounds"], kept["bounds"]):
        assert found.keys() == bounds().keys()
        for key, ends in bounds().items():
            assert found[key] == pytest.approx(ends, rel=1e-9), key


def test_tables_over_time_and_runs_have_their_columns(result: tuple[Path, str]) -> None:
    """The RMSE of a step has the interval of a scaled chi-square variable of the moments of P."""
    tables = result[0] / "tables"
    for name, covariance in COVARIANCES.items():
        steps = [row for row in rows_of(tables / "steps.csv") if row["estimator"] == name]
        runs = [row for row in rows_of(tables / "runs.csv") if row["estimator"] == name]
        times = [row for row in rows_of(tables / "times.csv") if row["estimator"] == name]
        root = np.sqrt(MEAN_SQUARE)
        block = covariance[:2, :2]
        degrees = RUNS * np.trace(block) ** 2 / np.trace(block @ block)
        ends = np.sqrt(np.trace(block) * chi2.ppf([0.025, 0.975], degrees) / degrees)
        quantities = {
            "position_rmse_m": known.rmse(name, 0, 1),
            "rmse_x_m": known.rmse(name, 0),
            "rmse_y_m": known.rmse(name, 1),
            "rmse_heading_rad": known.rmse(name, 2),
        }
        for key, of_one in quantities.items():
            assert column(steps, key) == pytest.approx(of_one * root)
            assert column(runs, key) == pytest.approx(of_one * SIZES)
            assert column(times, key) == pytest.approx(of_one * SIZES.repeat(len(times) // RUNS))
        assert column(steps, "nees") == pytest.approx(known.nees(name) * MEAN_SQUARE)
        assert column(runs, "nees") == pytest.approx(known.nees(name) * SIZES**2)
        assert column(steps, "elapsed_s") == pytest.approx(TIMES_S)
        assert column(steps, "step").tolist() == ROWS.tolist()
        assert set(column(steps, "runs")) == {RUNS}
        assert set(column(runs, "estimates")) == {STEPS}
        for low_or_high, place in (("low", 0), ("high", 1)):
            assert column(steps, f"position_rmse_m_{low_or_high}") == pytest.approx(ends[place])
            of_nees = bounds()[f"{name}.nees.car"][place]
            assert column(steps, f"nees_{low_or_high}") == pytest.approx(of_nees)
        until = column([row for row in times if row["run"] == "0"], "until_s")
        assert (until > TIMES_S).all()
        assert (until - TIMES_S <= 0.1).all()


def test_late_messages_modes_and_particles_are_means_over_the_runs(result: tuple[Path, str]) -> None:
    tables = result[0] / "tables"
    late = {row["became"]: row for row in rows_of(tables / "late.csv")}
    assert {row["became"]: row["estimator"] for row in late.values()} == {
        "dropped": "one",
        "inserted": "two",
    }
    for became, delays in known.LATE_S.items():
        assert float(late[became]["messages"]) == RUNS * len(delays)
        assert float(late[became]["late_s"]) == pytest.approx(np.mean(delays))
    assert float(late["inserted"]["repeated"]) == RUNS * sum(known.REPEATED)
    modes = rows_of(tables / "modes.csv")
    for mode, probability in (("calm", known.CALM), ("agile", 1.0 - known.CALM)):
        own = [row for row in modes if row["mode"] == mode]
        assert column(own, "probability") == pytest.approx(probability)
        assert column(own, "elapsed_s") == pytest.approx(TIMES_S)
    shares = rows_of(tables / "effective.csv")
    assert column(shares, "effective_share") == pytest.approx(known.EFFECTIVE / 50.0)


def chart(folder: Path, name: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "figures" / f"{name}.json").read_text())
    return found


def test_charts_have_each_estimators_numbers_on_the_axis_that_names_them(
    result: tuple[Path, str],
) -> None:
    """Both lie outside throughout, but for the RMSE of `two`, which its covariance promises."""
    errors = chart(result[0], "errors-car")
    drawn = [
        (panel["y"]["label"], panel["title"], panel["series"][0], panel["bands"][0])
        for panel in errors["panels"]
    ]
    assert errors["columns"] == 2
    assert "all 6 runs" in errors["title"]
    at = 0
    for label, quantity in (("position error, RMS (m)", "position_rmse_m"), ("mean NEES", "nees")):
        for name in ERRORS:
            axis, title, series, ends = drawn[at]
            at += 1
            assert axis == label
            assert series["label"] == name
            assert series["x"] == pytest.approx(TIMES_S)
            assert series["y"] == pytest.approx([metrics()[f"{name}.{quantity}.car"]] * STEPS)
            rows = [row for row in rows_of(result[0] / "tables/steps.csv") if row["estimator"] == name]
            assert ends["low"] == pytest.approx(column(rows, f"{quantity}_low"))
            assert ends["high"] == pytest.approx(column(rows, f"{quantity}_high"))
            is_out = not ends["low"][0] <= series["y"][0] <= ends["high"][0]
            assert title == f"{name}: outside {'always' if is_out else 'never'}"
    [panel] = chart(result[0], "effective-car")["panels"]
    assert panel["y"]["label"] == "effective share"
    assert panel["series"][0]["y"] == pytest.approx(known.EFFECTIVE / 50.0)
    [panel] = chart(result[0], "modes-car")["panels"]
    assert {each["label"]: each["y"][4] for each in panel["series"]} == pytest.approx(
        {"calm": 0.1, "agile": 0.9}
    )
    panels = chart(result[0], "late-car")["panels"]
    assert [each["title"] for each in panels] == [
        "one: 18 dropped",
        "two: 12 inserted, 48 reprocessed for them",
    ]
    for panel, delays in zip(panels, known.LATE_S.values(), strict=True):
        assert panel["y"]["label"] == "mean delay (s)"
        assert panel["series"][0]["x"] == pytest.approx([0.4 * row for row in range(len(delays))])
        assert panel["series"][0]["y"] == pytest.approx(delays)


def page_of(place: Path, *names: str) -> str:
    said = run_here("report", *names, "-o", f"{'-'.join(names)}.html")
    assert said.code == 0, said.err
    return (place / f"{'-'.join(names)}.html").read_text(encoding="utf-8")


def sheet(page: str) -> dict[str, Row]:
    """The first table of a page: by row, and estimator."""
    found: dict[str, Row] = {}
    text = re.search(r"<table.*?</table>", page, re.DOTALL)
    assert text is not None
    columns: list[str] = []
    for row in re.findall(r"<tr.*?</tr>", text[0], re.DOTALL):
        cells = [_text(each) for each in re.findall(r"<t[dh].*?</t[dh]>", row, re.DOTALL)]
        columns = columns or cells[1:]
        if len(cells) > len(columns):
            found[cells[0]] = dict(zip(columns, cells[1:], strict=True))
    return found


def _text(markup: str) -> str:
    return " ".join(unescape(re.sub(r"<[^>]*>", " ", markup)).split())


def test_the_page_has_each_number_in_the_unit_of_its_row(place: Path, result: tuple[Path, str]) -> None:
    """Beside errors and NEES, where they lie with 95 % over other runs."""
    page = page_of(place, "result")
    rows = sheet(page)
    found = metrics()
    for name in ERRORS:
        position, heading, nees = (
            found[f"{name}.{key}.car"] for key in ("position_rmse_m", "heading_rmse_rad", "nees")
        )
        assert rows["position error, RMS (m)"][name].split()[0] == f"{position:.3g}"
        assert rows["heading error, RMS (°)"][name].split()[0] == f"{np.degrees(heading):.3g}"
        cell = rows["NEES aim 3"][name].removeprefix("✕ outside its interval").split()
        numbers = [float(each) for each in cell if re.fullmatch(r"[\d.]+", each)]
        wanted = (nees, *student(known.nees(name) * SIZES**2))
        assert numbers == pytest.approx(wanted, abs=0.055)
        assert rows["age of an estimate (ms)"][name] == "20"
    assert rows["NIS per component aim 1"]["one"].split()[0] == f"{known.NIS * STEPS / DEGREES:.3f}"
    assert rows["NIS per component aim 1"]["two"] == "\u2013"
    assert rows["log-likelihood per run"]["one"].split()[0] == "\u221236"
    assert rows["measurements gated out (%)"]["one"] == "14.3"
    low, high = _bootstrapped(known.rmse("one", 0, 1) * SIZES)
    ends = [float(each) for each in rows["position error, RMS (m)"]["one"].split()[1::2]]
    assert ends == pytest.approx([low, high], rel=0.02)
    text = _text(page)
    for name, other in (("one", "two"), ("two", "one")):
        factor = np.sqrt(found[f"{name}.nees.car"] / 3.0)
        assert f"{factor:.2g} times" in text, (name, other)


def _bootstrapped(values: np.ndarray) -> tuple[float, float]:
    """The root mean square over resampled runs, widened for few runs as Student's t is."""
    runs = len(values)
    tail = 1.0 - norm.cdf(np.sqrt(runs / (runs - 1)) * t.ppf(0.975, runs - 1))
    drawn = np.random.default_rng(7).integers(0, runs, (20_000, runs))
    squares = np.square(values)[drawn].mean(axis=1)
    low, high = np.sqrt(np.quantile(squares, [tail, 1.0 - tail]))
    return float(low), float(high)


@pytest.mark.paper
def test_a_comparison_is_of_the_second_less_the_first_whichever_comes_first(place: Path) -> None:
    """Intervals have about the width of Student's, and verdicts say who errs less."""
    for first, second, verdict in (("one", "two", "better"), ("two", "one", "worse")):
        said = run_here("compare", first, second, "--out", f"{first}-{second}")
        assert said.code == 0, said.err
        rows = printed(said.out, f"car {second} against {first}")
        table = {row["metric"]: row for row in rows}
        values = {name: known.rmse(name, 0, 1) * SIZES for name in ERRORS}
        means = [float(values[name].mean()) for name in (first, second)]
        row = table["position_rmse_m"]
        assert [row[first], row[second]] == [f"{each:.4g}" for each in means]
        difference = means[1] - means[0]
        assert float(row["difference"]) == pytest.approx(difference, rel=1e-3)
        low, high = student(values[second] - values[first])
        assert float(row["95 % from"]) == pytest.approx(low, abs=0.15 * (high - low))
        assert float(row["to"]) == pytest.approx(high, abs=0.15 * (high - low))
        assert (row["verdict"], row["runs"], row["aim"]) == (verdict, str(RUNS), "low")
        assert table["nees"]["aim"] == "3"
        sentence = next(line for line in said.out.splitlines() if line.startswith("position_rmse_m"))
        assert sentence.startswith(
            f"position_rmse_m of car: {second} is {verdict} than {first}: "
            f"{means[1]:.4g} against {means[0]:.4g}; difference {difference:.3g} (95 % "
        )
        assert f"margin {0.02 * means[0]:.3g}" in sentence
        page = page_of(place, f"{first}-{second}")
        [percent] = [
            panel for panel in _panels(page) if panel["x"]["label"] == f"{second} minus {first} (%)"
        ]
        drawn = [x for each in percent["series"] if each["style"] == "markers" for x in each["x"]]
        assert pytest.approx(100.0 * difference / means[0]) in drawn


def _panels(page: str) -> list[dict[str, Any]]:
    """The panels of all charts of a page."""
    data = re.findall(r"<script[^>]*application/json[^>]*>(.*?)</script>", page, re.DOTALL)
    return [panel for each in data for panel in json.loads(each)["panels"]]


def test_a_timeline_of_the_run_has_its_errors_and_bands(place: Path) -> None:
    """Signs are estimate less truth; a band is two of the estimator's own standard deviations."""
    from fuselog.replay.timeline.drawing.canvas import PALETTE, TRUTH
    from tests.replay.timeline.test_timeline import read

    said = run_here("view", "estimates0.mcap", "--save", "run.rrd")
    assert said.code == 0, said.err
    moving, still = read(place / "run.rrd"), read(place / "run.rrd", static=True)
    for number, (name, errors) in enumerate(ERRORS.items()):
        for at, (component, scale) in enumerate(
            (("x_m", 1.0), ("y_m", 1.0), ("heading_rad", 180.0 / np.pi))
        ):
            plot = moving[f"/plots/car/error_{component}/{name}"]
            values = np.array(plot["Measurements:values"])[:, 0]
            np.testing.assert_allclose(values, scale * SIZES[0] * errors[:, at], atol=1e-9)
            bands = np.sqrt(np.array(plot["Measurements:variances"])[:, 1])
            sigma = np.sqrt(COVARIANCES[name][at, at])
            np.testing.assert_allclose(bands, 2.0 * scale * sigma, rtol=1e-9)
            np.testing.assert_allclose(plot["sim_time"], ROWS * STEP_NS)
            assert list(plot["step"]) == ROWS.tolist()
        curve = moving[f"/plots/car/nees_3/{name}"]
        wanted = known.nees(name) * SIZES[0] ** 2
        np.testing.assert_allclose(np.ravel(curve["Scalars:scalars"]), wanted, rtol=1e-9)
        looks = [each for entity, each in still.items() if name in entity.split("/")]
        colours = {
            colour >> 8
            for columns in looks
            for key, rows in columns.items()
            if key.endswith(":colors")
            for colour in rows[0]
        }
        assert int.from_bytes(bytes(PALETTE[number]), "big") in colours
        assert int.from_bytes(bytes(TRUTH), "big") not in colours
    truth = np.array(moving["/plots/car/heading_rad/truth"]["Scalars:scalars"]).ravel()
    np.testing.assert_allclose(truth, np.degrees(3.1))


def test_exports_hold_what_was_written(place: Path) -> None:
    assert run_here("export", "estimates1.mcap", "--to", "csv", "-o", "csv").code == 0
    [path] = [each for each in Path("csv").iterdir() if "one" in each.name and "state" in each.name]
    rows = rows_of(path)
    stream = known.state("one", SIZES[1])
    for row, mean, stamp in zip(rows, stream["mean"], known.STAMPS_NS.tolist(), strict=True):
        numbers = [float(row[name]) for name in row if name.startswith("mean")]
        assert numbers == pytest.approx(mean.tolist())
        assert stamp in {int(each) for each in row.values() if re.fullmatch(r"\d{19}", each)}
    assert run_here("export", "estimates1.mcap", "--to", "tum", "-o", "tum").code == 0
    [path] = [each for each in Path("tum").iterdir() if "two" in each.name]
    lines = [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]
    mean = known.state("two", SIZES[1])["mean"]
    for line, state in zip(lines, mean, strict=True):
        numbers = [float(each) for each in line]
        half = 0.5 * state[2]
        turned = np.array([0.0, 0.0, np.sin(half), np.cos(half)])
        assert numbers[1:4] == pytest.approx([state[0], state[1], 0.0], abs=1e-9)
        assert abs(np.dot(numbers[4:], turned)) == pytest.approx(1.0)
    assert lines[1][0] == "1767225600.100000000"


def test_the_description_of_a_log_counts_its_messages(place: Path) -> None:
    said = run_here("info", "estimates0.mcap").out
    last_s = 0.1 * (STEPS - 1) + known.AGE_S  # by the log's own clock, on which estimates are later
    assert f"{last_s:.6g} s from 2026-01-01 00:00:00 UTC" in said
    rows = {line.split()[0]: line.split()[1:] for line in said.splitlines() if line.startswith(" /")}
    for topic, schema, count in (
        ("/estimates/one/car/state", "fuselog.GaussianEstimate", STEPS),
        ("/estimates/one/car/skipped", "fuselog.Skipped", 3),
        ("/estimates/two/car/rewound", "fuselog.Rewound", 2),
    ):
        assert rows[topic] == [schema, str(count), f"{count / last_s:.4g}"]


def test_of_many_cases_there_is_the_median_under_each_estimator() -> None:
    """Of `two` one case lacks its number: the median is of the others."""
    found: dict[str, float | None] = {
        f"one.rmse_m.case{number}": float(number) for number in range(1, 8)
    }
    found |= {f"two.rmse_m.case{number}": 10.0 * number for number in range(1, 7)}
    found["two.rmse_m.case7"] = None
    out = io.StringIO()
    with redirect_stdout(out):
        print_metrics(found, {}, details="--json")
    [row] = printed(out.getvalue(), "one")
    assert row == {"": "rmse_m", "one": "4 (1 to 7)", "two": "35 (10 to 60)"}


def test_pose_errors_have_their_statistics_in_their_columns() -> None:
    """The same names for every error, whose unit is in its row."""
    names = ("rmse", "mean", "median", "std", "min", "max")
    errors = (
        "ape_translation_{}_m",
        "ape_rotation_{}_deg",
        "rpe_translation_{}_m",
        "rpe_rotation_{}_deg",
    )
    found = {
        error.format(name): float(10 * row + column)
        for row, error in enumerate(errors)
        for column, name in enumerate(names)
    }
    out = io.StringIO()
    with redirect_stdout(out):
        print_pose_errors({**found, "poses": 5.0, "rpe_pairs": 4.0})
    rows = printed(out.getvalue(), "rmse")
    wanted = ("APE translation (m)", "APE rotation (deg)", "RPE translation (m)", "RPE rotation (deg)")
    for number, (row, title) in enumerate(zip(rows, wanted, strict=True)):
        cells = {name: f"{10 * number + column:.4g}" for column, name in enumerate(names)}
        assert row == {"": title, **cells}
    assert out.getvalue().splitlines()[-1] == "5 poses, 4 rpe pairs"


def test_the_explorer_draws_and_says_the_numbers_of_the_run() -> None:
    """NIS in spans of time has the bounds of the components that were measured in each."""
    size = 0.8
    made = {each.topic: gather([each]) for each in known.estimated(size) if "/one/" in each.topic}
    run = RunMetadata("own", epoch_ns=known.EPOCH_NS)
    log = fl.MemorySource({each.topic: each for each in known.sensed()}, run, "own")
    errors = [each for each in Judge([log], {}, gap_limit_s=0.2).add(made).errors if each is not None]
    case = cases_of(made, errors, known.EPOCH_NS)["car"]
    assert case.path is not None
    mean = known.TRUTH + size * ERRORS["one"]
    np.testing.assert_allclose(case.path.points, mean[:, :2])
    np.testing.assert_allclose(case.path.time_s, TIMES_S, atol=1e-12)
    np.testing.assert_allclose(case.sigma, np.sqrt(np.diag(COVARIANCES["one"]))[None].repeat(STEPS, 0))
    np.testing.assert_allclose(case.covariance, COVARIANCES["one"][None, :2, :2].repeat(STEPS, 0))
    span = np.floor(TIMES_S / BIN_S + 1e-9).astype(int)
    degrees = np.bincount(span, np.where(known.BEARING_LACKS, 1, 2))
    count = np.bincount(span)
    assert case.nis is not None
    np.testing.assert_allclose(case.nis.time_s, (np.arange(len(count)) + 0.5) * BIN_S)
    np.testing.assert_allclose(case.nis.mean, known.NIS * count / degrees)
    np.testing.assert_allclose(case.nis.low, chi2.ppf(0.025, degrees) / degrees)
    np.testing.assert_allclose(case.nis.high, chi2.ppf(0.975, degrees) / degrees)
    assert case.nees_interval == pytest.approx(chi2.ppf([0.025, 0.975], 3))
    said = numbers_of(case)
    assert said["error, RMS"] == (pytest.approx(size * known.rmse("one", 0, 1)), "m")
    assert said["NEES, aim 3"] == (pytest.approx(size**2 * known.nees("one")), "")
    assert case.log_likelihood == pytest.approx(known.LIKELIHOOD * (~known.GATED).sum())
    covariance = np.array([[[4.0, 1.0], [1.0, 2.0]]])
    [outline] = ellipses(np.array([[1.0, 2.0]]), covariance, 0.9) - [1.0, 2.0]
    squared = np.einsum("ni,ij,nj->n", outline, np.linalg.inv([[4.0, 1.0], [1.0, 2.0]]), outline)
    np.testing.assert_allclose(squared, chi2.ppf(0.9, 2))


def test_a_diagnosis_draws_nis_per_measured_component() -> None:
    """The mean of each sixtieth of the run in which something was measured, at its middle."""
    stream = known.innovations()
    [(name, drawn)] = nis_charts("one", {stream.topic: stream}, known.EPOCH_NS).items()
    [panel] = drawn.panels
    assert (name, panel.y.label, panel.x.label) == ("nis-car", "NIS per component", "time (s)")
    series, aim = panel.series
    assert series.label == "one"
    assert series.y == pytest.approx(known.NIS / np.where(known.BEARING_LACKS, 1, 2))
    assert np.abs(np.array(series.x) - TIMES_S).max() <= 0.51 * TIMES_S[-1] / 60
    assert set(aim.y) == {1.0}
