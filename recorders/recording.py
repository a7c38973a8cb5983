"""Recorders, which turn parameters or a folder of real data into streams."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import LogWriter, RunMetadata, Stream
from fuselog.recorders.log.planes import in_plane_of_log
from fuselog.recorders.log.streams import concatenate
from fuselog.recorders.parameters import Parameters, ParametersType, build
from fuselog.recorders.registry import foreign_code, load

# Simulated runs start at 2026-01-01T00:00:00Z, so that stamps are positive and tools show a date.
SIMULATION_EPOCH_NS = 1_767_225_600_000_000_000


def simulation_stamps_ns(elapsed_s: ArrayLike) -> NDArray[np.int64]:
    """Compute stamps from times since the start of a simulation.

    Args:
        elapsed_s: times of any shape, in s.

    Returns:
        Stamps of the same shape, in ns.

    Raises BadInput if a log cannot store one of the stamps.
    """
    with np.errstate(over="ignore"):
        elapsed_ns = np.rint(np.asarray(elapsed_s, float) * 1e9)
    stamps_ns = SIMULATION_EPOCH_NS + elapsed_ns
    if stamps_ns.size and not (stamps_ns.min() >= 0 and stamps_ns.max() < 2**63):
        longest_s = float(np.max(np.abs(elapsed_s)))
        raise BadInput(
            f"the run lasts {longest_s:.3g} s, but stamps end in the year 2262; make it shorter"
        )
    return SIMULATION_EPOCH_NS + elapsed_ns.astype(np.int64)


def named_generator(
    rng: np.random.Generator, name: str, numbers: Mapping[str, int] | None = None
) -> np.random.Generator:
    """Return a generator for this name; new names do not change the random numbers of existing ones.

    Args:
        rng: generator of the run or of a part of the run; no numbers are drawn from it.
        name: name, such as that of a sensor, with at least two letters; the same name gives the same
            numbers.
        numbers: spawn indices by name, for names that used `rng.spawn(...)` before generators had names.
    """
    seed = rng.bit_generator.seed_seq
    assert isinstance(seed, np.random.SeedSequence)
    # all letters in one array, since the numbers of a key are converted one by one
    letters: Any = np.frombuffer(name.encode(), np.uint8).astype(np.uint32)
    key = numbers[name] if numbers and name in numbers else letters
    child = np.random.SeedSequence(
        seed.entropy, spawn_key=(*seed.spawn_key, key), pool_size=seed.pool_size
    )
    return np.random.Generator(type(rng.bit_generator)(child))


@dataclass(frozen=True)
class Recording:
    """The streams of one run in memory, one for every topic.

    Attributes:
        streams: one for every topic.
        epoch_ns: the run's time zero.
        notes: facts that the recorder reports, each with a short text.
    """

    streams: list[Stream]
    epoch_ns: int = SIMULATION_EPOCH_NS
    notes: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.streams:
            raise BadInput("a recording has no streams; give it at least one")
        for topic, count in Counter(stream.topic for stream in self.streams).items():
            if count > 1:
                raise BadInput(f"topic {topic}: has {count} streams; join them into one")


@dataclass
class Blocks:
    """Streams that come block by block, so that they may exceed memory.

    Attributes:
        blocks: lists of streams; a topic may appear in every block.
        epoch_ns, notes: as in `Recording`; complete after the last block.
    """

    blocks: Iterator[list[Stream]]
    epoch_ns: int = SIMULATION_EPOCH_NS
    notes: dict[str, str] = field(default_factory=dict)

    def together(self) -> Recording:
        """Read all blocks into memory."""
        parts: dict[str, list[Stream]] = {}
        for block in self.blocks:
            for stream in block:
                parts.setdefault(stream.topic, []).append(stream)
        return Recording([concatenate(each) for each in parts.values()], self.epoch_ns, self.notes)


@dataclass(frozen=True)
class Recorder(Generic[ParametersType]):
    """Base of simulators and importers, with a summary and parameters.

    Attributes:
        summary: description in one line.
        parameters: type of the parameters.
    """

    summary: str
    parameters: type[ParametersType]


@dataclass(frozen=True)
class Simulator(Recorder[ParametersType]):
    """A scenario that can be simulated repeatedly, each run with its own random numbers.

    Attributes:
        simulate: function of (parameters, generator) that returns a run.
        simulate_runs: function of (parameters, generators) that returns the same runs, faster; None if
            each run is simulated separately.
    """

    simulate: Callable[[ParametersType, np.random.Generator], Recording]
    simulate_runs: Callable[[ParametersType, list[np.random.Generator]], list[Recording]] | None = None


@dataclass(frozen=True)
class Importer(Recorder[ParametersType]):
    """A reader of real data in the layout that its publishers use, as a whole or block by block.

    Attributes:
        read: function of (path, parameters) that returns the recording.
    """

    read: Callable[[Path, ParametersType], Recording | Blocks]


def record_run(
    scenario: str, values: Mapping[str, Any], seed: int, run: int = 0
) -> tuple[Recording, RunMetadata]:
    """Simulate run number `run` of a scenario; the same arguments give the same streams.

    Raises BadInput for an unknown scenario or parameter, or if the name is an importer's.

    >>> recording, run = record_run("landmarks", {"duration_s": 2.0, "robots": 2}, seed=7)
    >>> sorted(stream.topic for stream in recording.streams if stream.topic.startswith("/robot2"))
    ['/robot2/odometry', '/robot2/prior', '/robot2/range_bearing', '/robot2/truth']
    >>> run.parameters["robots"]
    2
    """
    return record_runs(scenario, values, seed, [run])[0]


def record_runs(
    scenario: str, values: Mapping[str, Any], seed: int, runs: Sequence[int]
) -> list[tuple[Recording, RunMetadata]]:
    """Simulate several runs of a scenario; see `record_run`."""
    simulator: Recorder[Any] = load("recorders", scenario, Recorder)
    if not isinstance(simulator, Simulator):
        raise BadInput(f"'{scenario}' imports real data; run: fuselog import {scenario} PATH")
    for run in runs:
        if seed < 0 or run < 0:
            raise BadInput(f"seed {seed}, run {run}: both must be zero or more")
    parameters = build(simulator.parameters, values, f"scenario {scenario}")
    rngs = [np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(run,))) for run in runs]
    with foreign_code(f"scenario {scenario}"):
        if simulator.simulate_runs is not None:
            recordings = simulator.simulate_runs(parameters, rngs)
        else:
            recordings = [simulator.simulate(parameters, rng) for rng in rngs]
        placed = [replace(each, streams=in_plane_of_log(each.streams)) for each in recordings]
        return [
            (each, _metadata(scenario, parameters, seed, run, each))
            for run, each in zip(runs, placed, strict=True)
        ]


def import_run(source: str, path: Path, values: Mapping[str, Any]) -> tuple[Recording, RunMetadata]:
    """Import real data; raise BadInput for an unknown importer or parameter, or unreadable data."""
    importer, parameters = _importer(source, path, values)
    with foreign_code(f"importer {source}"):
        found = importer.read(path, parameters)
        recording = found.together() if isinstance(found, Blocks) else found
        return recording, _metadata(source, parameters, None, 0, recording)


def import_log(
    source: str,
    path: Path,
    values: Mapping[str, Any],
    target: Path,
    stated: Mapping[str, Any] | None = None,
) -> tuple[RunMetadata, int]:
    """Import real data into a log, block by block if possible; raises errors like `import_run`.

    Args:
        source: name of the importer.
        path: file or folder with the data.
        values: parameters of the importer.
        target: path of the log.
        stated: parameters that the log states instead of those in `values`.

    Returns the metadata of the run, and the number of messages in the log.
    """
    importer, parameters = _importer(source, path, values)
    messages = 0
    with foreign_code(f"importer {source}"), LogWriter(target) as log:
        found = importer.read(path, parameters)
        for block in found.blocks if isinstance(found, Blocks) else [found.streams]:
            log.write(block)
            messages += sum(map(len, block))
        run = _metadata(source, parameters, None, 0, found)
        run.parameters.update(stated or {})
        log.describe(run)
    return run, messages


def _importer(source: str, path: Path, values: Mapping[str, Any]) -> tuple[Importer[Any], Parameters]:
    importer: Recorder[Any] = load("recorders", source, Recorder)
    if not isinstance(importer, Importer):
        raise BadInput(f"'{source}' is a simulator; run: fuselog record {source}")
    if not path.exists():
        raise BadInput(f"{path}: no such file or folder; give the {source} data as published")
    return importer, build(importer.parameters, values, f"importer {source}")


def _metadata(
    name: str, parameters: Parameters, seed: int | None, run: int, recording: Recording | Blocks
) -> RunMetadata:
    values = parameters.model_dump(mode="json")
    return RunMetadata(name, values, seed, run, recording.epoch_ns, dict(recording.notes))
