# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Machine code: made of a program by LLVM, and loaded.

The code is for any processor of the machine's architecture, so machines may share a home folder.

This module needs llvmlite.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
import ctypes
from typing import Any

from llvmlite import binding as llvm
from mddag_executor.compiler.program import Program

_OPTIMISED = 2
"""LLVM's level: 3 takes a fifth longer, and does not make faster code."""
_INLINED = 225
"""LLVM's own threshold for linking functions into their callers, of its level 2."""


def make(program: Program) -> bytes:
    """Compile a program, and return an object file."""
    machine = _target_machine()
    module = llvm.parse_assembly(str(program.module))
    _optimise(module, machine)
    code: bytes = machine.emit_object(module)
    return code


def _target_machine() -> Any:
    with suppress(RuntimeError):  # newer versions need no initialisation, and refuse this one
        llvm.initialize()
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(
        opt=_OPTIMISED, reloc='default', codemodel='jitdefault')


def _optimise(module: Any, machine: Any) -> None:
    """Optimise a module, but not for vectors: no loop is long enough for them."""
    if hasattr(llvm, 'create_pass_builder'):
        options = llvm.create_pipeline_tuning_options(_OPTIMISED)
        options.loop_vectorization = options.slp_vectorization = False
        builder = llvm.create_pass_builder(machine, options)
        builder.getModulePassManager().run(module, builder)
        return
    # before llvmlite 0.44
    builder = llvm.create_pass_manager_builder()
    builder.opt_level = _OPTIMISED
    builder.inlining_threshold = _INLINED
    passes = llvm.create_module_pass_manager()
    builder.populate(passes)
    passes.run(module)


class MachineCode:
    """
    Loaded machine code.

    :param code: an object file.
    """

    def __init__(self, code: bytes) -> None:
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(''), _target_machine())
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        self._engine.finalize_object()

    def function(self, name: str, arguments: int) -> Callable[..., int]:
        """Return a function, which gets integers or addresses, and does not hold the GIL."""
        kind = ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_int64] * arguments)
        function: Any = kind(self._engine.get_function_address(name))
        function.code = self  # remains as long as the function does
        called: Callable[..., int] = function
        return called
