"""Compilation of kernels before their first use, by replaying short recordings on all cores."""

from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from itertools import product
from time import perf_counter
from typing import Any, NamedTuple

from fuselog.pipeline.api.replays import replay
from fuselog.pipeline.output.terminal import print_json, print_table, say
from fuselog.pipeline.runs.executors import inline_pool, processes
from fuselog.pipeline.runs.inputs import load_scenario, shipped
from fuselog.recorders.compiling.cache import cache_folder, is_private, kept_files
from fuselog.recorders.compiling.compile import core_count, is_uncompiled
from fuselog.recorders.errors import BadInput, choices, without_warnings_of_numbers
from fuselog.recorders.log import loops
from fuselog.recorders.recording import Importer, Recorder, record_run
from fuselog.recorders.registry import available, load
from fuselog.replay.engine import chi2
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.inference.all_methods import METHODS, modelled
from fuselog.replay.inference.estimators import registered_models
from fuselog.replay.inference.model.binding import topics_of
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.requirements import names_state

USUAL = ("ekf", "ukf", "smoother:ekf")
SHORT_S = (2.0, 12.0)  # durations to try in s; the first one that a scenario accepts is used
Pair = tuple[str, str]


class Precompiled(NamedTuple):
    """The result for a model and a method: the scenario and the run time, or the reason for a failure.

    Attributes:
        model, method: registered names.
        scenario: the scenario that was recorded and replayed.
        took_s: duration of the replay in s, including everything that it compiled.
        why_not: the reason why this method did not replay the model; empty if it did.
    """

    model: str
    method: str
    scenario: str
    took_s: float
    why_not: str = ""


@without_warnings_of_numbers()
def precompile(
    models: str | Iterable[str] | None = None,
    methods: str | Iterable[str] | None = None,
    *,
    workers: int | None = None,
) -> list[Precompiled]:
    """Compile and store the kernels needed for the first replay of each model with each method.

    A kernel is specific to the sensors of a log, so short recordings of the registered scenarios that
    fit a model are replayed. A log with other sensors compiles its own kernels on its first replay, and
    so does a model that fits no scenario or is not registered.

    Args:
        models: names from `models`, all by default.
        methods: methods such as "smoother:ukf"; by default ekf, ukf and smoother:ekf. If either argument
            is left out, methods that cannot estimate a model are skipped.
        workers: number of processes, by default one per core; a script must guard its own code with `if
            __name__ == "__main__":`, because the processes import it.

    Returns:
        A row for every model, method and scenario. Scenarios with the same sensors have one row, for the
        first of them.

    Raises BadInput for an unknown name, a method that cannot estimate a model, or a cache that cannot
    store kernels.
    """
    names = [models] if isinstance(models, str) else models
    chosen = [methods] if isinstance(methods, str) else methods
    if names is None:
        pairs = _working(registered_models(), chosen or USUAL)
    elif chosen is None:
        pairs = _usual(names)
    else:
        pairs = list(product(names, chosen))
    return precompile_pairs(pairs, workers=workers)


def precompile_pairs(pairs: Iterable[Pair], *, workers: int | None = None) -> list[Precompiled]:
    """Compile the kernels for pairs of a model and a method; see `precompile`."""
    pairs = list(dict.fromkeys(pairs))
    for model, method in pairs:
        modelled(load("models", model, Model), method)
    _check_cache()
    loops.load()
    open_pool = inline_pool if (workers or core_count()) == 1 else processes(workers or core_count())
    with open_pool() as pool:
        names = sorted({model for model, _ in pairs})
        fitting = _all(pool.executor, _fits, [(name, names) for name in _scenarios()])
        scenarios: dict[tuple[str, Any], str] = {}
        for scenario, fits in fitting:
            for model, sensors in fits.items():
                scenarios.setdefault((model, sensors), scenario)
        asked = [
            (scenario, model, method)
            for model, method in pairs
            for (own, _), scenario in scenarios.items()
            if own == model
        ]
        made = _all(pool.executor, _replayed, asked)
    served = {model for model, _ in scenarios}
    why = "no scenario fits this model, so its first replay compiles the kernels"
    return [*made, *(Precompiled(*pair, "", 0.0, why) for pair in pairs if pair[0] not in served)]


def show_precompiling(asked: Iterable[str], *, as_json: bool) -> None:
    """Compile kernels for pairs MODEL:METHOD, for the usual methods of MODEL, or for all models."""
    begun_s, before = perf_counter(), set(kept_files())
    pairs = [pair for text in asked for pair in _pairs_of(text)]
    made = precompile_pairs(pairs or _working(registered_models(), USUAL))
    took_s, kernels = perf_counter() - begun_s, len(set(kept_files()) - before)
    if as_json:
        rows = [each._asdict() for each in made]
        print_json({"folder": str(cache_folder()), "made": kernels, "took_s": took_s, "replays": rows})
        return
    table = [[*each[:3], each.why_not or f"{each.took_s:.1f} s"] for each in made]
    print_table(["model", "method", "scenario", "took"], table)
    say(f"{cache_folder()}: {kernels} new kernels in {took_s:.1f} s")


def _pairs_of(text: str) -> list[Pair]:
    model, _, method = text.partition(":")
    return [(model, method)] if method else _usual([model])


def _usual(models: Iterable[str]) -> list[Pair]:
    return _working({name: load("models", name, Model) for name in models}, USUAL)


def _working(models: dict[str, Model], methods: Iterable[str]) -> list[Pair]:
    """Choose the pairs whose method can estimate the model."""
    kinds = {method: method.partition(":")[0] for method in methods}
    for kind in kinds.values():
        if kind not in METHODS:
            raise BadInput(f"no method '{kind}'; {choices(kind, METHODS)}")
    return [
        (name, method)
        for (name, model), (method, kind) in product(models.items(), kinds.items())
        if not METHODS[kind].lacks(model)
    ]


def _check_cache() -> None:
    if is_uncompiled():
        raise BadInput("FUSELOG_UNCOMPILED=1 disables compilation; unset it")
    if not is_private(cache_folder() / "kernels"):
        raise BadInput(
            f"the cache {cache_folder()} is writable by other users, so nothing is stored; set "
            "FUSELOG_CACHE to a folder of your own"
        )


def _scenarios() -> list[str]:
    """List all scenarios that can be recorded."""
    names = [*available("recorders"), *shipped("scenarios")]
    return [
        name
        for name in names
        if not isinstance(load("recorders", load_scenario(name)[0], Recorder), Importer)
    ]


def _all(executor: Executor, work: Callable[..., Any], asked: Iterable[tuple[Any, ...]]) -> list[Any]:
    return [each.result() for each in [executor.submit(work, *given) for given in asked]]


def _fits(scenario: str, models: Iterable[str]) -> tuple[str, dict[str, Any]]:
    """Find the models that fit a scenario's log, with the sensors that each model uses."""
    topics, found = _recorded(scenario).topics, {}
    for name in models:
        model = load("models", name, Model)
        places = [each for each in topics_of(model, topics) if names_state(each.prior, model)]
        if model.by_name:  # other models have the same topics, and only the prior tells them apart
            places = [each for each in places if each.has_prior]
        if places:
            found[name] = tuple(sorted({tuple(own.topic for own, _ in each.sensors) for each in places}))
    return scenario, found


def _replayed(scenario: str, model: str, method: str) -> Precompiled:
    begun_s = perf_counter()
    try:
        replay(_recorded(scenario), {"precompiled": modelled(load("models", model, Model), method)})
        chi2.sf(1.0, 1)  # the summary of a replay compiles this function if the gate was used
    except BadInput as error:
        return Precompiled(model, method, scenario, perf_counter() - begun_s, str(error))
    return Precompiled(model, method, scenario, perf_counter() - begun_s)


def _recorded(scenario: str) -> MemorySource:
    """Make a short recording of a scenario."""
    recorder, values, _ = load_scenario(scenario)
    if "duration_s" in load("recorders", recorder, Recorder).parameters.model_fields:
        for duration_s in SHORT_S:
            try:
                return memory_source(*record_run(recorder, {**values, "duration_s": duration_s}, 0, 0))
            except BadInput:
                continue
    return memory_source(*record_run(recorder, values, 0, 0))
