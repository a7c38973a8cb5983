"""Claims as data: what expressions say of metrics and intervals, which verdicts follow."""

import gzip
import math
from pathlib import Path

import pytest

from fuselog.pipeline.output.claims import (
    Claim,
    StatedClaim,
    decide,
    judged,
    known,
    require_names,
    require_recordings,
)
from fuselog.pipeline.output.expressions import Values, evaluate, formatted, truth
from fuselog.pipeline.output.numbers import exactly
from fuselog.pipeline.runs.experiment import Experiment, Stated, load_experiment
from fuselog.pipeline.runs.inputs import Recording, holding, shipped
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import build
from fuselog.replay.judging.intervals import Interval
from fuselog.replay.judging.verdicts import Claimed
from tests.goldens.recipes import DATA, importer_of, unpack

METRICS = {
    "ekf.nees.robot1": 2.0,
    "ekf.nees.robot2": 3.0,
    "smoother:ekf.nees.robot1": 2.5,
    "ekf.rmse_m": 0.5,
    "ekf.gain.ukf": 0.3,
    "ekf.gain.few": 0.3,  # of fewer runs than an interval takes
    "ekf.by_noise.1": [1.0, 2.0, 4.0],
    "lost.rmse_m": None,
}
INTERVALS: dict[str, tuple[float | None, float | None]] = {
    "ekf.gain.ukf": (0.1, 0.5),
    "ekf.gain.few": (None, None),
    "ekf.nees.robot1": (1.5, 2.5),
}
VALUES = Values(METRICS, INTERVALS, {"runs": exactly(100)})


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("nees[ekf, robot1] - 2 * rmse_m[ekf]", (1.0, 0.5, 1.5)),
        ("1 / gain[ekf, ukf]", (1 / 0.3, 2.0, 10.0)),
        ("nees[smoother:ekf, robot1]", (2.5, 2.5, 2.5)),
        ("max(nees[*, robot1], 1)", (2.5, 2.5, 2.5)),
        ("by_noise[ekf, 1][-1] / 2", (2.0, 2.0, 2.0)),
        ("count(by_noise[ekf, 1] > [0, 2, 3])", (2.0, 2.0, 2.0)),
        ("abs(gain[ekf, ukf] - 0.2)", (0.1, 0.0, 0.3)),
        ("deviation(by_noise[ekf, 1])", (math.sqrt(7 / 3),) * 3),
        ("-gain[ekf, ukf]", (-0.3, -0.5, -0.1)),
        ("abs(-gain[ekf, ukf])", (0.3, 0.1, 0.5)),
        ("0.5 - gain[ekf, ukf] ** 2", (0.41, 0.25, 0.49)),
        ("-2 * gain[ekf, ukf]", (-0.6, -1.0, -0.2)),
        ("low(gain[ekf, ukf]) + high(nees[ekf, robot1])", (2.6, 2.6, 2.6)),
        ("mean([gain[ekf, ukf], nees[ekf, robot1]])", (1.15, 0.8, 1.5)),
        ("median(by_noise[ekf, 1])", (2.0, 2.0, 2.0)),
        ("min(gain[ekf, ukf], 0.4)", (0.3, 0.1, 0.4)),
        ("sum(by_noise[ekf, 1]) - len(by_noise[ekf, 1])", (4.0, 4.0, 4.0)),
        ("sqrt(gain[ekf, ukf])", (math.sqrt(0.3), math.sqrt(0.1), math.sqrt(0.5))),
        ("log(gain[ekf, ukf])", (math.log(0.3), math.log(0.1), math.log(0.5))),
        ("degrees(rmse_m[ekf])", (math.degrees(0.5),) * 3),
        ("plus_minus(rmse_m[ekf], 0.2)", (0.5, 0.3, 0.7)),
        ("chi_square(0.95, 3)", (7.814728,) * 3),
        ("consistent(2, 50)", (2.0, 1.484439, 2.591224)),  # chi-square of 100 degrees, over 50
    ],
)
def test_expressions_carry_intervals(expression: str, value: tuple[float, ...]) -> None:
    found = evaluate(expression, VALUES)
    assert isinstance(found, Interval)
    assert found[:3] == pytest.approx(value)


@pytest.mark.parametrize(
    ("comparison", "holds"),
    [
        ("gain[ekf, ukf] > 0", True),
        ("gain[ekf, ukf] > 0.5", False),  # not even the upper end is
        ("gain[ekf, ukf] >= 0.5", None),
        ("gain[ekf, ukf] > 0.2", None),
        ("0 < gain[ekf, ukf] < 0.4", None),
        ("gain[ekf, ukf] > 0.2 and rmse_m[ekf] > 1", False),
        ("gain[ekf, ukf] > 0.2 or rmse_m[ekf] < 1", True),
        ("not gain[ekf, ukf] > 0.2", None),
        ("2 in nees[ekf, robot1]", True),
        ("3 in nees[ekf, robot1]", False),
        ("nees[ekf, robot1] in consistent(2, runs)", None),
        ("nees[ekf, *] > 1", True),  # a list holds in all entries
        ("by_noise[ekf, 1] < 4", False),
        ("falls(by_noise[ekf, 1])", False),
    ],
)
def test_an_interval_that_holds_both_leaves_a_comparison_open(
    comparison: str, holds: bool | None
) -> None:
    assert truth(comparison, VALUES) is holds


def test_sentences_say_numbers_their_intervals_and_names() -> None:
    template = "{gain[ekf, ukf]:+.2f} m, {nees[ekf, *]!n:.1f}; {100 * rmse_m[ekf]:.0f} %"
    assert (
        formatted(template, VALUES)
        == "+0.30 (+0.10 to +0.50) m, robot1 2.0 (1.5 to 2.5), robot2 3.0; 50 %"
    )


def claim(**values: object) -> StatedClaim:
    stated = {"sentence": "s", "paper": "p", **values}
    experiment = build(Experiment, {"title": "t", "claims": [stated]}, "experiment mine.toml")
    return experiment.claims[0]


@pytest.mark.parametrize(
    ("value", "verdict"),
    [
        ("gain[ekf, ukf]", "confirmed"),
        ("gain[ekf, ukf] - 0.3", "inconclusive"),
        ("gain[ekf, ukf] - 1", "refuted"),
        ("gain[ekf, few]", "inconclusive"),
        ("rmse_m[lost]", "not reproducible"),
        ("rmse_m[ekf | nobody][0]", "not reproducible"),
        ("rmse_m[nobody]", "not reproducible"),
    ],
)
def test_what_chance_may_have_made_is_not_shown(value: str, verdict: str) -> None:
    [found] = decide([claim(value=value, holds="value > 0")], METRICS, INTERVALS, {})
    assert found.verdict == verdict
    assert ("which needs 5" in found.why) == ("few" in value)
    left = decide([claim(value=value, holds="value > 0", optional=True)], METRICS, INTERVALS, {})
    assert len(left) == ("nobody" not in value)


@pytest.mark.parametrize(
    ("holds", "why"),
    [
        ("value < limit", "nees is not below 2.5 (limit) in 1 of 2 (robot2: 3)"),
        ("2.5 > value", "nees is not below 2.5 in 1 of 2 (robot2: 3)"),
        ("value[0] > value[1]", "nees of robot1 is 2 (1.5 to 2.5), not above 3 (nees, robot2)"),
        ("not (value[0] < 4 or value[1] == 1)", "nees of robot1 is 2 (1.5 to 2.5), below 4"),
        ("rmse_m[ekf] < 1 and value[1] in [1]", "nees of robot2 is 3, not within 1 to 1"),
        ("[1, 5] < [2, 4] and rmse_m[ekf] > 0", "[1, 5] is not below 4 in 1 of 2 (entry 2: 5)"),
        ("[1, 5] < [0, 6] or [1, 5] > [2, 7]", "[1, 5] is not below 0 in 1 of 2 (entry 1: 1); "
         "[1, 5] is not above 2 in 1 of 2 (entry 1: 1)"),
        ("over and falls(by_noise[ekf, 1])", "by_noise[ekf, 1] is not below the one before in 2 of 2 "
         "(entry 1: 2 against 1, entry 2: 4 against 2)"),
        ("1e5 * rmse_m[ekf] == 50000.0001", "100000.0 * rmse_m[ekf] is 50000, not equal to 50000.0001"),
    ],
)  # fmt: skip
def test_a_refuted_claim_names_the_numbers_that_are_against_it(holds: str, why: str) -> None:
    given = {"limit": "2 + rmse_m[ekf]", "over": "nees[ekf, *] > 1"}
    stated = claim(holds=holds, value="nees[ekf, *]", given=given)
    [found] = decide([stated], METRICS, INTERVALS, {})
    assert (found.verdict, found.why) == ("refuted", why)
    [found] = decide([stated.model_copy(update={"unless": "own words"})], METRICS, INTERVALS, {})
    assert found.why == "own words"


def test_a_comparison_with_a_number_that_is_missing_decides_nothing() -> None:
    stated = claim(
        given={"wins": "[rmse_m[ekf], rmse_m[lost]] < 1"},
        holds="count(wins) > 1 or any(wins)",
        ours="{count(wins):g} of {len(wins):g}",
    )
    [found] = decide([stated], METRICS, {}, {})
    assert (found.verdict, found.ours) == ("not reproducible", "1 of 2")
    assert found.why == "estimates are missing"


def test_a_claim_is_made_of_each_and_its_limit_stands_once() -> None:
    """Combinations in order; a table gives several names, a `*` what there is."""
    stated = claim(
        sentence="$robot: $words, at most {limit:g}",
        each={"robot": "nees[ekf, *]", "of": [{"words": "a", "least": 1}, {"words": "b", "least": 3}]},
        given={"limit": 2.5},
        value="nees[ekf, $robot]",
        holds="$least <= value <= limit",
        why="always",
        unless="except here",
    )
    found = decide([stated], METRICS, {}, {})
    assert [(each.claim, each.verdict, each.why) for each in found] == [
        ("robot1: a, at most 2.5", "confirmed", "always"),
        ("robot1: b, at most 2.5", "refuted", "always; except here"),
        ("robot2: a, at most 2.5", "refuted", "always; except here"),
        ("robot2: b, at most 2.5", "refuted", "always; except here"),
    ]
    assert found[0].ours == "2"
    [bare] = decide([claim(ours="-")], METRICS, {}, {})
    assert bare.verdict == "not reproducible"
    unmet = claim(value="rmse_m[ekf]", holds="value < 1", reproducible="value > 1")
    assert decide([unmet], METRICS, {}, {})[0].verdict == "not reproducible"


@pytest.mark.parametrize(
    ("stated", "verdict"),
    [
        ({"value": "gain[ekf, ukf]", "holds": "value > 0"}, "confirmed"),  # an interval decides
        ({"given": {"lead": "gain[ekf, ukf]"}, "holds": "lead > 1"}, "refuted"),
        ({"value": "rmse_m[ekf]", "holds": "value < 1"}, "inconclusive"),
        ({"given": {"half": "rmse_m[ekf] / 2"}, "value": "half", "holds": "value < 1"}, "inconclusive"),
        ({"holds": "gain[ekf, ukf] > 0 and rmse_m[ekf] < 1"}, "inconclusive"),
        ({"holds": "value(gain[ekf, ukf]) > 0"}, "inconclusive"),
        (
            {"value": "nees[ekf, robot1]", "holds": "2 in value"},
            "inconclusive",
        ),  # the fewer runs, the wider
        ({"holds": "2 in consistent(2, runs) and nees[ekf, robot2] < 4"}, "inconclusive"),
        ({"holds": "rmse_m[ekf] < 1", "least_runs": 3}, "confirmed"),
        ({"holds": "rmse_m[lost] < 1"}, "not reproducible"),
    ],
)
def test_few_runs_decide_by_intervals_or_by_a_stated_number_of_runs(
    stated: dict[str, object], verdict: str
) -> None:
    claims = [{"sentence": "s", "paper": "p", "ours": "-", **stated}]
    written = Stated("mine", "mine.toml", {"title": "t", "runs": 20, "claims": claims}, Path())

    def decided(runs: int) -> Claim:
        experiment = written.with_settings({}, {"runs": runs})
        [found] = decide(experiment.claims, METRICS, INTERVALS, {"runs": experiment.runs})
        return found

    assert decided(3).verdict == verdict
    assert ("only 3 runs; a verdict without an interval needs at least 20" in decided(3).why) == (
        verdict == "inconclusive"
    )
    assert (decided(20).verdict == verdict) == (verdict != "inconclusive")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"holds": "rmse_m[ekf] <"},
            r"experiment mine.toml: .*claim 's': 'rmse_m\[ekf\] <' cannot be read",
        ),
        ({"holds": "open('x') < 1"}, "no function 'open'"),
        ({"holds": "runs.__class__ < 1"}, "only numbers, names"),
        ({"ours": "{rmse_m[ekf]"}, "braces"),
        ({"hold": "1 < 2"}, "no parameter 'claims.0.hold'; did you mean 'holds'"),
    ],
)
def test_what_cannot_be_read_is_refused_before_the_run(values: dict[str, str], message: str) -> None:
    with pytest.raises(BadInput, match=message):
        claim(**values)


def test_nothing_is_confirmed_beside_a_number_that_is_missing() -> None:
    """Code that judges its own claims compares with NaN, which is false: no refutation."""
    assert Claim("s", "p", "2", "not shown").verdict == Claimed.INCONCLUSIVE  # of an older result
    [few] = decide(
        [claim(value="gain[ekf, few]", holds="value > 0", ours="{high(value)}")], METRICS, INTERVALS, {}
    )
    assert known(few) == few
    found = known(judged("s", "p", "nan against 2", holds=False))
    assert (found.verdict, found.why) == ("not reproducible", "estimates are missing")
    assert known(judged("s", "p", "nancy 1", holds=False)).verdict == "refuted"


def test_an_estimator_is_like_another_but_for_what_it_says() -> None:
    stated = {
        "plain": {"kind": "ekf", "rate": {"a": 1, "b": 2}},
        "ekf": {"like": "plain", "gate": 1},
        "ukf": {"like": "ekf", "kind": "ukf", "rate": {"b": 3}},
    }
    found = build(Experiment, {"title": "t", "estimators": stated}, "mine.toml").estimators
    assert found["ekf"] == {"rate": {"a": 1, "b": 2}, "gate": 1}
    assert found["ukf"] == {"rate": {"a": 1, "b": 3}, "gate": 1}
    for other in ("ekf", "nobody"):
        circle = {"title": "t", "estimators": {"plain": {"like": other}, "ekf": {"like": "plain"}}}
        with pytest.raises(BadInput, match=f"mine.toml: .* has like = '{other}|has like = 'plain'"):
            build(Experiment, circle, "mine.toml")


def test_a_name_that_is_nowhere_and_what_is_no_comparison_name_the_claim() -> None:
    with pytest.raises(
        BadInput, match="experiment mine: claim 's': no number 'limt'; did you mean 'limit'"
    ):
        require_names([claim(holds="1 < limt")], ["limit"], "experiment mine")
    wrong = (
        "rmse_m[ekf]",
        "by_noise[ekf, 1] < [1, 2]",
        "count(rmse_m[ekf]) > 0",
        "max(1 < 2) > 0",
        "1 < 2 < (1 < 2)",
    )
    for holds in wrong:
        with pytest.raises(BadInput, match="claim 's': "):
            decide([claim(holds=holds)], METRICS, {}, {})


def test_a_claim_has_no_verdict_on_another_recording() -> None:
    """By default it is of the first one; `any` is decided of all data, a name that nothing has never."""
    stated = [
        claim(value="rmse_m[ekf]", holds="value < 1", recording=name, ours="{value:.1f} m")
        for name in ("", "first", "second", "any", "third")
    ]
    found = decide(stated, METRICS, INTERVALS, {}, {"first": False, "second": True})
    confirmed, none = "confirmed", "no verdict"
    assert [each.verdict for each in found] == [none, none, confirmed, confirmed, none]
    assert {each.ours for each in found} == {"0.5 m"}
    assert found[0].why == "claimed for first, not for these data"
    lost = claim(value="rmse_m[nobody]", holds="value < 1")
    assert decide([lost], METRICS, {}, {}, {"first": False})[0].verdict == none
    require_recordings(stated[:4], {"first", "second"}, "experiment x")
    with pytest.raises(BadInput, match="experiment x: claim 's': no recording 'third'"):
        require_recordings(stated, {"first", "second"}, "experiment x")


def test_a_recording_is_told_by_what_is_in_its_files(tmp_path: Path) -> None:
    """Names of folders, compression, and what lies beside them count for nothing; a byte more counts."""
    for folder in ("here/a", "elsewhere/b"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "drive.csv").write_bytes(b"1,2")
        (tmp_path / folder / "README").write_text(folder)
    packed = tmp_path / "drive.csv.gz"
    packed.write_bytes(gzip.compress(b"1,2"))
    of = Recording(files="drive.csv*", sha256="")
    digests = {of.digest_of(_files(tmp_path / each)) for each in ("here", "elsewhere")}
    digests.add(of.digest_of([packed]))
    assert len(digests) == 1
    with pytest.raises(BadInput, match=f"recordings.drive has no sha256; .* '{(*digests,)[0]}'"):
        holding({"drive": of}, [packed], "experiment x")
    known = {"drive": of.model_copy(update={"sha256": digests.pop()})}
    assert holding(known, _files(tmp_path / "here"), "x") == {"drive": True}
    (tmp_path / "here" / "a" / "drive.csv").write_bytes(b"1,2\n")
    assert holding(known, _files(tmp_path / "here"), "x") == {"drive": False}
    assert holding(known, [tmp_path / "here" / "a" / "README"], "x") == {"drive": False}


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


@pytest.mark.paper
def test_claims_of_shipped_experiments_are_bound_to_the_data_they_were_made_of(
    real_data: Path, tmp_path: Path
) -> None:
    places = unpack(real_data, DATA, tmp_path)
    bound = 0
    for name in shipped("experiments"):
        _, experiment = load_experiment(name, {}, {})
        if experiment.import_ and experiment.claims:
            place = places[importer_of(experiment)]
            files = _files(place) if place.is_dir() else [place]
            found = holding(experiment.recordings, files, name)
            assert found, name
            assert all(found.values()), name
            require_recordings(experiment.claims, found, name)
            bound += 1
    assert bound == 16
