"""`fuselog check`: what is found, what is told of it, what passes, what is refused."""

import lzma
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import fuselog as fl
from fuselog.pipeline.checking.checking import Checked
from fuselog.pipeline.checking.command import write_junit
from fuselog.pipeline.checking.discrepancies import Discrepancy, discrepancies
from fuselog.pipeline.checking.golden import Replayed, checksums
from fuselog.pipeline.checking.stored import read, write
from fuselog.recorders.log import LogWriter
from fuselog.testing import _require, assert_golden

pytestmark = pytest.mark.usefixtures("blank_figures")

Fuselog = Callable[..., Any]
POSE = "/estimates/ekf/robot1/pose"
INNOVATION = "/estimates/ekf/robot1/innovation"


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "run.mcap"
    fl.write(path, fl.record("landmarks", seed=4, duration_s=10.0))
    return path


@pytest.fixture
def golden(log: Path, fuselog: Fuselog, tmp_path: Path) -> Path:
    path = tmp_path / "ekf.golden.xz"
    assert fuselog("check", log, "--against", path, "--update", "-e", "ekf").code == 0
    return path


def with_settings(golden: Path, **settings: Any) -> Path:
    """The golden of another estimator, as it was before a change of the code."""
    changed = read(golden)
    changed["settings"]["estimators"]["ekf"] |= settings
    write(golden, changed)
    return golden


def test_the_same_passes_and_gives_the_same_bytes(golden: Path, log: Path, fuselog: Fuselog) -> None:
    before = golden.read_bytes()
    said = fuselog("check", log, "--against", golden)
    assert (said.code, said.err) == (0, "")
    assert said.out.startswith("all ")
    assert fuselog("check", log, "--against", golden, "--update").code == 0
    assert golden.read_bytes() == before
    assert len(before) < 20_000


def test_a_change_in_the_seventh_digit_is_found_at_its_first_stamp(
    golden: Path, log: Path, fuselog: Fuselog
) -> None:
    """With what is different there, and the innovation that it comes from."""
    sigma_range_m = 0.1 * (1 + 1e-7)
    said = fuselog("check", log, "--against", with_settings(golden, sigma_range_m=sigma_range_m))
    assert said.code == 1
    done = [fl.replay(log, [{"ekf": settings}]) for settings in ({}, {"sigma_range_m": sigma_range_m})]
    before, after = (each.estimates[0][POSE] for each in done)
    apart = (before["mean"] != after["mean"]).any(axis=1)
    apart |= (before["covariance"] != after["covariance"]).any(axis=1)
    first_ns = before.publish_time_ns[np.argmax(apart)]
    assert apart.any()
    first, bits, innovation = said.out.splitlines()[:3]
    assert re.match(
        rf"run\.mcap {INNOVATION} covariance: range_m is \S+ at {first_ns} ns, the golden has \S+; "
        "relative difference 2e-07, allowed 1e-12",
        first,
    )
    assert bits.startswith(f"the bits of {INNOVATION} differ from {first_ns} ns on")
    assert "NIS" in innovation
    assert str(first_ns) in innovation
    page = (Path(__file__).parents[2] / "docs" / "compare.md").read_text(encoding="utf-8")
    [told] = re.findall(r"^run\.mcap /estimates.*?(?=\n```)", page, re.MULTILINE | re.DOTALL)
    number = r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?"
    assert re.sub(number, "#", told) == re.sub(number, "#", "\n".join([first, bits, innovation]))
    shown, printed = ([float(each) for each in re.findall(number, text)] for text in (told, said.out))
    assert shown == pytest.approx(printed[: len(shown)], rel=1e-5)


def test_tolerances_and_columns_are_kept_in_the_golden(
    golden: Path, log: Path, fuselog: Fuselog
) -> None:
    update = ("check", log, "--against", golden, "--update", "-e", "ekf")
    assert fuselog(*update, "--keep", "*/pose mean", "--tolerance", f"{POSE} mean=1e-3").code == 0
    streams = read(golden)["runs"]["run.mcap"]["streams"]
    assert {name for each in streams.values() for name in each["columns"]} == {"mean"}
    assert fuselog("check", log, "--against", with_settings(golden, sigma_range_m=0.1 + 1e-8)).code == 0
    said = fuselog("check", log, "--against", with_settings(golden, sigma_range_m=0.3))
    assert said.code == 1
    assert "allowed 0.001" in said.out


def test_a_golden_of_another_cpu_passes_within_its_tolerance(golden: Path) -> None:
    stored, found = read(golden), read(golden)
    found["arithmetic"] = "another"
    kept = found["runs"]["run.mcap"]["streams"][POSE]["columns"]["mean"]["kept"]
    kept[5][0] *= 1 + 1e-9
    assert not list(discrepancies(stored, Replayed(found, {})))
    kept[5][0] *= 1 + 1e-3
    [different] = discrepancies(stored, Replayed(found, {}))
    assert (different.component, different.part) == ("x_m", "mean")


def test_a_result_and_its_logs(tmp_path: Path, fuselog: Fuselog) -> None:
    """Its first logs, with its own estimators."""
    result, golden = tmp_path / "landmarks", tmp_path / "landmarks.golden.xz"
    fl.run("landmarks", runs=3, out=result, logs=2, set={"duration_s": 3.0})
    assert fuselog("check", result, "--against", golden, "--update").code == 0
    stored = read(golden)
    assert list(stored["runs"]) == ["run-0000.mcap", "run-0001.mcap"]
    assert list(stored["settings"]["estimators"]) == ["dead-reckoning", "ekf", "ukf"]
    assert fuselog("check", result / "logs", "--against", golden).code == 0
    said = fuselog("check", result / "logs" / "run-0000.mcap", "--against", golden)
    assert said.code == 2
    assert "the golden contains run-0000.mcap, run-0001.mcap" in said.err


def test_junit_has_a_run_s_failures_in_its_own_cases(tmp_path: Path) -> None:
    """The topic is one; run b alone differs there."""
    found = [Discrepancy("b", "/x", "mean", 1.0, 0.1)]
    write_junit(tmp_path / "j.xml", "g", Checked({("a", "/x"): 1, ("b", "/x"): 1}, found, []))
    [suite] = ElementTree.parse(tmp_path / "j.xml").getroot()
    failed = {case.get("name"): case.find("failure") is not None for case in suite}
    assert failed == {"a /x": False, "b /x": True}
    assert suite.get("failures") == "1"


def test_junit(golden: Path, log: Path, fuselog: Fuselog, tmp_path: Path) -> None:
    """A test case for each topic; a failure tells; times are no part of it."""
    path = tmp_path / "check.xml"
    for settings, failures in (({}, 0), ({"sigma_range_m": 0.2}, 2)):
        said = fuselog("check", log, "--against", with_settings(golden, **settings), "--junit", path)
        assert said.code == (failures > 0)
        root = ElementTree.parse(path).getroot()
        assert (root.tag, root.attrib) == ("testsuites", {"name": "fuselog check"})
        [suite] = root
        assert (suite.tag, suite.get("name"), suite.get("errors")) == ("testsuite", golden.name, "0")
        assert int(suite.get("tests", "")) == len(suite) > 1
        assert int(suite.get("failures", "")) == len(suite.findall("testcase/failure")) >= failures
        for case in suite:
            assert (case.tag, set(case.attrib)) == ("testcase", {"classname", "name"})
            assert all(set(each.attrib) == {"message", "type"} and each.text for each in case)
    assert "the golden has" in path.read_text(encoding="utf-8")


def test_junit_says_why_nothing_was_checked(
    golden: Path, log: Path, fuselog: Fuselog, tmp_path: Path
) -> None:
    """Continuous integration shows the sentence in place of a file that is missing or of last time."""
    path = tmp_path / "check.xml"
    other = tmp_path / "other.mcap"
    fl.write(other, fl.record("landmarks", seed=5, duration_s=1.0))
    said = fuselog("check", other, "--against", golden, "--junit", path)
    [suite] = ElementTree.parse(path).getroot()
    assert (said.code, suite.get("errors"), suite.get("failures")) == (2, "1", "0")
    error = suite.find("testcase/error")
    assert error is not None
    assert error.get("message") == said.err.removeprefix("fuselog: ").strip() != ""


def test_a_third_party_tests_its_own_estimator(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Written once where the environment asks for it, then compared."""
    golden = tmp_path / "mine.golden.xz"
    runs = {"seed 4": fl.record("landmarks", seed=4, duration_s=3.0)}
    mine = {"mine": {"kind": "ekf", "sigma_range_m": 0.1}}
    with pytest.raises(fl.BadInput, match="no such golden"):
        assert_golden(runs, golden, mine)
    monkeypatch.setenv("FUSELOG_UPDATE_GOLDENS", "1")
    assert_golden(runs, golden, mine)
    monkeypatch.delenv("FUSELOG_UPDATE_GOLDENS")
    assert_golden(runs, golden, mine)
    assert_golden(runs, golden)
    said = r"(?s)seed 4 /estimates/mine/.* the golden has.*FUSELOG_UPDATE_GOLDENS=1"
    with pytest.raises(AssertionError, match=said):
        assert_golden(runs, golden, {"mine": {"kind": "ekf", "sigma_range_m": 0.2}})


def test_a_failed_golden_says_each_of_ten_once(tmp_path: Path) -> None:
    """The first in the sentence on it, and nine more."""
    found = [Discrepancy("", f"/{number}", "mean", 1.0, 0.1) for number in range(12)]
    with pytest.raises(AssertionError) as raised:
        _require(Checked({}, found, ["the first"]), tmp_path)
    more = [each.sentence for each in found[1:10]]
    assert str(raised.value).splitlines() == [f"{tmp_path}:", "the first", *more]


def test_bad_input(golden: Path, log: Path, fuselog: Fuselog, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    note = tmp_path / "note.golden.xz"
    note.write_text("mine", encoding="utf-8")
    other = tmp_path / "run.mcap"
    with LogWriter(other) as writer:
        writer.write(fl.record("landmarks", seed=5, duration_s=1.0).streams.values())
    newer = tmp_path / "newer.golden.xz"
    newer.write_bytes(
        lzma.compress(lzma.decompress(golden.read_bytes()).replace(b'"format":1', b'"format":2'))
    )
    for arguments, sentence in (
        (
            (log, "--against", newer),
            "a newer version of fuselog wrote it (format 2, this version reads 1)",
        ),
        ((log, "--against", note), "is not a golden, or is damaged"),
        ((log, "--against", note, "--update", "-e", "ekf"), "exists and is not a golden"),
        ((log, "--against", tmp_path / "none.golden.xz"), "no such golden; --update creates it"),
        (
            (log, "--against", tmp_path / "none.golden.xz", "--update"),
            "name the estimators of the new golden",
        ),
        ((other, "--against", golden), "the recorded or imported data have changed"),
        ((tmp_path / "empty", "--against", golden), "has no logs to replay"),
        (
            (log, "--against", golden, "-e", "ukf"),
            "to check instead of one of them, such as lib:PATH, or add --update",
        ),
        ((log, "--against", golden, "--update", "--tolerance", "mean"), "expected PATTERN=RELATIVE"),
        ((log, "--against", golden, "--junit", note), "give a name that ends in .xml"),
    ):
        said = fuselog("check", *arguments)
        assert (said.code, "Traceback" in said.err) == (2, False)
        assert sentence in said.err
    assert note.read_text(encoding="utf-8") == "mine"


def test_a_checksum_tells_bits_apart() -> None:
    values = np.random.default_rng(0).normal(size=(1000, 3))
    changed = values.copy()
    changed[500:, 1] = np.nextafter(changed[500:, 1], np.inf)
    before, after = checksums({"mean": values}), checksums({"mean": changed})
    assert np.array_equal(before[:500], after[:500])
    assert np.mean(before[500:] != after[500:]) > 0.99


def _stream(mean: np.ndarray, covariance: np.ndarray) -> dict[str, Any]:
    """A stream as a golden keeps it, of which all rows are kept."""

    def column(values: np.ndarray) -> dict[str, Any]:
        return {
            "kept": values.tolist(),
            "sum": values.sum(axis=0).tolist(),
            "sum_of_squares": np.square(values).sum(axis=0).tolist(),
            "missing": np.zeros(values.shape[1]).tolist(),
        }

    return {
        "rows": len(mean),
        "publish_times": "a",
        "log_times": "b",
        "metadata": {"components": "x_m,heading_rad", "kinds": "linear,angle"},
        "columns": {"mean": column(mean), "covariance": column(covariance)},
    }


def _golden_of(mean: np.ndarray) -> dict[str, Any]:
    streams = {"/estimates/ekf/state": _stream(mean, np.ones((len(mean), 4)))}
    run = {"input": "same", "recorded": True, "streams": streams}
    return {"arithmetic": "here", "tolerances": {}, "metrics": {}, "runs": {"a": run}}


def test_infinite_numbers_are_equal_and_hide_no_others() -> None:
    """As of a filter that diverged: -inf as a likelihood, and squares that are infinite."""
    with np.errstate(over="ignore"):
        mean = np.array([[1.0, -np.inf], [3e200, 2.0], [4e200, 1.0]])
        same = Replayed(_golden_of(mean), {"a": {}})
        assert not list(discrepancies(_golden_of(mean), same))
        changed = _golden_of(mean + np.array([[0.0, 0.0], [0.0, 1e-3], [1e195, 0.0]]))
        [one] = discrepancies(_golden_of(mean), Replayed(changed, {"a": {}}))
    assert one.apart > 1e-6
    assert one.row == 1


@pytest.mark.parametrize(
    ("column", "entry", "by", "apart", "component"),
    [
        ("mean", 0, 2e-3, 1e-3, "x_m"),  # of its root mean square, which is 2
        ("mean", 1, 2e-3, 2e-3, "heading_rad"),  # of a radian, however small the angle is
        ("covariance", 1, 6e-3, 1e-3, "x_m and heading_rad"),  # of the product of the deviations
        ("covariance", 3, 9e-3, 1e-3, "heading_rad"),
        ("metric", 0, 0.5, 2.5e-3, ""),  # of the metric, which is 200
    ],
)
def test_how_far_apart_a_number_is_goes_by_its_own_size(
    column: str, entry: int, by: float, apart: float, component: str
) -> None:
    mean, covariance = np.tile([2.0, 0.01], (4, 1)), np.tile([4.0, 0.1, 0.1, 9.0], (4, 1))
    metric = 200.0

    def golden() -> dict[str, Any]:
        streams = {"/estimates/ekf/state": _stream(mean, covariance)}
        run = {"input": "same", "recorded": True, "streams": streams}
        return {
            "arithmetic": "here",
            "tolerances": {},
            "metrics": {"ekf.rmse_m": metric},
            "runs": {"a": run},
        }

    before = golden()
    if column == "metric":
        metric += by
    else:
        {"mean": mean, "covariance": covariance}[column][2, entry] += by
    [one] = discrepancies(before, Replayed(golden(), {"a": {}}))
    assert one.apart == pytest.approx(apart, rel=1e-2)
    assert (one.component, one.row) == (component, None if column == "metric" else 2)
