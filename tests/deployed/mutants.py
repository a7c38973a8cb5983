"""Plants errors of one character in a deployed filter, and asks its own test whether it notices them."""

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tests.deployed.building import COMPILERS

SWAPPED = {"+": "-", "-": "+", "*": "/", "/": "*", "<": ">", ">": "<"}
_FUNCTION = re.compile(r"^(?:static )?\w+ (\w+)\([^{};]*\)\n\{\n(.*?)^\}", re.DOTALL | re.MULTILINE)
_OPERATOR = re.compile(r"(?<= )[-+*/<>](?= |= )|(?<=[ (])-(?=\w)")


# What a log of the robot cannot show: half a turn more or less before a modulo, guards of a range of
# zero, a covariance of components that is zero in it, and in the derivative of sinc terms below rounding
# and the side of large angles.
_SAME = re.compile(
    r"modulo\(v\d [-+]|INFINITY [*/]|[-+] v4 [-+]|[-+] \(v2 <= 0\.0|[-+]= noise_1_0;"
    r"|/ 28\.0 \* \(1\.0 - v10 \* v10 / 54\.0|\(cos\(v10\) - v5\) / v4"
)
# every parameter of the robot differs from zero and one, so that each of its operators counts
ROBOT = {
    "bias_range_m": 0.01,
    "bias_bearing_rad": 0.001,
    "lever_x_m": 0.02,
    "lever_y_m": -0.01,
    "turn_bias_radps": 0.001,
    "forward_scale": 1.01,
    "turn_scale": 0.99,
    "gate_reopens_s": 1.0,
}


class Mutant(NamedTuple):
    """Holds a filter with one character changed.

    Attributes:
        function: where.
        line: the line before and after.
        text: the source.
    """

    function: str
    line: tuple[str, str]
    text: str


def _blanked(code: str) -> str:
    """Blank what is no code, in its place."""
    return re.sub(
        r"/\*.*?\*/|^ *static const .*$", lambda it: " " * len(it[0]), code, flags=re.MULTILINE
    )


def mutants_of(text: str) -> Iterator[Mutant]:
    """Iterate over the mutants of a filter's predictions, updates and gate."""
    for function in _FUNCTION.finditer(text):
        name = function[1]
        if not re.search(r"_predict$|_update_|^(update|correct|is_used|linearise_\w+)$", name):
            continue
        code = _blanked(function[2])
        for found in _OPERATOR.finditer(code):
            at = function.start(2) + found.start()
            mutated = text[:at] + SWAPPED[text[at]] + text[at + 1 :]
            begin, end = text.rfind("\n", 0, at) + 1, text.find("\n", at)
            if not any(it.start() <= at - begin < it.end() for it in _SAME.finditer(text[begin:end])):
                yield Mutant(name, (text[begin:end].strip(), mutated[begin:end].strip()), mutated)


def survivors(folder: Path, mutants: list[Mutant]) -> list[Mutant]:
    """Build a filter's test with each mutant; return those that it does not notice."""
    [test] = folder.glob("test_*.c")
    compiler = [COMPILERS[0], "-std=c99", "-O0", "-ffp-contract=off", "-w", f"-I{folder}"]
    built, program, mutated = folder / "test.o", folder / "mutant", folder / "mutant.c"
    subprocess.run([*compiler, "-c", test, "-o", built], check=True)
    missed = []
    for each in mutants:
        mutated.write_text(each.text, encoding="utf-8")
        subprocess.run([*compiler, mutated, built, "-lm", "-o", program], check=True)
        said = subprocess.run([program], capture_output=True, timeout=20, check=False)
        if said.returncode == 0:
            missed.append(each)
    return missed
