"""What parameters mean: said for all that are registered, and by `--set NAME=?`."""

from collections.abc import Iterator

import pytest
from pydantic import BaseModel

import fuselog as fl
from fuselog.pipeline.command_line.process import main
from fuselog.pipeline.logs.constraints import ConstraintParameters
from fuselog.pipeline.runs.experiment import Experiment, Study
from fuselog.recorders.families.biometrics.importer import Matchers
from fuselog.recorders.importers.ros.mapping import Mapping
from fuselog.recorders.importers.tables.mapping import LogMapping
from fuselog.recorders.parameters import describe
from fuselog.recorders.registry import available, load
from fuselog.replay.inference.all_methods import METHODS
from fuselog.replay.inference.observability import OBSERVABILITY

# Those that are in no list: of the command line, of an experiment's file, of mappings.
OTHERS = (ConstraintParameters, Experiment, LogMapping, Mapping, Matchers, OBSERVABILITY.parameters)


def _registered() -> Iterator[type[BaseModel]]:
    for entries in (fl.scenarios, fl.models, fl.estimators):
        yield from filter(None, (entry.parameters for entry in entries.values()))
    yield from (method.parameters for method in METHODS.values())
    yield from (load("studies", name, Study).options for name in available("studies"))
    yield from OTHERS


def test_every_parameter_says_what_it_means() -> None:
    """More than 900 of them; a unit that its name does not end with stands in its meaning."""
    described = [(kind, each) for kind in {*_registered()} for each in describe(kind)]
    assert len({(kind.__name__, each.name) for kind, each in described}) > 900
    silent = [
        f"{kind.__module__}.{kind.__name__}.{each.name}" for kind, each in described if not each.meaning
    ]
    assert not silent
    densities = [each for _, each in described if each.name.endswith("_density")]
    assert all(" in " in each.meaning for each in densities)


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("record landmarks --set range.rate_hz=?", ["range.rate_hz", "Hz", "number >= 0"]),
        ("record acoustic-1 --set mach_number=?", ["number > 1", "Mach number of the bullet"]),
        ("import ros bag --set clock=?", ["header, bag"]),
        ("replay a.mcap -e ekf --set ekf.gate_probability=?", ["ekf of robot", "0.999"]),
        ("replay a.mcap -e vqf --set heading_s=? --set gap=3", ["vqf", "time constant"]),
        ("replay a.mcap -e b --set b.kind=particles --set cloud=?", ["all particles"]),
        ("tune a.mcap -e ukf --free a --model robot --set sigma_range_m=?", ["from the log"]),
        ("check a.mcap --against a.golden.xz -e ekf --set topics=?", ["empty name"]),
        ("compare a b -e smoother:iterated -e ekf --set loss=?", ["square, huber, cauchy"]),
        ("diagnose a.mcap -e ekf --set bias_range_m=?", ["bias_range_m   ekf", "measured minus true"]),
        (
            "diagnose a.mcap -e ekf --set /fix.delay_s=?",
            ["/fix.delay_s", "delay of the stamps, which is subtracted"],
        ),
        ("replay a.mcap -e ekf --set /fix=?", ["/fix.FIELD_scale", "/fix.exchanged"]),
        ("observability a.mcap --set window_s=?", ["whole run"]),
        (
            "run landmarks --set runs=? --set robots=? --set kappa=?",
            ["recorded runs", "of robots", "ukf"],
        ),
        ("run uwb-outdoor --set options.windows=?", ["options.windows.NAME.begin.x_above_m"]),
        ("sweep landmarks --over robots=1,2 --set seed=?", ["integer >= 0"]),
        ("constrain a.mcap -o b.mcap --set window_s=?", ["number > 0", "0.5"]),
    ],
)
def test_a_question_is_answered_and_nothing_done(
    command: str, says: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No log is read: there is none."""
    monkeypatch.setenv("COLUMNS", "300")
    assert main(command.split()) == 0
    said = capsys.readouterr().out
    assert all(each in said for each in says), said


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        ("record landmarks --set rnge=?", "--set rnge=?: no such parameter; did you mean 'range'?"),
        ("replay a.mcap -e ekf --set gate=?", "--set gate=?: no such parameter; did you mean"),
        ("replay a.mcap -e efk --set a=?", "no estimator 'efk'; did you mean 'ekf'?"),
        ("replay a.mcap -e ekf --model rbot --set a=?", "no model 'rbot'; did you mean 'robot'?"),
        ("diagnose a.mcap --set a=?", "--set NAME=?: name an estimator, such as -e ekf"),
        ("estimators smoother:none", "'none' is not a filter that a smoother can use"),
    ],
)
def test_an_unknown_name_is_refused(
    command: str, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command.split()) == 2
    assert sentence in capsys.readouterr().err


def test_a_variant_has_its_own_options(capsys: pytest.CaptureFixture[str]) -> None:
    """`loss` is of smoother:iterated alone."""
    listed = {}
    for name in ("smoother:iterated", "smoother:ekf:lag=500ms"):
        assert main(["estimators", name, "--json"]) == 0
        listed[name] = capsys.readouterr().out
    assert '"loss_scale"' in listed["smoother:iterated"]
    assert '"loss_scale"' not in listed["smoother:ekf:lag=500ms"]
    assert '"forward": "ekf:lag=500ms"' in listed["smoother:ekf:lag=500ms"]
