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
"""
# ruff: noqa: ARG001, ARG002, ARG005, D102 - what the tables and numba call has the arguments that they give

import operator
from collections.abc import Callable
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
_STEPS = (np.floor, np.ceil, np.trunc, np.rint, np.sign, np.floor_divide, np.round, np.around)
_PREDICATES = (
    *(np.less, np.less_equal, np.greater, np.greater_equal, np.equal, np.not_equal),
    *(np.isnan, np.isfinite, np.isinf, np.signbit, np.logical_not),
)
# What is made of other functions; a true choice, so that NaN in what is not chosen stays there.
_COMPOSED: dict[Any, Callable[..., Any]] = {
    np.where: lambda condition, x, y: x if condition else y,
    np.minimum: lambda x, y: x if x <= y or np.isnan(x) else y,
    np.maximum: lambda x, y: x if x >= y or np.isnan(x) else y,
    np.clip: lambda x, low, high: np.minimum(np.maximum(x, low), high),
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
            for derivative, x in zip(derivatives, inputs, strict=False)
            if isinstance(x, Jet)
        ]
    if len({len(term) for term in terms}) > 1:
        raise TypeError(f"{function.__name__} of jets with {[len(term) for term in terms]} slopes")
    return Jet(value, tuple(map(sum, zip(*terms, strict=True))))


# --- numba -----------------------------------------------------------------------------------------

_NUMBERS = (types.Float, types.Integer, types.Boolean)
# What Python's operators and builtins are to NumPy.
_ALIASES = {
    np.positive: (operator.pos,),
    np.negative: (operator.neg,),
    np.add: (operator.add, operator.iadd),
    np.subtract: (operator.sub, operator.isub),
    np.multiply: (operator.mul, operator.imul),
    np.true_divide: (operator.truediv, operator.itruediv),
    np.floor_divide: (operator.floordiv, operator.ifloordiv),
    np.remainder: (operator.mod, operator.imod),
    np.power: (operator.pow, operator.ipow, pow),
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


def _typed(function: Any, type_of: Callable[..., Any]) -> None:
    """Tell numba the type that `type_of(*types)` says `function` has; None where it is not ours."""

    class Template(AbstractTemplate):
        prefer_literal = True

        def generic(self, args: Any, kws: Any) -> Any:
            given = None if kws else type_of(*args)
            return None if given is None else signature(given, *args)

    infer_global(function)(Template)


def _jet_type(*given: types.Type) -> JetType | None:
    """The jet type among types; None where there is none."""
    jets = {x for x in given if isinstance(x, JetType)}
    if len(jets) > 1:
        raise NumbaTypeError(f"jets with {sorted(x.n for x in jets)} slopes in one operation")
    return jets.pop() if jets else None


def _lowered(function: Any, arity: int, lower: Callable[..., Any]) -> None:
    """Have numba call `lower(context, builder, sig, args)` for every mix of jets and numbers."""
    for kinds in product((JetType, *_NUMBERS), repeat=arity):
        if JetType in kinds:
            lower_builtin(function, *kinds)(lower)


def _number(context: Any, builder: Any, given: types.Type, x: Any) -> tuple[types.Type, Any]:
    """Type and LLVM value of the number in an argument."""
    if isinstance(given, JetType):
        return types.float64, builder.extract_value(x, 0)
    if isinstance(given, types.IntegerLiteral):  # numba hands in the number itself, or its LLVM value
        return types.intp, context.get_constant(types.intp, given.literal_value)
    return given, x


def _slopes(builder: Any, x: Any) -> list[Any]:
    return [builder.extract_value(x, (1, k)) for k in range(x.type.elements[1].count)]


def _made(context: Any, builder: Any, jet_type: JetType, value: Any, slopes: list[Any]) -> Any:
    made = context.get_constant_undef(jet_type)
    made = builder.insert_value(made, value, 0)
    for k, slope in enumerate(slopes):
        made = builder.insert_value(made, slope, (1, k))
    return made


def _on_numbers(context: Any, builder: Any, function: Any, given: list[tuple[types.Type, Any]]) -> Any:
    """Type and value of `function` of numbers: exactly what numba makes of it without jets."""
    known = context.typing_context.resolve_value_type(function)
    sig = known.get_call_type(context.typing_context, tuple(kind for kind, _ in given), {})
    cast = [context.cast(builder, x, kind, to) for (kind, x), to in zip(given, sig.args, strict=True)]
    compiled = context.get_function(known, sig)
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


def _teach_smooth(function: Any, derivatives: Callable[..., Any] | None, arity: int) -> None:
    """A function of numbers that gives a number; no `derivatives` means slopes of 0."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        numbers = [_number(context, builder, *given) for given in zip(sig.args, args, strict=True)]
        kind, value = _on_numbers(context, builder, function, numbers)
        value = context.cast(builder, value, kind, types.float64)
        slopes = [context.get_constant(types.float64, 0.0)] * sig.return_type.n
        if derivatives is not None:
            floats = [context.cast(builder, x, kind, types.float64) for kind, x in numbers]
            partial_types = types.UniTuple(types.float64, arity)
            partials = _inlined(
                context,
                builder,
                derivatives,
                signature(partial_types, *[types.float64] * (1 + arity)),
                (value, *floats),
            )
            terms = [
                [
                    builder.fmul(builder.extract_value(partials, k), slope)
                    for slope in _slopes(builder, x)
                ]
                for k, (given, x) in enumerate(zip(sig.args, args, strict=True))
                if isinstance(given, JetType)
            ]
            slopes = (
                terms[0]
                if len(terms) == 1
                else [builder.fadd(x, y) for x, y in zip(*terms, strict=True)]
            )
        return _made(context, builder, sig.return_type, value, slopes)

    _typed(function, lambda *given: _jet_type(*given) if len(given) == arity else None)
    _lowered(function, arity, lower)


def _teach_predicate(function: Any, arity: int) -> None:
    """A function of numbers that says yes or no."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        numbers = [_number(context, builder, *given) for given in zip(sig.args, args, strict=True)]
        kind, value = _on_numbers(context, builder, function, numbers)
        return context.cast(builder, value, kind, types.boolean)

    _typed(function, lambda *given: types.boolean if len(given) == arity and _jet_type(*given) else None)
    _lowered(function, arity, lower)


def _teach_composed(function: Any, composed: Callable[..., Any], arity: int) -> None:
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _inlined(context, builder, composed, sig, args)

    def type_of(*given: types.Type) -> types.Type | None:
        jet_type = _jet_type(*given) if len(given) == arity else None
        return types.UniTuple(jet_type, 2) if function in (np.divmod, divmod) and jet_type else jet_type

    _typed(function, type_of)
    _lowered(function, arity, lower)


def _arity(function: Callable[..., Any]) -> int:
    return function.__code__.co_argcount


for _function, _derivatives in _DERIVATIVES.items():
    for _name in (_function, *_ALIASES.get(_function, ())):
        _teach_smooth(_name, _derivatives, _arity(_derivatives) - 1)
for _function in _STEPS:
    for _name in (_function, *_ALIASES.get(_function, ())):
        _teach_smooth(_name, None, 2 if _function is np.floor_divide else 1)
for _function in _PREDICATES:
    for _name in (_function, *_ALIASES.get(_function, ())):
        _teach_predicate(_name, _function.nin)
_teach_predicate(bool, 1)
for _function, _composed in _COMPOSED.items():
    for _name in (_function, *_ALIASES.get(_function, ())):
        _teach_composed(_name, _composed, _arity(_composed))


def _value(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return context.cast(
        builder, *reversed(_number(context, builder, sig.args[0], args[0])), types.float64
    )


def _slope(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    if isinstance(sig.args[0], JetType):
        return builder.extract_value(args[0], (1, sig.args[1].literal_value))
    return context.get_constant(types.float64, 0.0)


def _jet(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    value = context.cast(builder, args[0], sig.args[0], types.float64)
    floats = types.UniTuple(types.float64, sig.return_type.n)
    slopes = context.cast(builder, args[1], sig.args[1], floats)
    return _made(
        context,
        builder,
        sig.return_type,
        value,
        [builder.extract_value(slopes, k) for k in range(floats.count)],
    )


def _slope_type(x: types.Type, k: types.Type) -> types.Type | None:
    if not isinstance(k, types.IntegerLiteral):
        return None
    if isinstance(x, JetType):
        return types.float64
    return types.float64 if isinstance(x, _NUMBERS) else None


_typed(jet, lambda value, slopes: JetType(len(slopes)) if isinstance(slopes, types.BaseTuple) else None)
_typed(value_of, lambda x: types.float64 if isinstance(x, (JetType, *_NUMBERS)) else None)
_typed(slope_of, _slope_type)
for _kind in (JetType, *_NUMBERS):
    lower_builtin(value_of, _kind)(_value)
    lower_builtin(slope_of, _kind, types.IntegerLiteral)(_slope)
for _kind in _NUMBERS:
    lower_builtin(jet, _kind, types.BaseTuple)(_jet)


def _number_to_jet(context: Any, builder: Any, given: types.Type, to: JetType, x: Any) -> Any:
    slopes = [context.get_constant(types.float64, 0.0)] * to.n
    return _made(context, builder, to, context.cast(builder, x, given, types.float64), slopes)


for _kind in _NUMBERS:
    lower_cast(_kind, JetType)(_number_to_jet)
