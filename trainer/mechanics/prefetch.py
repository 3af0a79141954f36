"""Memory asked for before it is needed.

A kernel that computes a lot with each number it reads is stuck in the computation before the processor has seen which
memory comes next, and then waits for it. Asked for ahead of time, it comes while the kernel computes. To ask changes
no result; in plain Python it does nothing.
"""

from __future__ import annotations

from typing import Any, SupportsIndex

from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic, overload

#: Bytes that come together.
LINE = 64


def _instruction(typing, values, index):  # type: ignore[no-untyped-def]
    """The processor's instruction: for reading, into the second cache. ``values`` lie side by side."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        where = builder.gep(array.data, [arguments[1]])
        byte, word = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, word, word, word])
        ask = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        builder.call(ask, [builder.bitcast(where, byte), *(ir.Constant(word, n) for n in (0, 2, 1))])
        return context.get_dummy_value()

    return types.void(values, types.intp), generate


_prefetch: Any = intrinsic(_instruction)


def ask_for_line(values: Any, index: SupportsIndex) -> None:
    """Ask for the line of memory that an element lies in, or would; where there is no memory nothing comes."""


@overload(ask_for_line)
def _compiled(values, index):  # type: ignore[no-untyped-def]
    return lambda values, index: _prefetch(values, index)


@njit(cache=True, nogil=True, error_model="numpy")
def ask_for(values, begin, end):  # type: ignore[no-untyped-def]
    """Ask for the elements ``begin`` to ``end`` (not included) of ``values`` (n,), as far as they are there."""
    for k in range(max(begin, 0), min(end, len(values)), LINE // values.itemsize):
        ask_for_line(values, k)
