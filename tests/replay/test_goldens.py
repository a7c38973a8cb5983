"""What the estimators give is what they gave: all experiments' first logs against stored replays."""

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from fuselog.pipeline.checking.discrepancies import discrepancies
from fuselog.pipeline.checking.golden import TOLERANCE, Replayed, Tolerance, arithmetic
from fuselog.pipeline.checking.stored import Golden, read
from fuselog.recorders.errors import BadInput
from fuselog.recorders.registry import available
from fuselog.testing import assert_same
from tests.goldens import store
from tests.goldens.recipes import DATA, RECIPES, covered, index, unpack
from tests.goldens.store import ALLOWED
from tests.older_cpu import older_cpu

pytestmark = [pytest.mark.paper, pytest.mark.usefixtures("blank_figures")]

# real data that are fixtures of all tests
UNPACKED = ("acoustic", "autoferry", "mrclam6", "navigation")
# what rounding once decided: vertices, half turns, searches that end early (`test_biometrics` has ties);
# with the variables of `tests.older_cpu`, `make test` runs all tests so
FRAGILE = ("navigation-unknown-heading", "set-filter")
# what a process of its own does, as on another CPU; unless its arithmetic is the given one
ON_IT = """
import sys
from fuselog.testing import assert_same
from fuselog.pipeline.checking.golden import arithmetic
from tests.goldens import store
_, here, *names = sys.argv
if arithmetic() == here:
    sys.exit(print("alike"))
for name in names:
    assert_same(store.replayed(name, {}), store.path_of(name))
"""


def assert_is_golden(name: str, places: dict[str, Path]) -> None:
    assert_same(store.replayed(name, places), store.path_of(name))


def golden_of(name: str) -> Golden:
    return read(store.path_of(name))


def differences(
    name: str, golden: Golden, found: Golden, allowed: Mapping[str, Tolerance] | None = None
) -> Iterator[str]:
    own = golden | {"tolerances": {key: each._asdict() for key, each in (allowed or {}).items()}}
    return (each.sentence for each in discrepancies(own, Replayed(found, {})))


def streams_of(golden: Golden) -> dict[str, Any]:
    return {topic: each for run in golden["runs"].values() for topic, each in run["streams"].items()}


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where other real data are unpacked."""
    return tmp_path_factory.mktemp("goldens")


@pytest.mark.parametrize("name", RECIPES)
def test_golden(name: str, scratch: Path, request: pytest.FixtureRequest) -> None:
    importer, places = RECIPES[name].importer, {}
    if importer and (folder := DATA[importer][0]) in UNPACKED:
        places = {importer: request.getfixturevalue(folder)}
    elif importer:
        places = unpack(request.getfixturevalue("real_data"), [importer], scratch)
    assert_is_golden(name, places)


def test_what_rounding_once_decided_is_the_same_on_an_older_cpu() -> None:
    """After the tests above, so that kernels are compiled."""
    done = subprocess.run(
        [sys.executable, "-c", ON_IT, arithmetic(), *FRAGILE],
        env=os.environ | older_cpu(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    if done.stdout.strip() == "alike":
        pytest.skip("without what NumPy can leave out of this CPU, it computes alike")


def test_every_estimator_has_a_golden() -> None:
    """Of each at least one variant; and the page that says which is of today."""
    of_others = {"lib", "exec"}  # held to ours on their logs, see tests/replay/foreign
    assert {kind.partition(":")[0] for kind in covered()} == set(available("estimators")) - of_others
    assert {path.name for path in store.FOLDER.iterdir()} == {store.path_of(n).name for n in RECIPES}
    assert (store.FOLDER.parent / "README.md").read_text(encoding="utf-8") == index()


def test_what_a_replay_says_of_itself_is_no_golden() -> None:
    """How much was estimated is in none; where a run fails, when it did is."""
    streams = [each for name in RECIPES for each in streams_of(golden_of(name)).items()]
    assert not [topic for topic, _ in streams if topic.endswith("/coverage")]
    failures = [stream["rows"] for topic, stream in streams if topic.endswith("/failure")]
    assert failures
    assert all(rows > 0 for rows in failures)


@pytest.fixture(scope="module")
def golden() -> Golden:
    return golden_of("landmarks")


POSE = "/estimates/ekf/robot1/pose"


@pytest.mark.parametrize("part", ["kept", "sum", "sum_of_squares"])
def test_a_small_change_is_found(golden: Golden, part: str) -> None:
    """In a row that is kept, and in the sums over those that are not; unless the table allows it."""
    found = golden_of("landmarks")
    mean = streams_of(found)[POSE]["columns"]["mean"]
    numbers = mean["kept"][7] if part == "kept" else mean[part]
    numbers[0] *= 1 + 1e-9
    [sentence] = differences("landmarks", golden, found)
    assert sentence.startswith(f"landmarks {POSE} mean: ")
    assert not [*differences("landmarks", golden, found, {f"{POSE} mean": Tolerance(1e-8, "")})]
    assert [*differences("landmarks", golden, found, {"* covariance": Tolerance(1e-8, "")})]


def test_an_angle_is_compared_around_the_circle(golden: Golden) -> None:
    found = golden_of("landmarks")
    mean = streams_of(found)[POSE]["columns"]["mean"]
    mean["kept"][3][2] += 6.283185307179586
    assert not list(differences("landmarks", golden, found))
    mean["kept"][3][1] += 6.283185307179586
    assert len(list(differences("landmarks", golden, found))) == 1


def test_what_is_missing_or_new_or_late_is_found(golden: Golden) -> None:
    found = golden_of("landmarks")
    streams = found["runs"]["landmarks"]["streams"]
    streams["/estimates/ekf/robot9/pose"] = streams.pop(POSE)
    pose = streams["/estimates/ukf/robot1/pose"]
    pose["publish_times"], pose["metadata"] = "0", {**pose["metadata"], "frame": "elsewhere"}
    pose["columns"]["mean"]["missing"][0] = 1
    sentences = list(differences("landmarks", golden, found))
    parts = [sentence.split(":")[0].split()[2] for sentence in sentences]
    assert parts == ["as", "as", "publish_times", "metadata", "mean"]


def test_another_cpu_gets_more_but_the_same_input_is_asked_for(golden: Golden) -> None:
    found = golden_of("landmarks")
    found["runs"]["landmarks"]["input"] = "another"
    with pytest.raises(BadInput, match="recorded or imported data have changed"):
        list(differences("landmarks", golden, found))
    found["arithmetic"] = "another"
    streams_of(found)[POSE]["columns"]["mean"]["kept"][7][0] *= 1 + 1e-9
    assert not list(differences("landmarks", golden, found))
    streams_of(found)[POSE]["columns"]["mean"]["kept"][7][0] *= 1 + 1e-4
    assert list(differences("landmarks", golden, found))


def test_every_known_difference_has_its_reason() -> None:
    assert all(known.reason and known.relative > TOLERANCE for known in ALLOWED.values())
