"""What fuselog exports comes back, by the mapping that a guess writes: columns and stamps in ns."""

from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import fuselog as fl
from pipeline.logs.exporting import export
from recorders.importers.tables.guessing import guess
from recorders.log import Stream, write_log
from recorders.recording import Simulator, record_run

# What makes the runs short that are long.
SHORT: dict[str, dict[str, Any]] = {
    "biometric-scores": {"users": 20},
    "crossing": {"duration_s": 8.0},
    "landmarks": {"duration_s": 5.0},
    "navigation": {"duration_s": 10.5},
    "vehicles": {"duration_s": 5.0},
}
SCENARIOS = [
    each.name
    for each in entry_points(group="fuselog.recorders")
    if each.value.startswith("recorders.") and isinstance(each.load(), Simulator)
]


@pytest.fixture(scope="module", params=SCENARIOS)
def log(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short log of a scenario."""
    recording, metadata = record_run(request.param, SHORT.get(request.param, {}), 0)
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    write_log(path, recording.streams, metadata)
    return path


@pytest.mark.parametrize("to", ["csv", "parquet"])
def test_exported_tables_come_back(log: Path, to: Literal["csv", "parquet"], tmp_path: Path) -> None:
    streams = fl.open(log)
    for topic, file in export(log, to=to, out=tmp_path / to).files.items():
        if not len(streams[topic]):
            continue
        mapping = tmp_path / "mapping.toml"
        mapping.write_text(guess([file]))
        found = fl.import_("table", file, mapping=str(mapping))
        _assert_same(found[topic], streams[topic])


def _assert_same(found: Stream, wanted: Stream) -> None:
    columns, others = found.pandas(), wanted.pandas()
    assert list(columns) == list(others)
    for name in columns:
        if name.startswith(("quaternion", "state_orientation", "mean_orientation")):
            # which are made of unit length again
            np.testing.assert_allclose(columns[name], others[name], rtol=0, atol=1e-15)
        else:
            assert_array_equal(columns[name], others[name], err_msg=f"{wanted.topic} {name}")


def test_a_trajectory_comes_back_to_the_digits_that_are_written(tmp_path: Path) -> None:
    recording, metadata = record_run("navigation", {"duration_s": 10.5}, 0)
    [truth] = [each for each in recording.streams if each.topic == "/body/truth"]
    write_log(tmp_path / "run.mcap", [truth], metadata)
    file = tmp_path / "truth.txt"
    export(tmp_path / "run.mcap", to="tum", topics=["/body/truth"], out=file)
    found = fl.import_("table", file, mapping="tum")["/truth"]
    assert_array_equal(found.publish_time_ns, truth.publish_time_ns)
    assert truth.components[:3] == ["x_m", "y_m", "z_m"]
    np.testing.assert_allclose(found["state"][:, :3], truth["state"][:, :3], rtol=0, atol=1e-6)
