"""Every number and word that `--json` prints is what Python's result holds, or follows from the files.

A field of which no case below knows fails its case: a new one is added together with its check.
"""

from collections.abc import Iterator
from contextlib import ExitStack, chdir
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

import click
import numpy as np
import pytest
import rerun as rr

import fuselog as fl
from fuselog.pipeline.calibrating.ellipsoid_study import recorded
from fuselog.pipeline.checking.stored import read
from fuselog.pipeline.checking.stored import write as store
from fuselog.pipeline.command_line.group import fuselog
from fuselog.pipeline.output.terminal import format_value
from fuselog.recorders.log import schemas
from tests.pipeline.conftest import run_here
from tests.pipeline.json_cases import CASES, POSITIVE, QUARTER, Case
from tests.pipeline.json_of_files import leaves
from tests.pipeline.printed import printed

pytestmark = pytest.mark.usefixtures("blank_figures")

ELSEWHERE = {"cache": "test_cache"}  # compared there, as a whole
IMU = """accelerometer_noise_density: 0.002
accelerometer_random_walk: 0.0003
gyroscope_noise_density: 0.0001
gyroscope_random_walk: 0.00002
rostopic: /imu
update_rate: 200.0
"""


def check(printed: Any, wanted: Any) -> None:
    found, held = dict(leaves(printed)), dict(leaves(wanted))
    assert found.keys() == held.keys()
    for place, value in held.items():
        if value == POSITIVE:
            assert found[place] > 0, place
        elif isinstance(value, float):
            assert found[place] == pytest.approx(value, rel=1e-12, abs=1e-12), place
        else:
            assert found[place] == value, place


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, blank_figures: None) -> Iterator[Path]:
    """A folder of inputs, in which all commands run."""
    folder = tmp_path_factory.mktemp("json")
    with chdir(folder):
        _write_inputs()
        yield folder


def _write_inputs() -> None:
    run = fl.record("landmarks", duration_s=3.0, landmarks=5)
    fewer = run["/landmarks"].take(slice(1, None))
    fl.write("run.mcap", fl.MemorySource({**run.streams, "/landmarks": fewer}, run.run, "run"))
    Path("cut.mcap").write_bytes(Path("run.mcap").read_bytes()[:-2000])
    drive = fl.record("navigation", seed=4, run=2, duration_s=11.0)
    unit = drive["/body/inertial"]
    force = {"specific_force_mps2": unit["specific_force_mps2"] / 9.80665}
    in_g = replace(unit, columns={**unit.columns, **force})
    fl.write("grave.mcap", fl.MemorySource({**drive.streams, unit.topic: in_g}, drive.run, "grave"))
    noise = np.random.default_rng(0).normal(size=500)
    stamps = range(0, 25 * 10**9, 5 * 10**7)
    fl.write(
        "rest.mcap",
        [fl.make_stream("/range", schemas.RANGE, stamps, target_id=[1] * 500, range_m=noise)],
    )
    fl.write("turned.mcap", recorded("magnetometer", 1))
    Path("imu.yaml").write_text(IMU)
    with rr.RecordingStream("made") as made:
        made.save("made.rrd")
        for _ in range(3):
            made.log("a", rr.TextLog("a"))
        made.log("b/c", rr.TextLog("c"))
    way = np.stack([np.arange(9.0), np.arange(9.0) ** 2, np.arange(9.0) % 2], axis=1)
    turned = 2.0 * way @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) + [1.0, 2.0, 3.0]
    for name, places, begin_s, rotation in (
        ("way", way, 0.0, "0 0 0 1"),
        ("turned", turned, 0.5, f"0 0 {QUARTER} {QUARTER}"),
    ):
        lines = (f"{begin_s + row} {x} {y} {z} {rotation}\n" for row, (x, y, z) in enumerate(places))
        Path(f"{name}.tum").write_text("".join(lines))
    for line in (
        "record landmarks --set duration_s=3 --set landmarks=4 --seed 1 -o other.mcap",
        "replay run.mcap -e ekf --set sigma_range_m=0.05 -o est.mcap",
        "check run.mcap -e ekf --against ekf.golden.xz --update",
        "run landmarks --runs 2 --set duration_s=2 --out result",
    ):
        said = run_here(*line.split())
        assert said.code == 0, said.err
    surer = read(Path("ekf.golden.xz"))
    surer["settings"]["estimators"]["ekf"] |= {"sigma_range_m": 0.05}
    store(Path("surer.golden.xz"), surer)


# By command, which of its JSON is printed as a table, and its headings with what they are of there.
INTERVAL = {"value": "value", "95 % from": "low", "to": "high"}
TABLES = {
    "compare": (
        "differences",
        "metric",
        {"metric": "quantity", "aim": "aim", "ekf": "first_mean", "ukf": "second_mean"}
        | {"difference": "difference", "95 % from": "low", "to": "high", "verdict": "verdict"}
        | {"sure": "sure", "runs": "runs"},
    ),
    "diagnose": (
        "components",
        "component",
        {"mean": "mean", "mean square": "mean_square", "beyond 3 sigma": "beyond_3_sigma"}
        | {"autocorrelation": "next_correlation", "p if white": "probability_white"},
    ),
    "tune": ("parameters", "parameter", {"start": "start", **INTERVAL}),
    "calibrate": ("parameters", "parameter", {"start": "start", **INTERVAL}),
    "ellipsoid": ("parameters", "parameter", {"parameter": "parameter", **INTERVAL}),
    "noise": ("numbers", "column", {"column": "column", "term": "term", **INTERVAL}),
    "stress": (
        "changes",
        "change",
        {"verdict": "verdict", "sigmas": "amplification", "m": "metres", "deg": "degrees"}
        | {"growth": "growth", "ratio to half": "halved", "diverge at (s)": "parted_s", "by": "topic"},
    ),
}


@pytest.mark.paper
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.line)
@pytest.mark.usefixtures("place")
def test_what_is_printed_is_what_was_found(case: Case) -> None:
    """By `--json`, and in tables under the headings that name it."""
    results = list[Any]()
    with ExitStack() as stack:
        if case.calls:
            module, _, name = case.calls.rpartition(".")
            own = getattr(import_module(module), name)

            def keep(*given: Any, **options: Any) -> Any:
                results.append(own(*given, **options))
                return results[-1]

            stack.enter_context(patch(case.calls, keep))
        said = run_here(*case.line.split(), "--json")
    check(said.json, case.wanted(*results))
    if case.calls and (table := TABLES.get(case.line.split()[0])):
        with patch(case.calls, lambda *_, **__: results[0]):
            check_table(run_here(*case.line.split()).out, said.json, *table)


def check_table(text: str, found: Any, key: str, named: str, headings: dict[str, str]) -> None:
    rows = printed(text, named)
    assert len(rows) == len(found[key])
    for row, wanted in zip(rows, found[key], strict=True):
        for heading, name in headings.items():
            assert row.get(heading, "") == format_value(wanted[name]), (row, heading)


def test_every_command_that_prints_json_is_above() -> None:
    named = {case.line.split()[0] for case in CASES}
    has_json = {
        name
        for name, command in fuselog.commands.items()
        if any("--json" in option.opts for option in command.params if isinstance(option, click.Option))
    }
    assert has_json == named | ELSEWHERE.keys()
    for name, file in ELSEWHERE.items():
        text = Path(__file__).with_name(f"{file}.py").read_text(encoding="utf-8")
        assert f'"{name}", "--json").json == ' in text
