"""Claims from one source: what the pages say of experiments is made from the results kept beside them.

In a page stands a comment, a template, and below it what it gives, up to `<!-- end -->`:

    <!-- results
    The RMSE is {broad[bingham.movement_rmse_deg]:.2f} deg.

    {broad.claims}
    -->

`{NAME[KEY]:FORMAT}` is a metric of the experiment NAME, `{NAME[KEY][0]}` an entry of one that is a list,
`{NAME.claims}` its table of claims, `{NAME.counted}` how many there are of each verdict, and
`{NAME.verdicts}` the same in numbers alone. `{speed[WHAT]:.0f}` is how many times faster than a peer
`make bench` found fuselog to be at WHAT, and `{speed.machine}` where. `{deploy.costs}` and others are
what `python -m tests.deployed --keep` found. `{catalogue.data_sets}` is the table of public data and
their experiments, `{catalogue.mappings}` that of the mappings that ship.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from fuselog.pipeline.api.lists import listed
from fuselog.pipeline.output.claims import decide, known
from fuselog.pipeline.output.results import MetricValue, Result, read_result
from fuselog.pipeline.runs.experiment import Experiment, Study, load_experiment, numbers_of
from fuselog.pipeline.runs.inputs import shipped
from fuselog.recorders.importers.tables.mapping import read_mapping
from fuselog.recorders.importers.tables.mapping import shipped as shipped_mappings
from fuselog.recorders.parameters import build
from fuselog.recorders.registry import load
from fuselog.replay.judging.verdicts import Claimed

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "families" / "results"
SPEED = ROOT / "docs" / "speed.json"
DEPLOYED = ROOT / "docs" / "deploy.json"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
_BLOCK = re.compile(r"(<!-- results\n(.*?)\n-->\n)(.*?)(<!-- end -->)", re.DOTALL)


class Stored:
    """The result of one experiment, as templates see it."""

    def __init__(self, result: Mapping[str, Any]) -> None:
        self.settings: dict[str, Any] = result["settings"]
        self._name: str = result["experiment"]
        self.metrics: dict[str, MetricValue] = result["metrics"]
        self.intervals: dict[str, list[float | None]] = result.get("intervals", {})
        self.stated_claims: list[dict[str, str]] = [
            {**claim, "verdict": Claimed(claim["verdict"]).value} for claim in result["claims"]
        ]

    def __getitem__(self, key: str) -> MetricValue:
        """A metric."""
        return self.metrics[key]

    @property
    def verdicts(self) -> str:
        """How many claims are confirmed, refuted, inconclusive and not reproducible."""
        return ", ".join(map(str, self._counts().values()))

    @property
    def counted(self) -> str:
        """How many claims there are of each verdict, in words."""
        return ", ".join(f"{count} {verdict}" for verdict, count in self._counts().items())

    @property
    def claims(self) -> str:
        """What command gave the claims, and their table."""
        simulated = "import" not in self.settings
        runs = " (seed {seed}, {runs} runs)".format_map(self.settings) if simulated else ""
        head = [f"`fuselog run {self._name}`{runs}: {self.counted}.", ""]
        return "\n".join(
            [*head, "| claim | paper | ours | verdict |", "|---|---|---|---|", *self._rows()]
        )

    def _counts(self) -> dict[str, int]:
        found = Counter(claim["verdict"] for claim in self.stated_claims)
        return {verdict.value: found[verdict] for verdict in Claimed if verdict != Claimed.NO_VERDICT}

    def _rows(self) -> Iterator[str]:
        for claim in self.stated_claims:
            verdict = ": ".join(filter(None, [claim["verdict"], claim["why"]]))
            cells = [claim["claim"], claim["paper"], claim["ours"], verdict]
            yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


class Speed:
    """What `make bench` kept."""

    def __init__(self, kept: Mapping[str, Any]) -> None:
        rows = [row for table in kept.values() for row in table["rows"]]
        self._ratios = {what: ratio for what, *_, ratio in rows}
        self.machine = " and ".join(sorted({table["machine"] for table in kept.values()}))

    def __getitem__(self, what: str) -> float:
        """The ratio of a row."""
        return float(self._ratios[what].partition(" ")[0])


class Deployed:
    """What `python -m tests.deployed --keep` kept."""

    def __init__(self, kept: Mapping[str, Any]) -> None:
        self.kept = kept
        self.compiler, self.target_compiler = kept["compiler"], kept["target_compiler"]
        self.unfit = kept["unfit"]

    @property
    def compared(self) -> int:
        """How many pairs of model and method were compared with the replay."""
        return sum(map(len, self.kept["pairs"].values()))

    @property
    def models(self) -> int:
        """Of how many models they are."""
        return len(self.kept["pairs"])

    @property
    def furthest(self) -> float:
        """How far the furthest of them is from the replay."""
        return max(pair["furthest"] for each in self.kept["pairs"].values() for pair in each.values())

    @property
    def costs(self) -> str:
        """The table of costs of some."""
        rows = [
            "| filter | flops, worst case | square roots | calls of libm | code, bytes | stack, bytes |",
            "|---|---|---|---|---|---|",
        ]
        for model, states in (("batch-reactor", 2), ("robot", 3), ("orientation", 12), ("inertial", 16)):
            for method in ("ekf", "sqrt:ekf", "ukf", "sqrt:ukf"):
                pair = self.kept["pairs"][model][method]
                assert pair["states"] == states
                numbers = (pair[each] for each in ("flops", "roots", "calls", "text", "stack"))
                rows.append(f"| {model} `{method}`, {states} states | {' | '.join(map(str, numbers))} |")
        return "\n".join(rows)

    @property
    def target(self) -> str:
        """The table of what a robot's filters take on the emulated target."""
        rows = [
            "| filter | numbers | instructions, on average | at most | furthest from fuselog |",
            "|---|---|---|---|---|",
        ]
        for name, taken in self.kept["target"].items():
            method, numbers = name.split()
            rows.append(
                f"| `{method}` | `{numbers}` | {taken['average']} | {taken['most']} "
                f"| {taken['furthest']:.0e} |"
            )
        return "\n".join(rows)


class Catalogue:
    """What ships for real data, by its own descriptions."""

    @property
    def data_sets(self) -> str:
        """The table of data with the experiments that import them."""
        experiments: dict[str, list[str]] = {}
        for name in sorted(shipped("experiments")):
            of = as_shipped(name).import_
            if of is not None:
                experiments.setdefault(of.parameters.get("mapping", of.source), []).append(name)
        summaries = listed("scenarios") | _mappings()
        rows = [
            f"| {summaries[source]} | `fuselog run {first} --data PATH`"
            f"{''.join(f'; `{name}`' for name in others)} |"
            for source, (first, *others) in sorted(experiments.items())
        ]
        return "\n".join(["| data | experiments |", "|---|---|", *rows])

    @property
    def mappings(self) -> str:
        """The table of the mappings that ship."""
        rows = [f"| `{name}` | {summary} |" for name, summary in _mappings().items()]
        return "\n".join(["| name | for |", "|---|---|", *rows])


def _mappings() -> dict[str, str]:
    return {name: read_mapping(name).summary for name in shipped_mappings()}


def store(folder: Path) -> Path:
    """Keep what a result folder holds of claims, metrics and settings; not where its data lay."""
    result: Result = read_result(folder)
    kept = result.model_dump(mode="json", exclude={"files": True, "settings": {"data"}})
    return _write(result.experiment, kept)


def _write(name: str, kept: Mapping[str, Any]) -> Path:
    path = FOLDER / f"{name}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    return path


def decided(name: str) -> list[dict[str, str]]:
    """The claims of an experiment as it ships, by the numbers of its kept result."""
    experiment = as_shipped(name)
    study = load("studies", experiment.study, Study)
    numbers = numbers_of(experiment, build(study.options, experiment.options, name))
    kept, recordings = stored()[name], dict.fromkeys(experiment.recordings, True)
    found = decide(experiment.claims, kept.metrics, kept.intervals, numbers, recordings)
    return [vars(claim) for claim in map(known, found)]


def decide_anew(name: str) -> None:
    """Keep the claims of an experiment as its kept numbers decide them now."""
    kept = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    _write(name, kept | {"claims": decided(name)})


@cache
def as_shipped(name: str) -> Experiment:
    """An experiment as it ships, read once."""
    return load_experiment(name, {}, {})[1]


@cache
def stored() -> dict[str, Stored]:
    """The results that are kept, by experiment."""
    return {
        path.stem: Stored(json.loads(path.read_text(encoding="utf-8")))
        for path in sorted(FOLDER.glob("*.json"))
    }


@cache
def speed() -> Speed:
    """How fast fuselog is beside its peers, as last measured."""
    return Speed(json.loads(SPEED.read_text(encoding="utf-8")))


@cache
def deployed() -> Deployed:
    """What filters in C cost, and how they compare with the replay."""
    return Deployed(json.loads(DEPLOYED.read_text(encoding="utf-8")))


def rendered(page: str) -> str:
    """The text of a page with everything that is made from results made anew."""
    known = {**stored(), "speed": speed(), "deploy": deployed(), "catalogue": Catalogue()}
    return _BLOCK.sub(lambda block: f"{block[1]}{block[2].format_map(known)}\n{block[4]}", page)
