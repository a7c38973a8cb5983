"""Parameters: what is refused is named; settings nest; descriptions tell what is accepted."""

import re
from pathlib import Path
from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field, PositiveFloat, model_validator

from fuselog.recorders.errors import BadInput, choices
from fuselog.recorders.parameters import (
    Parameters,
    build,
    describe,
    explain,
    meanings,
    merge,
    parse_settings,
)
from fuselog.recorders.parsing import parse_json, read_toml


class Inner(Parameters):
    """A table of its own."""

    rate_hz: Annotated[float, Field(ge=0, lt=100)] = 5.0
    name: str = "a"


class Outer(Parameters):
    """Parameters with a table and what is optional."""

    count: int
    sigma_m: PositiveFloat | None = None
    inner: Inner = Inner(rate_hz=7.0)
    others: list[Inner] | None = None

    @model_validator(mode="after")
    def _check(self) -> "Outer":
        if self.count == 13:
            raise ValueError("count 13 brings bad luck")
        return self


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({}, "x: parameter 'count' is missing"),
        ({"count": "many"}, "x: parameter 'count' is 'many'; it should be a valid integer"),
        ({"count": 1, "cuont": 2}, "x: no parameter 'cuont'; did you mean 'count'?"),
        ({"count": 1, "zzz": 2}, "x: no parameter 'zzz'; available: count, sigma_m, inner, others"),
        ({"count": 1, "others": [{"rate": 2}]}, "'others.0.rate'; did you mean 'rate_hz'?"),
        ({"count": 1, "inner": {"rate": 2}}, "x: no parameter 'inner.rate'; did you mean 'rate_hz'?"),
        ({"count": 1, "inner": {"rate_hz": 100}}, "'inner.rate_hz' is 100; it should be less than 100"),
        ({"count": 1, "sigma_m": 0}, "'sigma_m' is 0; it should be greater than 0"),
        ({"count": 1, "sigma_m": float("inf")}, "'sigma_m' is inf; it should be a finite number"),
        ({"count": 13}, "x: count 13 brings bad luck"),
    ],
)
def test_what_is_wrong_is_named(values: dict[str, object], sentence: str) -> None:
    with pytest.raises(BadInput) as error:
        build(Outer, values, "x")
    assert sentence in str(error.value)


def test_a_setting_of_a_table_keeps_its_other_defaults() -> None:
    """The scenario's own default of the table counts, not the table's."""
    assert build(Outer, {"count": 1, "inner": {"name": "b"}}, "x").inner == Inner(rate_hz=7.0, name="b")


def test_descriptions_have_full_names_defaults_and_bounds() -> None:
    described = {
        each.name: (each.default, each.accepts) for each in describe(Outer, {"inner": {"name": "c"}})
    }
    assert described == {
        "count": (None, "integer"),
        "sigma_m": (None, "number > 0 or none"),
        "inner": (None, "table"),
        "inner.rate_hz": (7.0, "number >= 0 < 100"),
        "inner.name": ("c", "string"),
        "others": (None, "array of table or none"),
        "others[].rate_hz": (5.0, "number >= 0 < 100"),
        "others[].name": ("a", "string"),
    }


def test_what_lists_and_tables_accept_is_said() -> None:
    class Lists(Parameters):
        four: Annotated[tuple[PositiveFloat, ...], Field(min_length=4, max_length=4)] = (1, 1, 1, 1)
        some: Annotated[list[str], Field(min_length=2)] = ["a", "b"]
        by_name: dict[str, Inner] = {}

    assert [(each.name, each.accepts) for each in describe(Lists)] == [
        ("four", "array (4) of number > 0"),
        ("some", "array (at least 2) of string"),
        ("by_name", "table of table"),
        ("by_name.NAME.rate_hz", "number >= 0 < 100"),
        ("by_name.NAME.name", "string"),
    ]


class Stated(Parameters):
    """What is stated.

    Attributes:
        sigma_m: standard deviation of a range,
            per axis: x and y.
        low, high: a bound.
    """

    sigma_m: float = 1.0
    low: float = 0.0
    high: float = 1.0
    count: int = 2


class StatedAgain(Stated):
    """It says one anew.

    Attributes:
        low: the least.
    """


def test_the_docstring_says_what_parameters_mean() -> None:
    told = [(each.unit, each.meaning) for each in describe(Stated)]
    assert told == [
        ("m", "standard deviation of a range, per axis: x and y."),
        ("", "a bound."),
        ("", "a bound."),
        ("", ""),
    ]
    assert meanings(StatedAgain) == {**meanings(Stated), "low": "the least."}
    assert explain(StatedAgain) == {"": "What is stated.\n\nIt says one anew."}


def test_a_meaning_of_no_parameter_is_refused() -> None:
    class Wrong(Parameters):
        """Of a range.

        Attributes:
            sigma: standard deviation.
        """

        sigma_m: float = 1.0

    with pytest.raises(BadInput, match=r"Wrong: its docstring .* 'sigma' .*did you mean 'sigma_m'"):
        describe(Wrong)


def test_settings_are_toml_and_else_text() -> None:
    given_settings = ["a.b=1", "a.c=[1.5, 2]", "d=true", "e=some text", "f=2026=1", "a.b=3"]
    assert parse_settings(given_settings) == {
        "a": {"b": 3, "c": [1.5, 2]},
        "d": True,
        "e": "some text",
        "f": "2026=1",
    }


Tables = st.recursive(
    st.integers(), lambda inner: st.dictionaries(st.sampled_from("abc"), inner), max_leaves=8
)


@given(st.dictionaries(st.sampled_from("abc"), Tables), st.dictionaries(st.sampled_from("abc"), Tables))
def test_merging_is_settled_after_one_time(base: dict[str, object], over: dict[str, object]) -> None:
    """What was laid over stays; laying it over again changes nothing."""
    merged = merge(base, over)
    assert merge(merged, over) == merged
    assert merge(merged, {}) == merged
    assert set(merged) == set(base) | set(over)


def test_the_nearest_name_is_offered_else_all() -> None:
    assert choices("efk", ["ekf", "ukf"]) == "did you mean 'ekf'?"
    assert choices("gate", ["gate_probability", "kappa"]) == "did you mean 'gate_probability'?"
    assert choices("zzz", ["ekf", "ukf"]) == "available: ekf, ukf"
    assert choices("zzz", []) == "available: none"


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        (
            "a=" + "[" * 100_000,
            "--set a: the value cannot be used: it is nested more than 50 levels deep",
        ),
        ("a=" + "{b=" * 100_000, "it is nested more than 50 levels deep"),
        ("a={" + ".".join("b" * 100_000) + "=1}", "it is nested more than 50 levels deep"),
        (
            "a=" + "1" * 5000,
            "--set a: the value cannot be used: it has a whole number of more than 4300",
        ),
        (".".join("a" * 100_000) + "=1", "...: has more than 50 levels of nested names"),
    ],
    ids=["brackets", "tables", "dotted key", "digits", "name"],
)
def test_settings_that_no_parser_stands_are_told(setting: str, sentence: str) -> None:
    """Standard parsers run out of stack, memory or digits there."""
    with pytest.raises(BadInput, match=re.escape(sentence)):
        parse_settings([setting])


def test_a_file_that_no_parser_stands_is_told(tmp_path: Path) -> None:
    path = tmp_path / "deep.toml"
    for text in ("a = " + "[" * 100_000, "a = " + "1" * 5000, ".".join("a" * 100_000) + " = 1"):
        path.write_text(text)
        with pytest.raises(BadInput, match=r"deep\.toml: cannot be read as TOML \(it "):
            read_toml(path)
    path.write_text("a = " + "[" * 49 + "]" * 49 + '\nb = "' + "many words. " * 100 + '"')
    assert read_toml(path)["b"].startswith("many words. ")


@pytest.mark.parametrize("text", ["NaN", "[-Infinity]", '{"a": 1e999}'])
def test_what_json_has_no_number_for_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="which is not a JSON number"):
        parse_json(text)


def test_what_types_say_of_their_parameters() -> None:
    """Also what they inherit, and nested tables by their names, alike ones together."""

    class Base(Parameters):
        """Of all sensors."""

        rate_hz: float = 1.0

    class Sensor(Base):
        """Of this one."""

    class Robot(Parameters):
        left: Sensor = Sensor()
        right: Sensor = Sensor()
        more: list[Base] = []

    assert explain(Robot) == {
        "left., right.": "Of all sensors.\n\nOf this one.",
        "more[].": "Of all sensors.",
    }


def test_a_number_that_is_declared_float_is_float() -> None:
    """A default too: `1` of a person is no integer."""

    class Own(Parameters):
        sigma_m: float = 1
        limits_m: tuple[float, float] = (0, 1)

    assert [type(number) for number in (Own().sigma_m, *Own().limits_m, Own(sigma_m=2).sigma_m)] == [
        float
    ] * 4


def test_a_type_that_cannot_be_checked_is_named_where_it_is_used() -> None:
    class Foreign(Parameters):
        """Of somebody's plug-in.

        Attributes:
            course: no type of pydantic's.
        """

        course: re.Match[str] | None = None

    with pytest.raises(BadInput, match="estimator 'mine': its parameters, Foreign, cannot be checked: "):
        build(Foreign, {}, "estimator 'mine'")
