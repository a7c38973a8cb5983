"""The report: one page, offline, with the numbers of its results; opened in a browser where one is."""

import base64
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pipeline.output.charts import (
    COLOURS,
    REFERENCE_COLOUR,
    Axis,
    Chart,
    Panel,
    band,
    curve,
    draw,
    interval,
    level,
)
from pipeline.output.claims import Claim
from pipeline.output.report import write_report
from pipeline.output.report.verdict import verdict
from pipeline.output.results import Outcome, Result, result_folder, write_outcome
from recorders.errors import BadInput
from recorders.log import open_log, read_streams

pytestmark = pytest.mark.paper

Fuselog = Callable[..., Any]
WINDOWS = [(width, scheme) for width in (1280, 400) for scheme in ("light", "dark")]


class Page(HTMLParser):
    """What a page holds: its elements, and the text of those that the tests look into."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {"script": [], "h1": [], "h2": [], "span": [], "th": []}
        self._open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        """Begin an element."""
        self.elements.append((tag, dict(attributes)))
        self._open.append(tag)
        if tag in self.texts:
            self.texts[tag].append("")

    def handle_endtag(self, tag: str) -> None:
        """End the innermost element of a kind, and what was left open in it."""
        while self._open and self._open.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        """Take a text into all elements that it is in."""
        for tag in set(self._open) & set(self.texts):
            self.texts[tag][-1] += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        """The attributes of every element of a kind."""
        return [attributes for name, attributes in self.elements if name == tag]

    @property
    def charts(self) -> list[dict[str, Any]]:
        """The data of every chart."""
        scripts = zip(self.all("script"), self.texts["script"], strict=True)
        return [json.loads(text) for kind, text in scripts if kind.get("type") == "application/json"]


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory, fuselog: Fuselog) -> Path:
    """Three short runs of two robots, estimators not in the order of the alphabet."""
    folder = tmp_path_factory.mktemp("results") / "first"
    settings = ["--set", "duration_s=4", "--set", "robots=2", "--logs", "1"]
    assert fuselog("run", "landmarks", *settings, "--runs", "3", "--out", str(folder)).code == 0
    return folder


@pytest.fixture(scope="module")
def page_file(result: Path) -> Path:
    """The page of one result."""
    path = result.with_name("page.html")
    write_report([result], path)
    return path


def _written(folder: Path, settings: dict[str, Any], outcome: Outcome) -> Path:
    with result_folder(folder) as part:
        write_outcome(part, "sweep", {"title": "one title", **settings}, outcome)
    return folder


def test_the_page_is_whole_offline_and_small(result: Path, page_file: Path) -> None:
    """Nothing is fetched, only our scripts run, and who cannot see a figure is told what it is."""
    page = Page(page_file.read_text(encoding="utf-8"))
    assert page_file.stat().st_size < 5e6
    assert page.texts["h1"] == ["fuselog report"]
    levels = [int(tag[1]) for tag, _ in page.elements if tag in ("h1", "h2", "h3", "h4")]
    assert all(below - above <= 1 for above, below in pairwise(levels))
    addresses = [
        each[name] or "" for _, each in page.elements for name in ("src", "href") if name in each
    ]
    assert all(address.startswith(("#", "data:")) for address in addresses)
    assets = resources.files("pipeline.output.report")
    scripts = [(assets / name).read_text() for name in ("plotly-basic.min.js", "page.js")]
    kinds = [each.get("type") for each in page.all("script")]
    run = [text for text, kind in zip(page.texts["script"], kinds, strict=True) if kind is None]
    assert run == scripts
    [policy] = [each["content"] for each in page.all("meta") if "http-equiv" in each]
    digests = [base64.b64encode(hashlib.sha256(each.encode()).digest()).decode() for each in scripts]
    allowed = " ".join(f"'sha256-{digest}'" for digest in digests)
    assert (
        f"default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src {allowed}"
        == (policy)
    )
    plots = [each for each in page.all("div") if each.get("class") == "plot"]
    assert len(plots) == len(page.charts) == 1 + len(list(result.glob("figures/*.json")))
    assert all(each["role"] == "img" and each["aria-label"] for each in plots)


def test_the_charts_hold_the_numbers_of_the_result(result: Path, page_file: Path) -> None:
    """RMSE, NEES and its chi-square interval as the tables have them, estimators in one colour."""
    plan, errors, _ = Page(page_file.read_text(encoding="utf-8")).charts
    rmse, nees = errors["panels"]
    steps = pd.read_parquet(result / "tables/steps.parquet")
    for label in ("dead-reckoning", "ekf", "ukf"):
        own = steps[(steps["estimator"] == label) & (steps["case"] == "robot1")]
        for panel, quantity in ((rmse, "position_rmse_m"), (nees, "nees")):
            [series] = [each for each in panel["series"] if each["label"] == label]
            np.testing.assert_allclose(series["x"], own["elapsed_s"], rtol=1e-6)
            np.testing.assert_allclose(series["y"], own[quantity], rtol=1e-6)
        assert plan["colours"][label] == errors["colours"][label]
    [consistent] = nees["bands"]
    own = steps[(steps["estimator"] == "dead-reckoning") & (steps["case"] == "robot1")]
    np.testing.assert_allclose(consistent["low"], own["nees_low"], rtol=1e-6)
    np.testing.assert_allclose(consistent["high"], own["nees_high"], rtol=1e-6)
    assert [each["label"] for each in rmse["bands"]] == ["dead-reckoning", "ekf", "ukf"]
    [path] = [each for each in plan["panels"][0]["series"] if each["label"] == "truth"]
    assert path["reference"]
    assert len(path["x"]) > 10


def test_the_same_results_give_the_same_bytes(result: Path, page_file: Path, tmp_path: Path) -> None:
    write_report([result], tmp_path / "again.html")
    assert (tmp_path / "again.html").read_bytes() == page_file.read_bytes()


def test_metrics_have_the_order_of_e_and_their_bounds(
    result: Path, tmp_path: Path, fuselog: Fuselog
) -> None:
    """In the terminal, as JSON, from `evaluate`, in result.json and on the page."""
    shutil.copy(result / "logs/run-0000.mcap", tmp_path / "log.mcap")
    log, estimates = str(tmp_path / "log.mcap"), str(tmp_path / "log.estimates.mcap")
    choice = ["-e", "ukf", "-e", "dead-reckoning", "-e", "ekf"]
    printed = fuselog("replay", log, *choice)
    assert printed.out.splitlines()[1].split() == ["ukf", "dead-reckoning", "ekf"]
    outcome = fuselog("replay", log, *choice, "--json").json
    low, high = outcome["bounds"]["ekf.nees.robot1"]
    assert (low, high) == pytest.approx((0.2158, 9.3484), abs=1e-4)  # a table's chi-square of 3
    assert "(0.2158 to 9.348)" in printed.out
    for command in (["replay", log, *choice], ["evaluate", estimates]):
        metrics = fuselog(*command, "--json").json["metrics"]
        order = list(dict.fromkeys(key.partition(".")[0] for key in metrics))
        assert order == ["ukf", "dead-reckoning", "ekf"]
    judged = tmp_path / "judged"
    assert fuselog("evaluate", estimates, "--out", str(judged)).code == 0
    assert fuselog("report", str(judged), "-o", str(tmp_path / "page.html")).code == 0
    page = Page((tmp_path / "page.html").read_text(encoding="utf-8"))
    names = [text for text in page.texts["th"] if text in ("ukf", "dead-reckoning", "ekf")]
    assert names[:3] == ["ukf", "dead-reckoning", "ekf"]
    assert "(0.2158 to 9.348)" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_sections_are_named_by_what_differs_in_their_settings(tmp_path: Path) -> None:
    settings: list[dict[str, Any]] = [
        {"seed": 1, "record": {"scenario": "s", "parameters": {"rate_hz": 5}}},
        {"seed": 1, "record": {"scenario": "s", "parameters": {"rate_hz": 10}}},
        {"seed": 1, "record": {"scenario": "s"}},
        {"seed": 1, "record": {"scenario": "s"}},
    ]
    folders = [_written(tmp_path / f"{place}", each, Outcome()) for place, each in enumerate(settings)]
    write_report(folders, tmp_path / "page.html")
    page = Page((tmp_path / "page.html").read_text(encoding="utf-8"))
    assert page.texts["h2"] == [
        "sweep: rate_hz 5",
        "sweep: rate_hz 10",
        f"sweep: rate_hz default ({folders[2]})",
        f"sweep: rate_hz default ({folders[3]})",
    ]


def _result(metrics: dict[str, Any], claims: list[Claim], **bounds: tuple[float, float]) -> Result:
    settings = {"estimators": {"a": {}, "b": {}}, "record": {"scenario": "s"}, "runs": 4, "seed": 7}
    keyed = {f"b.nees{case}": each for case, each in bounds.items()}
    return Result(
        experiment="x",
        fuselog="1",
        settings=settings,
        input_sha256="",
        metrics=metrics,
        claims=claims,
        bounds=keyed,
    )


def test_the_verdict_says_which_claims_hold() -> None:
    claims = [
        Claim("A is 1", "1", "1", "confirmed"),
        Claim("B is 2", "2", "3", "refuted"),
        Claim("C is 3", "3", "", "not reproducible"),
        Claim("D is 4", "4", "3 to 5", "not shown"),
    ]
    assert verdict(_result({}, claims)) == (
        "a, b over 4 runs of s, seed 7.",
        "1 of 4 claims confirmed; 1 refuted: “B is 2”; 1 not shown; 1 not reproducible.",
    )


@pytest.mark.parametrize(
    ("nees", "said"),
    [
        (3.0, "its NEES of 3 lies within the 95 % interval 2 to 4: it is consistent"),
        (5.0, "its NEES of 5 lies above the 95 % interval 2 to 4: its covariances are too small"),
        (1.0, "its NEES of 1 lies below the 95 % interval 2 to 4: its covariances are too large"),
    ],
)
def test_the_verdict_names_the_best_estimator_and_whether_it_is_consistent(
    nees: float, said: str
) -> None:
    metrics = {"a.position_rmse_m": 0.5, "b.position_rmse_m": 0.25, "b.nees": nees}
    _, best = verdict(_result(metrics, [], **{"": (2.0, 4.0)}))
    assert best == f"b has the least position_rmse_m, 0.25; {said}."


def test_the_verdict_says_of_one_run_no_more_than_it_tells() -> None:
    """Its NEES has the interval of a single step; the logs replayed say how many runs there are."""
    metrics = {"b.position_rmse_m": 0.25, "b.nees": 3.0, "b.nis_per_component": 1.1}
    result = _result(metrics, [], **{"": (2.0, 4.0)})
    result.bounds["b.nis_per_component"] = (0.9, 1.2)
    result.settings.update(runs=1, logs={"files": ["a.mcap"]})
    assert verdict(result)[1] == (
        "position_rmse_m of b is 0.25; its NEES of 3 lies within the 95 % interval 2 to 4: one run does "
        "not show it to be inconsistent; its NIS of 1.1 per component, which says more, lies within 0.9 "
        "to 1.2."
    )
    result.settings.update(runs=2, logs={"files": ["a.mcap", "b.mcap"]})
    what, best = verdict(result)
    assert what.startswith("a, b over 2 runs")
    assert best.endswith("2 to 4: it is consistent.")


def test_the_verdict_calls_no_bound_the_best() -> None:
    metrics = {"a.position_rmse_m": 0.5, "bound.position_rmse_m": 0.25, "bound.over_ensemble": 1.0}
    assert verdict(_result(metrics, []))[1] == "position_rmse_m of a is 0.5."


def test_the_verdict_prefers_none_that_lacks_a_case_and_says_what_the_best_lacks() -> None:
    """Over two cases errors are averaged; an estimator without a number in one is not compared."""
    metrics = {
        "a.position_rmse_m.one": 0.1,
        "a.position_rmse_m.two": None,
        "b.position_rmse_m.one": 3.0,
        "b.position_rmse_m.two": 4.0,
        "b.nees.one": 3.0,
        "b.nees.two": 5.0,
        "b.failed_runs.one": 1.0,
        "b.failed_runs.two": 0.0,
        "b.estimated_share.one": 0.9,
        "b.estimated_share.two": 1.0,
    }
    _, best = verdict(_result(metrics, [], **{".one": (2.0, 4.0), ".two": (2.0, 4.0)}))
    assert best == (
        "position_rmse_m of b is 3.536; by NEES it is consistent in 1 of 2 cases; "
        "1 of its runs failed; it estimated 90.0 % of the span."
    )


def _lose(folder: Path) -> None:
    next(folder.glob("figures/*.svg")).unlink()


def _garble(folder: Path) -> None:
    next(folder.glob("figures/*.json")).write_text('{"panels": [{"title": 3}]}')


def _make_older(folder: Path) -> None:
    values = json.loads((folder / "result.json").read_text())
    values["format"] = 0
    (folder / "result.json").write_text(json.dumps(values))


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (_lose, ("figures/errors-robot", "is missing; run the experiment again")),
        (_garble, ("figures/errors-robot", "panels.0.title")),
        (_make_older, ("result.json", "an older version of fuselog wrote it (format 0")),
    ],
)
def test_a_damaged_or_older_result_is_one_sentence(
    result: Path,
    tmp_path: Path,
    fuselog: Fuselog,
    damage: Callable[[Path], None],
    parts: tuple[str, ...],
) -> None:
    shutil.copytree(result, tmp_path / "r")
    damage(tmp_path / "r")
    said = fuselog("report", str(tmp_path / "r"), "-o", str(tmp_path / "page.html"))
    assert said.code == 2
    assert len(said.err.splitlines()) == 1
    assert all(part in said.err for part in parts), said.err
    assert not (tmp_path / "page.html").exists()


def test_colours_stand_out_from_both_grounds() -> None:
    """WCAG 2.2, 1.4.11: 3 to 1 against white and against the dark ground; no two are one."""

    def luminance(colour: str) -> float:
        channels = np.array([int(colour[place : place + 2], 16) / 255 for place in (1, 3, 5)])
        linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    for colour in (*COLOURS, REFERENCE_COLOUR):
        for ground in ("#ffffff", "#15181c"):
            dark, light = sorted((luminance(colour), luminance(ground)))
            assert (light + 0.05) / (dark + 0.05) >= 3, (colour, ground)
    assert len(set(COLOURS)) == len(COLOURS)


def test_a_chart_is_described_once_and_drawn_as_it_is_described() -> None:
    """Gaps stay gaps, names may be places, and what does not fit together is refused."""
    chart = Chart(
        columns=2,
        panels=[
            Panel(
                y=Axis(label="error (m)", log=True, limits=(0.1, 10), ticks={1.0: "one"}),
                series=[curve("a", ["x", "y"], [1.0, np.nan]), level("good", ["x", "y"], 2.0)],
                bands=[interval("95 %", ["x", "y"], 1.0, 3.0)],
            ),
            Panel(series=[curve("a", [0, 1], [0, 1], "markers")], plane=True),
        ],
    )
    assert chart.panels[0].series[0].y == [1.0, None]
    assert Chart.model_validate_json(chart.model_dump_json()) == chart
    left, right = draw(chart).axes
    assert [line.get_color() for line in (*left.lines, *right.lines)] == [
        *(COLOURS[0], REFERENCE_COLOUR, COLOURS[0])
    ]
    assert (left.get_yscale(), left.get_ylim(), left.get_ylabel()) == ("log", (0.1, 10), "error (m)")
    assert [tick.get_text() for tick in left.get_yticklabels()] == ["one"]
    assert right.get_aspect() == 1
    [legend] = left.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["95 %", "a", "good"]
    for wrong in (lambda: curve("a", [0], [0, 1]), lambda: band("a", [0], [0], [0, 1])):
        with pytest.raises(ValueError, match="have one length"):
            wrong()


def test_the_viewer_is_asked_for_and_says_where_it_cannot_draw(tmp_path: Path) -> None:
    folder = _written(tmp_path / "r", {}, Outcome())
    with pytest.raises(BadInput, match=r"timeline\.rrd"):
        write_report([folder], tmp_path / "page.html", viewer=True)


# In a browser. None of our dependencies brings one: the tests take what is installed.


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Headless Chromium."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "msedge")
    with playwright.sync_playwright() as running:
        own = running.chromium.executable_path
        path = next(filter(None, map(shutil.which, names)), own if Path(own).exists() else None)
        if path is None:
            pytest.skip("no Chromium: install one, or run `playwright install chromium`")
        opened = running.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.fixture(scope="module", params=WINDOWS, ids=lambda window: f"{window[0]}-{window[1]}")
def shown(request: pytest.FixtureRequest, browser: Any, page_file: Path) -> Iterator[Any]:
    """The page in windows of each width and colour scheme, drawn; no error, and nothing is fetched."""
    width, scheme = request.param
    page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme)
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: said.append(request.url))
    page.goto(page_file.as_uri())
    page.wait_for_selector(".plot .main-svg")
    yield page
    page.close()
    assert [each for each in said if not each.startswith(("file:", "data:"))] == []


def test_in_a_browser_the_first_things_are_seen_at_once(shown: Any) -> None:
    width = shown.viewport_size["width"]
    assert shown.evaluate("document.documentElement.scrollWidth") <= width
    boxes = [each.bounding_box() for each in shown.locator(".verdict, .lead figure").all()]
    assert len(boxes) == 3
    assert all(box["x"] >= 0 and box["x"] + box["width"] <= width for box in boxes)
    if width == 1280:
        assert max(box["y"] + box["height"] for box in boxes) <= 800
    red, green, blue = (
        int(value)
        for value in shown.evaluate("getComputedStyle(document.body).backgroundColor")[4:-1].split(",")
    )
    is_dark = shown.evaluate("matchMedia('(prefers-color-scheme: dark)').matches")
    assert (red + green + blue < 128) == is_dark


def _await(page: Any, expression: str) -> None:
    """Wait until an expression is true; the page lets nothing be evaluated by itself."""
    for _ in range(100):
        if page.evaluate(expression):
            return
        page.wait_for_timeout(50)
    pytest.fail(f"never true: {expression}")


def test_in_a_browser_charts_hide_and_zoom(shown: Any) -> None:
    figure = shown.locator(".lead figure").nth(1)
    figure.scroll_into_view_if_needed()
    figure.locator(".main-svg").first.wait_for()
    plot = "document.querySelector('.lead figure:nth-child(2) .plot')"
    figure.locator(".legendtoggle").last.click()
    _await(shown, f"{plot}.data.filter((each) => each.visible === 'legendonly').length === 4")
    area = figure.locator(".nsewdrag").first.bounding_box()
    start = shown.evaluate(f"{plot}.layout.xaxis.range[0]")
    x, y = area["x"] + 0.3 * area["width"], area["y"] + 0.3 * area["height"]
    shown.mouse.move(x, y)
    shown.mouse.down()
    shown.mouse.move(x + 0.3 * area["width"], y + 0.4 * area["height"], steps=5)
    shown.mouse.up()
    _await(shown, f"{plot}.layout.xaxis.range[0] > {start} + 0.5")


def test_in_a_browser_tables_sort_by_numbers(shown: Any) -> None:
    table = shown.locator("table").first
    head = table.locator("thead button", has_text="position_rmse_m")
    for order in (1, -1):
        head.click()
        cells = table.locator("tbody td:nth-of-type(1)").all()
        values = [float(cell.get_attribute("data-value")) for cell in cells]
        assert values == sorted(values, reverse=order < 0)
        assert len(set(values)) == 3
    assert table.locator("th[aria-sort=descending]").count() == 1


def test_particles_are_in_the_first_picture_and_their_effective_share_in_a_figure(
    tmp_path: Path, fuselog: Fuselog
) -> None:
    """At six times from the first to the last, as many of equal weight as give the estimate's mean."""
    experiment, folder = tmp_path / "cloud.toml", tmp_path / "result"
    experiment.write_text(
        'title = "cloud"\nstudy = "localization"\n[record]\nscenario = "landmarks"\n'
        '[estimators."particles:50"]\ncloud = true\n'
    )
    run = ["run", experiment, "--set", "duration_s=1", "--logs", "1", "--out", folder]
    assert fuselog(*run).code == 0
    write_report([folder], tmp_path / "page.html")
    charts = Page((tmp_path / "page.html").read_text(encoding="utf-8")).charts
    [plan] = [each for each in charts if "first run from above" in each["title"]]
    assert plan["title"].endswith("with particles at 6 times")
    [cloud] = [each for each in plan["panels"][0]["series"] if each["style"] == "dots"]
    estimates = open_log(folder / "estimates/run-0000.mcap")
    stem = "/estimates/particles:50/robot1"
    found = read_streams(estimates, [f"{stem}/{leaf}" for leaf in ("pose", "particle", "effective")])
    pose, particle, effective = found.values()
    rows = np.linspace(0, len(pose) - 1, 6).round().astype(int)
    drawn = np.column_stack([cloud["x"], cloud["y"]]).reshape(6, -1, 2)
    places = particle["mean"].reshape(len(pose), 50, 3)[rows, :, :2]
    for points, of_stamp, row in zip(drawn, places, rows, strict=True):
        apart = np.abs(points[:, None] - of_stamp).max(axis=2).min(axis=1)
        assert apart.max() < 1e-6  # seven digits are in the page
        spread = np.sqrt(pose["covariance"].reshape(-1, 3, 3)[row, 0, 0])
        assert abs(points[:, 0].mean() - pose["mean"][row, 0]) < 0.2 * spread
    [shares] = [each for each in charts if "that is effective" in each["title"]]
    [curve] = shares["panels"][0]["series"]
    np.testing.assert_allclose(curve["y"], effective["effective"] / 50, rtol=1e-6)
