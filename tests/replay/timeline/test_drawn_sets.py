"""What is drawn of sets, scores, vessels and samples is what streams say; nothing is lost on the way."""

import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import rgb_to_hsv
from scipy.stats import chi2

from fuselog.recorders.log import make_stream, schemas
from fuselog.replay.families.biometrics.timeline import OF_PROBE
from fuselog.replay.families.tracking.ais_timeline import track_colours
from fuselog.replay.timeline.drawing.canvas import PALETTE, WRONG
from fuselog.replay.timeline.show import Drawing
from tests.replay.timeline.made_runs import SECOND, own, samples, scores, sets, vessels
from tests.replay.timeline.making import ESTIMATORS, columns, drawn, of_both, record
from tests.replay.timeline.reading import Wanted, check_views, compare, picture_of


def test_sets_are_drawn_with_their_areas(tmp_path: Path) -> None:
    """A rectangle, none, and a rectangle with a hole, which its area lacks."""
    stamps = SECOND * np.arange(1, 4)
    square = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]])
    hole = 1.0 + 0.25 * square[::-1]
    rings = [square, square + 1.0, hole + 1.0]
    run = drawn(tmp_path, *sets(rings))
    closed = np.stack([np.concatenate([ring, ring[:1]]) for ring in rings])
    wanted = {
        "/map/robot1/one": Wanted("lines", stamps[[0, 2, 2]], closed),
        "/map/robot1/truth": Wanted("dots", stamps, np.ones((3, 2))),
        "/plots/robot1/area/one": Wanted("curve", stamps, [12.0, 0.0, 12.0 - 0.75]),
    }
    compare(run.picture.moving, wanted)
    check_views(
        run.picture,
        {("Map", "map/robot1"), ("Area of the set (m²), at the end 11.2 for one", "plots/robot1/area")},
    )


def test_scores_are_those_of_each_probe_and_wrong_decisions_are_counted(tmp_path: Path) -> None:
    """Four probes, one of which is taken for another user; genuine is what is of one user."""
    arrivals = SECOND * np.arange(1, 5)
    rng = np.random.default_rng(1)
    given = rng.uniform(0.0, 1.0, (4, 4, 2)) + 2.0 * np.eye(4)[:, :, None]
    given[2, 3] += 3.0
    sums = given.sum(axis=2)
    run = drawn(tmp_path, *scores(given, arrivals))
    wanted = {}
    others = np.where(np.eye(4) > 0, -np.inf, 1.0)
    for plot, own_scores in (
        ("fusion/finger/one/scores", sums),
        ("matchers/finger/left", given[:, :, 0]),
        ("matchers/finger/right", given[:, :, 1]),
    ):
        greatest = np.where(others > 0, own_scores, -np.inf).max(axis=1)
        wanted[f"/{plot}/genuine"] = Wanted("curve", arrivals, np.diag(own_scores))
        wanted[f"/{plot}/impostor"] = Wanted("curve", arrivals, greatest)
    wanted["/fusion/finger/one/scores/threshold"] = Wanted("curve", arrivals[[0, -1]], [3.0, 3.0])
    wrong = [
        50.0 * (np.mean(np.diag(sums)[:k] <= 3.0) + np.sum((sums * others)[:k] > 3.0) / (3 * k))
        for k in range(1, 5)
    ]
    wanted["/errors/finger/one"] = Wanted("curve", arrivals, wrong)
    bars = {f"/fusion/finger/one/distribution/{kind}" for kind in ("genuine", "impostor")}
    compare({name: rows for name, rows in run.picture.moving.items() if name not in bars}, wanted)
    means = []
    for bar in sorted(bars):
        shares, at = (
            np.array(run.picture.moving[bar][f"BarChart:{name}"][-1][0]["buffer"])
            for name in ("values", "abscissa")
        )
        assert shares.sum() == pytest.approx(1.0)
        widths = run.picture.moving[bar]["BarChart:widths"][-1]
        assert widths == pytest.approx([0.5 * np.diff(at).mean()] * len(at), rel=1e-5)
        means.append(shares @ at)
    low, high = sums[others > 0], np.diag(sums)
    end = np.quantile(high, 0.95)
    width = end - low.min()
    assert means == pytest.approx(
        [np.minimum(high, end).mean(), np.minimum(low, end).mean()],
        abs=width / 30,
    )
    titles = {
        (f"one: log-likelihood ratio, {OF_PROBE} (-)", "fusion/finger/one/scores"),
        (
            "one: log-likelihood ratio, all comparisons so far (share in each bin)",
            "fusion/finger/one/distribution",
        ),
        ("Wrong decisions so far (%)", "errors/finger"),
        ("ROC: false reject rate over false accept rate", "rates/finger"),
        (f"left: score (-); {OF_PROBE}", "matchers/finger/left"),
        (f"right: score (-); {OF_PROBE}", "matchers/finger/right"),
    }
    check_views(run.picture, titles)


def test_a_fusion_without_a_threshold_decides_half_way_between_the_medians(tmp_path: Path) -> None:
    """The histogram and the probes have that threshold, and their titles tell where it is from."""
    given = np.random.default_rng(1).uniform(0.0, 1.0, (4, 4, 2)) + 2.0 * np.eye(4)[:, :, None]
    run = drawn(tmp_path, *scores(given, SECOND * np.arange(1, 5), threshold=""))
    sums, own_user = given.sum(axis=2), np.eye(4) > 0
    middle = 0.5 * (np.median(sums[own_user]) + np.median(sums[~own_user]))
    root = "/fusion/finger/one"
    assert np.ravel(run.picture.moving[f"{root}/scores/threshold"]["Scalars:scalars"]) == (
        pytest.approx([middle] * 2)
    )
    bars = run.picture.still[f"{root}/distribution/threshold"]["BarChart:abscissa"][0][0]
    assert np.array(bars["buffer"])[1] == pytest.approx(middle)
    told = [view.name for view in run.picture.views if "half-way between medians" in view.name]
    assert len(told) == 2


def test_a_failure_to_enrol_is_no_score(tmp_path: Path) -> None:
    given = np.random.default_rng(1).uniform(0.0, 1.0, (4, 4, 2)) + np.eye(4)[:, :, None]
    given[1, :, 0] = -1.0
    run = drawn(tmp_path, *scores(given, SECOND * np.arange(1, 5)))
    drawn_scores = np.ravel(run.picture.moving["/matchers/finger/left/genuine"]["Scalars:scalars"])
    assert drawn_scores == pytest.approx(np.diag(given[:, :, 0])[[0, 2, 3]])
    names = {view.name for view in run.picture.views}
    assert f"left: score (-), failures to enrol left out: 1; {OF_PROBE}" in names
    assert f"right: score (-); {OF_PROBE}" in names


def test_neighbours_in_number_are_far_apart_in_hue() -> None:
    hue = rgb_to_hsv(track_colours(np.arange(1, 100)) / 255.0)[:, 0]
    apart = np.abs(np.diff(hue))
    assert np.minimum(apart, 1.0 - apart).min() > 1 / 3


def test_reports_are_where_they_were_and_vessels_are_counted(tmp_path: Path) -> None:
    """Vessel 7 is heard for ten minutes after its last report; a track of its reports is another's."""
    stamps = SECOND * np.array([1, 10, 20, 30, 900])
    numbers = np.array([7, 8, 7, 8, 8])
    places = np.stack([10.0 * np.arange(5), -5.0 * np.arange(5)], axis=1)
    degrees = np.stack([50.0 + 1e-4 * np.arange(5), -1.0 - 2e-4 * np.arange(5)], axis=1)
    run = drawn(tmp_path, *vessels(stamps, numbers, [1, 2, 1, 3, 2], places, degrees))
    heard = SECOND * np.array([1, 10, 620, 630, 900])
    live = SECOND * np.array([1, 10, 30, 610, 620, 630, 900])
    wanted = {
        "/map/one/reports": Wanted("dots", stamps, places),
        "/geodetic/one/reports": Wanted("places", stamps, degrees),
        "/plots/live/vessels": Wanted("curve", heard, [1, 2, 1, 0, 1]),
        "/plots/live/one": Wanted("curve", live, [1, 2, 3, 2, 1, 0, 1]),
    }
    compare(run.picture.moving, wanted)
    colours = [row[0] for row in run.picture.moving["/map/one/reports"]["Points2D:colors"]]
    assert [colours.index(each) for each in colours] == [0, 1, 0, 3, 1]
    views = [(view.name.partition(",")[0], view.roots[0]) for view in run.picture.views]
    assert sorted(views) == [
        ("Heard within 10 min (number)", "plots/live"),
        ("Map", "map/one"),
        ("OpenStreetMap", "geodetic/one"),
        ("Vessels in tracks of one", "vessels"),
    ]
    [[table]] = run.picture.still["/vessels"]["TextDocument:text"]
    assert [line.split("|")[1:3] for line in table.splitlines()[2:]] == [["8", "3"], ["7", "2"]]


def test_samples_have_the_area_of_their_weight_in_the_circle_of_most(tmp_path: Path) -> None:
    places, weights = np.array([[0.0, 0.5], [1.0, -1.0], [-2.0, 0.25]]), np.array([1.2, 0.3, -0.5])
    run = drawn(tmp_path, *samples(places, weights))
    dots = run.picture.still["/map/one/samples"]
    np.testing.assert_allclose(dots["Points2D:positions"][0], places)
    np.testing.assert_allclose(
        np.square(dots["Points2D:radii"][0]), 14.0**2 * np.abs(weights), rtol=1e-5
    )
    packed = [int.from_bytes(bytes((*colour, 255)), "big") for colour in (PALETTE[0], PALETTE[0], WRONG)]
    assert dots["Points2D:colors"][0] == packed
    circle = np.array(run.picture.still["/map/one/circle"]["LineStrips2D:strips"][0][0])
    np.testing.assert_allclose(np.sum(circle**2, axis=1), chi2.ppf(0.95, 2), rtol=1e-5)
    assert [(view.name, view.roots) for view in run.picture.views] == [("one, 3 samples", ["map/one"])]


def test_two_stand_side_by_side_above_how_much_farther_off_the_second_is(tmp_path: Path) -> None:
    source = record("landmarks", duration_s=2.0, landmarks=3)
    made = of_both(source, "robot1")
    alone = drawn(tmp_path, source, made)
    with Drawing(source, identity="both", save=tmp_path / "both.rrd", sides=ESTIMATORS) as drawing:
        drawing.add(alone.made, alone.errors)
    picture = picture_of(tmp_path / "both.rrd")
    truth = alone.truth("robot1")
    one, two = (
        np.linalg.norm(
            (columns(each, "mean", "x_m", "y_m") - columns(truth, "state", "x_m", "y_m")[1:]), axis=1
        )
        for each in made
    )
    plot = "/plots/robot1/difference"
    curve = Wanted("curve", truth.publish_time_ns[1:], two - one)
    [drawn_of] = [rows for entity, rows in picture.moving.items() if entity.startswith(f"{plot}/two")]
    compare(
        {plot: drawn_of},
        {plot: curve},
    )
    titles = {view.name: view.roots for view in picture.views}
    assert [title for title in titles if "Legend" in title] == ["Legend"]
    assert titles["robot1 difference in the size of errors (m)"] == [plot[1:]]
    for name, other in (ESTIMATORS, ESTIMATORS[::-1]):
        [roots] = [roots for title, roots in titles.items() if title.startswith(f"{name}: Map, grid")]
        assert roots[0] == "map/robot1"
        assert f"- map/robot1/{other}" in roots
        assert f"- map/robot1/{name}" not in roots


def test_where_a_thinned_estimate_begins_it_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fuselog.replay.timeline.drawing.events.thin", lambda times: times[::2])
    source = record("landmarks", duration_s=2.0, landmarks=3)
    run = drawn(tmp_path, source, of_both(source, "robot1"))
    for name, stream, _ in run.estimates("robot1"):
        said = run.picture.moving[f"/events/robot1/{name}"]
        assert said["sim_time"] == [stream.publish_time_ns[0] - source.epoch_ns]
        [[text]] = said["TextLog:text"]
        assert re.search(rf", {name}: drawn at \S+ Hz instead of \S+ Hz$", text)


def test_nothing_is_lost_where_a_block_ends_or_a_number_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blocks of three messages, many of which share a stamp; one of two components may be missing."""
    monkeypatch.setattr("fuselog.replay.timeline.drawing.thinning.BLOCK_MESSAGES", 3)
    stamps = SECOND * np.repeat(np.arange(1, 9), [1, 2, 4, 1, 3, 5, 1, 2])
    value = np.stack([np.arange(19.0), -np.arange(19.0)], axis=1)
    value[4::5, 0] = np.nan
    metadata = {"components": "left_m,right_rad", "kinds": "linear,linear"}
    truth = make_stream("/truth", schemas.TRUTH_STATE, stamps, metadata=metadata, state=value)
    away = 1.0 + np.arange(19)
    seen = make_stream("/near", schemas.RANGE, stamps, target_id=np.arange(19) % 3, range_m=away)
    picture = drawn(tmp_path, own("unheard-of", truth, seen), []).picture
    for values, name in ((value[:, 0], "left_m"), (np.degrees(value[:, 1]), "right_rad")):
        curve = Wanted("curve", stamps, values)
        compare({name: picture.moving[f"/plots/{name}/truth"]}, {name: curve})
    circles = picture.moving["/about/near/seen"]["LineStrips2D:strips"]
    radii = [np.hypot(*strip[0]) for row in circles for strip in row or []]
    np.testing.assert_allclose(radii, away, rtol=1e-6)
