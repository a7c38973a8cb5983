"""The report: one page, offline, with the numbers of its results; opened in a browser where one is."""

import base64
import hashlib
import json
import re
import shutil
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from importlib import resources
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from fuselog.pipeline.output import RESULT_FILE
from fuselog.pipeline.output.charts import (
    COLOURS,
    OUTSIDE_COLOUR,
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
from fuselog.pipeline.output.claims import Claim
from fuselog.pipeline.output.report import (
    DARK,
    LIGHT,
    _figure,
    _legend,
    contrast,
    text_colours,
    write_report,
)
from fuselog.pipeline.output.report.first_run import Followed
from fuselog.pipeline.output.report.kinds import opening, run_sentences
from fuselog.pipeline.output.report.scene import typical_second
from fuselog.pipeline.output.results import Outcome, Result, read_result, result_folder, write_outcome
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import open_log, read_streams
from fuselog.recorders.parameters import build
from fuselog.recorders.parsing import parse_json

pytestmark = [pytest.mark.paper, pytest.mark.usefixtures("blank_figures")]

Fuselog = Callable[..., Any]
KEPT_RESULTS = sorted(Path(__file__).parents[2].glob("docs/families/results/*.json"))
WINDOWS = [(width, scheme) for width in (1280, 400) for scheme in ("light", "dark")]


class Page(HTMLParser):
    """What a page holds: its elements, and the text of those that the tests look into."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {name: [] for name in ("script", "h1", "h2", "h3", "th")}
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
    assert page.texts["h1"] == ["EKF, UKF and dead reckoning of a robot among landmarks"]
    levels = [int(tag[1]) for tag, _ in page.elements if tag in ("h1", "h2", "h3", "h4")]
    assert all(below - above <= 1 for above, below in pairwise(levels))
    addresses = [each["src"] or "" for _, each in page.elements if "src" in each]
    assert all(address.startswith("data:") for address in addresses)
    links = [each["href"] or "" for tag, each in page.elements if "href" in each and tag == "a"]
    assert all(link.startswith(("#", "https://")) for link in links)  # followed by a click alone
    assert not any("href" in each for tag, each in page.elements if tag != "a")
    assets = resources.files("fuselog.pipeline.output.report")
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
    assert len(plots) == len(page.charts) == 3 + len(list(result.glob("figures/*.json")))
    assert all(each["role"] == "group" and each["aria-label"] for each in plots)


def test_the_charts_hold_the_numbers_of_the_result(result: Path, page_file: Path) -> None:
    """RMSE, NEES and its chi-square interval as the tables have them, a panel for each estimator."""
    plan, lens, errors, nis, _ = Page(page_file.read_text(encoding="utf-8")).charts
    labels = ("dead-reckoning", "ekf", "ukf")
    steps = pd.read_parquet(result / "tables/steps.parquet")
    for place, label in enumerate(labels):
        own = steps[(steps["estimator"] == label) & (steps["case"] == "robot1")]
        for panel, quantity in zip(errors["panels"][place::3], ("position_rmse_m", "nees"), strict=True):
            [series] = [each for each in panel["series"] if each["label"] == label]
            np.testing.assert_allclose(series["x"], own["elapsed_s"], rtol=1e-6)
            np.testing.assert_allclose(series["y"], own[quantity], rtol=1e-6)
            [band] = panel["bands"]
            np.testing.assert_allclose(band["low"], own[f"{quantity}_low"], rtol=1e-6)
            np.testing.assert_allclose(band["high"], own[f"{quantity}_high"], rtol=1e-6)
            low, high = own[f"{quantity}_low"], own[f"{quantity}_high"]
            is_out = (own[quantity] < low) | (own[quantity] > high)
            marked = [x for each in panel["series"] if each["style"] == "outside" for x in each["x"]]
            np.testing.assert_allclose(marked, own["elapsed_s"][is_out], rtol=1e-6)
            share = is_out.mean()
            assert panel["title"].startswith(f"{label}: outside {'' if share else 'never'}")
        assert plan["colours"][label] == errors["colours"][label]
    assert [panel["title"].partition(":")[0] for panel in nis["panels"]] == ["ekf", "ukf"]
    assert len({str(panel["x"]["limits"]) for panel in lens["panels"]}) == 1
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
    assert names[:3] == ["ekf", "ukf", "dead-reckoning"]  # whom to take comes first
    told = "for a consistent estimator 0.216 to 9.35"
    assert told in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_figures_are_captioned_and_told_to_those_who_cannot_see_them(tmp_path: Path) -> None:
    """By its title a chart, else by its name; a picture by its quantity and case, if it is of one."""
    panel = Panel(x=Axis(label="t (s)"), y=Axis(label="NEES"), series=[curve("ekf", [0.0], [1.0])])
    above = panel.model_copy(update={"title": "left", "y": Axis(label="error (m)")})
    (tmp_path / "nees-robot1.svg").write_bytes(b"<svg/>")
    (tmp_path / "two_robots-1.svg").write_bytes(b"<svg/>")
    shown = [_figure(tmp_path / f"{name}.svg") for name in ("nees-robot1", "two_robots-1")]
    for title in ("", "Errors"):
        chart = Chart(panels=[above, panel, panel], title=title)
        (tmp_path / "two_robots-1.json").write_text(chart.model_dump_json())
        shown.append(_figure(tmp_path / "two_robots-1.svg"))
    told = [(each.name, each.caption, each.description) for each in shown]
    charted = "Chart: error (m) over t (s); NEES over t (s); left; ekf"
    assert told == [
        ("nees-robot1", "NEES of robot1", "Figure: NEES of robot1"),
        ("two_robots-1", "two_robots-1", "Figure: two_robots-1"),
        ("two_robots-1", "two robots 1", charted),
        ("two_robots-1", "Errors", charted),
    ]


@pytest.mark.parametrize(
    ("main", "compared", "words"),
    [
        ("gospa_m", ["a", "b"], "GOSPA: "),
        ("gospa_m", [], ""),
        ("position_rmse_m", ["a", "b"], ""),
    ],
)
def test_what_estimators_of_tracks_are_compared_by_is_told(
    main: str, compared: list[str], words: str
) -> None:
    begun: Any = SimpleNamespace(found=SimpleNamespace(main=main, compared=compared))
    told = _legend(begun)
    assert told.startswith(words)
    assert told.endswith("Lower is better.") == bool(told) == bool(words)


def test_sections_are_named_by_what_differs_in_their_settings(tmp_path: Path) -> None:
    settings: list[dict[str, Any]] = [
        {"seed": 1, "record": {"scenario": "s", "parameters": {"rate_hz": 5}}},
        {"seed": 1, "record": {"scenario": "s", "parameters": {"rate_hz": 10}}},
        {"seed": 1, "record": {"scenario": "s"}},
        {"seed": 1, "record": {"scenario": "s"}, "estimators": {"ekf": {}}},
    ]
    settings[1] |= {part: {"ekf": {"sigma_m": 0.1}} for part in ("estimators", "parameters")}
    folders = [_written(tmp_path / f"{place}", each, Outcome()) for place, each in enumerate(settings)]
    write_report(folders, tmp_path / "page.html")
    page = Page((tmp_path / "page.html").read_text(encoding="utf-8"))
    assert page.texts["h2"] == [
        "sweep: rate_hz 5, sigma_m default",
        "sweep: rate_hz 10, sigma_m 0.1",
        f"sweep: rate_hz default, sigma_m default ({folders[2]})",
        f"sweep: rate_hz default, sigma_m default ({folders[3]})",
    ]


def test_a_comparison_and_a_sweep_open_with_their_verdicts(
    result: Path, tmp_path: Path, fuselog: Fuselog
) -> None:
    """The number of runs is theirs, settings are written as they were set, and no number has an e."""
    logs = [str(tmp_path / f"{seed}.mcap") for seed in range(5)]
    for seed, log in enumerate(logs):
        record = ["record", "landmarks", "--seed", str(seed), "--set", "duration_s=2", "-o", log]
        assert fuselog(*record).code == 0
    compare, sweep = tmp_path / "compare", tmp_path / "sweep"
    assert fuselog("compare", *logs, "-e", "ekf", "-e", "ukf", "--out", compare).code == 0
    over = ["--over", "ekf.sigma_range_m=0.05:0.2:log3", "--set", "duration_s=2", "--runs", "2"]
    assert fuselog("sweep", "landmarks", *over, "--out", sweep).code == 0
    tried, came = run_sentences(read_result(compare), compare)
    assert tried == "ekf and ukf over the same 5 runs, run by run."
    assert "Over 5 runs" in came
    tried, came = run_sentences(read_result(sweep), sweep)
    assert tried.startswith(
        "Standard deviation of a range (ekf.sigma_range_m) from 0.05 to 0.2 m: 3 points, 2 runs of "
        "landmarks at each"
    )
    assert re.search(
        r"ekf has its smallest error with standard deviation of a range = 0\.[\d]+ m\.", came
    )
    assert "dead-reckoning and ukf do not depend on it." in came
    write_report([compare, sweep], tmp_path / "page.html")
    page = Page((tmp_path / "page.html").read_text(encoding="utf-8"))
    assert page.texts["h1"] == ["2 results"]
    titles = [chart["title"] for chart in page.charts]
    forest, scene, lens = titles[:3]  # several logs, and estimates that the folder does not keep
    assert forest.startswith("Differences in percent")
    assert scene.startswith("robot1, first run from above")
    assert lens.startswith("Lens: 1 s of the first run")
    axes = {panel["x"]["label"] for chart in page.charts for panel in chart["panels"]}
    assert "standard deviation of a range (m)" in axes
    assert not re.search(r"\de[-+]\d", " ".join(page.texts["h3"]))


def test_a_diagnosis_names_the_likeliest_cause_and_what_the_runs_give_without_it(
    tmp_path: Path, fuselog: Fuselog
) -> None:
    """A range noise stated four times too small; kept in the result by `run`, found anew by `report`."""
    folder = tmp_path / "broken"
    broken = ["--set", "ekf.sigma_range_m=0.025", "--set", "duration_s=5", "--runs", "2"]
    broken += ["--set", "ekf.turn_noise_density=0.001"]  # a second one, which stays
    done = fuselog("run", "landmarks", *broken, "--diagnose", "--out", folder)
    assert "most likely cause for ekf: sigma_range_m (standard deviation of a range) is" in done.out
    [cause] = read_result(folder).causes
    key, _, value = cause.setting.partition("=")
    assert (cause.estimator, key) == ("ekf", "ekf.sigma_range_m")
    assert float(value) == pytest.approx(0.1, rel=0.15)
    assert cause.mended.startswith("With that, over 2 runs: position error, RMS ")
    left = re.search(
        r"NEES ([\d.]+), expected 3; .* still ([\d.]+) times the expected value: there",
        cause.mended,
    )
    assert left is not None
    assert float(left[2]) == pytest.approx(float(left[1]) / 3.0, rel=0.06)
    assert f"The likeliest cause: {cause.short}." in run_sentences(read_result(folder), folder)[1]
    again = tmp_path / "page.html"
    write_report([folder], again)
    page = again.read_text(encoding="utf-8")
    assert f"<code>--set {cause.setting}</code>" in page
    assert "Not diagnosed" not in page
    assert fuselog("run", "landmarks", *broken, "--out", folder).code == 0  # which is ours still
    write_report([folder], again)
    assert "<b>Not diagnosed:</b> <code>--diagnose</code>" in again.read_text(encoding="utf-8")


def test_the_lens_is_at_the_second_that_is_most_like_the_run() -> None:
    """Half of the truths are outside over the run: neither where all are nor where none is."""
    time_s = np.arange(0.0, 30.0, 0.1)
    out = np.where(time_s < 10.0, 1.0, np.where(time_s < 20.0, time_s * 10 % 2 < 1, 0.0))
    error = np.column_stack([9.0 * out, np.zeros(len(out))])
    followed = Followed(time_s, np.zeros_like(error), error, np.tile(np.eye(2), (len(error), 1, 1)))
    begin_s, length_s = typical_second([followed])
    assert 10.0 <= begin_s < 20.0
    assert length_s == 1.0


def test_text_is_markdown_without_html(tmp_path: Path) -> None:
    text = "**Why** <script>alert(1)</script> ![x](https://x.org/a.png) [go](javascript:alert(1))"
    folder = _written(tmp_path / "r", {"text": text}, Outcome())
    write_report([folder], tmp_path / "page.html")
    written = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<strong>Why</strong> &lt;script&gt;alert(1)" in written
    page = Page(written)
    assert not page.all("img")
    assert not [each for each in page.all("a") if "javascript" in (each["href"] or "")]


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
    run_sentences = fuselog("report", str(tmp_path / "r"), "-o", str(tmp_path / "page.html"))
    assert run_sentences.code == 2
    assert len(run_sentences.err.splitlines()) == 1
    assert all(part in run_sentences.err for part in parts), run_sentences.err
    assert not (tmp_path / "page.html").exists()


def test_colours_stand_out_from_both_grounds() -> None:
    """WCAG 2.2, 1.4.11: 3 to 1 against white and against the dark ground; no two are one."""
    for colour in (*COLOURS, REFERENCE_COLOUR, OUTSIDE_COLOUR):
        assert all(contrast(colour, ground) >= 3 for ground in ("#ffffff", "#14171a")), colour
    for light, dark in text_colours():  # 1.4.3: texts need 4.5 to 1
        assert all(contrast(light, ground) >= 4.5 for ground in LIGHT)
        assert all(contrast(dark, ground) >= 4.5 for ground in DARK)
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
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
        with pytest.raises(ValueError, match="have the same length"):
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
    run_sentences: list[str] = []
    page.on("console", lambda message: run_sentences.append(message.text))
    page.on("pageerror", lambda error: run_sentences.append(str(error)))
    page.on("request", lambda request: run_sentences.append(request.url))
    page.goto(page_file.as_uri())
    page.locator(".looks figure").first.scroll_into_view_if_needed()  # drawn when it comes near
    page.wait_for_selector(".plot .main-svg")
    page.evaluate("scrollTo(0, 0)")
    yield page
    page.close()
    assert [each for each in run_sentences if not each.startswith(("file:", "data:"))] == []


def test_in_a_browser_the_verdict_and_the_cards_are_seen_at_once(shown: Any) -> None:
    width = shown.viewport_size["width"]
    assert shown.evaluate("document.documentElement.scrollWidth") <= width
    boxes = [each.bounding_box() for each in shown.locator(".verdict, .card").all()]
    assert len(boxes) == 4
    assert all(box["x"] >= 0 and box["x"] + box["width"] <= width for box in boxes)
    if width == 1280:
        assert max(box["y"] + box["height"] for box in boxes) <= 800
    assert shown.locator("details[open]").count() == 0
    assert shown.locator(".modebar-container:visible .modebar-btn:visible").count() == 0
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
    figure = shown.locator(".looks figure").first
    figure.scroll_into_view_if_needed()
    figure.locator(".main-svg").first.wait_for()
    plot = "document.querySelector('.looks figure .plot')"
    figure.locator(".legendtoggle").last.click()
    _await(shown, f"{plot}.data.filter((each) => each.visible === 'legendonly').length === 1")
    area = figure.locator(".nsewdrag").first.bounding_box()
    start = shown.evaluate(f"{plot}.layout.xaxis.range[0]")
    x, y = area["x"] + 0.3 * area["width"], area["y"] + 0.3 * area["height"]
    shown.mouse.move(x, y)
    shown.mouse.down()
    shown.mouse.move(x + 0.3 * area["width"], y + 0.4 * area["height"], steps=5)
    shown.mouse.up()
    _await(shown, f"{plot}.layout.xaxis.range[0] > {start} + 0.5")


def test_in_a_browser_tables_sort_by_numbers(shown: Any) -> None:
    folded = shown.locator("details", has_text="Table: coverage")
    folded.locator("summary").click()
    head = folded.locator("thead button", has_text="messages").first
    place = shown.evaluate("(button) => button.parentElement.cellIndex + 1", head.element_handle())
    for order in (1, -1):
        head.click()
        cells = folded.locator(f"tbody td:nth-child({place})").all()
        values = [float(cell.get_attribute("data-value")) for cell in cells]
        assert values == sorted(values, reverse=order < 0)
    assert folded.locator("th[aria-sort=descending]").count() == 1


def test_in_a_browser_axe_finds_nothing_at_level_aa(shown: Any) -> None:
    """Contrast, names, headings, tables, what a keyboard reaches: with all that is folded opened."""
    axe = pytest.importorskip("axe_playwright_python", reason="axe-playwright-python is not installed")
    script = (Path(axe.__file__).parent / "axe.min.js").read_text(encoding="utf-8")
    shown.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
    shown.evaluate(f"{script}; undefined")  # no script element, which the policy of the page refuses
    tags = '["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"]'
    options = f'{{runOnly: {{type: "tag", values: {tags}}}}}'
    found = shown.evaluate(f"axe.run(document, {options}).then((each) => each.violations)")
    told = [(each["id"], [node["html"][:120] for node in each["nodes"][:3]]) for each in found]
    assert told == []


def test_in_a_browser_trackers_and_claims_are_told_on_the_first_screen(
    browser: Any, tmp_path: Path
) -> None:
    """Whom to take, what is doubtful, a card each and one of the claims; on a phone nothing is cut."""
    long = "the tracker that has all of the sensors is better than every one that lacks one of them"
    gospa_m = {"nearest": 5.0, "jpda": 4.0, "pmbm": 3.0, "jipda": 3.5, "hungarian": 6.0}
    runs = [
        {"estimator": label, "run": run, "gospa_m": value + 0.01 * run}
        for label, value in gospa_m.items()
        for run in range(5)
    ]
    outcome = Outcome(
        metrics={f"{label}.gospa_m": value for label, value in gospa_m.items()},
        claims=[Claim(long, "expected", "", verdict) for verdict in ("refuted", "confirmed") * 4],
        tables={"runs": pd.DataFrame(runs)},
    )
    folder = _written(tmp_path / "r", {"runs": 5}, outcome)
    write_report([folder], tmp_path / "page.html")
    for width in (1280, 400):
        page = browser.new_page(viewport={"width": width, "height": 900})
        page.goto((tmp_path / "page.html").as_uri())
        assert page.locator(".verdict .first").inner_text().startswith("Take pmbm: ")
        assert page.locator(".doubtful").inner_text().startswith("Doubtful: ")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        cards = page.locator(".card")
        names = cards.locator("h3").all_inner_texts()
        assert names == ["pmbm", "jipda", "jpda", "Claims"]
        assert long in cards.last.inner_text()
        if width == 1280:
            boxes = [each.bounding_box() for each in cards.all()]
            assert max(box["y"] + box["height"] for box in boxes) <= 900
        page.close()


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
    assert "with particles at 6 times" in plan["title"]
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
    [shares] = [each for each in charts if "effective share of" in each["title"]]
    [curve] = shares["panels"][0]["series"]
    np.testing.assert_allclose(curve["y"], effective["effective"] / 50, rtol=1e-6)


@pytest.mark.parametrize("path", KEPT_RESULTS, ids=lambda path: path.stem)
def test_results_that_are_kept_have_an_opening_and_a_page(path: Path, tmp_path: Path) -> None:
    """Those of all shipped experiments, whose data need not be here; they do not state their kind."""
    values = {**parse_json(path.read_text(encoding="utf-8")), "files": {}}
    opened = opening(build(Result, values, str(path)), {})
    assert opened.tried.endswith(".")
    assert opened.story.verdict
    (tmp_path / RESULT_FILE).write_text(json.dumps(values), encoding="utf-8")
    write_report([tmp_path], tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert ": fuselog report</title>" in text
    assert not re.search(r">\s*[+-]?(nan|inf|None)\s*<", text)


def test_an_experiment_is_not_taken_for_a_command_by_its_name_or_tables(tmp_path: Path) -> None:
    for kind, name in (("run", "tune"), ("run", "compare"), ("tune", "tune")):
        folder = tmp_path / f"{kind}-{name}"
        folder.mkdir()
        tables = {each: pd.DataFrame({"sound": ["a"]}) for each in ("differences", "sweep", "runs")}
        tables["parameters"] = pd.DataFrame(
            {"parameter": ["sigma_range_m"], "start": 1.0, "value": 2.0, "low": 1.0, "high": 3.0}
        )
        outcome = Outcome(metrics={"ekf.position_rmse_m": 1.0}, tables=tables, kind=kind)
        write_outcome(folder, name, {"estimators": {"ekf": {}}}, outcome)
        write_report([folder], folder / "report.html")
        assert ("is estimated at 2 m" in (folder / "report.html").read_text()) == (kind == "tune")


def test_control_characters_are_shown_by_their_numbers(tmp_path: Path) -> None:
    """Wherever they stand: in a title, a text, a label, a claim, a table."""
    bad = "a\x9b2J\x1b[2J\x07\u202e\u2028b"
    outcome = Outcome(
        metrics={f"{bad}.position_rmse_m": 1.0, f"{bad}.nees": 1.0},
        tables={"names": pd.DataFrame({bad: [bad]})},
        claims=[Claim(claim=bad, paper=bad, ours=bad, verdict="confirmed")],
    )
    settings = {"title": bad, "text": f"# {bad}", "estimators": {bad: {}}, "notes": [bad]}
    write_outcome(tmp_path, bad.replace("\x1b", ""), settings, outcome)
    write_report([tmp_path], tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert {each for each in page if not each.isprintable()} <= {*"\n\t\u00a0\u2009\u202f"}
    assert "<title>a\\x9b2J\\x1b[2J\\x07\\u202e\\u2028b: fuselog report</title>" in page


def test_waiting_for_late_messages_shows_its_price_next_to_the_error(
    fuselog: Fuselog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the table of a comparison and on its page; without late messages no age is shown."""
    monkeypatch.chdir(tmp_path)
    late = ["duration_s=8", "range_bearing.latency_s=0.2", "range_bearing.latency_jitter_s=0.3"]
    record = (
        "record",
        "landmarks",
        "-o",
        "run.mcap",
        *(word for each in late for word in ("--set", each)),
    )
    assert fuselog(*record).code == 0
    for name, options in (("order", ()), ("wait", ("--arrival-order", "--late", "wait:0.9"))):
        assert fuselog("replay", "run.mcap", "-e", "ekf", "-o", f"{name}.mcap", *options).code == 0
    rows = fuselog("compare", "order.mcap", "wait.mcap", "--json", "--out", "both").json["differences"]
    names = [row["quantity"] for row in rows]
    at = names.index("estimate_age_s")
    assert ["rmse" in name for name in names] == [number < at for number in range(len(names))]
    assert (rows[at]["first_mean"], rows[at]["aim"]) == (0.0, "low")
    assert rows[at]["second_mean"] == pytest.approx(0.9, abs=0.02)
    assert fuselog("report", "both", "-o", "page.html").code == 0
    page = Path("page.html").read_text()
    assert page.count("Its estimates are on average 0.9") == 1
    accuracy, consistency = (page.index(f">{group}<") for group in ("Accuracy", "Consistency"))
    assert accuracy < page.index("age of an estimate", accuracy) < consistency
    Path("again.mcap").write_bytes(Path("order.mcap").read_bytes())
    rows = fuselog("compare", "order.mcap", "again.mcap", "--json").json["differences"]
    assert "estimate_age_s" not in {row["quantity"] for row in rows}
