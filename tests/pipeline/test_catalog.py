"""Catalogs of logs, conditions on them, and commands over the logs that they select."""

import shutil
from collections.abc import Callable, Sequence
from multiprocessing import active_children
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import fuselog as fl
from fuselog.pipeline.api.over_logs import measured
from fuselog.pipeline.logs import cataloguing
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.batches import Batch
from fuselog.pipeline.runs.checkpoints import Checkpoints
from fuselog.pipeline.selecting.catalog import read_catalog, rows_in, schema
from fuselog.pipeline.selecting.where import rows_where
from fuselog.recorders.errors import BadInput
from fuselog.replay.judging.errors.evaluation import chi_square_interval
from tests.pipeline.conftest import Said
from tests.pipeline.test_campaigns import contents

pytestmark = pytest.mark.usefixtures("blank_figures")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six logs of two robots in two folders, one of which was cut off."""
    folder = tmp_path_factory.mktemp("catalog")
    for seed in range(6):
        log = fl.record("landmarks", seed=seed, duration_s=1.0 + seed / 2)
        fl.write(folder / "drives" / f"robot{seed % 2}" / f"drive{seed}.mcap", log)
    whole = (folder / "drives/robot1/drive5.mcap").read_bytes()
    (folder / "drives/robot1/drive5.mcap").write_bytes(whole[: len(whole) // 2])
    (folder / "drives/robot0/notes.txt").write_text("not a log")
    return folder


@pytest.fixture
def drives(recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of these logs, in a working directory of its own."""
    shutil.copytree(recorded / "drives", tmp_path / "drives")
    monkeypatch.chdir(tmp_path)
    return Path("drives")


@pytest.fixture
def described(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the logs that are read for a catalog."""
    names: list[str] = []
    read = cataloguing.Describing.__call__

    def describe(task: cataloguing.Describing, log: Path, number: int, folder: Path) -> list[dict]:
        names.append(log.name)
        return read(task, log, number, folder)

    monkeypatch.setattr(cataloguing.Describing, "__call__", describe)
    return names


def test_a_row_states_what_the_log_holds(drives: Path) -> None:
    table = fl.catalog(drives).set_index("log")
    path = drives / "robot0" / "drive2.mcap"
    log, row = fl.open(path), table.loc[str(path)]
    assert len(table) == 6
    assert row["duration_s"] == pytest.approx(2.0)
    assert row["messages"] == sum(topic.messages for topic in log.topics.values())
    assert row["robot1_odometry_rate_hz"] == log.topics["/robot1/odometry"].messages / 2.0
    assert (row["seed"], row["scenario"], row["folder"]) == (2, "landmarks", "robot0")
    assert row["run_duration_s"] == 2.0
    assert row["fits_robot"]
    assert row["size_bytes"] == path.stat().st_size
    assert [each["topic"] for each in row["topics"]] == list(log.topics)
    cut = table.loc[str(drives / "robot1" / "drive5.mcap")]
    assert "was cut off" in cut["problem"]
    assert not cut["fits_robot"]
    assert table["problem"].notna().sum() == 1


def test_only_new_and_changed_logs_are_read_again(drives: Path, described: list[str]) -> None:
    place = Path("logs.parquet")
    fl.catalog(drives, out=place)
    assert len(described) == 6
    sites = pa.array([f"site {number}" for number in range(6)])
    pq.write_table(pq.read_table(place).append_column("site", sites), place)
    fl.write(drives / "robot0" / "drive0.mcap", fl.record("landmarks", seed=9, duration_s=1.0))
    (drives / "robot1" / "drive1.mcap").unlink()
    shutil.copy(drives / "robot0" / "drive2.mcap", drives / "new.mcap")
    described.clear()
    again = fl.catalog(drives, out=place).set_index("log")
    assert sorted(described) == ["drive0.mcap", "new.mcap"]
    assert len(again) == 6
    assert again.loc["drives/robot0/drive0.mcap", ["seed", "site"]].tolist() == [9, "site 0"]
    assert pd.isna(again.loc["drives/new.mcap", "site"])
    described.clear()
    deep = fl.catalog(drives, out=place, deep=True)
    assert len(described) == 6
    assert deep["sha256"].notna().sum() == 5
    assert deep["faults"].dropna().tolist() == [0] * 5
    described.clear()
    assert rows_in(fl.catalog(drives, out=place)[deep.columns]) == rows_in(deep)
    assert not described


def test_a_catalog_as_json(drives: Path, fuselog: Callable[..., Said]) -> None:
    said = fuselog("catalog", drives, "--deep", "--where", "folder == 'robot1'", "--json").json
    wanted = fl.catalog(drives, deep=True, where="folder == 'robot1'")
    assert said == {"logs": rows_in(wanted[schema().names])}
    assert [row["sha256"] is None for row in said["logs"]] == [False, False, True]
    fuselog("catalog", drives, "-o", "logs.parquet")
    assert fuselog("info", "logs.parquet", "--json").json["logs"] == rows_in(
        read_catalog(Path("logs.parquet"))
    )


def test_a_catalog_and_its_logs_are_moved_together(drives: Path) -> None:
    fl.catalog(drives, out="logs.parquet")
    Path("moved").mkdir()
    for each in (drives, Path("logs.parquet")):
        shutil.move(each, "moved")
    found = cataloguing.select([Path("moved/logs.parquet")], "seed == 2")
    assert found.logs == [Path("moved/drives/robot0/drive2.mcap")]
    paths = [Path("moved/logs.parquet"), Path("moved/drives"), Path("moved").absolute() / "drives"]
    again = cataloguing.select(paths)
    assert (len(again.logs), len(again.unreadable)) == (5, 1)
    assert len(fl.catalog(*paths[1:], out="twice.parquet")) == len(fl.catalog("twice.parquet")) == 6


def test_conditions_select_rows() -> None:
    table = pd.DataFrame(
        {
            "log": ["a", "b", "c"],
            "seed": pd.array([1, None, 3], "Int64"),
            "rate_hz": [4.0, np.nan, 6.0],
            "is_deep": [True, False, True],
            "problem": [None, None, None],
        }
    )
    for condition, logs in {
        "rate_hz > 4": "c",
        "not rate_hz > 4": "ab",
        "3 < rate_hz <= 4 or seed == 3": "ac",
        "seed / 2 + 1 >= 2.5": "c",
        "log in ['a', 'c'] and rate_hz < 5": "a",
        "log not in ('a', '@`c')": "bc",
        "is_deep": "ac",
        "rate_hz == rate_hz": "ac",
        "-rate_hz < -5": "c",
    }.items():
        assert "".join(rows_where(table, condition)["log"]) == logs, condition
    table["problem"] = [None, "cannot be read", None]
    assert "".join(rows_where(table, "rate_hz > 4")["log"]) == "bc"
    assert "".join(rows_where(table, "log != 'b'")["log"]) == "ac"


@pytest.mark.paper
@pytest.mark.parametrize(
    ("condition", "words"),
    [
        ("rate_h > 4", "did you mean 'rate_hz'?"),
        ("rate_hz >> 4", "RShift is not allowed"),
        ("rate_hz >", "cannot be parsed"),
        ("@seed > 4", "cannot be parsed"),
        ("`log` == 'a'", "cannot be parsed"),
        ("__import__('os').system('true')", "Call is not allowed"),
        ("log.__class__ == 'a'", "Attribute is not allowed"),
        ("log[0] == 'a'", "Subscript is not allowed"),
        ("(lambda: 1)() == 1", "Call is not allowed"),
        ("[log for log in 'a'] == 1", "ListComp is not allowed"),
        ("f'{log}' == 'a'", "JoinedStr is not allowed"),
        ("(seed := 1) == 1", "NamedExpr is not allowed"),
        ("9 ** 9 ** 9 ** 9 > 1", "Pow is not allowed"),
        ("'a' * 1000000000 == log", "'a' is not a number"),
        ("log * 1000000000 == 'a'", "log is not a number"),
        ("__class__ == 1", "no column '__class__'"),
        ("1 < 2", "is not a comparison"),
        ("rate_hz", "is not a comparison"),
        ("log > 3", "cannot be compared"),
        ("topics == 3", "contains lists"),
        ("(" * 300 + "1" + ")" * 300, "cannot be parsed"),
        ("1 < " * 9000 + "1", "longer than"),
        (" and ".join(["seed == 1"] * 600), "too many parts"),
        ("seed == '1'", "cannot be compared"),
        ("seed in ['1']", "cannot be compared"),
        ("seed == 2 or log", "log is not a comparison"),
        ("'a' in log", "write a list"),
        ("log in 'abc'", "write a list"),
        ("seed * 9999999999999999999 > 1", "exceed 64 bits"),
    ],
)
def test_a_condition_is_only_a_comparison(condition: str, words: str) -> None:
    table = pd.DataFrame({"log": ["a"], "seed": [1], "rate_hz": [4.0], "topics": [["/fix"]]})
    table["problem"] = None
    with pytest.raises(BadInput) as caught:
        rows_where(table, condition)
    assert words in str(caught.value)


def test_a_catalog_that_cannot_be_used_is_refused(drives: Path, fuselog: Callable[..., Said]) -> None:
    fl.catalog(drives, out="logs.parquet")
    pd.read_parquet("logs.parquet").to_parquet("table.parquet")
    Path("text.parquet").write_text("log")
    damaged = pq.read_table("logs.parquet")
    for name in ("log", "notes"):
        values = pa.array([None if name == "log" else "{"] * len(damaged), pa.string())
        place = damaged.column_names.index(name)
        pq.write_table(damaged.set_column(place, name, values), f"{name}.parquet")
    fl.write(drives / "still.mcap", fl.record("axis").streams.values())
    Path("empty").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fuselog.pipeline.selecting.catalog.FORMAT", 2)
        fl.catalog(drives, out="newer.parquet")
    fl.write(drives / "robot0" / "drive0.mcap", fl.record("landmarks", seed=9, duration_s=1.0))
    for line, words in {
        "catalog table.parquet": "is not a catalog",
        "catalog drives -o table.parquet": "exists and is not a catalog of fuselog",
        "catalog newer.parquet": "a newer version of fuselog wrote it",
        "catalog text.parquet": "is not a Parquet file",
        "catalog no.parquet": "no.parquet: cannot be read",
        "catalog empty": "has no logs",
        "catalog log.parquet": "its column log was changed",
        "catalog notes.parquet --where seed<1": "notes in the catalog are damaged",
        "replay logs.parquet -e ekf": "drive0.mcap: changed after it was catalogued",
        "replay drives/robot0 -e ekf --group foldr": "did you mean 'folder'?",
        "replay drives/robot0 -e ekf --where seed>70": "--where seed>70",
        "replay drives/robot0 drives/still.mcap -e ekf --group seed": "no value for drives/still.mcap",
        "replay drives/robot0 -e ekf --workers 1 --save a.rrd": "--save",
        "replay drives/robot0 -e ekf --workers 1 -o a.mcap": "selection of logs writes a result folder",
    }.items():
        said = fuselog(*line.split())
        assert (said.code, said.err.count("\n")) == (2, 1), line
        assert words in said.err, line
    assert not Path("out").exists()


@pytest.mark.paper
def test_each_log_of_a_selection_has_a_row(drives: Path, fuselog: Callable[..., Said]) -> None:
    """Each row has the numbers of a replay of its log alone; the logs that failed come first."""
    fl.write(drives / "still.mcap", fl.record("axis"))
    fuselog("catalog", drives, "-o", "logs.parquet")
    said = fuselog(
        "replay", "logs.parquet", "-e", "ekf", "-e", "bound", "--where", "seed != 4", "--json"
    )
    assert said.code == 0, said.err
    rows = pd.DataFrame(said.json["logs"])
    logs = list(dict.fromkeys(rows["log"]))
    assert [Path(log).stem for log in logs[:2]] == ["drive5", "still"]
    assert rows.groupby("log")["problem"].first().notna().sum() == 2
    for log in logs[2:]:
        own = rows[rows["log"] == log].set_index("estimator")
        metrics = fl.replay(log, ["ekf", "bound"]).metrics
        for label, quantity, value in metrics[["estimator", "quantity", "value"]].to_numpy():
            assert own.loc[label, quantity] == value
        assert fl.open(f"out/replay/{own.loc['ekf', 'estimates']}").run.notes["log"].endswith(log)
    errors = rows[rows["estimator"] == "ekf"]["position_rmse_m"].dropna().tolist()
    assert errors == sorted(errors, reverse=True)
    assert len(errors) == 4
    shown = fuselog("replay", "logs.parquet", "-e", "ekf", "--group", "folder", "--out", "out/other").out
    assert "fuselog info drives/robot1/drive5.mcap" in shown
    assert "there are only 2" in shown
    assert fuselog("view", "out/replay", "--runs", "worst:2", "--save", "viewed").code == 0
    assert len(list(Path("viewed").glob("*.rrd"))) == 4  # two of them drawn


@pytest.mark.paper
def test_a_comparison_over_logs_is_that_of_one_replay(
    drives: Path, fuselog: Callable[..., Said]
) -> None:
    """Over single logs it has the numbers of `compare` in one pass; a group has the mean of its logs."""
    labels = ("-e", "ekf", "-e", "dead-reckoning", "--json")
    (drives / "robot1" / "drive5.mcap").unlink()
    logs = sorted(drives.rglob("*.mcap"))
    together = pd.DataFrame(fuselog("compare", *logs, *labels).json["differences"])
    said = fuselog("compare", drives, "--workers", "1", *labels)
    alone = pd.DataFrame(said.json["differences"])
    keys = ["quantity", "case"]
    both = together.merge(alone, on=keys, suffixes=("", "_alone"))
    assert len(both) == len(alone) == len(together)
    for name in ("first_mean", "second_mean", "difference", "low", "high", "runs"):
        assert both[name].tolist() == pytest.approx(both[f"{name}_alone"].tolist(), nan_ok=True), name
    rows = pd.read_parquet("out/compare/tables/logs.parquet")
    assert [row["position_rmse_m"] for row in said.json["logs"]] == rows["position_rmse_m"].tolist()
    Path("cut.mcap").write_bytes(logs[0].read_bytes()[:-99])
    shown = fuselog(
        "compare", drives, "cut.mcap", *labels[:-1], "--workers", "1", "--set", "ekf.sigma_range_m=0.2"
    ).out.splitlines()
    again = "-e ekf -e dead-reckoning --set ekf.sigma_range_m=0.2"
    opened = [line for line in shown if line.startswith("fuselog replay")]
    assert opened[0] == f"fuselog replay cut.mcap {again}"
    assert shown[shown.index(opened[0]) - 1].startswith("cut.mcap: ")
    assert {*opened[1:]} <= {f"fuselog replay {log} {again}" for log in logs}
    assert len(opened) == 5
    said = fuselog("compare", drives, "--group", "folder", *labels, "--stress")
    assert (said.code, said.err.count("\n"), "--stress: does not apply" in said.err) == (2, 1, True)
    said = fuselog("compare", drives, *labels, "--group", "folder", "--out", "out/groups")
    found = pd.DataFrame(said.json["differences"]).set_index("quantity").loc["position_rmse_m"]
    own = rows[rows["estimator"] == "ekf"]
    folders = own["log"].map(lambda log: Path(log).parent.name)
    mean = own["position_rmse_m"].groupby(folders).mean().mean()
    assert found["first_mean"] == pytest.approx(mean, rel=1e-12)
    assert (found["runs"], found["verdict"]) == (2, "undecided")


@pytest.mark.paper
def test_lint_and_check_have_a_row_for_each_log(drives: Path, fuselog: Callable[..., Said]) -> None:
    whole = fl.record("landmarks", seed=1, duration_s=4.0)
    odometry = whole["/robot1/odometry"]
    silent = odometry.take(np.r_[0:15, 35 : len(odometry)])
    fl.write(drives / "silent.mcap", {**whole.streams, silent.topic: silent}.values())
    said = fuselog("lint", drives, "--json", "--out", "out/lint")
    names = [Path(row["log"]).name for row in said.json["logs"]]
    [finding] = fl.lint(drives / "silent.mcap")
    assert said.code == 1
    assert names[:2] == ["drive5.mcap", "silent.mcap"]
    assert [row["faults"] for row in said.json["logs"]] == [None, 1, 0, 0, 0, 0, 0]
    assert said.json["logs"][1]["finding"] == finding.sentence
    assert fuselog("lint", drives / "robot0").code == 0
    deep = fl.catalog(drives, deep=True).set_index("log").loc[str(drives / "silent.mcap")]
    assert (deep["gaps"], deep["longest_gap_s"], deep["faults"]) == (1, pytest.approx(1.05), 1)
    (drives / "silent.mcap").unlink()
    fuselog("catalog", drives, "-o", "logs.parquet")
    against = ("--against", "ekf.golden.xz", "--where")
    line = ("check", "logs.parquet", *against)
    assert fuselog(*line, "seed < 3", "--update", "-e", "ekf").code == 0
    (drives / "robot1" / "drive5.mcap").unlink()
    assert fuselog("catalog", drives, "-o", "logs.parquet").code == 0
    assert fuselog(*line, "seed < 3").code == 0
    said = fuselog(*line, "seed > 0 and seed < 4", "--json", "--out", "out/check")
    rows = {Path(row["log"]).stem: row["problem"] for row in said.json["logs"]}
    assert said.code == 1
    assert rows == {
        "drive0": "is missing, although the golden has it",
        "drive1": None,
        "drive2": None,
        "drive3": "is not in the golden; add it with --update",
    }


@pytest.mark.paper
def test_commands_on_all_logs_together_take_a_catalog(
    drives: Path, fuselog: Callable[..., Said]
) -> None:
    """The logs that meet the condition, while the one that cannot be read is reported."""
    fuselog("catalog", drives, "-o", "logs.parquet")
    chosen, logs = ("logs.parquet", "--where", "seed < 2"), sorted(drives.rglob("drive[01].mcap"))
    said = fuselog("run", *chosen, "-e", "ekf", "--logs", "0", "--out", "out/a", "--json")
    alone = fuselog("run", *logs, "-e", "ekf", "--logs", "0", "--out", "out/b", "--json").json
    assert said.json["metrics"] == alone["metrics"]
    assert "drive5.mcap: left out: it was cut off" in said.err
    assert pd.read_parquet("out/a/tables/unreadable.parquet")["log"].tolist() == [
        str(drives / "robot1" / "drive5.mcap")
    ]
    Path("mine.toml").write_text(
        'title = "mine"\n[logs]\ncatalog = "logs.parquet"\nwhere = "seed < 2"\n[estimators.ekf]\n'
    )
    assert fuselog("run", "mine.toml", "--logs", "0", "--json").json["metrics"] == alone["metrics"]
    over = ("--over", "gap_limit_s=0.1,0.2", "--out", "out/sweep", "--json")
    swept = fuselog("sweep", *chosen, "-e", "ekf", *over).json
    assert swept["settings"]["logs"]["files"] == [str(log) for log in logs]
    assert fuselog("view", *chosen, "--save", "viewed").code == 0
    assert sorted(each.stem for each in Path("viewed").glob("*.rrd")) == ["drive0", "drive1"]
    tuned = fuselog("tune", *chosen, "-e", "ekf", "--free", "sigma_range_m", "--json").json
    assert tuned["logs"] == [str(log) for log in logs]
    [told] = pd.read_parquet("out/tune/tables/unreadable.parquet").to_numpy().tolist()
    assert told == [str(drives / "robot1" / "drive5.mcap"), *fl.catalog(drives)["problem"].dropna()]
    for command in ("run -e ekf", "view", "tune -e ekf --free sigma_range_m"):
        name, *options = command.split()
        said = fuselog(name, "logs.parquet", *options, "--where", "seed == 7")
        words = f"no selected log can be read; {': '.join(told)}"
        assert (said.code, words in said.err, said.err.count("\n")) == (2, True, 1), command
    toml = Path("mine.toml").read_text().replace("seed < 2", "seed == 7")
    Path("none.toml").write_text(toml)
    said = fuselog("run", "none.toml")
    assert (said.code, words in said.err, said.err.count("\n")) == (2, True, 1)


@pytest.mark.paper
@pytest.mark.usefixtures("first_cause_alone")
def test_a_diagnosis_has_a_row_for_each_log(drives: Path, fuselog: Callable[..., Said]) -> None:
    log = drives / "robot1" / "drive3.mcap"
    settings = ("-e", "ekf", "--set", "sigma_bearing_rad=0.002", "--json")
    said = fuselog("diagnose", drives / "robot1", "--where", "seed == 3", *settings)
    alone = fuselog("diagnose", log, *settings).json
    rows = said.json["logs"]
    assert [Path(row["log"]).stem for row in rows] == ["drive5", "drive3"]
    assert rows[1]["gain"] == pytest.approx(
        max(each["gain"] for each in alone["sentences"] if each["gain"])
    )
    assert alone["found"][0].endswith(rows[1]["finding"])


def test_the_unit_of_a_verdict_is_the_group() -> None:
    """Six robots with four logs each, whose NEES is that of the robot: there are six values, not 24."""
    units = np.repeat([*"abcdef"], 4)
    rmse = np.repeat([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], 4) + np.tile([-0.1, 0.1], 12)
    rows = {"log": map(str, range(24)), "group": units, "estimator": "ekf", "case": "robot1"}
    numbers = {"position_rmse_m": rmse, "nees": 2.0 * rmse, "components": 3, "failed_runs": 0.0}
    table = pd.DataFrame({**rows, **numbers, "problem": None})
    table.loc[[2, 3, 23], "problem"] = "failed"
    outcome = Outcome()
    found = pd.DataFrame(measured(table, outcome)).set_index("quantity")
    nees = found.loc["nees"]
    half = 2.570582 * np.std([2, 4, 6, 8, 10, 12], ddof=1) / np.sqrt(6)  # t of 5 degrees
    assert nees[["value", "low", "high"]].tolist() == pytest.approx([7, 7 - half, 7 + half], rel=1e-6)
    assert outcome.bounds["ekf.nees.robot1"] == chi_square_interval(3, 6)
    assert nees[["aim", "verdict", "logs", "units"]].tolist() == [3, "overconfident", 24, 6]
    assert found.loc["position_rmse_m", "value"] == pytest.approx(np.sqrt(np.mean(rmse**2)))
    assert found.loc["failed_runs", "value"] == 2  # of the robots a and f
    alone = pd.DataFrame(measured(table.drop(columns="group"), Outcome())).set_index("quantity")
    assert alone.loc["nees", "high"] - alone.loc["nees", "low"] < 0.6 * 2 * half
    few = pd.DataFrame(measured(table[table["group"] < "e"], Outcome())).set_index("quantity")
    assert np.isnan(few.loc["nees", "low"])


@pytest.mark.paper
def test_an_interrupted_selection_is_resumed(
    drives: Path, monkeypatch: pytest.MonkeyPatch, fuselog: Callable[..., Said]
) -> None:
    line = ("replay", "drives", "-e", "ekf", "--workers", "1", "--out", "out")
    whole = contents_of(line, fuselog)
    packed: list[str] = []
    pack = Batch.packed

    def stopped(batch: Batch, folder: Path) -> bytes:
        if len(packed) == 3:
            packed.append("stopped")
            raise KeyboardInterrupt
        packed.append(batch.logs[0].stem)
        return pack(batch, folder)

    monkeypatch.setattr(Batch, "packed", stopped)
    assert fuselog(*line).code == 130
    assert not Path("out").exists()
    assert contents_of(line, fuselog) == whole
    assert packed == ["drive0", "drive2", "drive4", "stopped", "drive1", "drive3"]


@pytest.mark.paper
def test_a_full_disk_ends_a_selection_and_keeps_its_batches(
    drives: Path, fuselog: Callable[..., Said]
) -> None:
    """Every other log would fail as well, so it is no row; the limit stands in for the disk's."""
    resource = pytest.importorskip("resource")
    line = ("replay", "drives", "-e", "dead-reckoning", "--workers", "1", "--out", "out")
    whole = contents_of(line, fuselog)
    largest = len(whole["estimates/0001-drive2.estimates.mcap"])
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest, hard))
    try:
        said = fuselog(*line)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert said.code == 2
    assert "drive4.estimates.mcap: cannot be written (File too large)" in said.err
    assert len(list(Path("out.unfinished").glob("*.bin"))) == 2
    assert not Path("out").exists()
    assert contents_of(line, fuselog) == whole


@pytest.mark.paper
def test_a_killed_worker_changes_no_byte(
    drives: Path, monkeypatch: pytest.MonkeyPatch, fuselog: Callable[..., Said]
) -> None:
    for number in range(6):
        shutil.copy(drives / "robot0" / "drive4.mcap", drives / f"copy{number}.mcap")
    line = ("replay", "drives", "-e", "ekf", "--group", "folder", "--out", "out")
    whole = contents_of((*line, "--workers", "1"), fuselog)
    killed: list[BaseProcess] = []
    write = Checkpoints.write

    def written(checkpoints: Checkpoints, key: str, left: bytes) -> None:
        write(checkpoints, key, left)
        if not killed:
            killed.extend(active_children()[:1])
            killed[0].kill()

    monkeypatch.setattr(Checkpoints, "write", written)
    found = contents_of((*line, "--workers", "2"), fuselog)
    killed[0].join()
    assert killed[0].exitcode == -9
    assert found == whole


def contents_of(line: Sequence[str], fuselog: Callable[..., Said]) -> dict[str, bytes]:
    """Run a command, and take its result away."""
    said = fuselog(*line)
    assert said.code == 0, said.err
    found = contents(Path("out"))
    shutil.rmtree("out")
    return found
