"""What the explorer computes without a page: sliders' ends, settings as text, what is drawn of much."""

import math
import tomllib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import fuselog as fl
from fuselog.pipeline.diagnosing.hypotheses.parameters import STEPS
from fuselog.pipeline.exploring.curves import LINES, extremes, fewer, typical_time_s
from fuselog.pipeline.exploring.session import open_session, verdict_of
from fuselog.pipeline.exploring.sliders import FACTOR, REACH, Slider, _slider, in_words, setting_text
from fuselog.pipeline.output.words import quantity
from fuselog.pipeline.sensing.preparing import _STILL
from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.importers.tables.columns import _ENDINGS, _WRITTEN
from fuselog.recorders.log.impossible import LIMITS
from fuselog.recorders.parameters import Parameter
from fuselog.recorders.units import ENDINGS, MISTAKEN, Unit, conversion, parted, unit, written
from fuselog.replay.timeline.drawing.plots import shown_unit


@pytest.fixture(scope="module")
def log() -> fl.MemorySource:
    return fl.record("landmarks", seed=3, duration_s=2.0)


def test_of_much_the_first_the_last_and_all_extremes_are_drawn() -> None:
    assert fewer(7, 10).tolist() == [*range(7)]
    assert fewer(101, 5).tolist() == [0, 25, 50, 75, 100]
    count = 5 * LINES
    values = np.zeros(count)
    values[3::10], values[7::10] = -1.0 - np.arange(count // 10), 1.0 + np.arange(count // 10)
    rows = extremes(values)
    assert (np.diff(rows) > 0).all()
    assert len(rows) == LINES
    assert rows.tolist() == sorted([*range(3, count, 10), *range(7, count, 10)])
    values[[3, 7]] = np.nan  # which is drawn as zero, and hides no neighbour
    assert {13, 17, count - 7, count - 3} < {*extremes(values).tolist()}
    assert extremes(values[:LINES]).tolist() == [*range(LINES)]


def test_the_lens_begins_at_a_typical_second() -> None:
    """Outside are 1 of 2 in all: as in the seconds 1 and 3 and 6, of which 3 is in the middle."""
    per_second = [0.0, 2.0, 4.0, 2.0, 0.0, 4.0, 2.0]
    nees = np.concatenate([np.where(np.arange(4) < outside, 99.0, 0.1) for outside in per_second])
    case: Any = SimpleNamespace(
        errors=SimpleNamespace(nees=nees, elapsed_s=np.arange(28) / 4.0), nees_interval=(0.05, 9.0)
    )
    assert typical_time_s(case) == 3.0


def slider(own: float, low: float, high: float, *, is_logarithmic: bool) -> Slider:
    return Slider("sigma_range_m", own, "m", low=low, high=high, is_log=is_logarithmic)


@pytest.mark.parametrize(
    ("made", "place", "value"),
    [
        (slider(0.1, 0.01, 1.0, is_logarithmic=True), 0.25, 10**-1.5),
        (slider(0.1, 0.01, 1.0, is_logarithmic=True), 0.7501, 10**-0.4998),
        (slider(0.0, -2.0, 6.0, is_logarithmic=False), 0.33333, 0.66664),
        (slider(3.0, -2.0, 6.0, is_logarithmic=False), 0.625 + 1e-4, 3.0),
    ],
)
def test_a_place_of_a_slider_is_a_value_of_four_digits(made: Slider, place: float, value: float) -> None:
    assert made.value(place) == (made.default if value == made.default else float(f"{value:.4g}"))
    assert made.place(value) == pytest.approx(place, abs=2e-4)
    assert [made.values(3)[0], made.values(3)[-1]] == [made.low, made.high]
    assert made.words(made.default) == in_words(made.default, "m")


def test_every_unit_that_one_place_knows_all_know() -> None:
    """Its size, how it converts, what a report and a timeline write, and how numbers below zero look."""
    of_units = {*REACH, *STEPS, *LIMITS, *_STILL, *MISTAKEN} - {""}
    assert of_units <= set(ENDINGS.values())
    for written_by_others in (_ENDINGS, _WRITTEN):
        assert all(isinstance(unit(each), Unit) for each in written_by_others.values())
    for ending, own in ENDINGS.items():
        name = f"own_{ending}"
        assert parted(name) == ("own", own)
        assert conversion(own, name) == 1.0
        assert quantity(name).unit == own
        shown, sign, factor = shown_unit(name)
        degrees = own.replace("rad", "deg") if own in ("rad", "rad/s") else own
        assert (shown, sign, factor) == ("own", written(degrees), unit(own).size / unit(degrees).size)
        for value in (1e-5, 0.003, 0.05, 2.0):
            assert in_words(-value, own) == f"\N{MINUS SIGN}{in_words(value, own)}"
    for own, others in MISTAKEN.items():
        assert all(unit(other).powers == unit(own).powers for other in others)


@pytest.mark.parametrize(
    ("name", "unit", "bounds", "own", "ends", "is_logarithmic"),
    [
        ("share", "", (0.1, 0.9), 0.4, (0.1, 0.9), False),
        ("gate_probability", "", (0.0, 1.0), 0.99, (0.5, 1.0), False),
        ("sigma_m", "m", (0.0, math.inf), 2.0, (2.0 / FACTOR, 2.0 * FACTOR), True),
        ("sigma_m", "m", (0.0, math.inf), 0.0, (0.0, REACH["m"]), False),
        ("offset_rad", "rad", (-math.inf, math.inf), 0.0, (-REACH["rad"], REACH["rad"]), False),
        ("place_m", "m", (-math.inf, math.inf), -4.0, (-6.0, -2.0), False),
        ("place_m", "m", (-5.0, math.inf), -4.0, (-5.0, -2.0), False),
    ],
)
def test_ends_of_a_slider_follow_from_bounds_and_value(
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    unit: str,
    bounds: tuple[float, float],
    own: float,
    ends: tuple[float, float],
    is_logarithmic: bool,
) -> None:
    number = Parameter(name, None, unit, low=bounds[0], high=bounds[1])
    monkeypatch.setattr("fuselog.pipeline.exploring.sliders.number_of", lambda *_: number)
    monkeypatch.setattr("fuselog.pipeline.exploring.sliders.value_at_start", lambda *_: (own, False))
    made: Any = _slider(name, "group", None, SimpleNamespace(parameters=0))  # type: ignore[arg-type]
    low, high = ends
    wanted = number._replace(default=own, low=low, high=high, is_log=is_logarithmic, group="group")
    assert made == Slider(*wanted)


def test_settings_are_kept_as_toml_with_what_is_estimated(log: fl.MemorySource) -> None:
    """Of every filter those that it has, over its own; a kind where the label is none."""
    own = {"kind": "ekf", "sigma_range_m": 0.2}
    session = open_session(log, {"ekf": own, "mine": {"kind": "ukf", "kappa": 1.0}})
    values = {"sigma_range_m": 0.05, "kappa": 0.5, "bias_range_m": -0.125}
    both = {"sigma_range_m": 0.05, "bias_range_m": -0.125}
    assert tomllib.loads(session.toml(values)) == {
        "ekf": both,
        "mine": {"kind": "ukf", "kappa": 0.5} | both,
    }
    assert tomllib.loads(session.toml({}))["ekf"] == {"sigma_range_m": 0.2}
    assert list(setting_text(values)) == [
        "--set sigma_range_m=0.05",
        "--set kappa=0.5",
        "--set bias_range_m=-0.125",
    ]
    wider = session.with_estimated(["bias_range_m"])
    way = session.slider("bias_range_m")
    sigma = 0.25 * (way.high - way.low)
    assert tomllib.loads(wider.toml({}))["ekf"] == {
        "sigma_range_m": 0.2,
        "estimate": ["bias_range_m"],
        "estimate_sigma": {"bias_range_m": sigma},
    }
    assert wider.command({}).endswith(
        f"--set 'estimate=['\"'\"'bias_range_m'\"'\"']' --set estimate_sigma.bias_range_m={sigma!r}"
    )


def test_a_verdict_goes_by_errors_and_then_by_innovations() -> None:
    """It is the report's: of one log NEES of 2 lies in 0.05 to 7.4, NIS of 4 numbers in 0.12 to 2.8."""

    def said(nees: float, nis: float, *kinds: str, of: str = "robot1") -> str:
        white = {
            "a": SimpleNamespace(size=1, mean_square=nis - 0.3),
            "b": SimpleNamespace(size=3, mean_square=nis + 0.1),
            "c": SimpleNamespace(size=9, mean_square=np.nan),
        }
        squares = np.array([nees - 0.01, np.nan, nees + 0.01])
        errors = SimpleNamespace(nees=squares, components=("x_m", "y_m"))
        case: Any = SimpleNamespace(name="robot1", whiteness=white, errors=errors)
        alarms = [Finding(kind, "ekf", of, 1.0, f"{kind}!") for kind in kinds]  # type: ignore[arg-type]
        verdict = verdict_of(case, alarms, [])
        assert verdict_of(case, alarms, ["it stopped"])[0::2] == ("failed", "it stopped")
        return f"{verdict.level}: {verdict.headline} {verdict.detail}"

    over = "doubtful: Overconfident. Its {} are 2 times what it states."
    assert said(2.0, 4.0) == said(2.0, 4.0, "innovations") == over.format("innovations")
    assert said(8.0, 4.0) == said(8.0, 1.0) == over.format("errors")
    assert said(0.02, 4.0) == "doubtful: Conservative. Its errors are 0.1 of what it states."
    assert said(8.0, 4.0, "unused") == "doubtful: Doubtful. unused!"
    assert said(2.0, 1.0, "innovations") == "doubtful: Doubtful. innovations!"  # off by little
    good = "good: No problem found. NIS is 1.00 per component and NEES is 2.00 for 2"
    assert said(2.0, 1.0, "errors", of="robot2") == said(2.0, 1.0) == f"{good}, within their intervals."
