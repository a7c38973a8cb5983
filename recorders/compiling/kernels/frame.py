"""The frame of a lowered function: its blocks, and the memory of its variables."""

from types import FunctionType

from fuselog.recorders.compiling.kernels.expressions import Expressions
from fuselog.recorders.compiling.kernels.numbers import (
    Number,
    common_kind,
)
from fuselog.recorders.compiling.kernels.program import Program, definition_of
from fuselog.recorders.compiling.kernels.values import (
    Array,
    Record,
    at_run_time,
    entries,
    leaves,
    rebuilt,
    signature,
)
from fuselog.recorders.compiling.kernels.variables import placed_names
from fuselog.recorders.compiling.kinds import Value


class Wider(Exception):
    """The exception raised if a variable needs a wider numeric type than that of its first value."""


class Frame(Expressions):
    """The blocks of instructions of one function, and the memory of its variables."""

    def __init__(
        self, program: Program, function: FunctionType, arguments: list[Value], kinds: dict[str, str]
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
        self.kinds = kinds
        self.placed = placed_names(definition)
        self.places: dict[str, Value] = {}
        self.ended = False
        for name in names:
            if name in self.placed:
                self.assign(name, self.known.pop(name))

    # --- blocks ---

    def go(self, label: str) -> None:
        """End a block with a jump."""
        self.emitter.add(f"br label %{label}")
        self.ended = True

    def begin(self, label: str) -> None:
        """Begin a block."""
        self.emitter.lines.append(f"{label}:")
        self.ended = False

    def branch(self, condition: Number, yes: str, no: str) -> None:
        """End a block with a jump to one of two others."""
        self.emitter.add(f"br i1 {condition.code}, label %{yes}, label %{no}")
        self.ended = True

    # --- places in memory ---

    def place(self, value: Value) -> Value:
        """Allocate memory for values like this one; the leaves of the result are addresses."""
        return rebuilt(value, iter([self.emitter.memory(kind) for kind, _ in leaves(value)]))

    def write(self, place: Value, value: Value) -> None:
        """Store a value in its memory."""
        for (kind, code), (_, address) in zip(leaves(value), leaves(place), strict=True):
            self.emitter.add(f"store {kind} {code}, ptr {address}")

    def read(self, place: Value) -> Value:
        """Load the value from its memory."""
        names = []
        for kind, address in leaves(place):
            names.append(self.emitter.fresh())
            self.emitter.add(f"{names[-1]} = load {kind}, ptr {address}")
        return rebuilt(place, iter(names))

    def assign(self, name: str, value: Value) -> None:
        """Assign a value to a name."""
        if name not in self.placed:
            self.known[name] = value
            return
        value = self.fitting(name, value)
        if name not in self.places:
            self.places[name] = self.place(value)
        self.write(self.places[name], value)

    def fitting(self, name: str, value: Value) -> Value:
        """Convert a value to the kinds of its memory; raise `Wider` if the memory cannot hold it."""
        value = self.widened(name, unsure(at_run_time(value)))
        if name in self.places:
            value = self.converted(name, value, self.places[name])
        return value

    def widened(self, name: str, value: Value) -> Value:
        """Convert the numbers in a value to the kinds that their memory is known to need."""
        if isinstance(value, Number):
            kind = self.kinds.get(name, value.kind)
            return self.emitter.as_kind(value, common_kind(value, Number(kind, "")))
        parts = entries(value)
        if parts is None:
            return value
        made = tuple(self.widened(f"{name}[{place}]", each) for place, each in enumerate(parts))
        return Record(value.type, made) if isinstance(value, Record) else made

    def converted(self, name: str, value: Value, place: Value) -> Value:
        """Convert a number, or the numbers in a tuple, to the kinds of the memory.

        Raises `Wider` if the memory cannot hold them.
        """
        if signature(value) == signature(place):
            return value
        if isinstance(value, Number) and isinstance(place, Number):
            kind = common_kind(place, value)
            if kind != place.kind:
                self.kinds[name] = kind
                raise Wider
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

    def lookup(self, name: str) -> Value:
        """Return the value of a name."""
        if name in self.places:
            return self.read(self.places[name])
        return super().lookup(name)


def unsure(value: Value) -> Value:
    """Return a number, no longer assumed to be non-negative."""
    return value._replace(natural=False) if isinstance(value, Number) else value


def common_value(one: Value, other: Value) -> Value:
    """Return the first value, with its numbers in kinds that can represent those of both."""
    if isinstance(one, Number) and isinstance(other, Number):
        return one._replace(kind=common_kind(one, other))
    parts, others = entries(one), entries(other)
    if parts is None or others is None or len(parts) != len(others):
        return one
    made = tuple(map(common_value, parts, others))
    return Record(one.type, made) if isinstance(one, Record) else made
