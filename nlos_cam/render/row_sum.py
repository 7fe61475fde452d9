"""Sum of weighted rows of a table into one window of bins that stays in vector registers: the transport's inner loop.

A compiled loop over rows that adds to an array in memory loads and stores every bin for every row. Here the bins are
values of the compiler's own vectors, so each row costs one load and one multiply-add a vector. The rows are added in
their order, bin by bin, so the result has the bits of the plain loop. On processors with narrower vectors or without a
fused multiply-add the compiler splits the same operations.
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

WINDOW = 32
"""Bins of one sum: four vectors of 8, enough to hide the latency of their multiply-adds."""
VECTOR = 8
"""32-bit numbers of one vector: wider ones cross a cache line at every odd start, and gain nothing."""
_INDEX = ir.IntType(64)


def _add_rows(
    _context: Any,
    sums: Any,
    at: Any,
    table: Any,
    base: Any,
    offset: Any,
    weight: Any,
    first: Any,
    step: Any,
    count: Any,
) -> tuple[Any, Callable[..., Any]]:
    """Add `count` rows of WINDOW bins, times their weights, to sums[at : at + WINDOW]; all arrays are flat.

    Row j begins at table[base[j] + offset[first + j * step]] and has the weight weight[first + j * step].
    """
    columns = sums, at, table, base, offset, weight, first, step, count

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        arrays = [
            context.make_array(kind)(context, builder, arg).data if isinstance(kind, types.Array) else arg
            for kind, arg in zip(signature.args, args, strict=True)
        ]
        target, place, rows, starts, offsets, weights, begin, stride, number = arrays
        vector = ir.VectorType(ir.FloatType(), VECTOR)
        name = f"llvm.fmuladd.v{VECTOR}f32"
        multiply_add = cgutils.get_or_insert_function(builder.module, ir.FunctionType(vector, [vector] * 3), name)
        undefined, same = ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), VECTOR), None)

        def part(pointer: Any, k: int) -> Any:
            return builder.bitcast(builder.gep(pointer, [_INDEX(VECTOR * k)]), vector.as_pointer())

        target = builder.gep(target, [place])
        # Independent accumulators: a multiply-add takes about four cycles, and a single chain of them would leave the
        # unit idle while it waits for its own result. The compiler turns these variables into registers.
        bins = [cgutils.alloca_once(builder, vector) for _ in range(WINDOW // VECTOR)]
        for k, variable in enumerate(bins):
            builder.store(builder.load(part(target, k), align=4), variable)
        with cgutils.for_range(builder, number, intp=_INDEX) as loop:
            j = builder.add(begin, builder.mul(loop.index, stride))
            offset_j = builder.sext(builder.load(builder.gep(offsets, [j])), _INDEX)
            row = builder.gep(rows, [builder.add(builder.load(builder.gep(starts, [loop.index])), offset_j)])
            # Rows are aligned to a number, not to a vector: any shift in bins must be possible.
            lone = builder.insert_element(undefined, builder.load(builder.gep(weights, [j])), ir.IntType(32)(0))
            factor = builder.shuffle_vector(lone, undefined, same)
            for k, variable in enumerate(bins):
                terms = factor, builder.load(part(row, k), align=4), builder.load(variable)
                builder.store(builder.call(multiply_add, terms), variable)
        for k, variable in enumerate(bins):
            builder.store(builder.load(variable), part(target, k), align=4)
        return context.get_dummy_value()

    return types.void(*columns), generate


add_rows: Callable[..., None] = intrinsic(_add_rows)
