"""Functions that all studies share: obtain, replay and judge runs, keep the first logs, draw a run.

A study adds its own cases, claims, tables and figures.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fuselog.pipeline.altering.sources import alter_all
from fuselog.pipeline.output.results import RESULT_FILE, Result
from fuselog.pipeline.runs.ensemble import Pass, RunGroup, Settings, estimates_metadata, replay_parts
from fuselog.pipeline.runs.estimates import ErrorTables, hash_files, hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting
from fuselog.pipeline.runs.initial_states import order_of
from fuselog.pipeline.runs.inputs import load_scenario
from fuselog.pipeline.runs.recorded import Replayed, record_ensemble, replay_ensemble
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import LogWriter, open_log
from fuselog.recorders.parameters import build, merge
from fuselog.recorders.recording import import_run
from fuselog.recorders.remote.paths import seen_from
from fuselog.replay.engine.streams.blocks import Ragged, gather
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, in_memory, memory_source
from fuselog.replay.foreign.naming import of_file
from fuselog.replay.judging.judge import Judge

NO_REPLAY = "its settings are not sufficient for a replay; estimates logs can be compared"


@dataclass(frozen=True)
class Runner:
    """The runs of an experiment, and where and how the experiment runs.

    Attributes:
        experiment: the experiment.
        setting: where and how the experiment runs.
    """

    experiment: Experiment
    setting: Setting

    def obtain(
        self,
        parameters: Mapping[str, Any] | None = None,
        *,
        seed: int | None = None,
        first_run: int = 0,
        runs: int | None = None,
    ) -> list[MemorySource]:
        """Load runs into memory, from a simulation, an import or logs.

        Args:
            parameters: scenario parameters that replace the experiment's.
            seed: the seed of the runs, by default the experiment's.
            first_run: the number of the first run.
            runs: number of runs, by default the experiment's.

        Raises BadInput if the experiment does not state what to record or to import.
        """
        experiment, setting = self.experiment, self.setting
        if experiment.import_ and setting.data:
            source = experiment.import_
            return [memory_source(*import_run(source.source, setting.data, source.parameters))]
        if experiment.logs:
            files = experiment.files[first_run:][:runs]
            return [in_memory(LogSource(open_log(file))) for file in files]
        if not experiment.record:
            raise BadInput(
                f"experiment '{experiment.title}': there is no data; add one of the tables [record], "
                "[import] and [logs]"
            )
        recorder, values, _ = load_scenario(experiment.record.scenario)
        return record_ensemble(
            recorder,
            merge(merge(values, experiment.record.parameters), parameters or {}),
            experiment.seed if seed is None else seed,
            experiment.runs if runs is None else runs,
            setting.progress,
            first_run=first_run,
            all_runs=experiment.runs,
        )

    def replay(self, sources: Sequence[MemorySource], estimators: Settings | None = None) -> Replayed:
        """Replay the runs `sources` in memory with `estimators`, by default those of the experiment."""
        return replay_ensemble(
            sources,
            self.experiment.estimators if estimators is None else estimators,
            gap_limit_s=self.experiment.gap_limit_s,
            progress=self.setting.progress,
        )

    def keep(
        self,
        sources: Sequence[MemorySource],
        outputs: Mapping[str, Ragged],
        folder: str = "",
        *,
        drawn: str | None = "",
        first_run: int = 0,
    ) -> None:
        """Write logs and estimates of the first runs; other runs can be recorded again from the seed.

        Args:
            sources: the runs.
            outputs: the outputs of the estimators, by topic.
            folder: the folder for logs and estimates, in the setting's folder.
            drawn: the folder for the timeline of the first run, in the setting's folder; None for no
                timeline.
            first_run: the number of the first of these runs, if they are only some of all runs.
        """
        count = max(0, min(self.setting.logs - first_run, len(sources)))
        for run in self.setting.progress(range(count), "writing logs", count) if count else ():
            log, estimates = self._places(folder, first_run + run)
            _write_log(sources[run], log)
            metadata = estimates_metadata(sources[run], self.experiment.estimators, estimates, log)
            with LogWriter(estimates, metadata) as writer:
                writer.write([ragged.of_run(run) for ragged in outputs.values()])
        if drawn is not None:
            self.draw(sources, outputs, drawn)

    def draw(
        self, sources: Sequence[MemorySource], outputs: Mapping[str, Ragged], folder: str = ""
    ) -> None:
        """Draw the timeline of the first of the runs `sources`, with its `outputs`, to `folder`."""
        from fuselog.replay.timeline.show import show

        place = self.setting.folder / folder
        place.mkdir(parents=True, exist_ok=True)
        of_run = {topic: gather([rows.of_run(0)]) for topic, rows in outputs.items()}
        judged = Judge(sources[:1], {}, gap_limit_s=self.experiment.gap_limit_s).add(of_run)
        show(sources[0], of_run, judged.errors, save=place / "timeline.rrd")

    def run(self) -> Replayed:
        """Replay all of the experiment's runs in memory, and keep the first ones."""
        replayed = self.replay(self.obtain())
        self.keep(replayed.sources, replayed.outputs)
        return replayed

    def cases(self, cases: Mapping[str, Mapping[str, Any]]) -> Iterator[tuple[str, Replayed]]:
        """Replay each case, as `run` does; `cases` maps names to different scenario parameters.

        Files are written to a folder per case. The first case's timeline is also the experiment's
        timeline.
        """
        for number, (name, differing) in enumerate(cases.items()):
            replayed = self.replay(self.obtain(differing))
            self.keep(replayed.sources, replayed.outputs, name, drawn=name if number else "")
            yield name, replayed

    def judge(self, now: slice) -> Pass:
        """Judge the runs `now` in one streamed pass, and write logs and timeline of the first runs."""
        experiment, setting = self.experiment, self.setting
        order, late = order_of(arrival_order=bool(experiment.arrival_order), late=experiment.late)
        places = [self._places("", run) for run in range(now.start, min(setting.logs, now.stop))]
        sources: Sequence[LogSource | MemorySource]
        if experiment.logs:
            files = experiment.files[now]
            sources = [LogSource(open_log(file)) for file in files]
            input_sha256 = hash_files(files)
            estimates = [
                (path, self._as_seen_from(path, file))
                for (_, path), file in zip(places, files, strict=False)
            ]
        else:
            recorded = self.obtain(first_run=now.start, runs=now.stop - now.start)
            for source, (log, _) in zip(recorded, places, strict=False):
                _write_log(source, log)
            sources, estimates = recorded, [(path, log) for log, path in places]
            input_sha256 = hash_streams(recorded)
        sources = alter_all(sources, experiment.alterations or {})
        part = RunGroup(sources, now.start, len(sources) == experiment.runs, estimates)
        with ErrorTables(setting.folder) if setting.errors else nullcontext() as errors:
            done = replay_parts(
                [part],
                experiment.estimators,
                gap_limit_s=experiment.gap_limit_s,
                metrics=experiment.metrics,
                order=order,
                late=late,
                save=setting.folder / "timeline.rrd" if setting.draws else None,
                on_errors=errors.add if errors else None,
                progress=setting.progress,
            )
        done.input_sha256 = input_sha256
        return done

    def _as_seen_from(self, path: Path, log: Path) -> Path:
        """Return a path to a log that is valid after the folder has been moved to its final path."""
        return seen_from(path, self.setting.place / path.relative_to(self.setting.folder), log)

    def _places(self, folder: str, run: int) -> tuple[Path, Path]:
        """Return the paths of a run's log and estimates."""
        name, place = f"run-{run:04d}.mcap", self.setting.folder / folder
        return place / "logs" / name, place / "estimates" / name


def runner_again(folder: Path, result: Result) -> Runner:
    """Make the runner of a result from its settings, to replay its runs again.

    Raises BadInput if the settings do not state the runs and the estimators.
    """
    if not result.settings.get("estimators") or "study" not in result.settings:
        raise BadInput(NO_REPLAY)
    fields = {each.alias or name for name, each in Experiment.model_fields.items()}
    entries = {key: value for key, value in result.settings.items() if key in fields}
    entries["estimators"] = of_file(entries["estimators"])
    if "record" not in entries:  # the recorded data determine the number of runs
        entries = {key: value for key, value in entries.items() if key not in ("runs", "seed")}
    experiment = build(Experiment, entries, f"{folder / RESULT_FILE}: settings")
    experiment = experiment.model_copy(update={"runs": len(experiment.files) or experiment.runs})
    data = result.settings.get("data")
    setting = Setting(folder, folder, data=Path(data) if data else None)
    if experiment.import_ and setting.data is None:
        raise BadInput("its settings do not contain the folder of its data")
    return Runner(experiment, setting)


def _write_log(source: MemorySource, path: Path) -> None:
    with LogWriter(path, source.run) as writer:
        writer.write(source.streams.values())
