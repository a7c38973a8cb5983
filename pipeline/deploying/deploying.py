"""Writes a filter as C99: `deploy`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.api.planning import open as open_source
from pipeline.api.planning import settings_of
from pipeline.deploying.c_filter import source
from pipeline.deploying.c_header import header
from pipeline.deploying.c_names import CFilter, identifier
from pipeline.deploying.c_replay import replay_text, why_no_replay
from pipeline.deploying.c_test import test_text, vectors_of, vectors_text
from pipeline.deploying.certificate import CERTIFICATE, certificate_of, certificate_text
from pipeline.deploying.folder import cmake_text, readme_text
from recorders.atomic import whole_folder
from recorders.errors import BadInput
from replay.engine.replaying.estimator import Recursive, bind, configure
from replay.foreign.native.library import HEADER
from replay.inference.kalman.methods import FILTERS
from replay.inference.run.filtering import Filter
from replay.inference.whole_steps import EXTENDED, SAMPLED, whole_steps
from replay.tracing.c_text import DOUBLE, SINGLE

KINDS = {"ekf": EXTENDED, "ukf": SAMPLED}


def deploy(
    log: str | Path,
    estimator: str | Mapping[str, Any],
    out: str | Path,
    /,
    *,
    single: bool = False,
    **parameters: Any,
) -> Path:
    """Write a filter as C99 for a robot, with a recorded log as its test.

    The C has the filter's own operations in their order: its estimates are those of `replay`, to the
    last bit where it is compiled with -ffp-contract=off, in double precision and with the same libm.

    Args:
        log: a log that the filter fits: its sensors are those of the C, its channels state what is not
            given, and its first messages are the test.
        estimator: `ekf` or `ukf`, or a table of settings by its label.
        out: the folder to write, which must not be there or be empty; its name is the filter's in C.
        single: use single precision, `float`.
        parameters: of the estimator, such as `model="robot"`.

    Raises BadInput where the filter cannot be written so, and where the folder is not empty.

    >>> from pipeline.api.api import record, write
    >>> write("run.mcap", record("landmarks", seed=7, duration_s=2.0))
    >>> folder = deploy("run.mcap", "ekf", "robot_ekf", model="robot")
    >>> sorted(each.name for each in folder.iterdir())[:3]
    ['CMakeLists.txt', 'README.md', 'certificate.json']
    """
    [(label, settings)] = settings_of(estimator).items()
    place = Path(out)
    _check_empty(place)
    run = open_source(log)
    bound, filtering, kind = _bound(label, {**settings, **parameters}, run)
    made = CFilter(
        identifier(place.resolve().name),
        filtering,
        whole_steps(filtering, kind),
        SINGLE if single else DOUBLE,
        f"{filtering.stage.model.summary}: {filtering.method.summary}.",
    )
    vectors = vectors_of(run, bound, filtering)
    own_header, own_source = header(made), source(made)
    certificate = certificate_of(made, own_source, own_header)
    files = {
        f"{made.name}.h": own_header,
        f"{made.name}.c": own_source,
        f"test_{made.name}.c": test_text(made),
        "vectors.h": vectors_text(made, vectors),
        "CMakeLists.txt": cmake_text(made),
        "README.md": readme_text(made, Path(log).name, certificate),
        CERTIFICATE: certificate_text(made, certificate),
    }
    if not why_no_replay(made):
        files[f"{made.name}_replay.c"] = replay_text(made)
        files["fuselog_filter.h"] = HEADER.read_text(encoding="utf-8")
    with whole_folder(place, _check_empty) as folder:
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
    return place


def _check_empty(folder: Path) -> None:
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise BadInput(f"{folder}: is not empty; give another folder with -o, or empty it yourself")


def _bound(label: str, settings: dict[str, Any], run: Any) -> tuple[Recursive, Filter, str]:
    """Bind the filter; raises BadInput where it is none that can be written."""
    configure(label, settings)
    name = str(settings.get("kind", label))
    found = bind(label, [run], settings)
    [first, *others] = found
    filtering = getattr(getattr(first, "run", None), "__self__", None)
    if not isinstance(first, Recursive) or type(filtering) is not Filter:
        raise BadInput(
            f"estimator {label}: is no filter that can be written as C; give -e ekf or -e ukf"
        )
    kind = next((KINDS[each] for each in KINDS if filtering.method is FILTERS[each]), None)
    if kind is None:
        raise BadInput(
            f"estimator {label}: {name} cannot be written as C yet; give -e ekf, or -e ukf for a state "
            "without angles"
        )
    if others:
        several = ", ".join(each.name for each in found)
        raise BadInput(
            f"{run.name}: {several}: the log has several that fit; cut it to the topics of one first"
        )
    if filtering.parameters.every_s is not None:
        raise BadInput(f"estimator {label}: every_s: predict when you want an estimate; leave it out")
    if filtering.delays_ns.any():
        raise BadInput(
            f"estimator {label}: a message was measured before its stamp (delay); subtract that on the "
            "robot, and set the delay to 0"
        )
    return first, filtering, kind
