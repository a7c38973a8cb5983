"""Output of check results as JUnit XML for continuous integration, with a test case per topic."""

from pathlib import Path
from xml.etree import ElementTree

from fuselog.pipeline.checking.checking import Checked
from fuselog.pipeline.output.outputs import Kind
from fuselog.recorders.atomic import whole_file

NAME = "fuselog check"


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


JUNIT = Kind(".xml", "a JUnit file of fuselog check", _is_junit)
