"""Writes what a check found as JUnit's XML, for continuous integration: a test case for each topic."""

from pathlib import Path
from xml.etree import ElementTree

from pipeline.checking.checking import Checked
from pipeline.output.outputs import Kind
from recorders.atomic import whole_file

NAME = "fuselog check"


def write_junit(path: Path, golden: str, checked: Checked) -> None:
    """Write the results of a check, without times: the same check gives the same bytes."""
    failures = {(each.run, each.topic) for each in checked.found}
    cases = {*checked.fields, *failures}
    root = ElementTree.Element("testsuites", name=NAME)
    counts = {"tests": str(len(cases)), "failures": str(len(failures)), "errors": "0"}
    suite = ElementTree.SubElement(root, "testsuite", {"name": golden, **counts})
    for run, topic in sorted(cases):
        about = {"classname": golden, "name": " ".join(filter(None, (run, topic)))}
        case = ElementTree.SubElement(suite, "testcase", about)
        own = [each for each in checked.found if (each.run, each.topic) == (run, topic)]
        if own:
            message = own[0].sentence
            failure = ElementTree.SubElement(case, "failure", message=message, type="difference")
            failure.text = "\n".join(each.sentence for each in own)
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
