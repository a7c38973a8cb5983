"""Defines a recorder: something that turns parameters, or a folder of real data, into streams."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
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

# Simulated runs start at 2026-01-01T00:00:00Z: stamps are never negative and tools show a date.
SIMULATION_EPOCH_NS = 1_767_225_600_000_000_000


def simulation_stamps_ns(elapsed_s: ArrayLike) -> NDArray[np.int64]:
    """Compute the stamps of times since the epoch of simulations.

    Args:
        elapsed_s: of any shape, in s.

    Returns:
        The stamps, of the same shape, in ns.

    Raises BadInput where a stamp would be beyond what a log can hold.
    """
    with np.errstate(over="ignore"):
        elapsed_ns = np.rint(np.asarray(elapsed_s, float) * 1e9)
    stamps_ns = SIMULATION_EPOCH_NS + elapsed_ns
    if not ((stamps_ns >= 0) & (stamps_ns < 2**63)).all():
        longest_s = float(np.max(np.abs(elapsed_s)))
        raise BadInput(
            f"the run lasts {longest_s:.3g} s, and stamps end in the year 2262; make it shorter"
        )
    return SIMULATION_EPOCH_NS + elapsed_ns.astype(np.int64)


def named_generator(
    rng: np.random.Generator, name: str, numbers: Mapping[str, int] | None = None
) -> np.random.Generator:
    """Return a generator of its own for what has this name: one more name changes no other's numbers.

    Args:
        rng: of the run, or of a part of it; it is not drawn from.
        name: such as a sensor's, of two letters at least; the same name gives the same numbers again.
        numbers: of names that drew from `rng.spawn(...)` before they had a generator by name.
    """
    seed = rng.bit_generator.seed_seq
    assert isinstance(seed, np.random.SeedSequence)
    key = [numbers[name]] if numbers and name in numbers else name.encode()
    child = np.random.SeedSequence(
        seed.entropy, spawn_key=(*seed.spawn_key, *key), pool_size=seed.pool_size
    )
    return np.random.Generator(type(rng.bit_generator)(child))


@dataclass(frozen=True)
class Recording:
    """Holds streams in memory, before they are a log: one for every topic.

    Attributes:
        streams: one for every topic.
        epoch_ns: the run's time zero.
        notes: facts that the recorder met, one short text each.
    """

    streams: list[Stream]
    epoch_ns: int = SIMULATION_EPOCH_NS
    notes: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.streams:
            raise BadInput("a recording has no streams; give it at least one")
        for topic, count in Counter(stream.topic for stream in self.streams).items():
            if count > 1:
                raise BadInput(f"topic {topic}: is recorded as {count} streams; join them to one")


@dataclass
class Blocks:
    """Yields streams block by block, so that they may be more than memory holds.

    Attributes:
        blocks: the streams of each; a topic may come again in every block.
        epoch_ns, notes: as those of a `Recording`; whole when the last block has been drawn.
    """

    blocks: Iterator[list[Stream]]
    epoch_ns: int = SIMULATION_EPOCH_NS
    notes: dict[str, str] = field(default_factory=dict)

    def together(self) -> Recording:
        """Read all of it into memory."""
        parts: dict[str, list[Stream]] = {}
        for block in self.blocks:
            for stream in block:
                parts.setdefault(stream.topic, []).append(stream)
        return Recording([concatenate(each) for each in parts.values()], self.epoch_ns, self.notes)


@dataclass(frozen=True)
class Recorder(Generic[ParametersType]):
    """Holds what recorders have in common: what they are in one line, and their parameters.

    Attributes:
        summary: what it is, in a line.
        parameters: their type.
    """

    summary: str
    parameters: type[ParametersType]


@dataclass(frozen=True)
class Simulator(Recorder[ParametersType]):
    """Describes a scenario that can be recorded often, each run from its own random stream.

    Attributes:
        simulate: (parameters, generator) -> a run.
    """

    simulate: Callable[[ParametersType, np.random.Generator], Recording]


@dataclass(frozen=True)
class Importer(Recorder[ParametersType]):
    """Reads real data: a file or folder as its publishers lay it out, at once or block by block.

    Attributes:
        read: (path, parameters) -> what is there.
    """

    read: Callable[[Path, ParametersType], Recording | Blocks]


def record_run(
    scenario: str, values: Mapping[str, Any], seed: int, run: int = 0
) -> tuple[Recording, RunMetadata]:
    """Record run number `run` of a scenario; (scenario, values, seed, run) give the same streams.

    Raises BadInput for an unknown scenario or parameter, or one that only imports.

    >>> recording, run = record_run("landmarks", {"duration_s": 2.0, "robots": 2}, seed=7)
    >>> sorted(stream.topic for stream in recording.streams if stream.topic.startswith("/robot2"))
    ['/robot2/odometry', '/robot2/prior', '/robot2/range_bearing', '/robot2/truth']
    >>> run.parameters["robots"]
    2
    """
    simulator: Recorder[Any] = load("recorders", scenario, Recorder)
    if not isinstance(simulator, Simulator):
        raise BadInput(f"'{scenario}' imports real data; use: fuselog import {scenario} PATH")
    if seed < 0 or run < 0:
        raise BadInput(f"seed {seed}, run {run}: give numbers from zero on")
    parameters = build(simulator.parameters, values, f"scenario {scenario}")
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(run,)))
    with foreign_code(f"scenario {scenario}"):
        recording = simulator.simulate(parameters, generator)
        recording = replace(recording, streams=in_plane_of_log(recording.streams))
        return recording, _metadata(scenario, parameters, seed, run, recording)


def import_run(source: str, path: Path, values: Mapping[str, Any]) -> tuple[Recording, RunMetadata]:
    """Import real data; raises BadInput for an unknown importer or parameter, or data it cannot read."""
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
    """Import real data into a log, block by block where they come so; errors as `import_run`.

    Args:
        source: the importer's name.
        path: the data.
        values: the importer's parameters.
        target: the log.
        stated: parameters that the log states in place of those values.

    Returns what the run is, and how many messages the log has.
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
        raise BadInput(f"'{source}' simulates; use: fuselog record {source}")
    if not path.exists():
        raise BadInput(f"{path}: no such file or folder; give the {source} data as published")
    return importer, build(importer.parameters, values, f"importer {source}")


def _metadata(
    name: str, parameters: Parameters, seed: int | None, run: int, recording: Recording | Blocks
) -> RunMetadata:
    values = parameters.model_dump(mode="json")
    return RunMetadata(name, values, seed, run, recording.epoch_ns, dict(recording.notes))
