"""A filter as C: the same to the last bit, built without a warning, silent under the sanitizers."""

import json
import shutil
import subprocess
import sys
from contextlib import chdir
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fuselog as fl
from fuselog.pipeline.deploying.certificate import deepest_stack
from fuselog.pipeline.deploying.costs import Cost, cost_of
from fuselog.recorders.errors import BadInput
from fuselog.replay.families.sampling.reactor import REACTOR
from fuselog.replay.tracing.c_text import DOUBLE, c_lines
from fuselog.replay.tracing.functions import trace
from fuselog.replay.tracing.graph import Graph
from tests.claims.pages import DEPLOYED
from tests.deployed.building import (
    COMPILERS,
    compiled,
    furthest,
    furthest_of_all,
    missing_of_target,
    on_target,
    sanitizes,
)
from tests.deployed.hostile import hold_out
from tests.deployed.models import Tried, deployed, robot_log
from tests.deployed.mutants import ROBOT as MUTATED_ROBOT
from tests.deployed.mutants import Mutant, mutants_of, survivors
from tests.deployed.own_models import own_models
from tests.pipeline.conftest import run_here
from tests.replay.estimators.test_attitude import carried

# two sensors that state different sigmas under one name
ROBOT = {"duration_s": 10.0, "range": {"rate_hz": 2.0, "sigma_range_m": 0.5}}
needs_compiler = pytest.mark.skipif(not COMPILERS, reason="there is no C compiler here")


@pytest.fixture(autouse=True)
def unmeasured(monkeypatch: pytest.MonkeyPatch) -> None:
    """No filter is compiled once more for the memory in its certificate; one test undoes this."""
    monkeypatch.setattr("fuselog.pipeline.deploying.certificate._memory", lambda *_: None)


def recorded(tmp_path: Path, scenario: str, **parameters: Any) -> Path:
    log = tmp_path / f"{scenario}.mcap"
    fl.write(log, fl.record(scenario, seed=7, **parameters))
    return log


@needs_compiler
@pytest.mark.parametrize(
    ("scenario", "recording", "label", "by_all"),
    [
        ("landmarks", ROBOT, "ekf", False),
        ("landmarks", ROBOT, "iekf", False),
        ("landmarks", ROBOT, "sqrt:ukf", True),
        ("landmarks", {**ROBOT, "prior_sigma_rad": 3.0}, "sqrt:ukf", False),
        ("batch-reactor", {}, "ukf", False),
    ],
)
@pytest.mark.paper
def test_estimates_are_equal_to_the_last_bit(
    tmp_path: Path, scenario: str, recording: dict[str, Any], label: str, by_all: bool
) -> None:
    """By one compiler, or all of them with sanitizers; `make deployed` has every model by all.

    Where the heading is hardly known, samples are narrowed alike, but for rounding.
    """
    options: dict[str, Any] = {"model": "robot"} if scenario == "landmarks" else {}
    log, wide = recorded(tmp_path, scenario, **recording), recording.get("prior_sigma_rad", 0.0) > 1.0
    folder = fl.deploy(log, label, tmp_path / "filter_c", **options)
    away = furthest_of_all(folder) if by_all else furthest(compiled(folder))
    assert away <= 1e-12 * wide
    if sys.platform == "win32":
        return
    library = compiled(folder, "-shared", "-fPIC", "-O0")  # as the program, optimised or not
    kinds = {"kind": label, **options}, {"kind": "lib", "path": str(library), "in_process": True}
    replays = [fl.replay(log, {"it": each}) for each in kinds]
    own, foreign = (each.estimates[0] for each in replays)
    topics = [each for each in own.topics if each.endswith(("/innovation", "/state", "/pose"))]
    assert len(topics) == 2
    for topic in topics:
        ours, theirs = (each.read([topic])[topic] for each in (own, foreign))
        for name in ("mean", "covariance", "innovation", "normalised_innovation_squared", "accepted"):
            if name in ours.columns:
                np.testing.assert_allclose(
                    ours[name], theirs[name], rtol=1e-12 * wide, err_msg=f"{topic} {name}"
                )


@pytest.mark.paper
@needs_compiler
@pytest.mark.skipif(sys.platform == "win32", reason="the library is built for POSIX")
@pytest.mark.usefixtures("first_cause_alone")
def test_a_deployed_filter_has_the_cause_of_its_model(tmp_path: Path) -> None:
    """It declares what its parameters are, as the model's functions read them."""
    log = recorded(tmp_path, "landmarks", **{**ROBOT, "duration_s": 5.0})
    settings = {"forward_noise_density": 0.4, "gate_probability": 1.0}
    folder = fl.deploy(log, "ekf", tmp_path / "filter_c", model="robot", **settings)
    library = compiled(folder, "-shared", "-fPIC", "-O0")
    kinds = (
        {"kind": "ekf", "model": "robot", **settings},
        {"kind": "lib", "path": str(library), "in_process": True},
    )
    own, foreign = (fl.diagnose(log, {"it": each}).causes.iloc[0] for each in kinds)
    assert own["kind"] == "process noise"
    names = ["value", "low", "high", "gain"]
    assert foreign[names].tolist() == pytest.approx(own[names].tolist(), rel=1e-6)
    assert foreign["sentence"].partition("; try")[0] == own["sentence"].partition("; try")[0]


@pytest.mark.paper
@needs_compiler
def test_a_gap_of_the_control_widens_the_estimate(tmp_path: Path) -> None:
    """Of an orientation, whose mean is found in rounds where it is sampled."""
    samples, _ = carried()
    stamps_s = (samples.publish_time_ns - samples.publish_time_ns[0]) * 1e-9
    log = tmp_path / "carried.mcap"
    fl.write(log, [samples.take((stamps_s < 4.0) & ~((stamps_s > 1.5) & (stamps_s < 2.2)))])
    folder = fl.deploy(log, "sqrt:ukf", tmp_path / "filter_c", model="orientation")
    assert furthest(compiled(folder, "-O0")) < 1e-12
    source = folder / "filter_c.c"
    text = source.read_text()
    source.write_text(
        text.replace("return pass_gap(filter, time_ns, parameters);", "filter->is_in_gap = 0;")
    )
    assert furthest(compiled(folder, "-Wno-unused-function", "-O0")) > 0.1


@needs_compiler
@pytest.mark.skipif(sys.platform == "win32", reason="the library is built for POSIX")
@pytest.mark.paper
def test_check_says_whether_the_c_is_as_the_golden(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = recorded(tmp_path, "landmarks", duration_s=2.0)
    monkeypatch.chdir(tmp_path)
    folder = fl.deploy(log, "ekf", tmp_path / "robot_ekf", model="robot", sigma_range_m=0.2)
    library = compiled(folder, "-shared", "-fPIC", "-O0")
    for name, sigma_m in (("same", 0.2), ("other", 0.3)):
        kept = f"--update -e ekf --set ekf.model=robot --set ekf.sigma_range_m={sigma_m}"
        assert run_here("check", log, "--against", f"{name}.golden.xz", *kept.split()).code == 0
    checked = ("check", log, "--against", "same.golden.xz", "-e", f"lib:{library}")
    said = run_here(*checked)
    assert said.code == 0, said.out
    assert said.out.startswith("all ")
    said = run_here("check", log, "--against", "other.golden.xz", "-e", f"lib:{library}")
    assert said.code == 2
    assert "was deployed from a different filter" in said.err
    source = folder / "robot_ekf.c"
    text = source.read_text()
    source.write_text(text.replace("+= C[row][i] * v[i];", "+= 1.0001 * C[row][i] * v[i];"))
    compiled(folder, "-shared", "-fPIC", "-O0")
    said = run_here(*checked)
    assert said.code == 1
    assert "/estimates/ekf/robot1/" in said.out


def test_certificate_counts_what_a_step_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    log = recorded(tmp_path, "landmarks", duration_s=2.0)
    folder = fl.deploy(log, "ekf", tmp_path / "robot_ekf", model="robot")
    found = json.loads((folder / "certificate.json").read_text())
    # sin and cos of the mean heading, sin of sinc, cos of its slope;
    # roots of the range and of two pivots, atan2 of the bearing, fmod of its wrapping
    costs = [(each["roots"], each["calls"]) for each in found["steps"].values()]
    assert costs == [(0, 4), (3, 2)]
    assert found["worst"]["flops"] == sum(each["flops"] for each in found["steps"].values())
    # F P F' of 3 states, lower half of the second product, and P H', H P H' of 2 components
    assert found["products"]["dense_flops"] == 9 * 5 + 6 * 5 + 6 * 5 + 3 * 5
    if shutil.which("gcc"):
        assert found["memory"]["text"] > 1000  # some thousand bytes, and two covariances on the stack
        assert found["memory"]["stack"] > 2 * 9 * 8


def folded(x: Any, _: Any) -> Any:
    """Of either side some operations, which both need, and one function."""
    shared = x * x + 1.0
    if x > 0.0:
        return shared * np.sin(shared), 2.0 * shared + 3.0 * x, shared
    side = np.cos(x) / (1.0 + shared * shared * shared)
    return side * side + shared, side - shared, side


def test_a_side_of_a_branch_is_computed_only_if_it_is_chosen() -> None:
    """The bound counts the more expensive side, which C computes in a branch."""
    outputs = trace(Graph(), folded, (None, None)).returned
    assert cost_of(outputs) == Cost(flops=2 + 7, calls=1)
    named = {f"y{i}": node for i, node in enumerate(outputs)}
    lines = [*c_lines(named, {(0, None): "x"}, DOUBLE)]
    place = lines.index("} else {")
    assert [line for line in lines[: place + 1] if "cos" in line] == []
    assert [line for line in lines[place:] if "sin" in line] == []


class CartParameters(fl.ModelParameters):
    """What a cart's camera and pushes are."""

    sigma_m: float = 0.01
    push_density: float = 0.001


def roll(state: Any, _: Any, duration_s: Any, __: Any) -> Any:
    return state[0] + duration_s * state[1], state[1]


CART = fl.Model(
    "a cart that rolls past a camera",
    {"x_m": "linear", "v_mps": "linear"},
    CartParameters,
    (
        fl.Sensor(
            "camera",
            fl.schemas.VECTOR_MEASUREMENT,
            {"x_m": "linear"},
            lambda state, *_: (state[0],),
            lambda parameters: (parameters.sigma_m**2,),
            vector="value",
        ),
    ),
    fl.Motion(roll, lambda _, duration_s, parameters: (0.0, parameters.push_density**2 * duration_s)),
)


def cart_log(log: Path, prior_s: float, seconds: float, variance: float) -> Path:
    """Write a log of a cart that rolls past its camera, with a prior of so wide variances."""
    stamps = fl.simulation_stamps_ns(np.arange(0.0, seconds, 0.01))
    noise = 0.01 * np.random.default_rng(1).standard_normal((len(stamps), 1))
    prior = fl.make_stream(
        "/cart/prior",
        fl.schemas.GAUSSIAN_ESTIMATE,
        fl.simulation_stamps_ns(np.array([prior_s])),
        metadata={"components": "x_m,v_mps", "kinds": "linear,linear"},
        mean=np.zeros((1, 2)),
        covariance=np.diag([variance, variance]).reshape(1, 4),
    )
    camera = fl.make_stream(
        "/cart/camera",
        fl.schemas.VECTOR_MEASUREMENT,
        stamps,
        metadata={"components": "x_m"},
        value=5.0 + 0.02 * np.arange(len(stamps))[:, None] + noise,
    )
    fl.write(log, [prior, camera])
    return log


@needs_compiler
@pytest.mark.usefixtures("uncompiled")
def test_vectors_begin_where_the_filter_starts_and_are_refused_if_they_show_nothing(
    tmp_path: Path,
) -> None:
    log = cart_log(tmp_path / "late.mcap", 4.5, 5.0, 100.0)
    folder = fl.deploy(log, fl.modelled(CART, "ekf"), tmp_path / "late", gate_probability=0.999)
    said = subprocess.run([compiled(folder)], capture_output=True, text=True, check=True).stdout
    assert said.splitlines() == [
        "51 updates, 50 estimates: furthest 0, at event -1",
        "camera: 50 accepted, 1 rejected",
    ]
    log = cart_log(tmp_path / "after.mcap", 6.0, 5.0, 100.0)
    with pytest.raises(BadInput, match="accepts no measurement after its start"):
        fl.deploy(log, fl.modelled(CART, "ekf"), tmp_path / "after")
    assert not (tmp_path / "after").exists()


@pytest.mark.paper
@needs_compiler
def test_its_test_notices_errors_of_one_character(tmp_path: Path) -> None:
    """One of each function; `python -m tests.deployed` plants all."""
    tried = Tried("robot", robot_log(tmp_path), None, {"model": "robot", **MUTATED_ROBOT})
    folder = deployed(tried, "ekf", tmp_path)
    planted: dict[str, list[Mutant]] = {}
    for each in mutants_of((folder / f"{folder.name.lower()}.c").read_text()):
        planted.setdefault(each.function, []).append(each)
    assert len(planted) == 7
    chosen = [own[len(own) // 2] for own in planted.values()]
    assert [(each.function, each.line) for each in survivors(folder, chosen)] == []


@pytest.mark.paper
@needs_compiler
@pytest.mark.parametrize("name", ["log", "own", "vectors"])
def test_a_filter_may_be_named_as_what_stands_beside_it(tmp_path: Path, name: str) -> None:
    """A function of libm, a variable of the test, and files of the folder."""
    folder = fl.deploy(robot_log(tmp_path), "ekf", tmp_path / name, model="robot")
    assert furthest(compiled(folder, "-O0")) < 1e-12


@pytest.mark.paper
@needs_compiler
def test_a_body_that_does_not_turn_has_an_orientation_in_single_precision(tmp_path: Path) -> None:
    """A rotation by nothing is divided by its angle, which a tiny constant keeps from being zero.

    The folder has the name of a variable of its own C.
    """
    samples = carried()[0].take(slice(0, 60))
    at_rest = replace(samples, columns={**samples.columns, "turn_rate_radps": np.zeros((60, 3))})
    fl.write(tmp_path / "rest.mcap", [at_rest])
    folder = fl.deploy(tmp_path / "rest.mcap", "ekf", tmp_path / "c", model="orientation", single=True)
    assert furthest(compiled(folder, "-O0")) < 1e-3


@pytest.mark.paper
@needs_compiler
@pytest.mark.parametrize(("label", "single"), [("ekf", True), ("sqrt:ukf", False)])
def test_a_hostile_caller_gets_outcomes_and_finite_states(
    tmp_path: Path, label: str, single: bool
) -> None:
    if not sanitizes(COMPILERS[0]):
        pytest.skip(f"{COMPILERS[0]} lacks its sanitizers' libraries here")
    tried = Tried("robot", robot_log(tmp_path), None, {"model": "robot"})
    folder = deployed(tried, label, tmp_path, single=single)
    assert hold_out(folder, COMPILERS[0], sanitized=True) > 500
    if not single:
        return  # a fault that is planted in one of them
    source = next(each for each in folder.glob("*.c") if each.stem == folder.name.lower())
    text = source.read_text()
    source.write_text(text.replace("return checked(filter);", f"return {source.stem.upper()}_WELL;"))
    with pytest.raises(AssertionError, match="is_state_finite"):
        hold_out(folder, COMPILERS[0], sanitized=False)


@pytest.mark.paper
@needs_compiler
@pytest.mark.usefixtures("uncompiled")
def test_single_precision_says_where_it_breaks_and_the_square_root_holds(tmp_path: Path) -> None:
    """The prior is 1e5 times as wide as a measurement: squared that is more than float's digits."""
    log = cart_log(tmp_path / "cart.mcap", 0.0, 1.5, 1e6)
    costs = {}
    for kind in ("ekf", "sqrt:ekf"):
        folder = fl.deploy(log, fl.modelled(CART, kind), tmp_path / kind.replace(":", "_"), single=True)
        costs[kind] = json.loads((folder / "certificate.json").read_text())["single"]
    assert costs["ekf"]["lost_event"] > 0
    assert "use a square-root form" in (tmp_path / "ekf/README.md").read_text()
    assert costs["sqrt:ekf"]["lost_event"] is None
    assert costs["sqrt:ekf"]["furthest"] < 1e-4
    assert costs["sqrt:ekf"]["estimates"] == 150


def test_stack_is_that_of_the_deepest_chain() -> None:
    node = 'node: {{ title: "{0}" label: "{0}\\nx.c:1:5\\n{1} bytes (static)" }}\n'
    edge = 'edge: {{ sourcename: "{0}" targetname: "{1}" label: "x.c:2:3" }}\n'
    calls = "".join(
        [
            *(node.format(*each) for each in (("wide", 100), ("top", 40), ("middle", 50), ("low", 16))),
            *(edge.format(*each) for each in (("top", "middle"), ("middle", "low"), ("wide", "sin"))),
        ]
    )
    assert deepest_stack(calls) == 40 + 50 + 16


def test_refusals_write_nothing(tmp_path: Path) -> None:
    log = recorded(tmp_path, "landmarks", duration_s=2.0)
    out = tmp_path / "robot_ekf"
    for label, options, sentence in (
        ("smoother:ekf", {"model": "robot"}, "smoother:ekf: this estimator cannot be written as C"),
        ("lrkf:rukf-10", {"model": "robot"}, "lrkf:rukf-10 draws new samples in every step"),
        ("ekf", {"model": "robot", "sigma_range_m": -1.0}, "sigma_range_m"),
    ):
        with pytest.raises(BadInput, match=sentence):
            fl.deploy(log, label, out, **options)
        assert not out.exists()

    def by_float(*_: Any) -> Any:
        return float(_[0][0]), 0.0

    reactor = recorded(tmp_path, "batch-reactor")
    with pytest.raises(BadInput, match="analytic cannot be written as C; give -e ekf, iekf, ukf"):
        fl.deploy(reactor, "analytic", out)
    model = replace(REACTOR, motion=fl.Motion(by_float))
    with pytest.raises(
        BadInput, match=r"by_float \(test_deploying.py, line \d+\): it uses float\(\) on"
    ):
        fl.deploy(reactor, fl.modelled(model, "ekf"), out)
    assert not out.exists()
    out.mkdir()
    (out / "mine.c").write_text("mine")
    with pytest.raises(BadInput, match="robot_ekf: the folder is not empty; give another one with -o"):
        fl.deploy(log, "ekf", out, model="robot")
    assert [each.name for each in out.iterdir()] == ["mine.c"]


@pytest.mark.parametrize(
    ("out", "name"),
    [("new/Robot EKF", "robot_ekf"), ("empty/2 wheels", "n2_wheels"), ("Float", "float_")],
)
def test_a_filter_is_written_where_it_was_asked_for_and_nowhere_else(
    tmp_path: Path, out: str, name: str
) -> None:
    """Into a new folder or an empty one, whose name it gets; over nothing, not even over itself."""

    def state() -> dict[str, bytes]:
        return {str(each): each.read_bytes() for each in Path().rglob("*") if each.is_file()}

    log = recorded(tmp_path, "landmarks", duration_s=2.0)
    words = ("deploy", log.name, "-e", "ekf", "--model", "robot", "-o")
    with chdir(tmp_path):
        Path("empty/2 wheels").mkdir(parents=True)
        Path("a file").write_text("mine")
        before = state()
        said = run_here(*words, out)
        assert (said.code, said.err) == (0, "")
        files = {"CMakeLists.txt", "README.md", "certificate.json", "cortex_m4f.c", "cortex_m4f.ld"}
        files |= {"fuselog_filter.h", "vectors.h", f"test_{name}.c", f"{name}_replay.c"}
        files |= {f"{name}.c", f"{name}.h"}
        written = state()
        assert written.keys() - before.keys() == {str(Path(out, each)) for each in files}
        assert written.items() >= before.items()
        assert said.out.splitlines() == [
            f"{Path(out)}: {', '.join(sorted(files))}",
            f"{Path(out, 'README.md')} explains how to build, test and replay it",
        ]
        assert f"{name}_init(" in written[str(Path(out, f"{name}.h"))].decode()
        readme = written[str(Path(out, "README.md"))].decode()
        data = "range_m, bearing_rad, landmarks_x_m, landmarks_y_m"
        assert f"| `{name}_update_range_bearing` | range_bearing | {data} |" in readme
        assert f"Made by `fuselog deploy` from {log.name};" in readme
        for place, sentence in (
            (out, f"{Path(out)}: the folder is not empty; give another one with -o, or empty it\n"),
            ("a file", "Invalid value for '-o' / '--out': Directory 'a file' is a file"),
        ):
            refused = run_here(*words, place)
            assert refused.code == 2
            assert refused.err.startswith(f"fuselog: {sentence}")
        assert state() == written


@pytest.mark.paper
@pytest.mark.parametrize(("single", "away"), [(False, 1e-12), (True, 2e-6)])
def test_an_emulated_cortex_m4f_gives_the_estimates(tmp_path: Path, single: bool, away: float) -> None:
    if missing := missing_of_target():
        pytest.skip(f"there is no {missing} here")
    tried = Tried("robot", robot_log(tmp_path), None, {"model": "robot"})
    taken = on_target(deployed(tried, "ekf", tmp_path, single=single), away)
    kept = json.loads(DEPLOYED.read_text())["target"]["ekf float" if single else "ekf double"]
    assert [taken.average, taken.most] == pytest.approx([kept["average"], kept["most"]], rel=0.1)


@pytest.mark.paper
def test_the_costs_that_are_kept_are_those_of_now(tmp_path: Path) -> None:
    """`python -m tests.deployed --keep` keeps them."""
    tried = Tried("robot", robot_log(tmp_path), None, {"model": "robot"})
    kept = json.loads(DEPLOYED.read_text())["pairs"]["robot"]
    for method in ("ekf", "sqrt:ukf"):
        folder = deployed(tried, method, tmp_path)
        found = json.loads((folder / "certificate.json").read_text())["worst"]
        assert found == {name: kept[method][name] for name in found}


@needs_compiler
@pytest.mark.usefixtures("uncompiled")
@pytest.mark.paper
def test_models_of_the_pages_deploy_as_they_stand_there(tmp_path: Path) -> None:
    """`python -m tests.deployed` has them by every method."""
    found = []
    for name, model, log, settings in own_models(tmp_path):
        folder = deployed(Tried(name, log, model, settings), "sqrt:ukf", tmp_path)
        assert furthest(compiled(folder, "-O0")) <= 1e-12
        found.append(name)
    assert found == ["pendulum", "pendulum with its length", "ball", "walker"]
