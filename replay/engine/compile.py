"""Compiles a kernel together with the model functions it is made of, once per source text.

numba's own disk cache finds module-level functions only, does not notice that a function from another
file has changed, and stops on a damaged file. So the sources of a kernel and of everything it calls
become one module, whose compiled code is kept in the user's cache under the hash of that text: a changed
model is a new file, a known one loads in a fraction of a second. Kernels stay plain Python functions,
which also run uncompiled.
"""

import __future__

import ast
import collections
import gc
import inspect
import logging
import os
import pickle
import re
import sys
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager
from functools import cache, lru_cache, partial, wraps
from hashlib import sha256
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from threading import Timer
from types import FunctionType, ModuleType
from typing import Any, ParamSpec, TypeGuard, TypeVar

import numba
import numpy as np
from numba._dynfunc import make_function
from numba.core import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import register_pass
from numba.core.errors import NumbaError
from numba.core.registry import cpu_target
from numba.core.serialize import dumps
from numba.core.typed_passes import NativeLowering

from recorders.errors import BadInput
from replay.engine.cache import cache_folder, in_turn, is_private, read_checked, say_once, write_checked

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

# What a version names, which is part of every key; of any other module the sources are needed.
_VERSIONED = {*sys.stdlib_module_names, "numpy", "numba"}
_LOG = logging.getLogger("fuselog")
# What compiles in less time is not told of.
_PATIENCE_S = 1.0


# In place of a definition's name, which has the hash of the definition.
_NAME = "_defined_here"


class DoesNotCompile(BadInput):
    """What numba says of a function that it cannot compile, and of which line."""


def compiled(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a function of arrays and numbers, with all that it calls, when it is first called.

    For what Python calls as it stands; inside another kernel it is compiled with the rest. Its arguments
    are given by position. Raises BadInput, when called, where a source is not at hand.
    """

    @cache
    def kernel() -> Callable[Parameters, Result]:
        if _is_uncompiled():
            return np.errstate(all="ignore")(function)
        bundle = _Bundle()
        name = bundle.add(function.__name__, function)
        names = ", ".join(inspect.signature(function).parameters)
        text = f"def kernel({names}):\n    return {name}({names})"
        return _compile(bundle, name, text, function)

    @wraps(function)
    def call(*arguments: Parameters.args, **named: Parameters.kwargs) -> Result:
        return kernel()(*arguments, **named)

    return call


def compile_over_runs(run_once: Callable[..., None], *, allocates: bool = True) -> Callable[..., None]:
    """Compile a function of one run into a loop over all runs, on all cores.

    Args:
        run_once: `run_once(run, *arguments)` does the work of run number `run` and writes only what
            belongs to that run. It may be a closure over model functions and numbers: that is how it is
            specialised. It may use NumPy and functions that keep to the same.
        allocates: whether it makes arrays. A kernel that does not is compiled without the counting of
            references to arrays, and is several times as fast.

    Returns `loop(runs, *arguments, scratch=None, own=None)`; its results do not depend on the number of
    runs or cores. What `scratch()` returns, made anew for every core, is the last argument of
    `run_once`: arrays that one run after another may work in. Or that is `own[run]`, such as the run's
    generator of random numbers; a run whose own is None is left out.
    Raises BadInput where a source is not at hand (a function typed at a prompt, say).

    For finding a fault: with FUSELOG_UNCOMPILED=1 the kernels are plain Python, and an index beyond an
    array is an IndexError; with FUSELOG_BOUNDSCHECK=1 it is one in compiled kernels too.
    """
    if _is_uncompiled():
        return uncompiled_over_runs(run_once)
    bundle = _Bundle(allocates)
    kernel = bundle.add("run_once", run_once)
    names = ", ".join(list(inspect.signature(run_once).parameters)[1:])
    loop = _compile(
        bundle,
        kernel,
        f"def kernel(first, end, {names}):\n"
        "    for run in range(first, end):\n"
        f"        {kernel}(run, {names})",
        run_once,
    )
    hint = "" if allocates else " (a kernel that makes arrays is compiled with allocates=True)"
    return partial(_over_runs, name=run_once.__name__, loop=loop, places=bundle.places, hint=hint)


class _InlinedLibrary(JITCodeLibrary):
    """The code of one function that only other compiled code calls, and of which that gets a copy.

    It is optimised there, once; numba would optimise it at every level of calls above it, which takes
    half of the time that a kernel of many small functions needs to compile. Nor is machine code made of
    it, which takes a quarter.
    """

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call]
        self._verify_declare_only_symbols()  # type: ignore[no-untyped-call]
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _InlinedLowering(NativeLowering):
    """Makes a library that only compiled code calls; numba knows it by a function without code."""

    _name = "inlined_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower without the ways in from Python."""
        flags = state.flags
        flags.no_cpython_wrapper = flags.no_cfunc_wrapper = flags.no_compile = True
        super().run_pass(state)  # type: ignore[no-untyped-call]
        lowered, described, kept = state["cr"], state["cr"].fndesc, (state.library,)
        name, module = described.qualname, described.lookup_module()
        function = make_function(module, name, "inlined", 0, lowered.env, kept)
        state.targetctx.insert_user_function(function, described, kept)
        state["cr"] = lowered._replace(cfunc=function)
        return True


class Inlined(Compiler):
    """The compiler of functions that end up in another kernel, see `numba.njit(pipeline_class=...)`."""

    def define_pipelines(self) -> Any:
        """The usual passes, but for the last, into a library of another kind."""
        codegen = self.state.targetctx.codegen()
        library = _InlinedLibrary(codegen, self.state.func_id.func_qualname)  # type: ignore[no-untyped-call]
        self.state.library = library
        managers = super().define_pipelines()  # type: ignore[no-untyped-call]
        for manager in managers:
            manager.passes = [
                (_InlinedLowering if each is NativeLowering else each, why)
                for each, why in manager.passes
            ]
        return managers


# Where what kernels are made of is defined, each once; compiled code that was kept looks for it there.
_PARTS = sys.modules.setdefault("kernel_parts", ModuleType("kernel_parts"))
vars(_PARTS).update(collections=collections, numba=numba, numpy=np, Inlined=Inlined)


def _is_uncompiled() -> bool:
    return os.environ.get("FUSELOG_UNCOMPILED") == "1"


def uncompiled_over_runs(run_once: Callable[..., None]) -> Callable[..., None]:
    """What `compile_over_runs` returns, in plain Python; NaN and infinity raise nothing here either."""

    def loop(
        runs: int,
        *arguments: Any,
        scratch: Callable[[], Any] | None = None,
        own: Sequence[Any] | None = None,
    ) -> None:
        memory = [scratch()] if scratch else []
        with np.errstate(all="ignore"):
            for run in range(runs):
                if own is None:
                    run_once(run, *arguments, *memory)
                elif own[run] is not None:
                    run_once(run, *arguments, own[run])

    return loop


@lru_cache(maxsize=1)
def _helpers(process: int) -> ThreadPoolExecutor:  # noqa: ARG001
    """The threads beside the calling one; a forked process has none of its parent's."""
    return ThreadPoolExecutor(max(1, numba.config.NUMBA_NUM_THREADS - 1))  # type: ignore[attr-defined]


def _over_runs(
    runs: int,
    *arguments: Any,
    scratch: Callable[[], Any] | None = None,
    own: Sequence[Any] | None = None,
    name: str,
    loop: Callable[..., None],
    places: Mapping[tuple[str, int], str],
    hint: str,
) -> None:
    """Share the runs among the cores; in a few pieces per core, since runs differ in length."""

    def work(pieces: Iterator[tuple[int, int]]) -> None:
        memory = [scratch()] if scratch else []
        for first, end in pieces:
            if own is None:
                loop(first, end, *arguments, *memory)
                continue
            for run in range(first, end):
                if own[run] is not None:
                    loop(run, run + 1, *arguments, own[run])

    cores = min(runs, numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    cuts = [runs * piece // (4 * cores) for piece in range(4 * cores + 1)] if cores > 1 else [0, runs]
    waiting = iter(list(pairwise(cuts)))  # all threads take their next piece from here
    try:
        if cores > 1:  # compiles here: a thread would wait for ever for a module that is being imported
            last = [scratch()] if scratch else [each for each in own or () if each is not None][:1]
            if own is None or last:
                loop(0, 0, *arguments, *last)
        helpers = [_helpers(os.getpid()).submit(work, waiting) for _ in range(cores - 1)]
        try:
            work(waiting)
        finally:  # none works on when this returns
            begun = [helper for helper in helpers if not helper.cancel()]
            wait(begun)
        for helper in begun:
            helper.result()
    except NumbaError as error:
        said = re.sub(r"\x1b\[\d*m", "", str(error))  # bold where colorama is installed
        reason = next(line for line in said.splitlines() if not line.startswith("Failed in"))
        reason = re.sub(r",? ?(defined )?at \w+_[0-9a-f]{16} \(\d+\)", "", reason)
        line = re.search(r'File "(\w+_[0-9a-f]{16})", line (\d+)', said)
        place = places.get((line[1], int(line[2])), "") if line else ""
        raise DoesNotCompile(f"kernel '{name}' does not compile: {reason}{place}{hint}") from error


class _Bundle:
    """Sources in the order they are needed, each under a name that says what it is.

    The name has the hash of the source, in which the names of all that it needs stand: two closures of
    one function, over different models, are two, and what two kernels need is one and compiled once.
    """

    def __init__(self, allocates: bool = True) -> None:
        # a division by zero gives infinity, which is a failure of its run, and no exception
        inner = "error_model='numpy', no_cpython_wrapper=True, no_cfunc_wrapper=True"
        bounds = ", boundscheck=True" if os.environ.get("FUSELOG_BOUNDSCHECK") == "1" else ""
        self.options = f"_nrt={allocates}{bounds}"
        inner += ", pipeline_class=Inlined"
        if not allocates:  # one piece is faster where no counting of references stands in the way
            inner += ", forceinline=True"
        self._decorator = f"@numba.njit({inner}, {self.options})"
        self.definitions: dict[str, str] = {}
        # where a definition's lines come from, in words
        self.places: dict[tuple[str, int], str] = {}
        self._names: dict[Any, str] = {}

    def add(self, name: str, value: Any) -> str:
        """Define a value, called `name` where it is used, and before it what it needs; its own name."""
        value = inspect.unwrap(value)  # what has been compiled already is compiled with the rest
        literal = _literal(value)
        origin = getattr(value, "__qualname__", "<locals>")
        if literal is None and "<locals>" in origin and not isinstance(value, FunctionType | ModuleType):
            raise BadInput(
                f"a kernel uses '{name}', a {type(value).__name__}, which is neither a function, a "
                "number "
                "nor a tuple, and cannot be imported by name: pass it as an argument"
            )
        key = value if literal is None else (name, literal)
        if key not in self._names:
            self._names[key] = self._define(name, value, origin, literal)
        return self._names[key]

    def _define(self, name: str, value: Any, origin: str, literal: str | None) -> str:
        lines: dict[int, str] = {}
        if isinstance(value, FunctionType) and not _is_known_to_numba(value):
            name = value.__name__
            source, lines = self._source(value)
            definition = f"{self._decorator}\n{source}"
        elif isinstance(value, ModuleType):
            if value.__name__.partition(".")[0] not in _VERSIONED:
                raise BadInput(
                    f"a kernel uses the module {value.__name__}: import what it needs by name, "
                    "so that a change in the module is noticed"
                )
            definition = f"import {value.__name__} as {_NAME}"
        elif literal is not None:
            definition = f"{_NAME} = {literal}"
        elif _is_made_here(value):
            definition = f"{_NAME} = collections.namedtuple({name!r}, {value._fields})"
        else:
            definition = f"from {value.__module__} import {origin} as {_NAME}  # {_stamp(value)}"
        own = f"{name}_{sha256(definition.encode()).hexdigest()[:16]}"
        self.definitions[own] = definition.replace(_NAME, own)
        self.places |= {(own, 1 + line): place for line, place in lines.items()}
        return own

    def _source(self, function: FunctionType) -> tuple[str, dict[int, str]]:
        """A function called `_NAME`, and where its lines, counted from 1, come from."""
        closure = inspect.getclosurevars(function)
        needed = {**closure.globals, **closure.nonlocals}
        definition = _definition(function)
        file, above = function.__code__.co_filename, function.__code__.co_firstlineno - 1
        for node in ast.walk(definition):
            if _is_global_random(node, needed):
                raise DoesNotCompile(
                    f"{function.__qualname__} uses np.random ({file}, line {above + node.lineno}): its "
                    "numbers would depend on how runs are shared among cores; draw from the generator "
                    "that the run is given (draws=True)"
                )
        names = {name: self.add(name, value) for name, value in needed.items()}
        definition.name = _NAME
        for node in ast.walk(definition):
            if isinstance(node, ast.Name):
                node.id = names.get(node.id, node.id)
        source = ast.unparse(definition)
        before, after = (
            [node for node in ast.walk(tree) if isinstance(node, ast.stmt)]
            for tree in (definition, ast.parse(source).body[0])
        )
        return source, {
            new.lineno: f" ({file}, line {above + old.lineno})"
            for old, new in zip(before, after, strict=True)
        }


def _is_global_random(node: ast.AST, needed: Mapping[str, Any]) -> TypeGuard[ast.expr]:
    """Whether an expression is NumPy's module of generators that are nobody's own."""
    if isinstance(node, ast.Attribute) and node.attr == "random":
        return isinstance(node.value, ast.Name) and needed.get(node.value.id) is np
    if isinstance(node, ast.Name):
        found = needed.get(node.id)
        return found is np.random or getattr(found, "__self__", None) is np.random.mtrand._rand
    return False


def _is_made_here(value: Any) -> bool:
    """Whether it is a NamedTuple that was made at run time, which no import by name finds."""
    made = isinstance(value, type) and issubclass(value, tuple) and hasattr(value, "_fields")
    return made and getattr(sys.modules.get(value.__module__), value.__name__, None) is not value


def _is_known_to_numba(function: FunctionType) -> bool:
    """Whether numba has an implementation of its own for it (`numba.extending.overload`)."""
    context = cpu_target.typing_context
    context.refresh()
    try:
        context.resolve_value_type(function)
    except ValueError:
        return False
    return True


def _stamp(value: Any) -> str:
    """What changes with a thing that is imported by name, and so makes another kernel.

    Of a NamedTuple the order of its fields; of what numba has an implementation of, the module's source.
    """
    if hasattr(value, "_fields"):
        return " ".join(value._fields)
    if value.__module__.partition(".")[0] in _VERSIONED:
        return ""
    try:
        return sha256(inspect.getsource(sys.modules[value.__module__]).encode()).hexdigest()
    except (OSError, TypeError):  # written in C
        return ""


def _literal(value: Any) -> str | None:
    """A number, text, tuple of these or read-only array as source; None for anything else."""
    if isinstance(value, float):
        return f"float('{float(value)!r}')"  # infinity and NaN too
    if isinstance(value, tuple):
        entries = [_literal(entry) for entry in value]
        return None if None in entries else f"({''.join(f'{entry}, ' for entry in entries)})"
    if isinstance(value, np.ndarray) and not value.flags.writeable and not value.dtype.hasobject:
        content = f"bytes.fromhex('{value.tobytes().hex()}'), '{value.dtype.str}'"
        return f"numpy.frombuffer({content}).reshape({value.shape})"
    return repr(value) if isinstance(value, bool | int | str) else None


def _definition(function: FunctionType) -> ast.FunctionDef:
    """A function's source without its decorators and docstring."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    except (OSError, TypeError, SyntaxError) as error:
        raise BadInput(
            f"the source of {function.__qualname__} cannot be found ({error}); "
            "define it as a function in a file"
        ) from error
    definition = tree.body[0]
    if not isinstance(definition, ast.FunctionDef):
        raise BadInput(
            f"{function.__qualname__} is not a `def` function, of which kernels are made; write it as "
            "one"
        )
    definition.decorator_list = []
    if ast.get_docstring(definition) is not None:
        definition.body = definition.body[1:]
    return definition


def _compile(
    bundle: _Bundle, called: str, definition: str, function: Callable[..., Any]
) -> Callable[..., Any]:
    """The function `kernel` that calls one that a bundle holds, which is made of `function`."""
    for own, source in bundle.definitions.items():
        if own not in vars(_PARTS):
            _execute(source, own, _PARTS)
    needed = f"import numba\nfrom {_PARTS.__name__} import {called}"
    text = f"{needed}\n@numba.njit(nogil=True, {bundle.options})\n{definition}\n"
    return _load(text, f"{function.__module__}.{function.__name__}")


def _execute(source: str, name: str, module: ModuleType) -> None:
    exec(compile(source, name, "exec", __future__.annotations.compiler_flag), vars(module))


@lru_cache(maxsize=64)
def _load(text: str, title: str) -> Callable[..., Any]:
    """The function `kernel` of a module with this text; `title` is what to call it to a user."""
    versions = f"{sys.implementation.cache_tag} numba {numba.__version__} numpy {version('numpy')}"
    name = f"kernel_{sha256((versions + text).encode()).hexdigest()[:24]}"
    module = ModuleType(name)
    sys.modules[name] = module  # compiled code that was kept looks for it there
    _execute(text, name, module)
    if not numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        module.kernel._cache = code = _CompiledCode(name, title)
        module.kernel.compile = partial(code.compile, module.kernel.compile)
    return module.kernel


class _CompiledCode:
    """Keeps the compiled code of one kernel, in the place of numba's own cache.

    A file is checked before it is executed. Nothing about the disk stops the work: what cannot be loaded
    is compiled anew and replaced.
    """

    cache_path = None

    def __init__(self, name: str, title: str) -> None:
        self._name = name
        self._title = title
        # what holds while it is compiled
        self._meanwhile = ExitStack()

    def compile(self, by_numba: Callable[[Any], Any], signature: Any) -> Any:
        """Load or compile the kernel for these types of arguments; numba asks the methods below."""
        with global_compiler_lock, self._meanwhile:
            return by_numba(signature)

    def load_overload(self, signature: Any, target: Any) -> CompileResult | None:
        """The code, or None: it is compiled then, which is said where it takes long.

        Of several processes that want it one compiles, and the others load what that one has kept.
        """
        target.refresh()  # numba's own cache says: "to ensure it is initialized"
        path = self._path(signature, target)
        if path is None or not is_private(path.parent):
            self._meanwhile.enter_context(_compiling(self._title))
            return None
        found = _loaded(path, target)
        if found is None:
            self._meanwhile.enter_context(_compiling(self._title))
            if self._meanwhile.enter_context(in_turn(path)):
                found = _loaded(path, target)
        return found

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep the code."""
        path = self._path(signature, result.target_context)
        # an address in the code is worth nothing in another process
        if path is None or result.library.has_dynamic_globals or not is_private(path.parent):
            return
        try:
            write_checked(path, dumps((path.name, result._reduce())), "a kernel that fuselog compiled")
        except BadInput as error:
            why = str(error).removeprefix(f"{path}: ")
            say_once(f"the cache {path.parent} {why}: what is compiled now is not kept")

    def _path(self, signature: Any, target: Any) -> Path | None:
        """The file for one processor and these types of arguments."""
        key = "\n".join([*map(str, target.codegen().magic_tuple()), *map(_described, signature)])
        try:
            folder = cache_folder()
        except RuntimeError:  # a user without a home
            return None
        return folder / "kernels" / f"{self._name}-{sha256(key.encode()).hexdigest()[:24]}.bin"


def _loaded(path: Path, target: Any) -> CompileResult | None:
    content = read_checked(path)
    if content is None:
        return None
    try:
        name, parts = pickle.loads(content)
        return CompileResult._rebuild(target, *parts) if name == path.name else None
    except Exception:  # whatever a file of other versions, or of a class that has moved, leads to
        return None


@contextmanager
def _compiling(title: str) -> Iterator[None]:
    """Say that a kernel is compiled, where that takes long, and collect no garbage meanwhile.

    A compiler makes very many objects and little garbage; looking for that takes a seventh of its time.
    """
    patience = Timer(_PATIENCE_S, _LOG.info, (f"compiling {title}, once",))
    patience.daemon = True
    collecting = gc.isenabled()
    gc.disable()
    patience.start()
    try:
        yield
    finally:
        patience.cancel()
        if collecting:
            gc.enable()


def _described(kind: Any) -> str:
    """The name of a type, and the fields of a named tuple, which numba knows by its class alone."""
    if not isinstance(kind, types.BaseTuple):
        return str(kind)
    entries = ", ".join(map(_described, kind.types))  # type: ignore[attr-defined]
    return f"{getattr(kind, 'instance_class', tuple)} {getattr(kind, 'fields', '')} ({entries})"
