"""Goes through a function's source once and writes what it does as LLVM's text.

Statements are here, expressions in `expressions`. A name that gets one value before all its uses is that
value; any other is a place in memory, of which LLVM makes registers. What is known already is worked
out: an `if` of it takes one side, a loop over a tuple is written out.
"""

import ast
import operator
from collections.abc import Iterator, Sequence
from types import FunctionType
from typing import Any, NamedTuple

from replay.engine.compiling.kernels.expressions import Expressions
from replay.engine.compiling.kernels.numbers import (
    WHOLE,
    Emitter,
    Number,
    binary,
    common_kind,
    compare,
    constant,
    is_static,
)
from replay.engine.compiling.kernels.program import DoesNotCompile, Program, definition_of
from replay.engine.compiling.kernels.values import (
    Array,
    Record,
    at_run_time,
    entries,
    is_local,
    leaves,
    load,
    part_of,
    rebuilt,
    signature,
    store,
)
from replay.engine.compiling.kernels.variables import placed_names


class _Wider(Exception):
    """A variable has to hold numbers of another kind than its first value."""


class _Loop(NamedTuple):
    """Where `break` and `continue` of a loop lead."""

    end: str
    next: str


def lower(program: Program, function: FunctionType, arguments: list[Any]) -> tuple[Emitter, Any]:
    """The body of a function for these arguments, and what it returns."""
    kinds: dict[str, str] = {}
    while True:
        lowering = _Lowering(program, function, arguments, kinds)
        try:
            return lowering.emitter, lowering.body()
        except _Wider:
            continue
        except DoesNotCompile:
            raise
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
            raise DoesNotCompile(
                f"{function.__qualname__} does not compile ({lowering.place_in_source()}): {reason}"
            ) from error


class _Lowering(Expressions):
    def __init__(
        self, program: Program, function: FunctionType, arguments: list[Any], kinds: dict[str, str]
    ) -> None:
        definition, _, _ = definition_of(function)
        names = [each.arg for each in (*definition.args.posonlyargs, *definition.args.args)]
        rest = definition.args.vararg
        super().__init__(program, function)
        if rest is not None:
            names, arguments = (
                [*names, rest.arg],
                [*arguments[: len(names)], tuple(arguments[len(names) :])],
            )
        self.known.update(zip(names, arguments, strict=True))
        self.definition = definition
        self._kinds = kinds
        self._placed = placed_names(definition)
        self._places: dict[str, Any] = {}
        self._loops: list[_Loop] = []
        self._ended = False
        self._depth = 0  # of branches and loops that may not be run
        self._returned: Any = None
        self._exit = ""
        for name in names:
            if name in self._placed:
                self.assign(name, self.known.pop(name))

    def body(self) -> Any:
        """Lower all of it; what it returns."""
        self.statements(self.definition.body)
        if self._exit:
            if not self._ended:
                if signature(self._returned) != signature(None):
                    raise TypeError("not every way through it returns something")
                self.go(self._exit)
            self.begin(self._exit)
            return self.read(self._returned)
        return self._returned

    # --- blocks ---

    def go(self, label: str) -> None:
        """End a block by going on elsewhere."""
        self.emitter.add(f"br label %{label}")
        self._ended = True

    def begin(self, label: str) -> None:
        """Begin a block."""
        self.emitter.lines.append(f"{label}:")
        self._ended = False

    def branch(self, condition: Number, yes: str, no: str) -> None:
        """End a block by going on at one of two."""
        self.emitter.add(f"br i1 {condition.code}, label %{yes}, label %{no}")
        self._ended = True

    # --- places in memory ---

    def place(self, value: Any) -> Any:
        """A place for values like this one: its leaves are addresses."""
        return rebuilt(value, iter([self.emitter.memory(kind) for kind, _ in leaves(value)]))

    def write(self, place: Any, value: Any) -> None:
        """Write a value to a place for it."""
        for (kind, code), (_, address) in zip(leaves(value), leaves(place), strict=True):
            self.emitter.add(f"store {kind} {code}, ptr {address}")

    def read(self, place: Any) -> Any:
        """The value at a place."""
        names = []
        for kind, address in leaves(place):
            names.append(self.emitter.fresh())
            self.emitter.add(f"{names[-1]} = load {kind}, ptr {address}")
        return rebuilt(place, iter(names))

    def assign(self, name: str, value: Any) -> None:
        """Give a name a value."""
        if name not in self._placed:
            self.known[name] = value
            return
        value = self.fitting(name, value)
        if name not in self._places:
            self._places[name] = self.place(value)
        self.write(self._places[name], value)

    def fitting(self, name: str, value: Any) -> Any:
        """The value as one that its place holds; raises `_Wider` where the place has to be another."""
        value = self.widened(name, _unsure(at_run_time(value)))
        if name in self._places:
            value = self.converted(name, value, self._places[name])
        return value

    def widened(self, name: str, value: Any) -> Any:
        """The value with the kinds of numbers that its place was found to need."""
        if isinstance(value, Number):
            kind = self._kinds.get(name, value.kind)
            return self.emitter.as_kind(value, common_kind(value, Number(kind, "")))
        parts = entries(value)
        if parts is None:
            return value
        made = tuple(self.widened(f"{name}[{place}]", each) for place, each in enumerate(parts))
        return Record(value.type, made) if isinstance(value, Record) else made

    def converted(self, name: str, value: Any, place: Any) -> Any:
        """A number, or a tuple's numbers, as those of the place; `_Wider` where it cannot hold them."""
        if signature(value) == signature(place):
            return value
        if isinstance(value, Number) and isinstance(place, Number):
            kind = common_kind(place, value)
            if kind != place.kind:
                self._kinds[name] = kind
                raise _Wider
            return self.emitter.as_kind(value, kind)
        parts, places = entries(value), entries(place)
        if parts is None or places is None or len(parts) != len(places):
            if isinstance(value, Array) and isinstance(place, Array):
                raise TypeError(f"{name} is an array of another shape, or another layout, than before")
            raise TypeError(
                f"{name} is a {type(value).__name__} here and a {type(place).__name__} before"
            )
        made = tuple(
            self.converted(f"{name}[{at}]", *both)
            for at, both in enumerate(zip(parts, places, strict=True))
        )
        return rebuilt(place, iter([code for each in made for _, code in leaves(each)]))

    def lookup(self, name: str) -> Any:
        """What a name stands for."""
        if name in self._places:
            return self.read(self._places[name])
        return super().lookup(name)

    # --- statements ---

    def statements(self, body: Sequence[ast.stmt]) -> None:
        """Lower statements up to the one after which none is run."""
        for statement in body:
            if self._ended:
                return
            self.line = statement.lineno
            getattr(self, f"do_{type(statement).__name__}", self.refuse)(statement)

    def refuse(self, statement: ast.stmt) -> None:
        """Say that there are no such statements in kernels."""
        raise TypeError(f"a kernel has no {type(statement).__name__.lower()} statements")

    def do_Pass(self, _: ast.Pass) -> None:  # noqa: N802
        """Do nothing."""

    def do_Expr(self, statement: ast.Expr) -> None:  # noqa: N802
        """A call, or a docstring."""
        if not isinstance(statement.value, ast.Constant):
            self.value(statement.value)

    def do_Assign(self, statement: ast.Assign) -> None:  # noqa: N802
        """`a = b = value`."""
        value = self.value(statement.value)
        for target in statement.targets:
            self.give(target, value)

    def do_AnnAssign(self, statement: ast.AnnAssign) -> None:  # noqa: N802
        """`a: type = value`."""
        if statement.value is not None:
            self.give(statement.target, self.value(statement.value))

    def do_AugAssign(self, statement: ast.AugAssign) -> None:  # noqa: N802
        """`a += value`, of a name, or of a place in an array, which is found once."""
        target = statement.target
        if isinstance(target, ast.Subscript):
            place = self.element(target)
            found = self.operation(statement.op, load(self.emitter, place), self.value(statement.value))
            store(self.emitter, place, found)
        else:
            found = self.operation(statement.op, self.value(target), self.value(statement.value))
            self.give(target, found)

    def give(self, target: ast.expr, value: Any) -> None:
        """Assign to a name, names, or a part of an array."""
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

    def fill(self, place: Array, value: Any) -> None:
        """Write a number, or an array of the same shape, to every place of an array."""

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

        size = place.shape[0]
        stop = constant(size) if isinstance(size, int) else Number(WHOLE, size)
        for index in self.counted(constant(0), stop, 1):
            write(index)

    def do_Return(self, statement: ast.Return) -> None:  # noqa: N802
        """Where no branch is open, what is returned may be known; else all of it is a place."""
        value = None if statement.value is None else self.value(statement.value)
        if is_local(value):
            raise TypeError("it returns an array that it has made; pass one that it fills")
        if self._depth == 0 and not self._exit:
            self._returned, self._ended = value, True
            return
        value = self.widened("what is returned", _unsure(at_run_time(value)))
        if not self._exit:
            self._exit = self.label("exit")
            self._returned = self.place(value)
        else:
            value = self.converted("what is returned", value, self._returned)
        self.write(self._returned, value)
        self.go(self._exit)

    def do_If(self, statement: ast.If) -> None:  # noqa: N802
        """Both sides, or the one that is known to be taken."""
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
            if not self._ended:
                self.go(after)
                is_reached = True
        self._depth -= 1
        if is_reached:
            self.begin(after)

    def do_While(self, statement: ast.While) -> None:  # noqa: N802
        """A loop, tested at its head."""
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
            self._ended = True

    def inside(self, body: Sequence[ast.stmt], loop: _Loop, then: str) -> None:
        """The statements of a loop, after which it goes on at `then`."""
        self._loops.append(loop)
        self._depth += 1
        self.statements(body)
        if not self._ended:
            self.go(then)
        self._depth -= 1
        self._loops.pop()

    def do_Break(self, _: ast.Break) -> None:  # noqa: N802
        """Leave the loop."""
        self.go(self._loops[-1].end)

    def do_Continue(self, _: ast.Continue) -> None:  # noqa: N802
        """Go on with the loop's next round."""
        self.go(self._loops[-1].next)

    def do_For(self, statement: ast.For) -> None:  # noqa: N802
        """A loop over a range of numbers, or written out over what is known."""
        call = statement.iter
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "range":
            bounds = [self.value(each) for each in call.args]
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
        """The number of a loop's round, once: between the loop's head and its end."""
        if not is_static(step) or step == 0:
            raise TypeError("the step of a range is a number that is known")
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
        if not self._ended:
            self.go(following)
        self._depth -= 1
        self._loops.pop()
        self.begin(following)
        self.write(place, binary(self.emitter, operator.add, self.read(place), step))
        self.go(head)
        self.begin(after)

    def chosen(self, condition: Number, yes: ast.expr, no: ast.expr) -> Any:
        """`yes if condition else no`, of which one is computed."""
        labels, after, before = (
            (self.label("then"), self.label("else")),
            self.label("after"),
            self.emitter.lines,
        )
        values, blocks = [], []
        for label, expression in zip(labels, (yes, no), strict=True):
            self.emitter.lines = []
            self.begin(label)
            values.append(_unsure(at_run_time(self.value(expression))))
            blocks.append(self.emitter.lines)
        place = self.place(_common(*values))
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


def _unsure(value: Any) -> Any:
    """A number of which it is not known whether it is negative."""
    return value._replace(natural=False) if isinstance(value, Number) else value


def _common(one: Any, other: Any) -> Any:
    """The one value, with numbers of the kinds that hold the other's too."""
    if isinstance(one, Number) and isinstance(other, Number):
        return one._replace(kind=common_kind(one, other))
    parts, others = entries(one), entries(other)
    if parts is None or others is None or len(parts) != len(others):
        return one
    made = tuple(map(_common, parts, others))
    return Record(one.type, made) if isinstance(one, Record) else made
