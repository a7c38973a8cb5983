"""Claims from one source: what the pages say of experiments is made from the results kept beside them.

In a page stands a comment, a template, and below it what it gives, up to `<!-- end -->`:

    <!-- results
    The RMSE is {broad[bingham.movement_rmse_deg]:.2f} deg.

    {broad.claims}
    -->

`{NAME[KEY]:FORMAT}` is a metric of the experiment NAME, `{NAME[KEY][0]}` an entry of one that is a list,
`{NAME.claims}` its table of claims, `{NAME.verdicts}` how many there are of each verdict.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, get_args

from pipeline.claims import Verdict
from pipeline.results import MetricValue, Result, read_result

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "families" / "results"
TOLD = ("diagnose", "tune")  # pages that are of no family, and hold results
PAGES = [*sorted(FOLDER.parent.glob("*.md")), *(ROOT / "docs" / f"{name}.md" for name in TOLD)]
_BLOCK = re.compile(r"(<!-- results\n(.*?)\n-->\n)(.*?)(<!-- end -->)", re.DOTALL)


class Stored:
    """The result of one experiment, as templates see it."""

    def __init__(self, result: Mapping[str, Any]) -> None:
        self.settings: dict[str, Any] = result["settings"]
        self._name: str = result["experiment"]
        self._metrics: dict[str, MetricValue] = result["metrics"]
        self._claims: list[dict[str, str]] = result["claims"]

    def __getitem__(self, key: str) -> MetricValue:
        """A metric."""
        return self._metrics[key]

    @property
    def verdicts(self) -> str:
        """How many claims are confirmed, refuted and not reproducible."""
        return ", ".join(map(str, self._counts().values()))

    @property
    def claims(self) -> str:
        """What command gave the claims, and their table."""
        how_many = ", ".join(f"{count} {verdict}" for verdict, count in self._counts().items())
        simulated = "import" not in self.settings
        runs = " (seed {seed}, {runs} runs)".format_map(self.settings) if simulated else ""
        head = [f"`fuselog run {self._name}`{runs}: {how_many}.", ""]
        return "\n".join(
            [*head, "| claim | paper | ours | verdict |", "|---|---|---|---|", *self._rows()]
        )

    def _counts(self) -> dict[str, int]:
        found = Counter(claim["verdict"] for claim in self._claims)
        return {verdict: found[verdict] for verdict in get_args(Verdict)}

    def _rows(self) -> Iterator[str]:
        for claim in self._claims:
            verdict = ": ".join(filter(None, [claim["verdict"], claim["why"]]))
            cells = [claim["claim"], claim["paper"], claim["ours"], verdict]
            yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def store(folder: Path) -> Path:
    """Keep what a result folder holds of claims, metrics and settings; not where its data lay."""
    result: Result = read_result(folder)
    kept = result.model_dump(mode="json", exclude={"files": True, "settings": {"data"}})
    path = FOLDER / f"{result.experiment}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    return path


@cache
def stored() -> dict[str, Stored]:
    """The results that are kept, by experiment."""
    return {
        path.stem: Stored(json.loads(path.read_text(encoding="utf-8")))
        for path in sorted(FOLDER.glob("*.json"))
    }


def rendered(page: str) -> str:
    """The text of a page with everything that is made from results made anew."""
    return _BLOCK.sub(lambda block: f"{block[1]}{block[2].format_map(stored())}\n{block[4]}", page)
