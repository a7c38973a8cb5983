"""Compiles functions that end up in another kernel, in a quarter of the time that numba takes.

The text of this file is part of the key of every kernel that is kept: what it changes is compiled anew.
"""

from numba._dynfunc import make_function
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering

from fuselog.replay.engine.compiling.kinds import OfNumba


class _InlinedLibrary(JITCodeLibrary):
    """Holds the code of one function that only other compiled code calls, which gets a copy of it.

    It is optimised there, once; numba would optimise it at every level of calls above it, which takes
    half of the time that a kernel of many small functions needs to compile. Nor is machine code made of
    it, which takes a quarter.
    """

    def _optimize_functions(self, module: OfNumba) -> None:
        """Make the code small for what links it; what takes longer is done where it ends up."""
        module.data_layout = self._codegen._data_layout
        passes, builder = self._codegen._function_pass_manager(opt=1)
        for function in module.functions:
            if not function.is_declaration:
                passes.run(function, builder)

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

    def run_pass(self, state: OfNumba) -> bool:
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
    """Compiles functions that end up in another kernel, see `numba.njit(pipeline_class=...)`."""

    def define_pipelines(self) -> OfNumba:
        """Return the usual passes, but for the last, into a library of another kind."""
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
