"""The function `deploy`, which writes a filter as C99."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from fuselog.pipeline.api.planning import Named, settings_of
from fuselog.pipeline.api.planning import open as open_source
from fuselog.pipeline.checking.checking import Runs
from fuselog.pipeline.checking.stored import Golden
from fuselog.pipeline.deploying.c_replay import replay_text, why_no_replay
from fuselog.pipeline.deploying.c_source.filter import source
from fuselog.pipeline.deploying.c_source.header import header
from fuselog.pipeline.deploying.c_source.names import CFilter, identifier, text_of
from fuselog.pipeline.deploying.c_test import test_text, vectors_of, vectors_text
from fuselog.pipeline.deploying.certificate import CERTIFICATE, certificate_of, certificate_text
from fuselog.pipeline.deploying.folder import cmake_text, readme_text
from fuselog.pipeline.output.outputs import check_folder
from fuselog.pipeline.runs.ensemble import Settings
from fuselog.recorders.atomic import settled, whole_folder
from fuselog.recorders.errors import BadInput, without_warnings_of_numbers
from fuselog.recorders.remote.paths import located
from fuselog.replay.engine.replaying.estimator import Reading, Recursive, bind, configure
from fuselog.replay.foreign.filters import description_of_library
from fuselog.replay.foreign.naming import shorthand
from fuselog.replay.foreign.native.library import HEADER
from fuselog.replay.inference.kalman.methods import FILTERS, filter_with
from fuselog.replay.inference.run.filtering import Filter
from fuselog.replay.inference.whole_steps import EXTENDED, ITERATED, SAMPLED, whole_steps
from fuselog.replay.tracing.c_text import DOUBLE, SINGLE, Precision

# by the class that creates a method's steps
KINDS = {
    FILTERS["ekf"].steps: EXTENDED,
    FILTERS["iekf"].steps: ITERATED,
    FILTERS["ukf"].steps: SAMPLED,
    filter_with("sqrt", "ekf").steps: EXTENDED,
    filter_with("sqrt", "ukf").steps: SAMPLED,
}
DEPLOYABLE = "ekf, iekf, ukf, lrkf:SAMPLING, sqrt:ekf or sqrt:ukf"


@without_warnings_of_numbers()
def deploy(
    log: str | Path,
    estimator: Named,
    out: str | Path,
    /,
    *,
    single: bool = False,
    **parameters: Any,
) -> Path:
    """Write a filter as C99 for a robot, with a recorded log as its test.

    The C code has the same operations as the filter, in the same order. Its estimates equal those of
    `replay` to the last bit if the code is compiled in double precision, with -ffp-contract=off and with
    the same libm.

    Args:
        log: a log that the filter fits. The C code has the log's sensors. Parameters that are not set
            have the values in the log's channels. The test is made from the first messages.
        estimator: `ekf`, `iekf`, `ukf`, `lrkf:SAMPLING`, `sqrt:ekf` or `sqrt:ukf`; the result of
            `modelled` for a model of your own and one of these methods; or a table of settings by label.
        out: the folder to write, which must be empty or not exist; its name is the filter's name in C.
        single: use single precision, `float`.
        parameters: parameters of the estimator, such as `model="robot"`.

    Returns:
        The folder that was written.

    Raises BadInput if the filter cannot be written as C, or if the folder is not empty.

    >>> from fuselog.pipeline.api.api import record, write
    >>> write("run.mcap", record("landmarks", seed=7, duration_s=2.0))
    >>> folder = deploy("run.mcap", "ekf", "robot_ekf", model="robot")
    >>> sorted(each.name for each in folder.iterdir())[:3]
    ['CMakeLists.txt', 'README.md', 'certificate.json']
    """
    [(label, settings)] = settings_of(estimator).items()
    place = settled(Path(out))
    check_folder(place, {"log": [located(log)]})
    _check_empty(place)
    run, name = open_source(log), identifier(place.resolve().name)
    precision = SINGLE if single else DOUBLE
    bound, made = _made(name, label, {**settings, **parameters}, run, precision)
    made = _without_clash(made, bound.reading)
    vectors = vectors_of(run, bound, made.filtering)
    files = {
        f"{made.name}.h": header(made),
        f"{made.name}.c": source(made),
        f"test_{made.name}.c": test_text(made),
        "vectors.h": vectors_text(made, vectors),
        "cortex_m4f.c": text_of("cortex_m4f.c"),
        "cortex_m4f.ld": text_of("cortex_m4f.ld"),
        "CMakeLists.txt": cmake_text(made),
    }
    certificate = certificate_of(made, files)
    files["README.md"] = readme_text(made, Path(log).name, certificate)
    files[CERTIFICATE] = certificate_text(made, certificate)
    if bound.reading is not None and not why_no_replay(made):
        files[f"{made.name}_replay.c"] = replay_text(made, bound.reading())
        files["fuselog_filter.h"] = HEADER.read_text(encoding="utf-8")
    with whole_folder(place, _check_empty) as folder:
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
    return place


def in_place_of_golden(name: str, runs: Runs, golden: Golden) -> Settings:
    """Replace the estimator of a golden by a program, for `fuselog.pipeline.checking.checking.check`.

    Args:
        name: the program, such as `lib:./robot_ekf.so`.
        runs: the runs of the golden.
        golden: the golden, as returned by `fuselog.pipeline.checking.stored.read`.

    Returns the program's settings by the golden's label. Raises BadInput if `name` is not a program, if
    the golden does not have exactly one estimator, or if the program was deployed from another filter.
    """
    _, program = shorthand(name)
    if not program:
        raise BadInput(
            f"-e {name}: a golden names its estimators; give a program to check instead of one of them, "
            "such as lib:PATH, or add --update"
        )
    stored = golden["settings"]["estimators"]
    if len(stored) != 1:
        raise BadInput(
            f"-e {name}: the golden has {len(stored)} estimators; give a golden with this filter only, "
            "as --update -e ekf writes it"
        )
    [(label, settings)] = stored.items()
    found = description_of_library(label, program).digest if program["kind"] == "lib" else ""
    for run in runs.values() if found else ():
        _, made = _made("filter", label, settings, run, DOUBLE)
        if found not in (made.digest, made._replace(precision=SINGLE).digest):
            raise BadInput(
                f"{program['path']}: was deployed from a different filter ({found}) than the golden's "
                f"{label} in {run.name} ({made.digest}); deploy the golden's filter with the same "
                "settings"
            )
    return {label: program}


def _made(
    name: str, label: str, settings: Mapping[str, Any], run: Any, precision: Precision
) -> tuple[Recursive, CFilter]:
    """Bind a filter to a log, and trace its steps."""
    bound, filtering, kind = _bound(label, dict(settings), run)
    origin = f"{filtering.bound_model.model.summary}: {filtering.method.summary}."
    return bound, CFilter(name, filtering, whole_steps(filtering, kind), precision, origin)


def _without_clash(made: CFilter, reading: Callable[[], Reading] | None) -> CFilter:
    """Rename a filter whose name is already used in its C code, for example by a variable."""
    alone = made._replace(name="fuselog_filter")
    text = source(alone) + test_text(alone)
    if reading is not None and not why_no_replay(alone):
        text += replay_text(alone, reading())
    words = re.findall(r"\w+", re.sub(r'/\*.*?\*/|//[^\n]*|"[^"\n]*"', " ", text, flags=re.DOTALL))
    return made._replace(name=f"{made.name}_filter") if made.name in words else made


def _check_empty(folder: Path) -> None:
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise BadInput(f"{folder}: the folder is not empty; give another one with -o, or empty it")


def _bound(label: str, settings: dict[str, Any], run: Any) -> tuple[Recursive, Filter, str]:
    """Bind the filter to a log; raise BadInput if it cannot be written as C."""
    configure(label, settings)
    kind = settings.get("kind", label)
    name = kind if isinstance(kind, str) else label
    found = bind(label, [run], settings)
    [first, *others] = found
    filtering = getattr(getattr(first, "run", None), "__self__", None)
    if not isinstance(first, Recursive) or type(filtering) is not Filter:
        raise BadInput(f"estimator {label}: this estimator cannot be written as C; give -e {DEPLOYABLE}")
    kind = KINDS.get(filtering.method.steps)
    if kind is None or filtering.is_random:
        why = "draws new samples in every step" if kind else "cannot be written as C"
        raise BadInput(f"estimator {label}: {name} {why}; give -e {DEPLOYABLE}")
    if others:
        several = ", ".join(each.name for each in found)
        raise BadInput(
            f"{run.name}: {several}: several estimators fit the log; cut it to the topics of one first"
        )
    if filtering.parameters.every_s is not None:
        raise BadInput(
            f"estimator {label}: every_s: the C code predicts whenever you call it; remove this setting"
        )
    if filtering.delays_ns.any():
        raise BadInput(
            f"estimator {label}: messages of a sensor are delayed; subtract the delay from their stamps "
            "on the robot, and set the delay to 0"
        )
    return first, filtering, kind
