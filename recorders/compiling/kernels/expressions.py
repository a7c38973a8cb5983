"""Lowering of expressions: known values are evaluated as in Python, others become instructions."""

import ast
import operator
from abc import ABC, abstractmethod
from collections.abc import Hashable, Iterator
from types import FunctionType

import numpy as np

from fuselog.recorders.compiling.kernels.functions import FUNCTIONS
from fuselog.recorders.compiling.kernels.known import (
    OPERATORS,
    as_python,
    from_python,
    is_in,
    is_known,
    is_not_in,
)
from fuselog.recorders.compiling.kernels.numbers import (
    REAL,
    TRUTH,
    WHOLE,
    Number,
    binary,
    common_kind,
    compare,
    constant,
    inverse,
    is_static,
    negative,
)
from fuselog.recorders.compiling.kernels.scope import Scope
from fuselog.recorders.compiling.kernels.values import (
    Array,
    Record,
    entries,
    load,
    made,
    part_of,
    row_kind,
    store,
)
from fuselog.recorders.compiling.kinds import AnyArray, Value

# Functions that create arrays, and whether these are initialised with zeros.
_MAKERS = {np.empty: False, np.empty_like: False, np.zeros: True, np.zeros_like: True}


class Expressions(Scope, ABC):
    """The part of a function's lowering that handles expressions."""

    @abstractmethod
    def chosen(self, condition: Number, yes: ast.expr, no: ast.expr) -> Value:
        """Lower `yes if condition else no`."""

    # --- expressions ---

    def value(self, node: ast.expr) -> Value:
        """Lower an expression; return its value."""
        self.line = getattr(node, "lineno", self.line)
        return getattr(self, f"of_{type(node).__name__}", self.unknown)(node)

    def unknown(self, node: ast.expr) -> Value:
        """Raise TypeError for expressions that kernels do not support."""
        raise TypeError(f"a kernel has no {type(node).__name__}: {ast.unparse(node)}")

    def of_Constant(self, node: ast.Constant) -> Value:  # noqa: N802
        """Return the value of a constant."""
        return node.value

    def of_Name(self, node: ast.Name) -> Value:  # noqa: N802
        """Return the value of a variable, a parameter, or a name from outside."""
        return self.lookup(node.id)

    def of_Tuple(self, node: ast.Tuple) -> Value:  # noqa: N802
        """Lower a tuple."""
        return tuple(self.listed(node.elts))

    def listed(self, nodes: list[ast.expr]) -> Iterator[Value]:
        """Yield entries or arguments, expanding starred ones such as `*others`."""
        for node in nodes:
            if isinstance(node, ast.Starred):
                yield from self.iterated(node.value)
            else:
                yield self.value(node)

    def of_GeneratorExp(self, node: ast.GeneratorExp) -> Value:  # noqa: N802
        """Lower a generator over known values to a tuple."""
        before = dict(self.known)
        found = tuple(self._generated(node, list(node.generators)))
        self.known = before
        return found

    def _generated(self, node: Value, generators: list[ast.comprehension]) -> Iterator[Value]:
        if not generators:
            yield self.value(node.elt)
            return
        first, *others = generators
        for each in self.iterated(first.iter):
            self._bind(first.target, each)
            if all(self.truth(self.value(test)) for test in first.ifs):
                yield from self._generated(node, others)

    def _bind(self, target: ast.expr, value: Value) -> None:
        if isinstance(target, ast.Name):
            self.known[target.id] = value
        elif isinstance(target, ast.Tuple):
            for each, part in zip(target.elts, entries(value) or (), strict=True):
                self._bind(each, part)

    def iterated(self, node: ast.expr) -> list[Value]:
        """Return the values over which a loop runs, which must be known."""
        found = self.value(node)
        parts = entries(found)
        if parts is not None:
            return list(parts)
        if isinstance(found, range | zip | enumerate | reversed | str):
            return [from_python(each) for each in found]
        raise TypeError("a loop needs a range or a tuple")

    def of_BinOp(self, node: ast.BinOp) -> Value:  # noqa: N802
        """Lower `a + b` and similar."""
        return self.operation(node.op, self.value(node.left), self.value(node.right))

    def operation(self, node: ast.operator, left: Value, right: Value) -> Value:
        """Lower a binary operator."""
        operation = OPERATORS[type(node)]
        if is_known(left) and is_known(right):
            both = as_python(left), as_python(right)
            if operation is operator.truediv and both[1] == 0:
                with np.errstate(all="ignore"):
                    return float(np.float64(both[0]) / np.float64(both[1]))
            return from_python(operation(*both))
        parts, others = entries(left), entries(right)
        if operation is operator.add and parts is not None and others is not None:
            return parts + others
        return binary(self.emitter, operation, self.scalar(left), self.scalar(right))

    def scalar(self, value: Value) -> Value:
        """Convert a value to a number; raise TypeError if it is not one."""
        if isinstance(value, Number) or is_static(value):
            return value
        if isinstance(value, Array) and (not value.shape or row_kind(value)):
            return load(self.emitter, value)
        raise TypeError(f"a number is needed, not a {type(value).__name__}")

    def of_UnaryOp(self, node: ast.UnaryOp) -> Value:  # noqa: N802
        """Lower `-a` and `not a`."""
        value = self.value(node.operand)
        if isinstance(node.op, ast.Not):
            found = self.truth(value)
            return inverse(self.emitter, found) if isinstance(found, Number) else not found
        if isinstance(node.op, ast.USub):
            return -value if is_static(value) else negative(self.emitter, self.scalar(value))
        return value

    def truth(self, value: Value) -> Value:
        """Convert a value to a truth value: known, or a number at run time."""
        if isinstance(value, Number):
            return self.emitter.truth(value)
        if isinstance(value, Array):
            raise TypeError("an array is neither true nor false")
        return bool(value)

    def of_BoolOp(self, node: ast.BoolOp) -> Value:  # noqa: N802
        """Lower `a and b`; the second operand is evaluated only if the first does not settle it."""
        is_and = isinstance(node.op, ast.And)
        first = self.truth(self.value(node.values[0]))
        rest = node.values[1] if len(node.values) == 2 else ast.BoolOp(node.op, node.values[1:])
        if not isinstance(first, Number):
            return self.truth(self.value(rest)) if first == is_and else first
        known = ast.Constant(not is_and)
        return self.chosen(first, rest, known) if is_and else self.chosen(first, known, rest)

    def of_Compare(self, node: ast.Compare) -> Value:  # noqa: N802
        """Lower `a < b` and `a < b < c`."""
        left, found = self.value(node.left), None
        for operation, right_node in zip(node.ops, node.comparators, strict=True):
            right = self.value(right_node)
            each = self.compared(OPERATORS[type(operation)], left, right)
            if found is None or found is True:
                found = each
            elif each is not True:
                found = binary(
                    self.emitter, operator.and_, self.emitter.truth(found), self.emitter.truth(each)
                )
            left = right
        return found

    def compared(self, operation: Value, left: Value, right: Value) -> Value:
        """Lower a single comparison."""
        if is_known(left) and is_known(right):
            return bool(operation(as_python(left), as_python(right)))
        if operation in (operator.is_, operator.is_not):
            return operation is operator.is_not
        parts, others = entries(left), entries(right)
        if operation in (is_in, is_not_in):
            alike = constant(False)
            for each in others or ():
                same = self.emitter.truth(self.compared(operator.eq, left, each))
                alike = binary(self.emitter, operator.or_, alike, same)
            return alike if operation is is_in else inverse(self.emitter, alike)
        if parts is None or others is None:
            return compare(self.emitter, operation, self.scalar(left), self.scalar(right))
        if operation not in (operator.eq, operator.ne) or len(parts) != len(others):
            raise TypeError("tuples are compared only by == and !=, and need the same length")
        found: Value = operation is operator.eq
        joined = operator.and_ if operation is operator.eq else operator.or_
        for part, other in zip(parts, others, strict=True):
            each = self.compared(operation, part, other)
            found = binary(
                self.emitter,
                joined,
                self.emitter.as_kind(found, TRUTH),
                self.emitter.as_kind(each, TRUTH),
            )
        return found

    def of_IfExp(self, node: ast.IfExp) -> Value:  # noqa: N802
        """Lower `a if condition else b`."""
        condition = self.truth(self.value(node.test))
        if isinstance(condition, Number):
            return self.chosen(condition, node.body, node.orelse)
        return self.value(node.body if condition else node.orelse)

    def of_Attribute(self, node: ast.Attribute) -> Value:  # noqa: N802
        """Return a field of a NamedTuple, a property of an array, or a name from a module."""
        return self.attribute(self.value(node.value), node.attr)

    def attribute(self, owner: Value, name: str) -> Value:
        """Return the attribute `name` of a value."""
        if isinstance(owner, Record) and name in owner.type._fields:
            return owner.get(name)
        if isinstance(owner, Array):
            if name == "T":
                return owner.turned
            if name == "shape":
                return tuple(map(_whole, owner.shape))
            if name == "size" and len(owner.shape) == 1:
                return _whole(owner.shape[0])
        elif not isinstance(owner, Number | Record):
            return from_python(getattr(owner, name))
        raise TypeError(f"a {type(owner).__name__} has no {name} in a kernel")

    def of_Subscript(self, node: ast.Subscript) -> Value:  # noqa: N802
        """Lower a subscript: an element or part of an array, or an entry of a tuple."""
        owner = self.value(node.value)
        parts = entries(owner)
        if parts is None:
            found = self.element(node, owner)
            return found if found.shape else load(self.emitter, found)
        if isinstance(node.slice, ast.Slice):
            bounds = (
                None if each is None else self.value(each)
                for each in (node.slice.lower, node.slice.upper)
            )
            return parts[slice(*bounds)]
        index = self.value(node.slice)
        return parts[int(index)] if is_static(index) else self.entry(parts, index)

    def entry(self, parts: tuple[Value, ...], index: Number) -> Number:
        """Select an entry of a tuple of numbers by an index at run time."""
        if not all(isinstance(each, Number) or is_static(each) for each in parts):
            raise TypeError("an index of this tuple has to be a known number")
        if all(map(is_static, parts)):
            kept = self.program.table(np.array(parts))
        else:
            real = common_kind(*parts) == REAL
            memory = self.emitter.memory(REAL if real else WHOLE, len(parts))
            kept = Array("<f8" if real else "<i8", memory, (len(parts),), (1,))
            for place, each in enumerate(parts):
                store(self.emitter, part_of(self.emitter, kept, (place,)), each)
        return load(self.emitter, part_of(self.emitter, kept, (index,)))

    def element(self, node: ast.Subscript, owner: Value = None) -> Array:
        """Return the element or part of an array that a subscript denotes."""
        owner = self.value(node.value) if owner is None else owner
        if isinstance(owner, np.ndarray):
            owner = self.constant_array(owner)
        if not isinstance(owner, Array):
            raise TypeError(f"{ast.unparse(node.value)} is not an array")
        index = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        if len(index) > len(owner.shape):
            raise TypeError(f"{ast.unparse(node)}: {len(index)} indices for {len(owner.shape)} axes")
        return part_of(self.emitter, owner, tuple(self._index(each) for each in index))

    def constant_array(self, array: AnyArray) -> Array:
        """Return an array from outside, which must not be writeable."""
        if array.flags.writeable:
            raise TypeError("a kernel uses an outside array that could change; pass it as an argument")
        return self.program.table(array)

    def _index(self, node: ast.expr) -> Value:
        if not isinstance(node, ast.Slice):
            return self.scalar(self.value(node))
        if node.step is not None:
            raise TypeError("slices cannot have steps here")
        return slice(
            *(
                None if each is None else self.scalar(self.value(each))
                for each in (node.lower, node.upper)
            )
        )

    # --- calls ---

    def of_Call(self, node: ast.Call) -> Value:  # noqa: N802
        """Lower a call of a function, a NamedTuple, or an object that lowers itself."""
        if isinstance(node.func, ast.Attribute) and node.func.attr == "_replace":
            owner = self.value(node.func.value)
            new = {each.arg: self.value(each.value) for each in node.keywords}
            names = owner.type._fields
            return Record(owner.type, tuple(new.get(name, owner.get(name)) for name in names))
        if isinstance(node.func, ast.Attribute) and node.func.attr == "copy":
            return self.copied(self.value(node.func.value))
        function = self.value(node.func)
        arguments = list(self.listed(node.args))
        named = {each.arg: self.value(each.value) for each in node.keywords if each.arg}
        return self.called(function, arguments, named)

    def called(self, function: Value, arguments: list[Value], named: dict[str, Value]) -> Value:
        """Lower a call; return its result."""
        write = getattr(function, "lowered", None)
        if write is not None:  # the object lowers itself, see fuselog.replay.tracing
            return write(self.program, self.emitter, arguments)
        if isinstance(function, Hashable) and function in _MAKERS:
            return self.new_array(*arguments, is_zero=_MAKERS[function], **named)
        is_number = isinstance(function, Hashable) and function in FUNCTIONS
        if not is_number:  # functions compiled for Python are compiled again as a part of this kernel
            function = getattr(function, "__wrapped__", function)
        if function is getattr:
            return self.attribute(*arguments)
        if function is len:
            return self._length(arguments[0])
        if function in (tuple, list) and arguments:
            return entries(arguments[0]) or tuple(from_python(each) for each in arguments[0])
        if function in (zip, enumerate, reversed) and not all(map(is_known, arguments)):
            return tuple(function(*(entries(each) for each in arguments)))
        if isinstance(function, type) and hasattr(function, "_fields"):
            names = function._fields[len(arguments) :]
            return Record(function, (*arguments, *(named[name] for name in names)))
        if all(map(is_known, (*arguments, *named.values()))):
            try:
                return self._worked_out(function, arguments, named)
            except ArithmeticError:  # kernels do not raise errors: a division by zero gives infinity
                pass
        if is_number:
            return FUNCTIONS[function](self.emitter, *map(self.scalar, arguments))
        if isinstance(function, FunctionType) and not str(function.__module__).startswith("numpy"):
            return self.program.call(self.emitter, function, _given(function, arguments, named))
        name = getattr(function, "__name__", function)
        raise TypeError(
            f"a kernel that creates no arrays cannot call {name}, which needs allocates=True"
        )

    def new_array(self, like: Value, dtype: Value = float, *, is_zero: bool) -> Array:
        """Lower `np.empty` and similar for known sizes; the memory lasts until the function returns."""
        shape = like.shape if isinstance(like, Array) else like if isinstance(like, tuple) else (like,)
        if not all(is_static(size) for size in shape):
            raise TypeError("an array that is created here needs known sizes; pass it as scratch")
        kept = like.dtype if isinstance(like, Array) else np.dtype(dtype).str
        array = made(self.emitter, tuple(map(int, shape)), kept)
        if is_zero:
            self.fill(array, 0)
        return array

    def copied(self, array: Array) -> Array:
        """Lower `array.copy()` for known sizes; the memory lasts until the function returns."""
        copy = self.new_array(array, is_zero=False)
        self.fill(copy, array)
        return copy

    @abstractmethod
    def fill(self, place: Array, value: Value) -> None:
        """Assign a number to every element of an array."""

    def _worked_out(self, function: Value, arguments: list[Value], named: dict[str, Value]) -> Value:
        """Evaluate a function with known arguments in Python."""
        known = [as_python(each) for each in arguments]
        with np.errstate(all="ignore"):
            return from_python(
                function(*known, **{name: as_python(each) for name, each in named.items()})
            )

    def _length(self, value: Value) -> Value:
        parts = entries(value)
        if isinstance(value, Array):
            return _whole(value.shape[0])
        return len(value if parts is None else parts)


def _whole(size: int | str) -> Value:
    return Number(WHOLE, size, natural=True) if isinstance(size, str) else size


def _given(function: FunctionType, arguments: list[Value], named: dict[str, Value]) -> list[Value]:
    """Return all arguments in the order of the parameters, including defaults."""
    code = function.__code__
    names = code.co_varnames[: code.co_argcount]
    defaults = dict(zip(names[::-1], (function.__defaults__ or ())[::-1], strict=False))
    given = dict(zip(names, arguments, strict=False))
    given |= named
    missing = [name for name in names if name not in given and name not in defaults]
    if missing or len(given) < len(named):
        raise TypeError(f"{function.__name__} lacks {', '.join(missing)}")
    return [
        *(given.get(name, from_python(defaults.get(name))) for name in names),
        *arguments[len(names) :],
    ]
