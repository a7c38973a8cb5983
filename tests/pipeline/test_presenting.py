"""Runs as a dataset: what Rerun's catalog reads back, what is kept, and what is refused."""

import json
import os
import shutil
import signal
import socket
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import numpy as np
import pandas as pd
import psutil
import pytest
from numpy.typing import NDArray

from fuselog.pipeline.output.results import RUNS as TABLE
from fuselog.pipeline.output.results import read_table
from fuselog.pipeline.presenting import segments
from fuselog.pipeline.presenting.drawing import draw, open_run
from fuselog.pipeline.presenting.making import Kept, runs_at
from fuselog.pipeline.presenting.segments import list_runs
from fuselog.recorders.log import open_log, read_streams
from fuselog.replay.timeline import catalog, viewer
from fuselog.replay.timeline.show import read_moments

pytest.importorskip("datafusion")
pytestmark = pytest.mark.usefixtures("blank_figures")

Fuselog = Callable[..., Any]
RUNS = 6  # so many that they are drawn by other processes


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory, fuselog: Fuselog, blank_figures: None) -> Path:
    """A result of five runs, of which one log was kept; others add to what is next to it."""
    folder = tmp_path_factory.mktemp("presenting") / "result"
    options = ["--runs", RUNS, "--logs", 1, "--set", "duration_s=2", "--out", folder]
    assert fuselog("run", "landmarks", *map(str, options)).code == 0
    return folder


@pytest.fixture(scope="module")
def dataset(result: Path, fuselog: Fuselog) -> Path:
    """Its dataset, with a run whose log was kept and one that was recorded again."""
    folder = result.with_name("dataset")
    said = fuselog("view", result, "--runs", "0,3", "--save", folder)
    assert said.code == 0, said.err
    return folder


def read_back(folder: Path) -> tuple[Any, pd.DataFrame]:
    """Read the table of segments as Rerun's server lists the files of a folder."""
    from rerun.server import Server

    server = Server(host="127.0.0.1", datasets={"all": folder})
    client = server.client()
    entry = client.get_dataset("all")
    table = entry.segment_table().to_pandas().set_index("rerun_segment_id").sort_index()
    return (server, client, entry), table


@pytest.mark.paper
def test_the_catalog_has_the_numbers_of_every_run(result: Path, dataset: Path) -> None:
    (server, *_), table = read_back(dataset)
    rows = read_table(result / TABLE)
    assert list(table.index) == [f"run-{run:04d}" for run in range(RUNS)]
    assert [each[0] for each in table["property:run:run"]] == [*range(RUNS)]
    for label, own in rows.groupby("estimator"):
        for key in own.columns.drop(["estimator", "case", "run"]):
            column = catalog.column_of(str(label), key)
            stated = own.sort_values("run")[key].to_numpy(float)
            if np.isnan(stated).all():
                assert column not in table
            else:
                np.testing.assert_array_equal([each[0] for each in table[column]], stated)
    by_rank = table["property:run:rank"].map(lambda each: each[0]).sort_values().index
    error = table["property:ukf:position_rmse_m"].map(lambda each: each[0])
    first = rows.groupby("estimator")["position_rmse_m"].apply(lambda of: np.sqrt((of**2).mean()))
    assert first.idxmin() == "ukf"
    assert error[by_rank].is_monotonic_decreasing
    for moment in read_moments(result / "timeline.rrd"):  # of run 0
        if moment.quantity == "nees":
            column = catalog.column_of(moment.estimator, "worst_at_s")
            assert table.loc["run-0000", column] == [moment.elapsed_s]
    is_known = table["property:ekf:worst_at_s"].map(bool)
    assert is_known.to_list() == [run in (0, 3) for run in range(RUNS)]
    server.shutdown()


def test_layers_have_the_values_of_the_logs(result: Path, dataset: Path) -> None:
    """Their columns equal the estimates and the truth of the run, in the precision of a drawing."""
    estimate, truth = (
        read_streams(open_log(result / kind / "run-0000.mcap"), [topic])[topic]
        for kind, topic in (
            ("estimates", "/estimates/ekf/robot1/pose"),
            ("logs", "/robot1/truth"),
        )
    )
    (server, _client, entry), _ = read_back(dataset)
    run = entry.filter_segments("run-0000")

    def drawn(entity: str, component: str) -> NDArray[np.float64]:
        rows = run.filter_contents(entity).reader(index="utc").to_pandas().dropna(subset=["utc"])
        assert (rows["utc"].astype("int64") == estimate.publish_time_ns).all()
        return np.stack([np.ravel(each.tolist()) for each in rows[f"{entity}:{component}"]])

    np.testing.assert_array_equal(estimate.publish_time_ns, truth.publish_time_ns)
    for name, states in (("ekf", estimate["mean"]), ("truth", truth["state"])):
        entity = f"/map/robot1/{name}/pose"
        np.testing.assert_array_equal(drawn(entity, "Arrows2D:origins"), np.float32(states[:, :2]))
        arrows = drawn(entity, "Arrows2D:vectors")
        headings = np.arctan2(arrows[:, 1], arrows[:, 0])
        np.testing.assert_allclose(np.exp(1j * headings), np.exp(1j * states[:, 2]), atol=1e-6)
    for number, name in enumerate(("x_m", "y_m")):
        entity = f"/plots/robot1/error_{name}/ekf"
        error = estimate["mean"][:, number] - truth["state"][:, number]
        np.testing.assert_allclose(drawn(entity, "Measurements:values")[:, 0], error, atol=1e-12)
        band = drawn(entity, "Measurements:variances")[:, 1]  # of 2 sigma
        np.testing.assert_allclose(band, 4.0 * estimate["covariance"][:, 4 * number], rtol=1e-12)
    server.shutdown()


def test_layers_are_what_was_recorded_and_each_estimator(result: Path, dataset: Path) -> None:
    """Kept files are drawn once, and are registered onto the segments that have only properties."""
    assert dataset.is_dir()
    runs = list_runs([result], 0.2)
    assert runs is not None
    kept = Kept(runs)
    before = {path: path.stat().st_mtime_ns for path in kept.folder.rglob("*.rrd")}
    with catalog.serve_dataset("runs") as served:
        properties = sorted(kept.properties().glob("*.rrd"))
        served.add([(path, catalog.PROPERTIES) for path in properties])
        served.add([layer for each in kept.made() for layer in each.layers])
        for each in kept.made():
            served.lay_out(each.folder / "layout.rbl")
        layers = served._entry.segment_table().to_pandas().set_index("rerun_segment_id")
        found = {name: {*of} for name, of in layers["rerun_layer_names"].items()}
        assert served._entry.default_blueprint() in served._entry.blueprints()
        assert served.has_layout
        process = psutil.Process()
        listening = [each for each in process.net_connections() if each.status == psutil.CONN_LISTEN]
        assert listening
        assert {each.laddr.ip for each in listening} == {"127.0.0.1"}
    drawn = {"properties", "base", "dead-reckoning", "ekf", "ukf"}
    assert found["run-0000"] == found["run-0003"] == drawn
    assert found["run-0001"] == {"properties"}
    assert before == {path: path.stat().st_mtime_ns for path in kept.folder.rglob("*.rrd")}


def test_the_list_of_runs_is_kept_until_a_file_of_it_changes(
    result: Path, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is read without the tables, from any folder, and equals what they give."""
    assert dataset.is_dir()
    place = tmp_path / "result"
    shutil.copytree(result, place)
    listed = list_runs([place], 0.2)
    assert listed is not None
    Kept(listed).properties()
    again: list[Sequence[Path]] = []
    monkeypatch.setattr(segments, "list_runs", lambda paths, *_, **__: again.append(paths))
    monkeypatch.chdir(tmp_path)
    assert runs_at([Path("result")], 0.5) == listed._replace(path=Path("result"))
    assert again == []
    stated = place / "result.json"
    before, text = stated.stat(), stated.read_text()
    stated.write_text(text.replace('"seed": 1', '"seed": 2'))
    os.utime(stated, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert runs_at([place], 0.2) is None
    stated.write_text(text)
    os.utime(stated, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert runs_at([place], 0.2) is not None
    (place / "logs" / "run-0000.mcap").unlink()
    assert runs_at([place], 0.2) is None
    assert len(again) == 2


def test_one_run_is_drawn_as_a_log_would_be(result: Path, fuselog: Fuselog, tmp_path: Path) -> None:
    """A run that was recorded again looks as one whose log was kept."""
    from rerun.chunk import RrdReader

    def rows(name: str) -> dict[str, int]:
        return {
            each.entity_path: each.num_rows
            for each in RrdReader(str(tmp_path / name)).stream()
            if "/plots/robot1/error" in each.entity_path and not each.is_static
        }

    for run in ("0", "3"):
        saved = tmp_path / f"{run}.rrd"
        assert fuselog("view", result, "--runs", run, "--save", saved, "--start", "1").code == 0
    assert rows("0.rrd") == rows("3.rrd")


def test_two_versions_of_an_estimator_are_in_one_scene(
    result: Path, fuselog: Fuselog, tmp_path: Path
) -> None:
    """Estimates of one log that were replayed with other settings are another layer."""
    log = tmp_path / "logs" / "run.mcap"
    log.parent.mkdir()
    shutil.copy(result / "logs" / "run-0000.mcap", log)
    assert fuselog("replay", log, "-e", "ekf").code == 0
    new = log.with_name("new.estimates.mcap")
    assert fuselog("replay", log, "-e", "ekf", "--set", "sigma_range_m=0.3", "-o", new).code == 0
    said = fuselog("view", log.parent, "--save", tmp_path / "set")
    assert said.code == 0, said.err
    (server, *_), table = read_back(tmp_path / "set")
    server.shutdown()
    old, other = (table[f"property:{name}:position_rmse_m"]["run"][0] for name in ("ekf", "ekf_new"))
    assert old != other
    runs = list_runs([log.parent], 0.2)
    assert runs is not None
    (made,) = Kept(runs).made()
    assert {name for _, name in made.layers} == {"base", "ekf", "ekf new"}
    (segment,) = runs.segments
    again = replace(segment, parts=(*segment.parts, segment.parts[1]))
    assert list(open_run(again)[2]) == ["ekf", "ekf new", "ekf new 2"]
    assert Kept(runs._replace(gap_limit_s=9.0)).made() == []


def test_a_run_that_is_not_replayed_as_it_was_is_reported(result: Path, tmp_path: Path) -> None:
    runs = list_runs([result], 0.2)
    assert runs is not None
    (segment,) = runs.chosen("2")
    for name in ("same", "other"):
        (tmp_path / name).mkdir()
    assert draw(segment, runs.gap_limit_s, tmp_path / "same") == []
    ekf = segment.properties["ekf"]
    stated = {**segment.properties, "ekf": {**ekf, "nees": 2.0 * float(ekf["nees"])}}
    (sentence,) = draw(replace(segment, properties=stated), runs.gap_limit_s, tmp_path / "other")
    assert sentence.startswith("run-0002: drawn now, nees of ekf is")


def test_the_layout_that_runs_share_counts_nothing(result: Path, tmp_path: Path) -> None:
    """What is outside the range of a plot differs from run to run."""

    def titles(file: Path) -> set[str]:
        from rerun.chunk import RrdReader

        reader = RrdReader(str(file))
        (layout,) = reader.blueprints()
        views = [each.to_record_batch() for each in reader.stream(store=layout)]
        return {
            name[0]
            for batch in views
            for name in (
                batch.column("ViewBlueprint:display_name").to_pylist()
                if "ViewBlueprint:display_name" in batch.schema.names
                else []
            )
            if name
        }

    runs = list_runs([result], 0.2)
    assert runs is not None
    draw(runs.chosen("0")[0], runs.gap_limit_s, tmp_path)
    of_one = titles(result / "timeline.rrd")
    assert any("outside" in title for title in of_one)
    shared = titles(tmp_path / "layout.rbl")
    assert len(shared) == len(of_one) + 1
    assert not any("outside" in title for title in shared)


@pytest.mark.paper
def test_two_results_of_the_same_runs_are_shown_together(
    result: Path, fuselog: Fuselog, tmp_path: Path
) -> None:
    """The estimates of the second have its name; other runs are refused."""
    common = ["landmarks", "--runs", str(RUNS), "--set", "duration_s=2", "--logs", "0"]
    old = tmp_path / "old"
    assert fuselog("run", *common, "--set", "ekf.sigma_range_m=1", "--out", old).code == 0
    said = fuselog("view", result, old, "--runs", "2", "--save", tmp_path / "set")
    assert said.code == 0, said.err
    (server, *_), table = read_back(tmp_path / "set")
    server.shutdown()
    for folder, label in ((result, "ekf"), (old, "ekf old")):
        rows = read_table(folder / TABLE).query("estimator == 'ekf'").sort_values("run")
        shown = [each[0] for each in table[catalog.column_of(label, "nees")]]
        np.testing.assert_array_equal(shown, rows["nees"])
    same = tmp_path / "new" / result.name
    shutil.copytree(old, same)
    compared = tmp_path / "compared"
    assert fuselog("compare", result, same, "--out", compared).code == 0
    said = fuselog("view", compared, "--runs", "2", "--save", tmp_path / "both")
    assert said.code == 0, said.err
    (server, *_), both = read_back(tmp_path / "both")
    server.shutdown()
    for label, named in (("ekf", "ekf"), ("ekf old", f"ekf new-{result.name}")):
        expected, shown = (
            each[catalog.column_of(name, "nees")].map(list)
            for each, name in ((table, label), (both, named))
        )
        assert expected.to_list() == shown.to_list()
    shutil.rmtree(same)
    gone = fuselog("view", compared, "--runs", "2")
    assert (gone.code, gone.err.count("\n")) == (2, 1)
    assert f"compared {same}, which is gone" in gone.err
    other = tmp_path / "other"
    assert fuselog("run", *common, "--seed", "9", "--out", other).code == 0
    said = fuselog("view", result, other, "--save", tmp_path / "none")
    assert said.code == 2
    assert "give results of the same runs" in said.err


@pytest.mark.paper
def test_points_of_a_sweep_have_their_parameters(fuselog: Fuselog, tmp_path: Path) -> None:
    """A run is replayed with the parameters of its point, so that its error is that of the table."""
    swept = ["--over", "ekf.sigma_range_m=0.05,0.5", "--runs", "2", "--set", "duration_s=2"]
    assert fuselog("sweep", "landmarks", *swept, "--out", tmp_path / "swept").code == 0
    said = fuselog("view", tmp_path / "swept", "--runs", "point-0001", "--save", tmp_path / "set")
    assert said.code == 0
    assert said.err == ""  # nothing differs from the result
    (server, *_), table = read_back(tmp_path / "set")
    server.shutdown()
    shown = table[catalog.column_of("run", "ekf.sigma_range_m")].map(lambda each: each[0])
    assert shown.to_dict() == {
        f"point-{point:04d}-run-{run:04d}": value
        for point, value in enumerate([0.05, 0.5])
        for run in range(2)
    }


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--runs", "9"], "has no run 9; its 6 runs are run-0000 to run-0005"),
        (["--runs", "worst:0"], "has no run worst:0"),
        (["--runs", "all", "--at", "1"], "are about one run; choose it with --runs NUMBER"),
        (
            ["--runs", "1", "--save", "{notes}"],
            "is not a dataset that fuselog wrote; give another folder",
        ),
    ],
)
def test_what_cannot_be_shown_is_refused(
    result: Path, fuselog: Fuselog, tmp_path: Path, options: list[str], words: str
) -> None:
    notes = tmp_path / "notes"
    notes.mkdir()
    (notes / "note.txt").write_text("mine")
    said = fuselog("view", result, *(each.format(notes=notes) for each in options))
    assert said.code == 2
    assert words in said.err
    assert said.err.count("\n") == 1
    assert [path.name for path in tmp_path.rglob("*")] == ["notes", "note.txt"]


def test_a_folder_without_runs_is_refused(dataset: Path, fuselog: Fuselog, tmp_path: Path) -> None:
    for folder, words in (
        (dataset, "is a dataset that fuselog saved; to serve it: rerun server --host 127.0.0.1 -d"),
        (dataset.with_name("result.segments"), "is a dataset that fuselog saved"),
        (tmp_path, "no such file; give a result with a timeline, a log, or a folder of *.mcap"),
    ):
        said = fuselog("view", folder)
        assert (said.code, said.err.count("\n")) == (2, 1)
        assert words in said.err


def test_a_folder_that_is_not_of_fuselog_is_kept(result: Path, fuselog: Fuselog, tmp_path: Path) -> None:
    """What is next to a result under the name of its drawings is not replaced."""
    place = tmp_path / "result"
    shutil.copytree(result, place)
    other = tmp_path / "result.segments" / "note.txt"
    other.parent.mkdir()
    other.write_text("mine")
    said = fuselog("view", place, "--save", tmp_path / "set")
    assert (said.code, said.err.count("\n")) == (2, 1)
    assert "result.segments: exists and is not a dataset that fuselog wrote; move it away" in said.err
    assert [path.name for path in other.parent.iterdir()] == ["note.txt"]


def test_logs_of_a_folder_are_recovered_and_told_apart(
    result: Path, fuselog: Fuselog, tmp_path: Path
) -> None:
    """A list that was kept with damaged logs is not used where they are refused."""
    whole = (result / "logs" / "run-0000.mcap").read_bytes()
    for name, contents in (("old", whole), ("new", whole[: len(whole) * 2 // 3])):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.mcap").write_bytes(contents)
    logs = [tmp_path / name / "run.mcap" for name in ("old", "new")]
    for _ in range(2):
        said = fuselog("view", *logs, "--runs", "old-run", "--recover", "--save", tmp_path / "set")
        assert (said.code, said.err.count("\n")) == (0, 1)
        assert f"{logs[1]}: it was cut off" in said.err
    names = {"new-run.rrd", "old-run.rrd", "fuselog.json", "layout.rbl"}
    assert {path.name for path in (tmp_path / "set").iterdir()} == names
    said = fuselog("view", *logs, "--save", tmp_path / "other")
    assert (said.code, said.err.count("\n")) == (2, 1)
    assert "readable with --recover" in said.err


@pytest.mark.paper
@pytest.mark.unix
def test_a_full_disk_is_one_sentence(result: Path, tmp_path: Path, fuselog: Fuselog) -> None:
    """Rerun's own writer of layouts would wait forever or stay silent; nothing half is left."""
    resource = pytest.importorskip("resource")
    place, saved = tmp_path / "result", tmp_path / "set"
    shutil.copytree(result, place)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    for limit, what in ((4000, "all runs"), (10_000, "layout"), (100_000, "whole")):
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
        try:
            said = fuselog("view", place, "--runs", "0", "--save", saved)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert (said.code, said.err.count("\n")) == (2, 1), (what, said.err)
        assert "cannot be written" in said.err
        kept = tmp_path / "result.segments"
        assert not saved.exists()
        assert not [*kept.rglob("*.part")]
        assert not (kept / "run-0000").exists()
        runs = list_runs([place], 0.2)
        assert runs is not None
        Kept(runs).properties()
    assert fuselog("view", place, "--runs", "0", "--save", tmp_path / "set").code == 0


def test_a_port_in_use_is_refused(result: Path, fuselog: Fuselog) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        said = fuselog("view", result, "--port", str(other.getsockname()[1]), "--web")
    assert said.code == 2
    assert "cannot use it" in said.err
    assert said.err.count("\n") == 1


@pytest.mark.paper
def test_a_run_without_log_and_seed_is_refused(result: Path, fuselog: Fuselog, tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    shutil.copy(result / "logs" / "run-0000.mcap", log)
    second = tmp_path / "second.mcap"
    shutil.copy(log, second)
    out = tmp_path / "out"
    assert fuselog("run", log, second, "-e", "ekf", "--logs", "0", "--out", out).code == 0
    second.unlink()
    said = fuselog("view", out, "--runs", "1", "--save", tmp_path / "set")
    assert said.code == 2
    assert str(second) in said.err
    assert not (tmp_path / "set").exists()


def test_without_the_extra_the_first_run_is_shown(
    result: Path, fuselog: Fuselog, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[Path] = []
    monkeypatch.setattr("fuselog.pipeline.presenting.command.has_catalog", lambda: False)
    monkeypatch.setattr(viewer, "view", lambda rrd, at_s: shown.append(rrd))  # noqa: ARG005
    said = fuselog("view", result)
    assert said.code == 0
    assert shown == [result / "timeline.rrd"]
    assert "needs the extra catalog" in said.err


@pytest.mark.paper
@pytest.mark.unix
def test_an_interrupted_view_leaves_nothing_half(
    result: Path,
    tmp_path: Path,
    fuselog: Fuselog,
    start_fuselog: Callable[..., subprocess.Popen[str]],
) -> None:
    """Drawn runs are whole; what a killed command left is removed by the next."""
    place, saved = tmp_path / "result", tmp_path / "set"
    shutil.copytree(result, place)
    kept = tmp_path / "result.segments"
    layers = {"base.rrd", "dead-reckoning.rrd", "ekf.rrd", "ukf.rrd", "layout.rbl"}
    for number, chosen in ((signal.SIGKILL, "4"), (signal.SIGINT, "all")):  # noqa: TID251
        process = start_fuselog("view", str(place), "--runs", chosen, "--save", str(saved))
        deadline = monotonic() + 60
        before = {folder for folder, *_ in os.walk(kept)}
        while not any(
            Path(folder).name == "new" and files and Path(folder).parent.parent.name != "all runs"
            for folder, _, files in os.walk(kept)
            if folder not in before
        ):
            assert process.poll() is None, process.communicate()
            assert monotonic() < deadline
            sleep(0.01)
        workers = psutil.Process(process.pid).children(recursive=True)
        process.send_signal(number)
        said = process.communicate()[1]
        psutil.wait_procs(workers, timeout=10)
        assert not saved.exists()
        drawn = [*kept.glob("run-*/[!.]*")]
        assert len(drawn) < RUNS
        assert all({path.name for path in each.iterdir()} == layers for each in drawn)
    assert said.splitlines()[-1] == "fuselog: stopped"
    assert not [*kept.rglob("*.part")]
    assert fuselog("view", place, "--runs", "0,4", "--save", saved).code == 0
    assert {path.name for path in (next((kept / "run-0004").iterdir())).iterdir()} == layers
    assert len([*saved.glob("*.rrd")]) == RUNS


@pytest.mark.paper
def test_a_report_has_the_command_that_opens_the_worst_run(
    result: Path, fuselog: Fuselog, tmp_path: Path
) -> None:
    """Its run is that of the table, and `view` opens it."""
    page = tmp_path / "page.html"
    assert fuselog("report", result, "-o", page).code == 0
    rows = read_table(result / TABLE).query("estimator == 'ekf'").set_index("run")
    worst = rows["position_rmse_m"].idxmax()
    command = f"fuselog view {result} --runs {worst} --at worst:ekf"
    text = page.read_text()
    assert f'<code>{command}</code> <button type="button" class="copy">' in text
    node = shutil.which("node")
    if node is not None:
        assert _copied(node, text, command) == [command, "Copied", command, "Selected"]
    runs = list_runs([result], 0.2)
    assert runs is not None
    assert [each.name for each in runs.chosen(str(worst))] == [f"run-{worst:04d}"]


def _copied(node: str, page: str, command: str) -> list[str]:
    """Click the button behind a command in node: what is copied, and what a refusal selects."""
    begin = page.index('for (const button of document.querySelectorAll("button.copy"))')
    script = page[begin : page.index("\n}\n", begin) + 2]
    stand_in = f"""
        const said = [], code = {{ textContent: {json.dumps(command)} }};
        const button = {{
            previousElementSibling: code,
            addEventListener: (_, act) => {{ button.click = act; }},
        }};
        const document = {{ querySelectorAll: () => [button] }};
        const getSelection = () => ({{ selectAllChildren: (each) => {{ selected = each; }} }});
        let selected = null, copy = async (text) => {{ said.push(text); }};
        const navigator = {{ clipboard: {{ writeText: (text) => copy(text) }} }};
        {script}
        (async () => {{
            await button.click();
            said.push(button.textContent);
            copy = async () => {{ throw new Error("not permitted"); }};
            await button.click();
            said.push(selected.textContent, button.textContent);
            console.log(JSON.stringify(said));
        }})();
    """
    done = subprocess.run([node, "-e", stand_in], capture_output=True, text=True, check=True)
    return list(json.loads(done.stdout))
