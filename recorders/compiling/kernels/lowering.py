"""Lowering of a function: its source is traversed once and written as LLVM IR.

Statements are lowered here, expressions in `expressions`. A name that is assigned only once, before all
of its uses, is replaced by its value; other names are variables in memory, which LLVM turns into
registers. Known values are evaluated: only the branch that is taken is lowered if the condition of an
`if` is known, and a loop over a tuple is unrolled.
"""

import ast
import operator
from collections.abc import Iterator, Sequence
from types import FunctionType
from typing import NamedTuple

from fuselog.recorders.compiling.kernels.arguments import KNOWN
from fuselog.recorders.compiling.kernels.frame import Frame, Wider, common_value, unsure
from fuselog.recorders.compiling.kernels.numbers import (
    REAL,
    WHOLE,
    Emitter,
    Number,
    binary,
    compare,
    constant,
    is_row,
    is_static,
    kind_of,
)
from fuselog.recorders.compiling.kernels.program import DoesNotCompile, Program
from fuselog.recorders.compiling.kernels.values import (
    Array,
    at_run_time,
    entries,
    is_local,
    load,
    part_of,
    row_kind,
    signature,
    store,
)
from fuselog.recorders.compiling.kinds import Value

_LEAST = 8  # numbers of a row that is copied as a whole


class _Loop(NamedTuple):
    """The targets of `break` and `continue` in a loop."""

    end: str
    next: str


def lower(program: Program, function: FunctionType, arguments: list[Value]) -> tuple[Emitter, Value]:
    """Lower a function for these arguments; return its body and its result."""
    kinds: dict[str, str] = {}
    while True:
        lowering = _Lowering(program, function, arguments, kinds)
        try:
            return lowering.emitter, lowering.body()
        except Wider:
            continue
        except DoesNotCompile:
            raise
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise DoesNotCompile(
                f"{function.__qualname__} does not compile ({lowering.place_in_source()}): {reason}"
            ) from error


class _Lowering(Frame):
    """The lowering of one function's body, for arguments of given kinds."""

    def __init__(
        self, program: Program, function: FunctionType, arguments: list[Value], kinds: dict[str, str]
    ) -> None:
        self._loops: list[_Loop] = []
        self._depth = 0  # depth of nested branches and loops, which may not be executed
        self._returned: Value = None
        self._exit = ""
        super().__init__(program, function, arguments, kinds)

    def body(self) -> Value:
        """Lower the whole body; return the function's result."""
        self.statements(self.definition.body)
        if self._exit:
            if not self.ended:
                if signature(self._returned) != signature(None):
                    raise TypeError("not every path through it returns a value")
                self.go(self._exit)
            self.begin(self._exit)
            return self.read(self._returned)
        return self._returned

    # --- statements ---

    def statements(self, body: Sequence[ast.stmt]) -> None:
        """Lower statements up to the first that ends the block, such as `return`."""
        for statement in body:
            if self.ended:
                return
            self.line = statement.lineno
            getattr(self, f"do_{type(statement).__name__}", self.refuse)(statement)

    def refuse(self, statement: ast.stmt) -> None:
        """Raise TypeError for statements that kernels do not support."""
        raise TypeError(f"a kernel has no {type(statement).__name__.lower()} statements")

    def do_Pass(self, _: ast.Pass) -> None:  # noqa: N802
        """Do nothing."""

    def do_Expr(self, statement: ast.Expr) -> None:  # noqa: N802
        """Lower a call, and ignore a docstring."""
        if not isinstance(statement.value, ast.Constant):
            self.value(statement.value)

    def do_Assign(self, statement: ast.Assign) -> None:  # noqa: N802
        """Lower `a = b = value`."""
        value = self.value(statement.value)
        for target in statement.targets:
            self.give(target, value)

    def do_AnnAssign(self, statement: ast.AnnAssign) -> None:  # noqa: N802
        """Lower `a: type = value`."""
        if statement.value is not None:
            self.give(statement.target, self.value(statement.value))

    def do_AugAssign(self, statement: ast.AugAssign) -> None:  # noqa: N802
        """Lower `a += value` for a name or an array element; the element is located only once."""
        target = statement.target
        if isinstance(target, ast.Subscript):
            place = self.element(target)
            found = self.operation(statement.op, load(self.emitter, place), self.value(statement.value))
            store(self.emitter, place, found)
        else:
            found = self.operation(statement.op, self.value(target), self.value(statement.value))
            self.give(target, found)

    def give(self, target: ast.expr, value: Value) -> None:
        """Assign to one or several names, or to a part of an array."""
        if isinstance(target, ast.Name):
            self.assign(target.id, value)
        elif isinstance(target, ast.Tuple):
            parts = entries(value)
            if parts is None or len(parts) != len(target.elts):
                raise TypeError(
                    f"{len(target.elts)} names for {'a number' if parts is None else len(parts)}"
                )
            for each, part in zip(target.elts, parts, strict=True):
                self.give(each, part)
        elif isinstance(target, ast.Subscript):
            place = self.element(target)
            if place.shape:
                self.fill(place, value)
            else:
                store(self.emitter, place, value)
        else:
            raise TypeError("only names and parts of arrays can be assigned to")

    def fill(self, place: Array, value: Value) -> None:
        """Assign a number, or an array of the same shape, to every element of an array."""

        def write(index: Number) -> None:
            part = part_of(self.emitter, place, (index,))
            source = part_of(self.emitter, value, (index,)) if isinstance(value, Array) else value
            if part.shape:
                self.fill(part, source)
            else:
                store(
                    self.emitter,
                    part,
                    load(self.emitter, source) if isinstance(source, Array) else source,
                )

        is_copied = row_kind(value) != "" and _LEAST <= int(value.shape[0]) <= KNOWN
        if row_kind(place) and (is_copied or (isinstance(value, Number) and is_row(value.kind))):
            store(self.emitter, place, self.scalar(value))
            return
        size = place.shape[0]
        stop = constant(size) if isinstance(size, int) else Number(WHOLE, size)
        for index in self.counted(constant(0), stop, 1):
            write(index)

    def do_Return(self, statement: ast.Return) -> None:  # noqa: N802
        """Lower `return`: in a branch, its value is kept in memory; elsewhere, it may stay known."""
        value = None if statement.value is None else self.value(statement.value)
        if is_local(value):
            raise TypeError("it returns an array that it created; pass it an array to fill")
        if self._depth == 0 and not self._exit:
            self._returned, self.ended = value, True
            return
        value = self.widened("what is returned", unsure(at_run_time(value)))
        if not self._exit:
            self._exit = self.label("exit")
            self._returned = self.place(value)
        else:
            value = self.converted("what is returned", value, self._returned)
        self.write(self._returned, value)
        self.go(self._exit)

    def do_If(self, statement: ast.If) -> None:  # noqa: N802
        """Lower both branches, or only the one that is known to be taken."""
        condition = self.truth(self.value(statement.test))
        if not isinstance(condition, Number):
            self.statements(statement.body if condition else statement.orelse)
            return
        yes, no, after = (self.label(name) for name in ("then", "else", "after"))
        self.branch(condition, yes, no)
        self._depth += 1
        is_reached = False
        for label, body in ((yes, statement.body), (no, statement.orelse)):
            self.begin(label)
            self.statements(body)
            if not self.ended:
                self.go(after)
                is_reached = True
        self._depth -= 1
        if is_reached:
            self.begin(after)

    def do_While(self, statement: ast.While) -> None:  # noqa: N802
        """Lower a `while` loop, whose condition is tested at its head."""
        head, body, after = (self.label(name) for name in ("while", "body", "after"))
        self.go(head)
        self.begin(head)
        condition = self.truth(self.value(statement.test))
        is_endless = not isinstance(condition, Number) and bool(condition)
        if is_endless:
            self.go(body)
        else:
            self.branch(self.emitter.truth(condition), body, after)
        self.begin(body)
        self.inside(statement.body, _Loop(after, head), head)
        self.begin(after)
        if is_endless and not any(isinstance(each, ast.Break) for each in ast.walk(statement)):
            self.emitter.add("unreachable")
            self.ended = True

    def inside(self, body: Sequence[ast.stmt], loop: _Loop, then: str) -> None:
        """Lower the statements in the body of a loop; after them, the loop continues at `then`."""
        self._loops.append(loop)
        self._depth += 1
        self.statements(body)
        if not self.ended:
            self.go(then)
        self._depth -= 1
        self._loops.pop()

    def do_Break(self, _: ast.Break) -> None:  # noqa: N802
        """Jump to the end of the loop."""
        self.go(self._loops[-1].end)

    def do_Continue(self, _: ast.Continue) -> None:  # noqa: N802
        """Jump to the next iteration of the loop."""
        self.go(self._loops[-1].next)

    def do_For(self, statement: ast.For) -> None:  # noqa: N802
        """Lower a loop over a range of numbers, or unroll one over known values."""
        call = statement.iter
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "range":
            bounds = [self.value(each) for each in call.args]
            if any(kind_of(each) == REAL for each in bounds):
                raise TypeError(f"{ast.unparse(call)} accepts only integers; convert them with int()")
            start, stop = (0, bounds[0]) if len(bounds) == 1 else bounds[:2]
            step = bounds[2] if len(bounds) == 3 else 1
            first, end = (self.emitter.as_kind(each, WHOLE) for each in (start, stop))
            for index in self.counted(first, end, step):
                self.give(statement.target, index)
                self.statements(statement.body)
            return
        after = self.label("after")
        for each in self.iterated(call):
            following = self.label("next")
            self.give(statement.target, each)
            self.inside(statement.body, _Loop(after, following), following)
            self.begin(following)
        self.go(after)
        self.begin(after)

    def counted(self, start: Number, stop: Number, step: int) -> Iterator[Number]:
        """Write the head of a counted loop, yield its index once for the body, and write its end."""
        if not is_static(step) or step == 0:
            raise TypeError("the step of a range has to be a known number")
        head, inner, following, after = (self.label(name) for name in ("for", "body", "next", "after"))
        place = self.place(start)
        self.write(place, start)
        self.go(head)
        self.begin(head)
        index = self.read(place)._replace(natural=start.natural and step > 0)
        compared = compare(self.emitter, operator.lt if step > 0 else operator.gt, index, stop)
        self.branch(compared, inner, after)
        self.begin(inner)
        self._loops.append(_Loop(after, following))
        self._depth += 1
        yield index
        if not self.ended:
            self.go(following)
        self._depth -= 1
        self._loops.pop()
        self.begin(following)
        self.write(place, binary(self.emitter, operator.add, self.read(place), step))
        self.go(head)
        self.begin(after)

    def chosen(self, condition: Number, yes: ast.expr, no: ast.expr) -> Value:
        """Lower `yes if condition else no`, so that only one of the two is evaluated."""
        labels, after, before = (
            (self.label("then"), self.label("else")),
            self.label("after"),
            self.emitter.lines,
        )
        values, blocks = [], []
        for label, expression in zip(labels, (yes, no), strict=True):
            self.emitter.lines = []
            self.begin(label)
            values.append(unsure(at_run_time(self.value(expression))))
            blocks.append(self.emitter.lines)
        place = self.place(common_value(*values))
        self.emitter.lines = before
        self.branch(condition, *labels)
        for value, block in zip(values, blocks, strict=True):
            self.emitter.lines = block
            self.write(place, self.converted("one side of a choice", value, place))
            self.go(after)
            before += block
        self.emitter.lines = before
        self.begin(after)
        return self.read(place)
