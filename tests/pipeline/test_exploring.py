"""A filter is played by its parameters: the session, and the page in a browser."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tomllib
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import Queue
from threading import Event
from typing import Any

import numpy as np
import pytest

import fuselog as fl
from fuselog.pipeline.exploring.curves import BIN_S, extremes, fewer, typical_time_s
from fuselog.pipeline.exploring.curves import Path as Track
from fuselog.pipeline.exploring.session import Session, numbers_of, open_session
from fuselog.pipeline.output.report.evidence import findings
from fuselog.pipeline.output.results import Result
from fuselog.recorders.errors import BadInput
from fuselog.replay.estimators.landmarks import ROBOT
from fuselog.replay.judging.consistency.consistency import ellipses
from tests.pipeline.conftest import shadowed

SURE = {"sigma_range_m": 0.03}  # of .1
GOOD = "No problem found."


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("explore") / "run.mcap"
    fl.write(path, fl.record("landmarks", seed=3, duration_s=20.0))
    return path


@pytest.fixture(scope="module")
def session(log: Path) -> Session:
    return open_session(log, "ekf")


def test_what_is_shown_is_what_a_replay_gives(session: Session, log: Path) -> None:
    played = session.play("ekf", SURE).cases["robot1"]
    replayed = fl.replay(log, {"ekf": {"kind": "ekf", **SURE}})
    errors, innovations = replayed.errors, replayed.innovations
    assert played.errors is not None
    assert played.nis is not None
    np.testing.assert_array_equal(played.errors.error[:, 1], errors["error_y_m"])
    np.testing.assert_array_equal(played.errors.nees, errors["nees"])
    first = innovations[(innovations["time_ns"] - replayed.logs[0].epoch_ns) * 1e-9 < BIN_S]
    assert played.nis.mean[0] == pytest.approx(first["nis"].sum() / first["degrees"].sum())
    opened = fl.replay(log, {"ekf": {"kind": "ekf", **SURE, "gate_probability": 1.0}}).innovations
    assert played.log_likelihood == pytest.approx(opened["log_likelihood"].sum())
    metrics = replayed.metrics.set_index("quantity")["value"]
    assert numbers_of(played)["error, RMS"] == (pytest.approx(metrics["position_rmse_m"]), "m")
    assert numbers_of(played)["NEES, aim 3"][0] == pytest.approx(metrics["nees"])
    assert numbers_of(played)["NIS, aim 1"][0] == pytest.approx(metrics["nis_per_component"])


def test_verdicts_are_on_the_right_side(session: Session) -> None:
    sure = session.play("ekf", SURE).verdicts["robot1"]
    careful = session.play("ekf", {"sigma_range_m": 0.4, "sigma_bearing_rad": 0.08}).verdicts["robot1"]
    assert session.play("ekf", {}).verdicts["robot1"].level == "good"
    assert (sure.level, sure.headline) == ("doubtful", "Overconfident.")
    assert careful.headline == "Conservative."


def test_report_explorer_and_warnings_have_one_verdict(session: Session, log: Path) -> None:
    """With 0.0868 m NIS is 1.11: outside of its 95 % band, within what 999 of 1,000 logs leave."""
    verdicts = []
    for sigma_range_m in (0.03, 0.0868, 0.1, 0.2):
        own = {"sigma_range_m": sigma_range_m}
        done = fl.replay(log, {"ekf": {"kind": "ekf", **own}})
        said: dict[str, Any] = {"metrics": done.judge.metrics, "bounds": done.judge.bounds, "claims": []}
        result = Result(experiment="e", fuselog="", settings={}, input_sha256="", **said)
        verdict = findings(result, {"runs": done.runs}).of["ekf"].verdict
        headline = session.play("ekf", own).verdicts["robot1"].headline
        assert headline == (f"{verdict.capitalize()}." if verdict != "consistent" else GOOD)
        reasons = {"small": "overconfident", "large": "conservative"}
        warned = [each.sentence.partition("its covariances are too ")[2][:5] for each in done.alarms]
        assert {reasons[each] for each in warned} <= {verdict}
        verdicts.append((verdict, len(warned)))
    sure = "overconfident"
    assert verdicts == [(sure, 2), (sure, 0), ("consistent", 0), ("conservative", 1)]


def test_saved_settings_replay_to_the_same_numbers(
    session: Session, log: Path, tmp_path: Path, fuselog: Callable[..., Any]
) -> None:
    file = tmp_path / "settings.toml"
    file.write_text(session.toml(SURE), encoding="utf-8")
    assert tomllib.loads(file.read_text(encoding="utf-8")) == {"ekf": SURE}
    command = session.command(SURE)
    assert command == f"fuselog replay {log} -e ekf --set sigma_range_m=0.03"
    played = session.play("ekf", SURE).cases["robot1"]
    error_m, _ = numbers_of(played)["error, RMS"]
    for words in (command.split()[1:], ["replay", log, "-e", "ekf", "--settings", file]):
        said = fuselog(*words, "-o", tmp_path / f"{len(words)}.mcap", "--json")
        assert json.loads(said.out)["metrics"]["ekf.position_rmse_m.robot1"] == pytest.approx(error_m)


def test_the_command_names_what_was_set_before(log: Path) -> None:
    """Settings of a filter's own, but for those that a slider changed since."""
    own = {"kind": "ekf", "sigma_range_m": 0.2, "sigma_bearing_rad": 0.1, "estimate": ["bias_range_m"]}
    own |= {"estimate_sigma": {"bias_range_m": 0.1}}
    found = open_session(log, {"ekf": own, "mine": {"kind": "ukf"}})
    assert found.command({"sigma_bearing_rad": 0.05}) == (
        f"fuselog replay {log} -e ekf --set ekf.sigma_range_m=0.2 "
        "--set 'ekf.estimate=[\"bias_range_m\"]' --set ekf.estimate_sigma.bias_range_m=0.1 "
        "-e mine --set 'mine.kind=\"ukf\"' --set sigma_bearing_rad=0.05"
    )


def test_sliders_are_of_what_the_log_is_read_by(session: Session) -> None:
    found = {each.name: each for each in session.sliders}
    assert {
        "sigma_range_m",
        "bias_bearing_rad",
        "turn_noise_density",
        "gate_probability",
    } <= found.keys()
    assert not {"sigma_fix_m", "lever_x_m", "sigma_heading_rad"} & found.keys()
    for slider in found.values():
        assert slider.low <= slider.default <= slider.high
        assert slider.value(slider.place(slider.default)) == slider.default
        ends = slider.value(0.0), slider.value(1.0)
        assert ends == pytest.approx((slider.low, slider.high), rel=1e-3)
    assert found["sigma_range_m"].value(0.0) == pytest.approx(0.01)
    with pytest.raises(BadInput, match="no slider 'sigma_rang_m'; did you mean 'sigma_range_m'"):
        session.slider("sigma_rang_m")


@pytest.mark.paper
def test_likelihood_is_greatest_where_tuning_ends(session: Session) -> None:
    along = session.likelihoods("ekf", SURE, "sigma_range_m")
    points = [(value, each["robot1"]) for value, each in along]
    best = max(points, key=lambda each: each[1])[0]
    tuned = session.tuned("ekf", SURE, ["sigma_range_m"])[0]["sigma_range_m"]
    values = [value for value, _ in points]
    assert abs(values.index(best) - np.argmin(np.abs(np.log(np.array(values) / tuned)))) <= 1
    assert session.diagnosed("ekf", SURE)[0].startswith("1. sigma_range_m")


@pytest.mark.paper
def test_a_parameter_is_taken_into_the_state(session: Session) -> None:
    """Its estimate is drawn and said; NEES is still of what the truth has."""
    document_of = pytest.importorskip("bokeh.document").Document
    from fuselog.pipeline.exploring.page import Page
    from fuselog.pipeline.exploring.widgets import time_range

    page = Page(session.with_estimated(["bias_range_m"]), document_of())
    page.end()
    page._component.value = "bias_range_m"
    case = page.played[0].cases["robot1"]
    assert case.components[-1] == "bias_range_m"
    assert case.nees_interval == session.play("ekf", {}).cases["robot1"].nees_interval
    drawn, figure = page.plots["error"].sources, page.plots["error"].figure
    line, band = drawn[0, "line"].data, drawn[0, "band"].data
    assert abs(line["y"][-1]) < 0.02
    assert band["low"][-1] < line["y"][-1] < band["high"][-1]
    assert figure.y_range.start < min(line["y"])
    assert figure.title.text.startswith("Estimate of bias range (m); ")
    assert "Estimated in the state: bias range is " in page._head.text
    assert "bias range, estimated from" in page._widgets["bias_range_m"][2].text
    assert figure.xaxis.axis_label == "time since the log began (s)"
    assert time_range(1_250_000_000 * 10**9).name == "seconds since 2009-08-11 14:13:20 UTC"


def test_only_methods_that_can_follow_the_log_are_offered(session: Session, log: Path) -> None:
    """A robot's model has no exact moments and no modes."""
    can = ["ekf", "iekf", "ukf", "lrkf", "sqrt", "smoother", "bank", "particles"]
    assert session.methods == can
    assert open_session(log, {"mine": fl.modelled(ROBOT, "ekf")}).methods == can
    assert "imm" in open_session(fl.record("vehicles", duration_s=5.0), "ekf").methods


def test_other_methods_estimate_an_own_model(log: Path) -> None:
    own = open_session(log, {"mine": fl.modelled(ROBOT, "ekf")})
    other = own.with_filters({"ukf": own.like_first("ukf")})
    assert other.play("ukf", {}).verdicts["robot1"].level == "good"


def test_a_log_without_truth_is_explored(log: Path) -> None:
    source = fl.open(log)
    streams = {name: source[name] for name in source if "truth" not in name}
    found = open_session(fl.MemorySource(streams, source.run, "blind", source.start_ns), "ekf")
    case = found.play("ekf", SURE).cases["robot1"]
    assert case.errors is None
    assert typical_time_s(case) is None
    assert found.play("ekf", SURE).verdicts["robot1"].headline == "Overconfident."


def test_nothing_drawn_is_lost(session: Session) -> None:
    values = np.zeros(100_000)
    values[[77_777, 33]] = 5.0, -4.0
    rows = extremes(values)
    assert len(rows) <= 400
    assert (values[rows].min(), values[rows].max()) == (-4.0, 5.0)
    [outline] = ellipses(np.array([[1.0, 2.0]]), np.diag([4.0, 1.0])[None]) - [1.0, 2.0]
    assert np.ptp(outline, axis=0) == pytest.approx(
        [4.0 * np.sqrt(5.9915), 2.0 * np.sqrt(5.9915)], rel=1e-3
    )


def test_the_lens_shows_the_truth_near_its_instant(session: Session) -> None:
    pytest.importorskip("bokeh")
    from fuselog.pipeline.exploring.plots import blank, show_lens

    plot, scene = blank("lens", ""), blank("scene", "")
    shown = plot.source(0, "truth", "x", "y")
    seconds = np.arange(60.0)
    truth = Track(seconds, np.stack([seconds, -seconds], axis=1))
    show_lens(plot, scene, {0: session.play("ekf", SURE)}, "robot1", truth, 30.0)
    assert shown.data["x"].tolist() == [*range(26, 35)]
    assert shown.data["y"].tolist() == [-each for each in range(26, 35)]


def test_the_page_draws_and_says_what_was_replayed(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All plots are read back, of a filter that is too sure, above the one that was pinned."""
    document_of = pytest.importorskip("bokeh.document").Document
    from fuselog.pipeline.exploring.page import Page

    document, acts = document_of(), Queue()
    document.add_next_tick_callback = acts.put
    page, slider = Page(session, document), session.slider("sigma_range_m")
    try:
        page._pin()
        page._widgets["sigma_range_m"][1].value = slider.place(0.03)
        shown = page.plots["likelihood"].sources[0, "here"]
        while list(shown.data["x"]) != [slider.place(0.03)]:  # which comes after the replay
            acts.get(timeout=20.0)()
        page._component.value = "y_m"
    finally:
        page.end()
    drawn = {name: plot.sources for name, plot in page.plots.items()}
    titles = {name: plot.figure.title.text for name, plot in page.plots.items()}
    assert page.values.keys() == {"sigma_range_m"}
    values = dict(page.values)
    for of, played in (("pinned", session.play("ekf", {})), (0, session.play("ekf", values))):
        case = played.cases["robot1"]
        sigma, most = 1.96 * np.sqrt(case.errors.covariance[:, 1, 1]), np.abs(case.errors.error[:, 1])
        wanted = {
            "error": (case.errors.elapsed_s, case.errors.error[:, 1]),
            "nees": (case.errors.elapsed_s, case.errors.nees),
            "nis": (case.nis.time_s, case.nis.mean),
            "scene": tuple(case.path.points.T),
        }
        for name, (x, y) in wanted.items():
            line = drawn[name][of, "line"].data
            shown = set(zip(line["t" if "t" in line else "x"].tolist(), line["y"].tolist(), strict=True))
            assert shown <= set(zip(x.tolist(), y.tolist(), strict=True)), name
            assert len(shown) >= min(len(x), 200), name
        row = np.argmin(np.abs(case.path.time_s - page._at_s))
        outline = drawn["lens"][of, "ellipse"].data
        middle = [np.mean([np.min(outline[axis]), np.max(outline[axis])]) for axis in "xy"]
        np.testing.assert_allclose(middle, case.path.points[row], atol=1e-3)
    band, rows = drawn["error"][0, "band"].data, fewer(len(sigma))
    np.testing.assert_allclose((band["low"], band["high"]), (-sigma[rows], sigma[rows]))
    is_out = {"Error of y (m)": most > sigma, "NIS per component": None, "NEES": None}
    low, high = case.nees_interval
    is_out["NEES"] = (case.errors.nees < low) | (case.errors.nees > high)
    is_out["NIS per component"] = (case.nis.mean < case.nis.low) | (case.nis.mean > case.nis.high)
    for (words, outside), name in zip(is_out.items(), ("error", "nis", "nees"), strict=True):
        share = np.mean(outside)
        said = f"{words}: outside {100 * share:.{int(share < 0.1)}f} %; 5 % expected"
        assert titles[name] == said
    assert titles["scene"] == "Scene from above (m)"
    assert titles["lens"] == f"Lens at {page._at_s:.1f} s (m)"
    for plot, low, high in (("nees", *case.nees_interval), ("nis", case.nis.low, case.nis.high)):
        interval = drawn[plot][0, "interval"].data
        assert np.all(interval["low"] == low)
        assert np.all(interval["high"] == high)
    end = page.plots["error"].figure.y_range.end
    assert end == pytest.approx(1.1 * max(2 * np.median(sigma), np.quantile(most, 0.995)), rel=0.3)
    assert end == -page.plots["error"].figure.y_range.start
    least = min(case.whiteness, key=lambda name: case.whiteness[name].probability)
    assert titles["whiteness"].endswith(f" {least.rpartition('_')[0]}")
    np.testing.assert_array_equal(
        drawn["whiteness"][0, "line"].data["y"], case.whiteness[least].correlation
    )
    line, peak, here = (drawn["likelihood"][0, what].data for what in ("line", "peak", "here"))
    assert np.all(np.diff(line["x"]) > 0)
    assert (peak["y"], here["x"]) == (max(line["y"]), slider.place(0.03))
    assert here["y"].tolist() == [case.log_likelihood]
    assert f">{case.log_likelihood:,.0f}<".replace("-", "\N{MINUS SIGN}") in page._head.text
    assert slider.words(slider.value(peak["x"][0])) in titles["likelihood"]
    seen = page.plots["likelihood"].figure.y_range
    assert seen.start < min(here["y"]) <= max(peak["y"]) < seen.end
    assert "Overconfident." in page._head.text
    assert "pinned" in page._head.text
    for slow_s, is_said in ((1e9, False), (0.0, True)):
        monkeypatch.setattr("fuselog.pipeline.exploring.widgets.SLOW_S", slow_s)
        page._show_head()
        assert ("One replay takes" in page._head.text) == is_said
    assert "--set sigma_range_m=0.03" in page._command.text


def test_the_newest_work_wins() -> None:
    pytest.importorskip("bokeh")
    from fuselog.pipeline.exploring.page import NewestFirst

    begun, go_on, done, ended = Event(), Event(), [], Event()
    worker = NewestFirst(done.append)

    def first(is_newer: Any) -> None:
        begun.set()
        go_on.wait(5.0)
        done.append(("first", is_newer()))

    worker.ask(first)
    begun.wait(5.0)
    for number in range(5):
        worker.ask(lambda _, number=number: (done.append(number), ended.set()))
    go_on.set()
    assert ended.wait(5.0)
    worker.end()
    assert done == [("first", True), 4]


@pytest.mark.parametrize(
    ("estimators", "sentence"),
    [
        (["ekf", "ukf", "iekf"], "ekf, ukf, iekf: explore takes at most 2 filters at a time"),
        (["network"], "network"),
    ],
)
def test_what_cannot_be_explored_is_said(log: Path, estimators: list[str], sentence: str) -> None:
    with pytest.raises(BadInput, match=sentence):
        open_session(log, estimators)


# The page.


@pytest.fixture(scope="module")
def explorer(log: Path) -> Iterator[Any]:
    pytest.importorskip("bokeh")
    explorer = fl.explore(log, "ekf", show=False)
    yield explorer
    explorer.close()


def test_who_does_not_know_the_address_gets_nothing(explorer: Any) -> None:
    base = explorer.url.rsplit("/", 2)[0]
    host, port = base.removeprefix("http://").split(":")
    assert host == "127.0.0.1"
    for path in ("/", "/ws", "/autoload.js", "/static/js/bokeh.min.js", "/" + "a" * 32 + "/"):
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(base + path)
        assert refused.value.code == 404
        refused.value.close()
    for family, address in ((socket.AF_INET, _outer_address()), (socket.AF_INET6, "::1")):
        with socket.socket(family) as tried:
            tried.settimeout(1.0)
            assert tried.connect_ex((address, int(port))) != 0


def _outer_address() -> str:
    """An address of this machine in its network, else another one of its loopback."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        try:
            asked.connect(("192.0.2.1", 9))
            return str(asked.getsockname()[0])
        except OSError:
            return "127.0.0.2"


def asked(url: str, path: str, *headers: str, upgrade: bool = True) -> bytes:
    """The begin of the answer to a request for a path, of a WebSocket unless that is not wanted."""
    lines = [f"GET /{path} HTTP/1.1", *headers]
    if upgrade:
        lines += ["Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Version: 13"]
        lines += ["Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="]
    name, port = url.removeprefix("http://").split("/")[0].split(":")
    with socket.create_connection((name, int(port))) as connection:
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        return connection.recv(64)


@pytest.mark.paper
def test_a_page_of_another_origin_gets_nothing(explorer: Any) -> None:
    """Nor does another name of this machine, or a WebSocket that has no origin."""
    with urllib.request.urlopen(explorer.url) as answer:
        assert "Access-Control-Allow-Origin" not in answer.headers
        assert 'name="referrer" content="no-referrer"' in answer.read().decode()
    host, path = explorer.url.removeprefix("http://").split("/", 1)
    own, other = f"http://{host}", host.replace("127.0.0.1", "localhost")
    for given, origin in (
        *((host, ["http://evil.example"]), (host, ["http://localhost:1"]), (host, []), (host, ["null"])),
        *((other, [own]), (other, [f"http://{other}"]), ("evil.example", ["http://evil.example"])),
        (host, [own, "http://evil.example"]),
    ):
        stated = [f"Host: {given}", *(f"Origin: {each}" for each in origin)]
        answered = asked(explorer.url, f"{path}ws", *stated)
        assert answered.startswith((b"HTTP/1.1 403 ", b"HTTP/1.1 400 ")), (given, origin, answered)
    assert asked(explorer.url, path, f"Host: {other}", upgrade=False).startswith(b"HTTP/1.1 403 ")
    own_headers = f"Host: {host}", f"Origin: {own}"
    assert asked(explorer.url, f"{path}ws", *own_headers).startswith(b"HTTP/1.1 101 ")


NOW = """() => {
  const source = Bokeh.documents[0].get_model_by_name("nis-line-0");
  return Array.from(source.data.y).reduce((sum, each) => sum + each, 0) / source.data.y.length;
}"""
DRAG = 'place => { Bokeh.documents[0].get_model_by_name("sigma_range_m").value = place; }'


@pytest.mark.paper
def test_in_a_browser_curves_follow_the_slider(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The newest value wins; the timeline is opened with it, at the instant of the lens."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium: install one, or run `playwright install chromium`")
    explorer = fl.explore(log, "ekf", show=False)
    slider = explorer.session.slider("sigma_range_m")
    said: list[str] = []
    viewed, is_viewed = [], Event()

    def view(rrd: Path, *, at_s: float) -> None:
        viewed.append((rrd.read_bytes()[:4], f"Lens at {at_s:.1f} s (m)"))
        is_viewed.set()

    monkeypatch.setattr("fuselog.replay.timeline.viewer.view", view)  # there is no screen
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.on(
            "console", lambda message: said.append(message.text) if message.type == "error" else None
        )
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto(explorer.url)
        page.wait_for_selector("text=No problem found.")
        axe = pytest.importorskip("axe_playwright_python", reason="axe-playwright-python is missing")
        page.evaluate((Path(axe.__file__).parent / "axe.min.js").read_text(encoding="utf-8"))
        assert page.evaluate("axe.run().then((each) => each.violations.map((one) => one.id))") == []
        handle = page.get_by_role("slider", name="sigma range, /robot1/range_bearing")
        assert handle.get_attribute("aria-valuetext") == "10 cm"
        before = page.evaluate(NOW)
        for place in (0.9, 0.1, 0.7, 0.25):  # the last one wins
            page.evaluate(DRAG, place)
        wanted = explorer.session.play("ekf", {"sigma_range_m": slider.value(0.25)}).cases["robot1"]
        mean = float(wanted.nis.mean.mean())
        page.wait_for_function(f"Math.abs(({NOW})() - {mean}) < 1e-9 * {mean}")
        page.wait_for_selector("text=Overconfident.")
        assert mean > 2.0 * before
        page.wait_for_selector(f"text=--set sigma_range_m={slider.value(0.25)!r}")
        page.get_by_text("Pin", exact=True).click()
        page.get_by_text("Reset", exact=True).click()
        page.wait_for_selector("text=No problem found.")
        page.wait_for_selector("text=pinned")
        assert page.get_by_text("--set sigma_range_m").count() == 0
        page.set_viewport_size({"width": 400, "height": 900})
        where = "(each) => each.getBoundingClientRect().top"
        shown = [page.get_by_role(role).first.evaluate(where) for role in ("main", "form")]
        assert shown == sorted(shown)  # on a phone plots come before sliders
        page.get_by_text("Timeline", exact=True).click()
        assert is_viewed.wait(30.0)
        title = "() => Bokeh.documents[0].get_model_by_name('lens').title.text"
        assert viewed == [(b"RRF2", page.evaluate(title))]
        browser.close()
    explorer._is_ended.wait(20.0)
    assert explorer._is_ended.is_set()  # the page is closed
    assert said == []


@pytest.mark.skipif(os.name != "posix", reason="an interrupt is sent as POSIX has it")
@pytest.mark.paper
def test_ctrl_c_ends_everything(
    log: Path, start_fuselog: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    """Odd requests give one line a kind meanwhile, without the secret and without control characters.

    No module of the current folder is imported.
    """
    pytest.importorskip("bokeh")
    command = ["explore", str(log), "-e", "ekf", "--no-browser"]
    with shadowed(tmp_path), start_fuselog(*command, stderr=subprocess.STDOUT) as running:
        assert running.stdout is not None
        said = running.stdout.readline()
        url = re.search(r"http://\S+/", said)
        assert url is not None, said
        with urllib.request.urlopen(url[0]) as answer:
            assert answer.status == 200
        host, path = url[0].removeprefix("http://").split("/", 1)
        for each in ("ws", "ws?a=\x9b2J", "ws/../x", "%00", "autoload.js?bokeh-session-id=x", "\x9b"):
            for protocol in 2 * ("bokeh, x", "x, bokeh.\x9b") + ("bokeh, " + "a" * 100,):
                own = f"Host: {host}", f"Origin: http://{host}", f"Sec-WebSocket-Protocol: {protocol}"
                assert asked(url[0], path + each, *own)
            assert asked(url[0], each, f"Host: {host}", upgrade=False).startswith(b"HTTP/1.1 404 ")
        running.send_signal(signal.SIGINT)
        assert running.wait(10.0) == 128 + signal.SIGINT
        lines = running.stdout.read().splitlines()
    assert 1 < len(lines) < 10
    assert len({*lines}) == len(lines)
    assert not [each for each in lines if path.strip("/") in each or "\x9b" in each or "Trace" in each]
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(url[0])


ENDS = """
import atexit, sys, threading
import fuselog as fl
if __name__ == "__main__":
    atexit.register(lambda: print(threading.active_count()))  # after all that is registered later
    fl.explore(sys.argv[1], "ekf", show=False)
    assert not {"rerun", "scipy.optimize"} & sys.modules.keys()  # slow to import, for views and searches
"""


@pytest.mark.paper
@pytest.mark.paper
def test_a_script_that_ends_with_an_open_page_ends_the_server(log: Path, tmp_path: Path) -> None:
    """Python up to 3.13 breaks off threads that are still at work, which can abort the process."""
    pytest.importorskip("bokeh")
    script = tmp_path / "script.py"
    script.write_text(ENDS, encoding="utf-8")
    ended = subprocess.run([sys.executable, script, log], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "1\n", "")
