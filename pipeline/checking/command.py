"""The command `fuselog check`, which replays runs and reports the first difference from a golden."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

from fuselog.pipeline.api.over_logs import FAULTS, campaign_of, show_over_logs
from fuselog.pipeline.checking.checking import Checked, check, runs_of, update
from fuselog.pipeline.checking.golden import Tolerance
from fuselog.pipeline.checking.over_logs import InPlace, check_over_logs
from fuselog.pipeline.checking.stored import read
from fuselog.pipeline.output.outputs import Kind, check_files
from fuselog.pipeline.output.terminal import print_json, say
from fuselog.pipeline.output.words import count
from fuselog.pipeline.runs.settings import pairs_of, settings_of_estimators
from fuselog.pipeline.selecting.selection import SelectionOptions
from fuselog.recorders.atomic import whole_file
from fuselog.recorders.errors import BadInput

_TOLERANCE = "PATTERN=RELATIVE, as '/estimates/ekf/* mean=1e-9'"

NAME = "fuselog check"


def check_path(
    path: Path,
    golden: Path,
    *,
    is_update: bool,
    labels: Sequence[str],
    arrival_order: bool,
    late: str | None,
    columns: Sequence[str],
    tolerances: Sequence[str],
    junit: Path | None,
    out: Path | None,
    as_json: bool,
    settings_file: Path | None,
    settings: Sequence[str],
    in_place: InPlace | None = None,
    selection: SelectionOptions | None = None,
) -> bool:
    """Compare the runs at `path` with a golden, or write the golden; return whether all fields agree.

    `in_place` is called with a program's name, the runs and the golden. `in_place` returns the settings
    of the estimators that replace those of the golden.
    """
    if is_update:
        if junit is not None:
            raise BadInput("--junit: writes the results of a check; leave it out with --update")
        chosen = settings_of_estimators(labels, settings, settings_file)
        made = update(
            path,
            golden,
            {"late": late, "arrival_order": arrival_order},
            estimators=chosen,
            columns=columns,
            tolerances=pairs_of("--tolerance", tolerances, _tolerance, _TOLERANCE),
            where=selection.where if selection else None,
        )
        streams = sum(len(run["streams"]) for run in made["runs"].values())
        size_kb = golden.stat().st_size / 1e3
        say(f"{golden}: {count(len(made['runs']), 'run')}, {streams} streams, {size_kb:.0f} kB")
        return True
    if junit is not None:
        check_files([(junit, JUNIT)], {"golden": [golden]})
    is_replaced = in_place is not None and len(labels) == 1
    try:
        if (
            (labels and not is_replaced)
            or settings
            or settings_file
            or late
            or arrival_order
            or columns
            or tolerances
        ):
            raise BadInput(
                f"{golden}: already defines the replay and the allowed differences; to change them, add "
                "--update"
            )
        if selection is not None:
            campaign = campaign_of(selection, out or Path("out/check"))
            if junit is not None:
                raise BadInput("--junit: does not apply to a selection of logs; leave it out")
            of_logs = check_over_logs(campaign, golden, labels[0] if labels else None, in_place)
            show_over_logs(of_logs, as_json=as_json)
            return bool(of_logs.table["problem"].isna().all() and not of_logs.table[FAULTS].any())
        if out is not None:
            raise BadInput(f"--out {out}: applies to a selection of logs; leave it out")
        sources, stored = runs_of(path), read(golden)
        replaced = in_place(labels[0], sources, stored) if in_place and labels else None
        done = check(sources, stored, replaced)
    except (BadInput, OSError) as error:
        if junit is not None:
            write_junit(junit, golden.name, error)
        raise
    if junit is not None:
        write_junit(junit, golden.name, done)
    if as_json:
        print_json(
            {
                "equal": not done.found,
                "fields": sum(done.fields.values()),
                "first": list(done.sentences),
                "differences": [each.sentence for each in done.found],
            }
        )
        return not done.found
    say(*done.sentences)
    if done.found:
        say(f"{len(done.found)} of {sum(done.fields.values())} fields differ from {golden}")
    else:
        say(f"all {sum(done.fields.values())} fields agree with {golden}")
    return not done.found


def _tolerance(text: str) -> Tolerance:
    if not (relative := float(text)) >= 0.0:
        raise ValueError
    return Tolerance(relative)


def write_junit(path: Path, golden: str, outcome: Checked | Exception) -> None:
    """Write the results of a check, or the error that prevented it.

    The file contains no times, so the same check always gives the same bytes.
    """
    cases: dict[tuple[str, str], list[str]] = {}
    kind, element = "difference", "failure"
    if isinstance(outcome, Exception):
        cases["", ""] = [str(outcome)]
        kind, element = type(outcome).__name__, "error"
    else:
        cases = {each: [] for each in outcome.fields}
        for each in outcome.found:
            cases.setdefault((each.run, each.topic), []).append(each.sentence)
    counts = {"tests": len(cases), "failures": 0, "errors": 0}
    counts[f"{element}s"] = sum(map(bool, cases.values()))
    root = ElementTree.Element("testsuites", name=NAME)
    suite = ElementTree.SubElement(
        root, "testsuite", {"name": golden, **{name: str(count) for name, count in counts.items()}}
    )
    for (run, topic), sentences in sorted(cases.items()):
        about = {"classname": golden, "name": " ".join(filter(None, (run, topic))) or "check"}
        case = ElementTree.SubElement(suite, "testcase", about)
        if sentences:
            found = ElementTree.SubElement(case, element, message=sentences[0], type=kind)
            found.text = "\n".join(sentences)
    ElementTree.indent(root)
    with whole_file(path) as part:
        ElementTree.ElementTree(root).write(part, encoding="utf-8", xml_declaration=True)


def _is_junit(path: Path) -> bool:
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError):
        return False
    return root.tag == "testsuites" and root.get("name") == NAME


JUNIT = Kind(".xml", "a JUnit file that fuselog check wrote", _is_junit)
