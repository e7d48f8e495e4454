# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
A small compiler, which makes machine code of functions in a part of Python.

Theory of operation
-------------------
1.  The source has integers, tuples of them, lists that contain either, and named tuples of lists
    and integers (``kinds``).  Every function has annotations, so the kind of a variable is that of
    the value which it gets first.  A name that the function does not assign is a constant or a
    function of its module.
2.  There are no checks: an index must be from 0 to below the length, and integers have 64 bits.
    (Tests compare with the same functions on Python's lists, where Python checks.)
3.  Each function that is called is translated once (``statements``, ``expressions``).  All of
    them form one module of LLVM (``program``), and LLVM decides which ones it links into their
    callers.  ``writer`` writes the instructions, ``machine_code`` has LLVM make code of them.
4.  A list that a function makes is a vector of its own, whose memory it frees when it returns.  It
    has one name.  A list in a list has a new address when the outer list becomes longer, so a
    variable must not have it then.  Without memory the program ends.
5.  An argument that is a function is not passed: a program has one function for all of these.  An
    argument that may be a function or None is always None.

What the source must not contain raises ``NotCompiledError`` with file and line.

Nothing here knows the scheduler.  All modules but ``kinds`` and ``runtime`` need llvmlite.
"""
