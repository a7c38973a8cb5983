"""What fuselog exports comes back, by the mapping that a guess writes: columns and stamps in ns."""

from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import fuselog as fl
from fuselog.pipeline.logs.exporting import export
from fuselog.recorders.importers.tables.guessing import guess
from fuselog.recorders.log import Stream, write_log
from fuselog.recorders.recording import Simulator, record_run

# What makes the runs short that are long.
SHORT: dict[str, dict[str, Any]] = {
    "biometric-scores": {"users": 20},
    "car": {"duration_s": 5.0},
    "crossing": {"duration_s": 8.0},
    "landmarks": {"duration_s": 5.0},
    "navigation": {"duration_s": 10.5},
    "vehicles": {"duration_s": 5.0},
}
SCENARIOS = [
    each.name
    for each in entry_points(group="fuselog.recorders")
    if each.value.startswith("fuselog.") and isinstance(each.load(), Simulator)
]


FORMATS = [
    *((name, "csv") for name in SCENARIOS),
    # only reading the cells is different
    *((name, "parquet") for name in ("crossing", "landmarks", "navigation", "shot-sequence")),
]


@pytest.fixture(scope="module")
def log(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short log of a scenario."""
    recording, metadata = record_run(request.param, SHORT.get(request.param, {}), 0)
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    write_log(path, recording.streams, metadata)
    return path


@pytest.mark.paper
@pytest.mark.parametrize(("log", "to"), FORMATS, indirect=["log"], scope="module")
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


@pytest.mark.parametrize("log", SCENARIOS, indirect=True, scope="module")
def test_trajectories_come_back_to_the_digits_that_are_written(log: Path, tmp_path: Path) -> None:
    streams = fl.open(log)
    placed = [topic for topic, each in streams.items() if {"x_m", "y_m"} <= {*(each.components or ())}]
    for topic in placed:
        given, file = streams[topic], tmp_path / "poses.txt"
        if given.schema.name not in ("TruthState", "GaussianEstimate") or len(given) < 2:
            continue
        export(log, to="tum", topics=[topic], out=file)
        found = fl.import_("table", file, mapping="tum")["/truth"]
        assert_array_equal(found.publish_time_ns, given.publish_time_ns)
        numbers = given["state" if "state" in given.columns else "mean"]
        names = list(given.components or ())
        for index, name in enumerate(["x_m", "y_m", "z_m"]):
            wanted = numbers[:, names.index(name)] if name in names else 0.0
            np.testing.assert_allclose(found["state"][:, index], wanted, rtol=0, atol=1e-6)
        if "heading_rad" in names:
            w, z = found["state"][:, 3], found["state"][:, 6]
            turned = 2 * np.arctan2(z, w) - numbers[:, names.index("heading_rad")]
            np.testing.assert_allclose(np.sin(turned), 0, rtol=0, atol=1e-6)
        elif "orientation_w" in names:
            own = numbers[:, [names.index(f"orientation_{part}") for part in "wxyz"]]
            alike = np.abs(np.sum(own * found["state"][:, 3:], axis=1))
            np.testing.assert_allclose(alike, 1, rtol=0, atol=1e-9)
        file.unlink()
