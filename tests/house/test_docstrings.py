"""Docstrings open with a sentence, and those of public names say what is taken and returned.

Public is what `fuselog/__init__.pyi` lists. Whether a sentence is a good one, no test can say.

Docstrings and comments name what is there: modules, their names, classes and their fields, files. What
is looked at stands in backticks with a dot in it, or is a path. What begins with neither a module nor a
class is passed over; behind a variable of the same file must stand a field of some class.
"""

import ast
import io
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest

from tests.house.sources import PATHS, ROOT, Definition, definitions_of, text_of, tree_of

STUB = ast.parse((ROOT / "fuselog" / "__init__.pyi").read_text(encoding="utf-8"))
ENTRY = re.compile(r"^    (\*{0,2}\w+(?:, \w+)*): \S", re.MULTILINE)
ARRAY = re.compile(r"\b(Floats|Integers|Booleans|NDArray|ArrayLike|Times)\b")


def section_of(node: Definition, head: str) -> str:
    """What stands under a heading of a docstring, such as `Args`; empty where there is none."""
    _, _, after = f"\n{ast.get_docstring(node) or ''}".partition(f"\n{head}:\n")
    return re.split(r"\n(?=\S)", after)[0]


def entries_of(node: Definition, head: str) -> set[str]:
    return {name for names in ENTRY.findall(section_of(node, head)) for name in names.split(", ")}


def parameters_of(function: ast.FunctionDef) -> set[str]:
    given = function.args
    named = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
    return {each.arg for each in named if each} - {"self", "cls"}


def takes_arrays(function: ast.FunctionDef) -> bool:
    """Whether a public function takes several arguments, and an array among them."""
    annotations = [each.annotation for each in function.args.args + function.args.kwonlyargs]
    is_public = not function.name.startswith("_")
    has_array = any(each and ARRAY.search(ast.unparse(each)) for each in annotations)
    return is_public and has_array and len(parameters_of(function)) > 1


def fields_of(node: ast.ClassDef) -> set[str]:
    """The public fields of a dataclass, a named tuple or a type of parameters."""
    return {
        each.target.id
        for each in node.body
        if isinstance(each, ast.AnnAssign)
        and isinstance(each.target, ast.Name)
        and not each.target.id.startswith("_")
        and "ClassVar" not in ast.unparse(each.annotation)
    }


def faults_of_opening(node: Definition) -> Iterator[str]:
    """What keeps the first line of a docstring from being a sentence."""
    first, *more = (ast.get_docstring(node) or "").split("\n")
    if not first:
        yield "has no docstring"
    elif not first.endswith("."):
        yield "opens without a full stop"
    elif first[0].islower():
        yield "opens in lower case"
    elif more and more[0]:
        yield "opens with more than a line"


def faults_of_function(node: ast.FunctionDef) -> Iterator[str]:
    """What the docstring of a public function lacks."""
    yield from faults_of_opening(node)
    if missing := parameters_of(node) - entries_of(node, "Args"):
        yield f"has no Args of {sorted(missing)}"
    if node.returns and ast.unparse(node.returns) != "None" and not section_of(node, "Returns"):
        yield "has no Returns"


def faults_of_class(node: ast.ClassDef) -> Iterator[str]:
    """What the docstring of a public class lacks, or one of its public methods."""
    yield from faults_of_opening(node)
    if missing := fields_of(node) - entries_of(node, "Attributes"):
        yield f"has no Attributes of {sorted(missing)}"
    for each in node.body:
        if isinstance(each, ast.FunctionDef) and not each.name.startswith("_"):
            for fault in faults_of_opening(each):
                yield f"{each.name} {fault}"
            text = ast.get_docstring(each) or ""
            for name in parameters_of(each) - entries_of(each, "Args"):
                if f"`{name}`" not in text:
                    yield f"{each.name} does not say what {name} is"


def faults_of(node: ast.stmt) -> Iterator[str]:
    if isinstance(node, ast.FunctionDef):
        yield from faults_of_function(node)
    elif isinstance(node, ast.ClassDef):
        yield from faults_of_class(node)


def definition(module: str, name: str) -> ast.stmt:
    """The statement that defines a name of a module, also where it imports that from another one."""
    place = Path(*module.split("."))
    tree = tree_of(place / "__init__.py" if (ROOT / place).is_dir() else place.with_suffix(".py"))
    for each in tree.body:
        if isinstance(each, ast.FunctionDef | ast.ClassDef) and each.name == name:
            return each
        if isinstance(each, ast.ImportFrom):
            for alias in each.names:
                if name == (alias.asname or alias.name):
                    return definition(each.module or "", alias.name)
    return ast.Pass()  # a value, or a module


def test_public_names_say_what_they_take_and_return() -> None:
    faults = [
        f"{alias.name} {fault}"
        for node in STUB.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        for fault in faults_of(definition(node.module or "", alias.name))
    ]
    assert not faults, "\n".join(faults)


def test_modules_and_classes_open_with_a_sentence() -> None:
    faults = [
        f"{path}: {getattr(node, 'name', 'the module')} {fault}"
        for path in PATHS
        for node in definitions_of(path)
        if isinstance(node, ast.Module | ast.ClassDef)
        for fault in faults_of_opening(node)
    ]
    assert not faults, "\n".join(faults)


def test_functions_of_arrays_say_what_they_take() -> None:
    """Names and types do not tell shapes and units."""
    faults = [
        f"{path}: {node.name} has no Args"
        for path in PATHS
        for node in tree_of(path).body
        if isinstance(node, ast.FunctionDef) and takes_arrays(node)
        if not section_of(node, "Args")
    ]
    assert not faults, "\n".join(faults)


def test_where_arguments_are_described_they_all_are() -> None:
    """And those alone; ruff's D417, which knows one name a line, is off."""
    for path in PATHS:
        for node in definitions_of(path):
            if isinstance(node, ast.FunctionDef) and section_of(node, "Args"):
                described = {name.lstrip("*") for name in entries_of(node, "Args")}
                assert described == parameters_of(node), f"{path}: {node.name} {described}"


@pytest.mark.parametrize(
    ("source", "fault"),
    [
        ('"""A function"""', "opens without a full stop"),
        ('"""does."""', "opens in lower case"),
        ('"""Does\nthis."""', "opens without a full stop"),
        ('"""Does.\nMuch."""', "opens with more than a line"),
        ("pass", "has no docstring"),
        ('"""Does.\n\nArgs:\n    first: a number.\n"""', "has no Args of ['second']"),
        ('"""Does.\n\nArgs:\n    first, second: numbers.\n"""', "has no Returns"),
    ],
)
def test_what_lacks_something_is_found(source: str, fault: str) -> None:
    body = source.replace("\n", "\n    ")
    [function] = ast.parse(f"def made(first: int, second: int) -> int:\n    {body}").body
    assert fault in list(faults_of(function))


def test_a_field_without_a_meaning_is_found() -> None:
    source = 'class Made(NamedTuple):\n    """Holds two.\n\n    Attributes:\n        one: 1.\n    """\n'
    [made] = ast.parse(f"{source}    one: int\n    two: int\n").body
    assert list(faults_of(made)) == ["has no Attributes of ['two']"]


# What is named is there

OWN = [path for path in PATHS if path.parts[0] != "fuselog"]  # whose names are of others
DOTTED = re.compile(r"`([A-Za-z]\w*(?:\.[A-Za-z]\w*)+)(?:\(.*?\))?`")
PATH = re.compile(r"(?<![\w./])(?:recorders|replay|pipeline|tests|docs|data)/[\w./-]*\w")


def bound_in(statements: list[ast.stmt]) -> Iterator[str]:
    """The names that a module or a class binds itself."""
    for each in statements:
        match each:
            case ast.FunctionDef() | ast.ClassDef():
                yield each.name
            case ast.Assign() | ast.AnnAssign():
                targets = each.targets if isinstance(each, ast.Assign) else [each.target]
                for target in targets:
                    yield from (node.id for node in ast.walk(target) if isinstance(node, ast.Name))
            case ast.If() | ast.Try():
                yield from bound_in(each.body + each.orelse)
            case ast.ImportFrom():
                yield from (alias.asname or alias.name for alias in each.names)


@cache
def holders() -> dict[str, set[str]]:
    """What may stand behind a dot, by the last name of every module and by the name of every class."""
    found, bases = defaultdict[str, set[str]](set), defaultdict[str, set[str]](set)
    for path in OWN:
        *above, module = path.with_suffix("").parts
        if above[:1] != ["fuselog"]:
            above.insert(0, "fuselog")
        if module == "__init__":
            *above, module = above
        for outer, inner in pairwise([*above, module]):
            found[outer].add(inner)
        for node in definitions_of(path):
            if isinstance(node, ast.Module):
                imports_count = path.name == "__init__.py"
                kept = [
                    each for each in node.body if imports_count or not isinstance(each, ast.ImportFrom)
                ]
                found[module] |= set(bound_in(kept))
            elif isinstance(node, ast.ClassDef):
                found[node.name] |= set(bound_in(node.body))
                found[node.name] |= {
                    inner.attr
                    for inner in ast.walk(node)
                    if isinstance(inner, ast.Attribute)
                    and isinstance(inner.value, ast.Name)
                    and inner.value.id == "self"
                }
                bases[node.name] |= {ast.unparse(base).partition("[")[0] for base in node.bases}
    fields = found["a variable"] = set[str]()
    for name in bases:
        fields |= found[name]
    for _ in range(4):  # the longest line of descent
        for name, above_it in bases.items():
            for base in above_it & set(bases):
                found[name] |= found[base]
    return dict(found)


def prose_of(path: Path) -> Iterator[str]:
    text = text_of(path)
    behind = "\n".join(line.partition("#")[2] for line in text.splitlines())
    if DOTTED.search(behind) or PATH.search(behind):  # few files: to take one apart takes long
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            if token.type == tokenize.COMMENT:
                yield token.string
    for node in definitions_of(path):
        yield ast.get_docstring(node) or ""


def is_there(dotted: str) -> bool:
    known = holders()
    first, second = dotted.split(".")[:2]
    if first == "fuselog" and second not in ("pipeline", "recorders", "replay"):
        return True  # a message, or a group of entry points
    for holder, name in pairwise(dotted.split(".")):
        if holder not in known or name == "NAME":  # a value, whose type is not known here
            return True
        if name not in known[holder]:
            return False
    return True


def variables_of(path: Path) -> set[str]:
    nodes = list(ast.walk(tree_of(path)))
    variables = {node.id for node in nodes if isinstance(node, ast.Name)}
    variables |= {node.arg for node in nodes if isinstance(node, ast.arg)}
    return variables - {node.name for node in nodes if isinstance(node, ast.ClassDef | ast.alias)}


def missing_from(path: Path, text: str) -> list[str]:
    """The names in a text that lead nowhere."""
    missing = [each for each in PATH.findall(text) if not (ROOT / each).exists()]
    if dotted := [each for each in DOTTED.findall(text) if not is_there(each)]:
        variables, fields = variables_of(path), holders()["a variable"]
        missing += [
            each
            for each in dotted
            if not (each.split(".")[0] in variables and each.split(".")[1] in fields)
        ]
    return missing


@pytest.mark.paper
def test_what_is_named_is_there() -> None:
    missing = {str(path): missing_from(path, "\n".join(prose_of(path))) for path in OWN}
    assert not {path: names for path, names in missing.items() if names}


def test_every_attribute_that_is_described_is_one() -> None:
    for path in OWN:
        for node in definitions_of(path):
            if isinstance(node, ast.ClassDef):
                _, _, section = (ast.get_docstring(node) or "").partition("\nAttributes:\n")
                section = section.partition("\n\n")[0]
                for names in re.findall(r"^    (\w[\w, ]*):", section, re.MULTILINE):
                    for name in names.split(", "):
                        assert name in holders()[node.name], f"{path}: {node.name} has no {name}"


@pytest.mark.parametrize(
    "text",
    [
        "see `fuselog.replay.inference.steps.reading`",
        "see `steps.taking_in`",
        "see `Stream.colums`",
        "see replay/inference/steps.py",
    ],
)
def test_what_has_moved_is_found(text: str) -> None:
    assert missing_from(Path("replay/inference/run/recursion.py"), text)
