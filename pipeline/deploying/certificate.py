"""What a step of a filter in C costs: operations, counted in its graphs, and memory, by the compiler."""

import json
import operator
import re
import shutil
import subprocess
from collections.abc import Collection, Mapping
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from pipeline.deploying.c_source.names import CFilter
from replay.inference.kalman.iterated_update import ITERATIONS
from replay.inference.linear_algebra.covariances import COVARIANCES
from replay.inference.linear_algebra.gaussian import (
    Innovation,
    add_through,
    downdate,
    inflate,
    kalman_step,
    whiten,
)
from replay.inference.linear_algebra.manifold import by_right_jacobian
from replay.inference.linear_algebra.sparse import (
    measuring_covariance,
    pattern_of,
    propagating_covariance,
)
from replay.inference.model.corrections import sloping
from replay.inference.whole_steps import Step
from replay.tracing.functions import Argument, Shape, trace
from replay.tracing.graph import CONSTANT, INPUT, POWER, SELECT, Graph, Node, needed

CERTIFICATE = "certificate.json"
OPTIONS = ("-std=c99", "-O2", "-ffp-contract=off")
_FLOPS = (operator.add, operator.sub, operator.mul, operator.truediv)
_FREE = (
    *(CONSTANT, INPUT, SELECT),
    *(operator.neg, operator.not_, operator.and_, operator.or_, operator.xor),
    *(operator.lt, operator.le, operator.gt, operator.ge, operator.eq, operator.ne),
    *(np.absolute, np.isnan, np.isfinite, np.isinf, np.signbit, np.sign, np.fmin, np.fmax),
)


class Cost(NamedTuple):
    """Holds what a step costs at most: both sides of every condition count, and every iterate.

    Attributes:
        flops: additions, subtractions, multiplications and divisions.
        roots: square roots.
        calls: of libm's other functions, such as sin and fmod.
    """

    flops: int
    roots: int
    calls: int


NOTHING = Cost(0, 0, 0)


class Memory(NamedTuple):
    """Holds what a compiler makes of a filter.

    Attributes:
        compiler: its name, version and target.
        text: bytes of code and constants.
        stack: bytes that the deepest chain of calls takes, without libm's own.
    """

    compiler: str
    text: int
    stack: int


class Certificate(NamedTuple):
    """Holds what a filter costs.

    Attributes:
        steps: the cost of the functions of the C, by name.
        worst: of a prediction and the costliest update after it.
        dense, sparse: flops of the products F P F', P H' and H P H' of all steps, with all entries of F
            and H, and without those that are known to be zero or one.
        memory: None without a compiler that tells it.
    """

    steps: Mapping[str, Cost]
    worst: Cost
    dense: int
    sparse: int
    memory: Memory | None


def certificate_of(made: CFilter, source: str, header: str) -> Certificate:
    """Count what a filter costs, and have its C compiled where there is a compiler.

    Args:
        made: the filter.
        source: its C.
        header: its header.
    """
    t, predict, correct = made.tangent, made.steps.predict, _correction(made)
    products = [_products(predict, "F", t, t)]
    steps = {"predict": _sum(_cost_of_step(predict), products[0][1], _entering(predict, t))}
    for row, ((name, sensor), step) in enumerate(zip(made.sensors, made.steps.innovate, strict=True)):
        m, robust = len(sensor.measured), {**made.robustness(row + 1), "reopens_s": np.nan}
        algebra = _algebra(m, t, any(value == value for value in robust.values()))
        products.append(_products(step, "H", m, t))
        own = _sum(_cost_of_step(step), products[-1][1], _entering(step, m))
        times = ITERATIONS if made.steps.is_iterated else 1
        steps[f"update_{name}"] = _sum(*[own, algebra] * times, correct)
    updates = [cost for name, cost in steps.items() if name != "predict"]
    worst = _sum(steps["predict"], max(updates, default=NOTHING))
    dense, sparse = (sum(each[place].flops for each in products) for place in (0, 1))
    return Certificate(steps, worst, dense, sparse, _memory(made.name, source, header))


def certificate_text(made: CFilter, certificate: Certificate) -> str:
    """Write certificate.json."""
    memory = certificate.memory
    text = {
        "filter": made.name,
        "digest": made.digest,
        "steps": {name: cost._asdict() for name, cost in certificate.steps.items()},
        "worst": certificate.worst._asdict(),
        "products": {"dense_flops": certificate.dense, "flops": certificate.sparse},
        "memory": None if memory is None else memory._asdict(),
    }
    return json.dumps(text, indent=2) + "\n"


def _cost_of_step(step: Step) -> Cost:
    return _cost([*step.outputs.values(), *step.conditions])


def _cost(outputs: Collection[Node]) -> Cost:
    flops = roots = calls = 0
    for node in needed(outputs):
        if node.operation in _FLOPS:
            flops += 1
        elif node.operation is POWER:
            flops += abs(node.value).bit_length() + abs(node.value).bit_count() - 2 + (node.value < 0)
        elif node.operation is np.sqrt:
            roots += 1
        elif node.operation is np.sinc:  # sin(pi x) / (pi x)
            flops, calls = flops + 2, calls + 1
        elif node.operation not in _FREE:
            calls += 1
    return Cost(flops, roots, calls)


def _sum(*costs: Cost) -> Cost:
    return Cost(*(sum(each) for each in zip(*costs, strict=True)))


def _traced(function: Any, *arguments: Argument) -> Cost:
    result = trace(Graph(), function, arguments)
    return _cost([*result.returned, *(node for _, _, node in result.written)])


@cache
def _algebra(m: int, t: int, is_robust: bool) -> Cost:
    """The cost of the update behind an innovation of m components, for t of the tangent space."""

    def update(v: Any, spread: Any, cross: Any, covariance: Any, factor: Any) -> Any:
        innovation, step = Innovation(v, spread, cross), np.empty(t, object)
        squared, _ = whiten(innovation, m)
        if is_robust:
            inflate(innovation, m, factor)
        kalman_step(innovation, m, step)
        downdate(covariance, cross, m)
        return squared, *step

    return _traced(update, Shape((m,)), Shape((m, m)), Shape((t, m)), Shape((t, t)), None)


def _products(step: Step, jacobian: str, rows: int, t: int) -> tuple[Cost, Cost]:
    """The cost of products with a Jacobian: with all its entries, and without those that are known."""
    if not step.has(jacobian):
        return NOTHING, NOTHING
    known = {
        (place[0], place[1]): node.value if node.is_constant else None
        for (name, place), node in step.outputs.items()
        if name == jacobian
    }
    patterns = None, pattern_of(known, rows)
    square = Shape((t, t))
    if jacobian == "F":
        first, last = (_traced(propagating_covariance(each), *(square,) * 4) for each in patterns)
    else:
        sizes = square, Shape((rows, t)), Shape((t, rows)), Shape((rows, rows))
        first, last = (_traced(measuring_covariance(each), *sizes) for each in patterns)
    return first, last


def _entering(step: Step, size: int) -> Cost:
    """The cost of noise that enters through a gain."""
    gains = sum(name == "u" for name, _ in step.outputs)
    if not gains:
        return NOTHING
    return _traced(add_through, Shape((size, size)), Shape((size, gains)), Shape((gains,)))


def _correction(made: CFilter) -> Cost:
    model, step = made.filtering.stage.model, made.steps.correct
    kinds, square = model.kinds, Shape((made.tangent, made.tangent))
    mean, vector = Shape((model.size,)), Shape((made.tangent,))
    own = _sum(_cost_of_step(step), _products(step, "F", made.tangent, made.tangent)[1])
    if model.correct is not None:
        return _sum(own, _traced(sloping(kinds, model.correct), mean, square, vector))
    return _sum(own, _traced(partial(COVARIANCES.turn, by_right_jacobian(kinds)), vector, square))


def _memory(name: str, source: str, header: str) -> Memory | None:
    """Compile a filter; None without a GCC that tells what its functions call and need (10 or newer)."""
    compiler = shutil.which("gcc")
    if compiler is None:
        return None
    with TemporaryDirectory() as place:
        folder = Path(place)
        (folder / f"{name}.c").write_text(source, encoding="utf-8")
        (folder / f"{name}.h").write_text(header, encoding="utf-8")

        def said(*command: str) -> str:
            return subprocess.run(
                command, cwd=folder, capture_output=True, text=True, check=True, encoding="utf-8"
            ).stdout

        try:
            said(compiler, *OPTIONS, "-fcallgraph-info=su", "-c", f"{name}.c")
            version, target = said(compiler, "-dumpfullversion"), said(compiler, "-dumpmachine")
            sizes = said("size", f"{name}.o").splitlines()[1].split()
            calls = next(folder.glob("*.ci")).read_text(encoding="utf-8")
        except (OSError, subprocess.CalledProcessError, IndexError, StopIteration):
            return None
    return Memory(f"gcc {version.strip()} for {target.strip()}", int(sizes[0]), deepest_stack(calls))


def deepest_stack(calls: str) -> int:
    """Find how many bytes the deepest chain of calls takes.

    Args:
        calls: a call graph with stack usage, as GCC writes it (`-fcallgraph-info=su`). What is called
            and not compiled with it, as libm's functions, counts nothing.
    """
    own = {
        name: int(size)
        for name, size in re.findall(r'node: { title: "([^"]+)" label: "[^"]*?(\d+) bytes', calls)
    }
    edges = set(re.findall(r'edge: { sourcename: "([^"]+)" targetname: "([^"]+)"', calls))

    @cache
    def depth(name: str) -> int:
        below = [depth(called) for caller, called in edges if caller == name and called in own]
        return own[name] + max(below, default=0)

    return max(map(depth, own), default=0)
