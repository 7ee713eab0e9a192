"""Explicit vectors of sixteen float32 values in kernels: one row of a tile.

A compiler vectorizes a loop only if it can prove that the arrays do not overlap, and one missed proof costs a factor
of five. The vectors are therefore explicit: a kernel loads a row, computes with ``+ - * /`` and the functions below,
and stores it. LLVM maps sixteen lanes to the instructions of the machine (AVX-512, AVX2, NEON).

These functions can be called from kernels only.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import extending
from numba.core import types
from numba.extending import models, overload, register_model

intrinsic: Any = extending.intrinsic  # its annotations describe the undecorated function
LANES = 16
_LLVM = ir.VectorType(ir.FloatType(), LANES)
# Allows a * b + c to become one fused instruction; no other fast-math flag is set.
_FLAGS = ("contract",)


class _LanesType(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"float32x{LANES}")


_lanes = _LanesType()


@register_model(_LanesType)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _LLVM)


def _splat(builder: Any, scalar: Any) -> Any:
    empty = ir.Constant(_LLVM, ir.Undefined)
    first = builder.insert_element(empty, scalar, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(first, empty, zeros)


def _operand(builder: Any, kind: Any, value: Any) -> Any:
    return value if isinstance(kind, _LanesType) else _splat(builder, value)


def _pointer(context: Any, builder: Any, kind: Any, array: Any, offset: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [offset]), _LLVM.as_pointer())


@intrinsic
def load(typingctx: Any, array: Any, offset: Any) -> Any:
    """Load sixteen values of a flat float32 array, starting at ``offset``."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = builder.load(_pointer(context, builder, signature.args[0], *args))
        value.align = 4
        return value

    return _lanes(array, types.intp), generate


@intrinsic
def store(typingctx: Any, array: Any, offset: Any, value: Any) -> Any:
    """Write sixteen values to a flat float32 array, starting at ``offset``."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        where = _pointer(context, builder, signature.args[0], args[0], args[1])
        builder.store(args[2], where).align = 4
        return context.get_dummy_value()

    return types.void(array, types.intp, _lanes), generate


@intrinsic
def splat(typingctx: Any, scalar: Any) -> Any:
    """The same float32 in every lane."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _splat(builder, args[0])

    return _lanes(types.float32), generate


def _binary(instruction: str) -> Any:
    @intrinsic
    def function(typingctx: Any, left: Any, right: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            operands = [_operand(builder, kind, value) for kind, value in zip(signature.args, args)]
            return getattr(builder, instruction)(*operands, flags=_FLAGS)

        kinds = [_lanes if isinstance(kind, _LanesType) else types.float32 for kind in (left, right)]
        return _lanes(*kinds), generate

    return function


_add, _sub, _mul, _div = (_binary(name) for name in ("fadd", "fsub", "fmul", "fdiv"))


def _overload_operator(symbol: Any, function: Any) -> None:
    # Numba compares the signatures of both functions, annotations included.
    @overload(symbol)
    def choose(left, right):  # type: ignore[no-untyped-def]
        if isinstance(left, _LanesType) or isinstance(right, _LanesType):
            return lambda left, right: function(left, right)
        return None


for _symbol, _function in (
    (operator.add, _add),
    (operator.iadd, _add),
    (operator.sub, _sub),
    (operator.mul, _mul),
    (operator.truediv, _div),
):
    _overload_operator(_symbol, _function)


@intrinsic
def select_greater(typingctx: Any, left: Any, right: Any, yes: Any, no: Any) -> Any:
    """Per lane, ``yes`` where ``left > right``, otherwise ``no`` (also if one of them is NaN)."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        left, right, yes, no = (_operand(builder, k, v) for k, v in zip(signature.args, args))
        return builder.select(builder.fcmp_ordered(">", left, right), yes, no)

    kinds = [_lanes if isinstance(k, _LanesType) else types.float32 for k in (left, right, yes, no)]
    return _lanes(*kinds), generate


@intrinsic
def any_positive(typingctx: Any, value: Any) -> Any:
    """Whether any lane is greater than zero."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        mask = builder.fcmp_ordered(">", args[0], ir.Constant(_LLVM, [0.0] * LANES))
        bits = builder.bitcast(mask, ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(_lanes), generate


@intrinsic
def total(typingctx: Any, value: Any) -> Any:
    """Sum of the lanes in a fixed order: the upper half is added to the lower half until one lane remains."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value, width = args[0], LANES
        while width > 1:
            width //= 2
            low = ir.Constant(ir.VectorType(ir.IntType(32), width), list(range(width)))
            high = ir.Constant(ir.VectorType(ir.IntType(32), width), list(range(width, 2 * width)))
            value = builder.fadd(
                builder.shuffle_vector(value, value, low), builder.shuffle_vector(value, value, high)
            )
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return types.float32(_lanes), generate


@intrinsic
def store_totals(typingctx: Any, array: Any, offset: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Write the sums of the lanes of four vectors to a flat float32 array, starting at ``offset``.

    Folding the vectors into each other takes half the steps of four calls of `total`.
    """

    def indices(*groups: range) -> Any:
        numbers = [i for group in groups for i in group]
        return ir.Constant(ir.VectorType(ir.IntType(32), len(numbers)), numbers)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array, offset, *vectors = args
        block = LANES  # lanes that belong to the same vector
        while len(vectors) > 1:
            half = block // 2
            starts = range(0, 2 * LANES, block)
            low = indices(*(range(s, s + half) for s in starts))
            high = indices(*(range(s + half, s + block) for s in starts))
            vectors = [
                builder.fadd(builder.shuffle_vector(x, y, low), builder.shuffle_vector(x, y, high))
                for x, y in zip(vectors[::2], vectors[1::2])
            ]
            block = half
        value = vectors[0]
        while block > 1:
            half = block // 2
            starts = range(0, 4 * block, block)
            low = indices(*(range(s, s + half) for s in starts))
            high = indices(*(range(s + half, s + block) for s in starts))
            value = builder.fadd(
                builder.shuffle_vector(value, value, low), builder.shuffle_vector(value, value, high)
            )
            block = half
        data = context.make_array(signature.args[0])(context, builder, array).data
        where = builder.bitcast(builder.gep(data, [offset]), ir.VectorType(ir.FloatType(), 4).as_pointer())
        builder.store(value, where).align = 4
        return context.get_dummy_value()

    return types.void(array, types.intp, _lanes, _lanes, _lanes, _lanes), generate
