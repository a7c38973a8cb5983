"""Exact derivatives of plain functions: a jet is a number with its slopes by n chosen variables.

Forward-mode automatic differentiation; Griewank and Walther, Evaluating Derivatives, chapter 3, under
the name that Ceres Solver gave it. The same `def` of a model takes floats and jets, plain and compiled
by numba: importing this module teaches numba the type. Values are those of the same call on floats.

Where a derivative does not exist or is infinite at one point, the slopes there are chosen:

- `sqrt`, `cbrt`, `hypot`, `arctan2` and `abs` have slope 0 where their arguments are 0: the mean of both
  sides of `abs`, and no NaN from the length of a vector that vanishes;
- the lesser and the greater of two equal numbers have the slopes of the first;
- steps (`floor`, `round`, `sign`, `//`) have slope 0 everywhere, `a % b` that of `a - b floor(a / b)`;
- a branch has the slopes of the side that is taken.

A derivative that is infinite elsewhere (`log` at 0, `1 / x`) makes slopes infinite or NaN. In compiled
code take a tuple of jets apart by `a, b, c = model(x)`: an index carries all of the tuple along each
time, and 240 of them took 25 s of compiling instead of 3.
"""
# ruff: noqa: ARG002, ARG005, D102 - what the tables and numba call has the arguments that they give

import math
import operator
from collections.abc import Callable
from functools import reduce
from itertools import product
from typing import Any

import numpy as np
from numba.core import types
from numba.core.compiler import Flags
from numba.core.errors import NumbaTypeError
from numba.core.imputils import lower_cast
from numba.core.typeconv.castgraph import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import (
    lower_builtin,
    make_attribute_wrapper,
    models,
    register_model,
)

from recorders.errors import BadInput
from replay.engine.arrays import Function

_REFUSAL = (
    "a jet is a number with slopes: a model for jets uses np.* of scalars (not math.*), returns tuples "
    "(not arrays), and takes value_of(x) where the number alone is meant"
)


# --- derivatives -----------------------------------------------------------------------------------


def _sinc_derivative(value: float, x: float) -> tuple[float]:
    u = np.pi * x
    if abs(u) < 0.03:  # the quotient loses digits; the next term of the series is below 1e-18
        square = u * u
        return (
            -np.pi * u / 3.0 * (1.0 - square / 10.0 * (1.0 - square / 28.0 * (1.0 - square / 54.0))),
        )
    return ((np.cos(u) - value) / x,)


def _arctan2_derivatives(value: float, y: float, x: float) -> tuple[float, float]:
    squared = x * x + y * y
    return (0.0, 0.0) if squared == 0.0 else (x / squared, -y / squared)


def _power_derivatives(value: float, base: float, exponent: float) -> tuple[float, float]:
    by_base = 0.0 if exponent == 0.0 else exponent * base ** (exponent - 1.0)
    return by_base, 0.0 if base == 0.0 else value * np.log(base)


# How a function's value changes with each argument, from its value and its arguments.
_DERIVATIVES: dict[Any, Callable[..., tuple[float, ...]]] = {
    np.positive: lambda v, x: (1.0,),
    np.negative: lambda v, x: (-1.0,),
    np.add: lambda v, x, y: (1.0, 1.0),
    np.subtract: lambda v, x, y: (1.0, -1.0),
    np.multiply: lambda v, x, y: (y, x),
    np.true_divide: lambda v, x, y: (1.0 / y, -v / y),
    np.power: _power_derivatives,
    operator.pow: _power_derivatives,  # of an integer by multiplication, unlike np.power
    np.remainder: lambda v, x, y: (1.0, -np.floor(x / y)),
    np.fmod: lambda v, x, y: (1.0, -np.trunc(x / y)),
    np.absolute: lambda v, x: (np.sign(x),),
    np.fabs: lambda v, x: (np.sign(x),),
    np.copysign: lambda v, x, y: (np.copysign(1.0, x) * np.copysign(1.0, y), 0.0),
    np.square: lambda v, x: (2.0 * x,),
    np.reciprocal: lambda v, x: (-v * v,),
    np.sqrt: lambda v, x: (0.0 if v == 0.0 else 0.5 / v,),
    np.cbrt: lambda v, x: (0.0 if v == 0.0 else 1.0 / (3.0 * v * v),),
    np.hypot: lambda v, x, y: (0.0, 0.0) if v == 0.0 else (x / v, y / v),
    np.exp: lambda v, x: (v,),
    np.exp2: lambda v, x: (v * np.log(2.0),),
    np.expm1: lambda v, x: (v + 1.0,),
    np.log: lambda v, x: (1.0 / x,),
    np.log2: lambda v, x: (1.0 / (x * np.log(2.0)),),
    np.log10: lambda v, x: (1.0 / (x * np.log(10.0)),),
    np.log1p: lambda v, x: (1.0 / (1.0 + x),),
    np.sin: lambda v, x: (np.cos(x),),
    np.cos: lambda v, x: (-np.sin(x),),
    np.tan: lambda v, x: (1.0 + v * v,),
    np.arcsin: lambda v, x: (1.0 / np.sqrt(1.0 - x * x),),
    np.arccos: lambda v, x: (-1.0 / np.sqrt(1.0 - x * x),),
    np.arctan: lambda v, x: (1.0 / (1.0 + x * x),),
    np.arctan2: _arctan2_derivatives,
    np.sinc: _sinc_derivative,
    np.sinh: lambda v, x: (np.cosh(x),),
    np.cosh: lambda v, x: (np.sinh(x),),
    np.tanh: lambda v, x: (1.0 - v * v,),
    np.arcsinh: lambda v, x: (1.0 / np.sqrt(x * x + 1.0),),
    np.arccosh: lambda v, x: (1.0 / np.sqrt(x * x - 1.0),),
    np.arctanh: lambda v, x: (1.0 / (1.0 - x * x),),
    np.deg2rad: lambda v, x: (np.pi / 180.0,),
    np.radians: lambda v, x: (np.pi / 180.0,),
    np.rad2deg: lambda v, x: (180.0 / np.pi,),
    np.degrees: lambda v, x: (180.0 / np.pi,),
}
# Derivative 0 everywhere but at the steps themselves.
_STEPS = (np.floor, np.ceil, np.trunc, np.rint, np.round, np.around, np.sign, np.floor_divide)
_PREDICATES = (
    *(np.less, np.less_equal, np.greater, np.greater_equal, np.equal, np.not_equal),
    *(np.isnan, np.isfinite, np.isinf, np.signbit, np.logical_not),
)
# What is made of other functions; a true choice, so that NaN in what is not chosen stays there.
_COMPOSED: dict[Any, Function] = {
    np.where: lambda condition, x, y: x if condition else y,
    np.minimum: lambda x, y: x if x <= y or np.isnan(x) else y,
    np.maximum: lambda x, y: x if x >= y or np.isnan(x) else y,
    np.clip: lambda x, low, high: np.minimum(np.maximum(x, low), high),
    min: lambda x, y: y if y < x else x,
    max: lambda x, y: y if y > x else x,
    np.divmod: lambda x, y: (x // y, x % y),
}


# --- plain Python ----------------------------------------------------------------------------------


class Jet(np.lib.mixins.NDArrayOperatorsMixin):
    """A number and its slopes, in plain Python: operators and functions of NumPy on scalars work on it.

    Anything else raises TypeError with its name.
    """

    __slots__ = ("slopes", "value")

    def __init__(self, value: float, slopes: tuple[float, ...]) -> None:
        self.value = float(value)
        self.slopes = tuple(float(slope) for slope in slopes)

    def __repr__(self) -> str:
        return f"jet({self.value!r}, {self.slopes!r})"

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        options.pop("out", None)  # of `x += y`, for which a new jet does as well
        return _apply(ufunc if method == "__call__" else getattr(ufunc, method), inputs, options)

    def __array_function__(self, function: Any, _: Any, inputs: Any, options: dict[str, Any]) -> Any:
        return _apply(function, inputs, options)

    def __bool__(self) -> bool:
        return self.value != 0.0

    def __round__(self, decimals: int = 0) -> Any:
        return _apply(np.round, (self, decimals), {})

    def __float__(self) -> float:
        raise TypeError(_REFUSAL)

    def __int__(self) -> int:
        raise TypeError(_REFUSAL)

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise TypeError(_REFUSAL)


def jet(value: float, slopes: tuple[float, ...]) -> Any:
    """The number `value` that changes by `slopes` (n,) with n variables; plain and compiled."""
    return Jet(value, slopes)


def value_of(x: Any) -> float:
    """The number alone, of a jet or a plain number."""
    return x.value if isinstance(x, Jet) else float(x)


def slope_of(x: Any, k: int) -> float:
    """How `x` changes with variable number `k`, a constant in compiled code; 0.0 for a plain number."""
    return x.slopes[k] if isinstance(x, Jet) else 0.0


def _apply(function: Any, inputs: tuple[Any, ...], options: dict[str, Any]) -> Any:
    """What a function of NumPy gives for numbers and at least one jet."""
    if options or any(np.ndim(x) for x in inputs if not isinstance(x, Jet)):
        raise TypeError(f"{function.__name__} with arrays or with {sorted(options)}: {_REFUSAL}")
    if function in _COMPOSED:
        return _COMPOSED[function](*inputs)
    numbers = [np.float64(x.value) if isinstance(x, Jet) else x for x in inputs]
    with np.errstate(all="ignore"):  # infinity and NaN without a warning, as compiled
        if function in _PREDICATES:
            return function(*numbers)
        if function in _STEPS:
            derivatives: tuple[float, ...] = (0.0,) * len(inputs)
            value = function(*numbers)
        elif function in _DERIVATIVES:
            value = function(*numbers)
            derivatives = _DERIVATIVES[function](value, *map(np.float64, numbers))
        else:
            raise TypeError(f"{function.__name__} has no derivative here: {_REFUSAL}")
        terms = [
            [derivative * slope for slope in x.slopes]
            for derivative, x in zip(derivatives, inputs, strict=True)
            if isinstance(x, Jet)
        ]
    if len({len(term) for term in terms}) > 1:
        raise TypeError(f"{function.__name__} of jets with {[len(term) for term in terms]} slopes")
    return Jet(value, tuple(map(sum, zip(*terms, strict=True))))


# --- numba -----------------------------------------------------------------------------------------

_NUMBERS: tuple[type[types.Type], ...] = (types.Float, types.Integer, types.Boolean)
# What else each function is called.
_ALIASES: dict[Any, tuple[Any, ...]] = {
    np.positive: (operator.pos,),
    np.negative: (operator.neg,),
    np.add: (operator.add, operator.iadd),
    np.subtract: (operator.sub, operator.isub),
    np.multiply: (operator.mul, operator.imul),
    np.true_divide: (operator.truediv, operator.itruediv),
    np.floor_divide: (operator.floordiv, operator.ifloordiv),
    np.remainder: (operator.mod, operator.imod),
    operator.pow: (operator.ipow, pow),
    np.absolute: (abs,),
    np.round: (round,),
    np.divmod: (divmod,),
    np.less: (operator.lt,),
    np.less_equal: (operator.le,),
    np.greater: (operator.gt,),
    np.greater_equal: (operator.ge,),
    np.equal: (operator.eq,),
    np.not_equal: (operator.ne,),
    np.logical_not: (operator.not_,),
}


class JetType(types.Type):
    """numba's type of a jet with `n` slopes; a plain number becomes one where a jet is needed."""

    def __init__(self, n: int) -> None:
        self.n = n
        super().__init__(name=f"jet with {n} slopes")

    def can_convert_from(self, typingctx: Any, other: types.Type) -> Conversion | None:
        return Conversion.safe if isinstance(other, _NUMBERS) else None

    def unify(self, typingctx: Any, other: types.Type) -> types.Type | None:
        return self if isinstance(other, _NUMBERS) else None


class _JetModel(models.StructModel):
    def __init__(self, manager: Any, jet_type: JetType) -> None:
        slopes = types.UniTuple(types.float64, jet_type.n)
        super().__init__(manager, jet_type, [("value", types.float64), ("slopes", slopes)])  # type: ignore[no-untyped-call]


register_model(JetType)(_JetModel)
make_attribute_wrapper(JetType, "value", "value")
make_attribute_wrapper(JetType, "slopes", "slopes")


def _typed(function: Any, type_of: Callable[..., types.Type | None]) -> None:
    """Tell numba the type of what `function` gives, from those of its arguments; None: not ours."""

    class Template(AbstractTemplate):
        key = function
        prefer_literal = True  # an exponent and the number of a slope are known while compiling

        def generic(self, args: Any, kws: Any) -> Any:
            given = None if kws else type_of(*args)
            return None if given is None else signature(given, *args)

    infer_global(function, types.Function(Template))


def _jet_type(*given: types.Type) -> JetType | None:
    """The jet type among types; None where there is none."""
    jets = {x for x in given if isinstance(x, JetType)}
    if len(jets) > 1:
        raise NumbaTypeError(f"jets of {sorted(x.n for x in jets)} slopes in one operation")
    return jets.pop() if jets else None


def _teach(function: Any, arity: int, type_of: Callable[[JetType], types.Type], lower: Function) -> None:
    """Have numba compile `function` of jets and numbers by `lower(context, builder, sig, args)`."""

    def typed(*given: types.Type) -> types.Type | None:
        jet_type = _jet_type(*given) if len(given) == arity else None
        return None if jet_type is None else type_of(jet_type)

    _typed(function, typed)
    for kinds in product((JetType, *_NUMBERS), repeat=arity):
        if JetType in kinds:
            lower_builtin(function, *kinds)(lower)


def _slopes(builder: Any, x: Any) -> list[Any]:
    return [builder.extract_value(x, (1, k)) for k in range(x.type.elements[1].count)]


def _made(context: Any, builder: Any, jet_type: JetType, value: Any, slopes: list[Any]) -> Any:
    made = builder.insert_value(context.get_constant_undef(jet_type), value, 0)
    for k, slope in enumerate(slopes):
        made = builder.insert_value(made, slope, (1, k))
    return made


def _numbers(context: Any, builder: Any, sig: Any, args: Any) -> list[tuple[types.Type, Any]]:
    """Type and LLVM value of the number in each argument."""
    numbers: list[tuple[types.Type, Any]] = []
    for kind, x in zip(sig.args, args, strict=True):
        if isinstance(kind, JetType):
            numbers.append((types.float64, builder.extract_value(x, 0)))
        elif isinstance(kind, types.IntegerLiteral):  # `x` may be Python's integer
            numbers.append((types.intp, context.get_constant(types.intp, kind.literal_value)))
        else:
            numbers.append((kind, x))
    return numbers


def _floats(context: Any, builder: Any, numbers: list[tuple[types.Type, Any]]) -> list[Any]:
    return [context.cast(builder, x, kind, types.float64) for kind, x in numbers]


def _on_numbers(
    context: Any, builder: Any, function: Any, numbers: list[tuple[types.Type, Any]]
) -> tuple[types.Type, Any]:
    """Type and value of `function` of numbers: what numba makes of it where there are no jets."""
    known = context.typing_context.resolve_value_type(function)
    sig = known.get_call_type(context.typing_context, tuple(kind for kind, _ in numbers), {})
    compiled = context.get_function(known, sig)
    cast = [context.cast(builder, x, kind, to) for (kind, x), to in zip(numbers, sig.args, strict=False)]
    cast += [context.get_dummy_value()] * (len(sig.args) - len(numbers))  # where it has defaults
    result = compiled(builder, cast)
    context.add_linking_libs(getattr(compiled, "libs", ()))
    return sig.return_type, result


def _inlined(context: Any, builder: Any, function: Any, sig: Any, args: Any) -> Any:
    """The result of a plain function, compiled into the caller; a division by 0 gives infinity."""
    flags: Any = Flags()
    flags.error_model = "numpy"
    flags.forceinline = True
    compiled = context.compile_subroutine(builder, function, sig, flags=flags)
    return context.call_internal(builder, compiled.fndesc, sig, args)


def _chained(context: Any, builder: Any, sig: Any, args: Any, value: Any, derivatives: list[Any]) -> Any:
    """The jet of a function with this value and these derivatives by its arguments: the chain rule."""
    terms = [
        [builder.fmul(derivative, slope) for slope in _slopes(builder, x)]
        for derivative, kind, x in zip(derivatives, sig.args, args, strict=False)
        if isinstance(kind, JetType)
    ]
    slopes = [reduce(builder.fadd, of_one) for of_one in zip(*terms, strict=True)]
    return _made(context, builder, sig.return_type, value, slopes)


def _teach_smooth(name: Any, function: Any, derivatives: Function, arity: int) -> None:
    by_argument = types.UniTuple(types.float64, arity)
    sig_of_derivatives = signature(by_argument, *[types.float64] * (1 + arity))

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        numbers = _numbers(context, builder, sig, args)
        (value,) = _floats(context, builder, [_on_numbers(context, builder, function, numbers)])
        floats = [value, *_floats(context, builder, numbers)]
        found = _inlined(context, builder, derivatives, sig_of_derivatives, floats)
        each = [builder.extract_value(found, k) for k in range(arity)]
        return _chained(context, builder, sig, args, value, each)

    _teach(name, arity, lambda jet_type: jet_type, lower)


def _teach_flat(name: Any, function: Any, arity: int, given: types.Type | None = None) -> None:
    """A function that does not change with its arguments; it gives a jet, or the type `given`."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind, found = _on_numbers(context, builder, function, _numbers(context, builder, sig, args))
        return context.cast(builder, found, kind, sig.return_type)

    _teach(name, arity, lambda jet_type: given or jet_type, lower)


def _teach_power_by_constant(name: Any) -> None:
    """A power whose exponent is an integer in the source is multiplied out, as it is of floats."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        exponent = sig.args[1].literal_value
        size, below = abs(exponent), max(exponent - 1, 0)

        def positive(x: float) -> tuple[float, float]:
            return x**size, exponent * x**below

        def negative(x: float) -> tuple[float, float]:
            value = 1.0 / x**size
            return value, exponent * value / x

        power = negative if exponent < 0 else positive
        pair = signature(types.UniTuple(types.float64, 2), types.float64)
        found = _inlined(context, builder, power, pair, [builder.extract_value(args[0], 0)])
        value, derivative = (builder.extract_value(found, k) for k in range(2))
        return _chained(context, builder, sig, args, value, [derivative])

    lower_builtin(name, JetType, types.IntegerLiteral)(lower)


def _teach_composed(name: Any, composed: Function) -> None:
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _inlined(context, builder, composed, sig, args)

    def type_of(jet_type: JetType) -> types.Type:
        return types.UniTuple(jet_type, 2) if composed is _COMPOSED[np.divmod] else jet_type

    _teach(name, composed.__code__.co_argcount, type_of, lower)


def _teach_least(name: Any, lesser: Function) -> None:
    """Python's `min` and `max`, of two numbers or more."""

    def type_of(*given: types.Type) -> types.Type | None:
        return _jet_type(*given) if all(isinstance(x, (JetType, *_NUMBERS)) for x in given) else None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        jet_type = sig.return_type
        jets = [context.cast(builder, x, kind, jet_type) for kind, x in zip(sig.args, args, strict=True)]
        of_two = signature(jet_type, jet_type, jet_type)
        return reduce(lambda x, y: _inlined(context, builder, lesser, of_two, [x, y]), jets)

    _typed(name, type_of)
    lower_builtin(name, JetType, types.VarArg(types.Any))(lower)
    for kind in _NUMBERS:
        lower_builtin(name, kind, types.VarArg(types.Any))(lower)


def _teach_refusal(name: Any) -> None:
    """Say so in a sentence; numba would speak of candidates and signatures."""

    def refuse(*given: types.Type) -> None:
        if _jet_type(*given) is not None:
            raise BadInput(f"{name.__module__}.{name.__name__} of a jet: {_REFUSAL}")

    _typed(name, refuse)


def _teach_all() -> None:
    def names(function: Any) -> tuple[Any, ...]:
        return (function, *_ALIASES.get(function, ()))

    def arity(formula: Function) -> int:
        return formula.__code__.co_argcount

    for function, derivatives in _DERIVATIVES.items():
        for name in names(function):
            _teach_smooth(name, function, derivatives, arity(derivatives) - 1)
    for name in names(operator.pow):
        _teach_power_by_constant(name)
    for function in _STEPS:
        for name in names(function):
            _teach_flat(name, function, 2 if function is np.floor_divide else 1)
    for name in (np.round, np.around, round):
        _teach_flat(name, np.round, 2)  # to a number of decimals
    for function in _PREDICATES:
        for name in names(function):
            _teach_flat(name, function, function.nin, types.boolean)
    _teach_flat(bool, bool, 1, types.boolean)
    for function, composed in _COMPOSED.items():
        for name in names(function):
            teach = _teach_least if function in (min, max) else _teach_composed
            teach(name, composed)
    for name in (float, int, *(f for f in vars(math).values() if callable(f))):
        _teach_refusal(name)


_teach_all()


# The three functions that models and methods use.


def _type_of_jet(value: types.Type, slopes: types.Type) -> types.Type | None:
    if isinstance(value, _NUMBERS) and isinstance(slopes, (types.Tuple, types.UniTuple)):
        return JetType(slopes.count)
    return None


def _type_of_value(x: types.Type) -> types.Type | None:
    return types.float64 if isinstance(x, (JetType, *_NUMBERS)) else None


def _type_of_slope(x: types.Type, k: types.Type) -> types.Type | None:
    if not isinstance(k, types.IntegerLiteral):
        raise NumbaTypeError("slope_of(x, k) takes a constant k: the slopes of a jet are no array")
    if isinstance(x, JetType) and not 0 <= k.literal_value < x.n:
        raise NumbaTypeError(f"slope_of(x, {k.literal_value}) of a {x.name}")
    return _type_of_value(x)


def _lower_jet(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    value, *_ = _floats(context, builder, _numbers(context, builder, sig, args)[:1])
    floats = types.UniTuple(types.float64, sig.return_type.n)
    slopes = context.cast(builder, args[1], sig.args[1], floats)
    each = [builder.extract_value(slopes, k) for k in range(floats.count)]
    return _made(context, builder, sig.return_type, value, each)


def _lower_value(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return _floats(context, builder, _numbers(context, builder, sig, args))[0]


def _lower_slope(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    if isinstance(sig.args[0], JetType):
        return builder.extract_value(args[0], (1, sig.args[1].literal_value))
    return context.get_constant(types.float64, 0.0)


def _number_to_jet(context: Any, builder: Any, given: types.Type, to: JetType, x: Any) -> Any:
    slopes = [context.get_constant(types.float64, 0.0)] * to.n
    return _made(context, builder, to, context.cast(builder, x, given, types.float64), slopes)


_typed(jet, _type_of_jet)
_typed(value_of, _type_of_value)
_typed(slope_of, _type_of_slope)
for _kind in _NUMBERS:
    lower_builtin(jet, _kind, types.BaseTuple)(_lower_jet)
    lower_cast(_kind, JetType)(_number_to_jet)
for _jet_or_number in (JetType, *_NUMBERS):
    lower_builtin(value_of, _jet_or_number)(_lower_value)
    lower_builtin(slope_of, _jet_or_number, types.IntegerLiteral)(_lower_slope)
