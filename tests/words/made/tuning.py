"""Sentences of `fuselog tune`: what one has to know of the values."""

from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd

from fuselog.pipeline.tuning.confidence import SearchOutcome, confidence, doubts
from fuselog.pipeline.tuning.outcome import Tuning
from fuselog.pipeline.tuning.search import Coordinates
from fuselog.recorders.parameters import Parameter
from fuselog.replay.judging.intervals import Interval
from fuselog.replay.judging.verdicts import Squares

NAMES = ("sigma_range_m", "sigma_bearing_rad", "density")
FREE = [Parameter(name, 1.0, low=0.01, high=100.0, is_log=True) for name in NAMES]
SEARCHED = Coordinates(FREE, np.ones(len(FREE)))


def told() -> Iterator[str]:
    """What the logs determine: each by itself, ever less, and two that they hardly distinguish."""
    for curvature in (4.1, 3.9, 0.5, 0.1, 0.0, -1.0):
        made = np.diag([curvature, 500.0, 500.0])
        yield from _determined(curvature, made)
    for mixed in (-0.999, 0.999):
        made = 400.0 * np.array([[1.0, mixed, 0.0], [mixed, 1.0, 0.0], [0.0, 0.0, 1.0]])
        yield from _determined(mixed, made)
    made = np.diag([1.0, 500.0])
    yield f"at other places: {' / '.join(doubts(confidence([1, 2], made), SEARCHED))}"


def _determined(of: float, curvature: np.ndarray) -> Iterator[str]:
    """What a curvature tells of three parameters, and their standard errors."""
    found = confidence([0, 1, 2], curvature)
    errors = ", ".join(f"{each:.4g}" for each in np.sqrt(np.diag(found.covariance)))
    yield f"{of:g}: {' / '.join(doubts(found, SEARCHED)) or 'nothing'} [{errors}]"


def search() -> Iterator[str]:
    """How the search ended."""
    yield from _notes("well")
    yield from _notes("stopped", was_stopped=True)
    yield from _notes("not converged", has_converged=False)
    yield from _notes("with a gate", gate=0.99)
    yield from _notes("by nees", by="nees")
    yield from _notes("elsewhere", begins_alike=False)
    yield from _notes("at an edge", at_edge=["sigma_range_m"])
    yield from _notes("a spike", is_spike=True)
    yield from _notes("corrected", is_corrected=True)
    for value in (0.01, 100.0):
        yield from _notes(f"at {value:g}", optimum=np.array([value, 1.0, 1.0]))
    yield from _notes("assumed", free=[FREE[0]._replace(is_assumed=True), *FREE[1:]])
    yield from _notes("kept", free=[FREE[0].fixed, *FREE[1:]])


def held_out() -> Iterator[str]:
    """Logs that were held out, and folds."""
    for by in ("likelihood", "rmse"):
        for costs in ((100.0, 90.0), (90.0, 100.0)):
            for logs, gate in ((1, 1.0), (3, 0.99)):
                made = _made(by=by, gate=gate, held_out_costs=costs, held_out_logs=[None] * logs)
                yield from Tuning._notes_of_others(made)
    folds = pd.DataFrame({"cost_start": [3.0, 3.0, 3.0], "cost_tuned": [2.0, 3.0, 4.0]})
    yield from Tuning._notes_of_others(_made(folds=folds))


def whiteness() -> Iterator[str]:
    """Innovations that are white, and that are not."""
    for probability, correlation in ((0.002, -0.5), (0.0005, -0.5), (0.0005, 0.5)):
        about = {
            "case": "robot1",
            "component": "range_m",
            "ljung_box": 47.41,
            "probability": probability,
        }
        rows = [
            {"estimator": label, **about, "next_correlation": correlation}
            for label in ("start", "tuned")
        ]
        made = _made(whiteness=pd.DataFrame(rows))
        yield f"{probability:g}: {' / '.join(Tuning._notes_of_innovations(made)) or 'nothing'}"


def truth() -> Iterator[str]:
    """NEES that innovations do not explain."""
    for nees, nis in ((3.9, 1.0), (4.1, 1.0), (5.7, 1.4), (5.5, 1.4), (12.1, 1.5)):
        metrics = {f"{label}.nees.robot1": nees for label in ("start", "tuned")}
        metrics["tuned.nis_per_component.robot1"] = nis
        bounds = dict.fromkeys([key for key in metrics if "nees" in key], (2.0, 4.0))
        squares = Squares("nees", Interval(nees), 2.0, (2.0, 4.0))
        judge = SimpleNamespace(metrics=metrics, bounds=bounds, squares=lambda *_, own=squares: own)
        made = _made(replays=[SimpleNamespace(judge=judge)])
        yield f"NEES {nees:g}, NIS {nis:g}: {' / '.join(Tuning._notes_of_truth(made)) or 'nothing'}"


def _notes(name: str, **how: Any) -> Iterator[str]:
    found = list(Tuning._notes_of_search(_made(**how)))
    yield f"{name}: {' / '.join(found) or 'nothing'}"


def _made(**how: Any) -> Any:
    """A tuning of which only what sentences read is there."""
    ended: Mapping[str, Any] = {name: how.pop(name) for name in SearchOutcome._fields if name in how}
    free, gate, by = how.pop("free", FREE), how.pop("gate", 1.0), how.pop("by", "likelihood")
    values = {"optimum": np.ones(len(free)), "evaluations": 17, **ended}
    outcome = SearchOutcome(coordinates=Coordinates(free, np.ones(len(free))), **values)
    objective = SimpleNamespace(by=by, is_corrected=how.pop("is_corrected", False), left_out={})
    made = SimpleNamespace(found=outcome, gate=gate, objective=objective, held_out_costs=None, folds=[])
    vars(made).update({"held_out_logs": [], **how})
    made._scale = Tuning._scale.fget(made)  # type: ignore[attr-defined]
    return made


TUNED = (told, search, held_out, whiteness, truth)
