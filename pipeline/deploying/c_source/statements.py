"""The names, declarations and loops that make up the functions of a filter in C."""

from collections.abc import Iterable
from typing import Any, NamedTuple

from fuselog.pipeline.deploying.c_source.names import CFilter, identifier
from fuselog.replay.inference.linear_algebra.manifold import is_flat, manifold_blocks
from fuselog.replay.inference.step_graphs import Step
from fuselog.replay.tracing.graph import INPUT, Node, needed


class Inputs:
    """The C names of a step's inputs, with declarations of the inputs that the step uses."""

    def __init__(self, made: CFilter, part: str) -> None:
        model = made.filtering.bound_model.model
        self.state = [identifier(name) for name in model.state]
        self.controls = [identifier(name) for name in made.controls]
        self.part, self.made = part, made

    def names(self, step: Step, *arrays: str) -> tuple[dict[Any, str], list[str]]:
        """Return the C name of each input, and the lines that declare these names.

        Args:
            step: the step.
            arrays: C names of the arguments after mean and covariance; "" for an unused argument.
        """
        names: dict[Any, str] = {}
        lines: dict[str, str] = {}
        nodes = needed([*step.outputs.values()])
        real = self.made.precision.real
        for node in nodes:
            if node.operation is not INPUT:
                continue
            argument, place = node.value
            declared = ""
            if argument == 0:
                name = self.state[place[0]]
                declared = f"filter->mean[{self.made.name.upper()}_{name.upper()}]"
            elif isinstance(place, str):
                name = identifier(place)
                name = f"{name}_" if name in (*self.state, *self.controls) else name
                declared = f"parameters->{self.part}.{identifier(place)}"
            elif place is None:
                name = "duration_s"
            elif arrays[argument - 2] == "control":
                name = self.controls[place[0]]
                declared = f"filter->control[{self.made.name.upper()}_CONTROL_{name.upper()}]"
            else:
                name = f"{arrays[argument - 2]}[{place[0]}]"
            names[node.value] = name
            if declared:
                lines[name] = f"const {real} {name} = {declared};"
        return names, list(lines.values())


def moved_state(made: CFilter, step: Step) -> tuple[dict[str, Node], list[str]]:
    """Name the components of the mean after a step, and write the assignments."""
    state = [identifier(name) for name in made.filtering.bound_model.model.state]
    named: dict[str, Node] = {}
    lines: list[str] = []
    for (array, place), node in step.outputs.items():
        if array == "mean":
            name = f"next_{state[place[0]]}"
            named[name] = node
            lines.append(f"filter->mean[{made.name.upper()}_{state[place[0]].upper()}] = {name};")
    return named, lines


class Loops(NamedTuple):
    """Calls of loops, with the declarations and the results of the graph that these calls need."""

    declared: list[str]
    named: dict[str, Node]
    calls: list[str]


def jacobian_loops(step: Step, jacobian: str, rows: int, multiply: str, into: str, what: str) -> Loops:
    """Write the products with a step's Jacobian, and the addition of the step's noise.

    Args:
        step: a step that returns the Jacobian and the noise, which is either gains G of variances u, or
            a covariance N.
        jacobian: the name of the Jacobian, F or H.
        rows: its number of rows.
        multiply: the call that forms the product.
        into: the matrix that receives the product.
        what: `states` or `components`, for the size of that matrix.
    """
    size = "T" if what == "states" else "M"
    columns = columns_text(f"columns_of_{jacobian}", step.columns(jacobian, rows), size)
    noise = noise_loops(step, rows, into, what)
    return Loops(
        [columns, f"REAL {jacobian}[{size}][T];", *noise.declared],
        entries(step, jacobian) | noise.named,
        [multiply, *noise.calls],
    )


def noise_loops(step: Step, rows: int, into: str, what: str) -> Loops:
    """Write the sum of a matrix and a step's noise, defined by G, u and N; see `jacobian_loops`."""
    size = "T" if what == "states" else "M"
    declared: list[str] = []
    named: dict[str, Node] = {}
    calls: list[str] = []
    gains = count_gains(step)
    if gains:
        declared.append(f"REAL G[{size}][GAINS] = {{{{0}}}}, u[GAINS];")
        named |= entries(step, "G") | entries(step, "u")
        calls.append(f"add_through_{what}({into}, {rows}, (const REAL(*)[GAINS])G, u, {gains});")
    for (array, (row, *column)), node in step.outputs.items():
        if array == "N" and row >= column[0]:
            name = f"noise_{row}_{column[0]}"
            named[name] = node
            calls.append(f"{into}[{row}][{column[0]}] += {name};")
            if row > column[0]:
                calls.append(f"{into}[{column[0]}][{row}] = {into}[{row}][{column[0]}];")
    return Loops(declared, named, calls)


def columns_text(name: str, columns: list[list[int]], size: str) -> str:
    """Write the table that lists columns row by row; see covariance.c."""
    rows = ", ".join("{" + ", ".join(map(str, [*row, -1])) + "}" for row in columns)
    return f"static const signed char {name}[{size}][T + 1] = {{{rows}}};"


def entries(step: Step, array: str) -> dict[str, Node]:
    """Return the C names of the entries of an array that a step returns."""
    return {
        array + "".join(f"[{each}]" for each in place): node
        for (name, place), node in step.outputs.items()
        if name == array
    }


def count_gains(step: Step) -> int:
    """Count the independent noises of a step."""
    return sum(name == "u" for name, _ in step.outputs)


def turned_axes(made: CFilter) -> list[int]:
    """List the first axis of each orientation whose correction also rotates the covariance."""
    model = made.filtering.bound_model.model
    blocks = manifold_blocks(model.kinds) if made.sensors and model.correct is None else ()
    return [tangent for kind, _, tangent, _ in blocks if kind == "quaternion"]


def retriangulates(made: CFilter) -> bool:
    """Test whether a correction rotates the covariance, which makes its factor non-triangular."""
    model = made.filtering.bound_model.model
    return bool(made.sensors) and model.correct is None and not is_flat(model.kinds)


def body(lines: Iterable[str]) -> str:
    """Indent the lines of a function."""
    return "".join(f"    {each}\n" for each in lines)
