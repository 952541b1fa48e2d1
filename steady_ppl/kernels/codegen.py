"""Writes the code of a kernel from its scalar graph.

An instruction works on `SIMD_LANES` particles at once; what does not differ between them is computed once a trajectory.
"""

from collections.abc import Sequence
from contextlib import contextmanager
from typing import Any

from llvmlite import ir
from numba.core import cgutils

from steady_ppl.kernels.graph import PARTICLE, Elementwise, NotCompilable, Product, ScalarGraph
from steady_ppl.kernels.simd import FLOAT, OPERATIONS, Lanes

KERNEL_NAME = "kernel"  # of its module and its function
SIMD_LANES = 16  # particles of one instruction
WIDE, LONG = ir.VectorType(FLOAT, SIMD_LANES), ir.IntType(64)
POINTER = FLOAT.as_pointer()


def source(graph: ScalarGraph, inputs: Sequence[str], columns: dict[str, int]) -> str:
    """The code of a graph, for a `Kernel`; `NotCompilable` where some operation has none.

    `inputs` are those that differ between particles, the first of which is looked up at the ancestors. `columns` are of
    those that differ between trajectories only, name → first column.
    """
    return str(_Writer(graph, inputs, columns).module)


class _Writer:
    """Writes the code of one kernel; values are written when they are first asked for."""

    def __init__(self, graph: ScalarGraph, inputs: Sequence[str], columns: dict[str, int]) -> None:
        self.graph, self.columns = graph, columns
        self.module = ir.Module(KERNEL_NAME)
        kind = ir.FunctionType(ir.VoidType(), [POINTER] * (len(inputs) + 2) + [LONG.as_pointer(), POINTER, *[LONG] * 3])
        function = ir.Function(self.module, kind, KERNEL_NAME)
        for argument in function.args[: len(inputs) + 4]:
            argument.add_attribute("noalias")
        self.parameters, self.uniform, *data = function.args[: len(inputs) + 2]
        self.data = dict(zip(inputs, data, strict=True))
        self.first_input = inputs[0]
        self.ancestors, self.out, self.trajectories, self.particles, self.width = function.args[len(inputs) + 2 :]
        self.entry = function.append_basic_block("entry")
        self.builder = ir.IRBuilder(self.entry)
        self.values: dict[int, Lanes] = {}
        self.stored: dict[int, Any] = {}  # vectors as a whole, in the function's own memory
        self.needed, vectors = graph.uses()
        self.bases = {  # what a product with single scalars shares between particles
            number: self._reserve(FLOAT, vector.length)
            for number, vector in ((number, graph.vectors[number]) for number in sorted(vectors))
            if isinstance(vector, Product) and graph.whole_vector(vector.x) is None
        }
        self._write()
        self.builder.ret_void()

    @contextmanager
    def _loop(self, end: Any, step: int = 1) -> Any:
        """for i in range(0, end, step)."""
        with cgutils.for_range_slice(self.builder, LONG(0), end, LONG(step)) as (i, _):
            yield i

    def _reserve(self, kind: Any, count: int) -> Any:
        with self.builder.goto_block(self.entry):
            return self.builder.alloca(kind, count)

    def _write(self) -> None:
        builder, graph = self.builder, self.graph
        start = builder.append_basic_block("start")
        builder.branch(start)
        builder.position_at_end(start)
        with self._loop(self.trajectories) as b:
            self.trajectory = builder.mul(b, self.width)
            self.row = builder.mul(b, self.particles)
            self.stride = builder.mul(self.trajectories, self.particles)
            for number in sorted(self.needed):
                if graph.levels[number] < PARTICLE:
                    self.scalar(number)
            for vector in self.bases:
                self._base(vector)
            shared = dict(self.values)
            with self._loop(self.particles, SIMD_LANES) as i:
                last = builder.sub(self.particles, LONG(SIMD_LANES))
                beyond = builder.icmp_signed(">", i, last)
                self.at = builder.add(self.row, builder.select(beyond, last, i))  # the last block overlaps
                self._gather()
                for number in sorted(self.needed):
                    self.scalar(number)
                for k, number in enumerate(graph.outputs):
                    value = self.scalar(number).spread(SIMD_LANES)
                    if value.element == ir.IntType(1):
                        raise NotCompilable("a truth value as a result")
                    place = self._wide(self.out, builder.add(builder.mul(LONG(k), self.stride), self.at))
                    builder.store(value.value, place, align=4)
            self.values = shared

    def _load(self, pointer: Any, index: Any) -> Lanes:
        return Lanes(self.builder, self.builder.load(self.builder.gep(pointer, [index])))

    def _wide(self, pointer: Any, index: Any) -> Any:
        """Where the numbers of all lanes lie, aligned as a single one."""
        return self.builder.bitcast(self.builder.gep(pointer, [index]), WIDE.as_pointer())

    def _gather(self) -> None:
        """Load the elements of the first input that are needed, where the ancestors lie."""
        builder, graph = self.builder, self.graph
        wanted = [n for n in sorted(self.needed) if graph.scalars[n].arguments[:1] == (self.first_input,)]
        places = [self._reserve(WIDE, 1) for _ in wanted]
        pointer = self.data[self.first_input]
        starts = [builder.mul(LONG(graph.scalars[n].arguments[1]), self.stride) for n in wanted]
        none = builder.icmp_unsigned("==", builder.ptrtoint(self.ancestors, LONG), LONG(0))
        with builder.if_else(none) as (same, moved):
            with same:
                for start, place in zip(starts, places, strict=True):
                    builder.store(builder.load(self._wide(pointer, builder.add(start, self.at)), align=4), place)
            with moved:
                from_row = [builder.add(start, self.row) for start in starts]
                gathered = [ir.Constant(WIDE, ir.Undefined)] * len(wanted)
                for lane in range(SIMD_LANES):
                    index = builder.load(builder.gep(self.ancestors, [builder.add(self.at, LONG(lane))]))
                    for j, start in enumerate(from_row):
                        value = builder.load(builder.gep(pointer, [builder.add(start, index)]))
                        gathered[j] = builder.insert_element(gathered[j], value, ir.IntType(32)(lane))
                for value, place in zip(gathered, places, strict=True):
                    builder.store(value, place)
        for number, place in zip(wanted, places, strict=True):
            self.values[number] = Lanes(builder, builder.load(place))

    def scalar(self, number: int) -> Lanes:
        if number in self.values:
            return self.values[number]
        operation, arguments = self.graph.scalars[number]
        builder = self.builder
        match operation:
            case "constant":
                return Lanes(builder, FLOAT(arguments[0]))
            case "parameter":
                value = self._load(self.parameters, LONG(arguments[0]))
            case "input" if self.graph.levels[number] < PARTICLE:
                column = self.columns[arguments[0]] + arguments[1]
                value = self._load(self.uniform, builder.add(self.trajectory, LONG(column)))
            case "input":
                start = builder.mul(LONG(arguments[1]), self.stride)
                place = self._wide(self.data[arguments[0]], builder.add(start, self.at))
                value = Lanes(builder, builder.load(place, align=4))
            case "element":
                vector, k = arguments
                if vector not in self.stored:
                    self._vector(vector)
                value = self._load(self.stored[vector], LONG(k))
            case _:
                value = self._operate(operation, [self.scalar(n) for n in arguments])
        self.values[number] = value
        return value

    def _operate(self, operation: str, operands: Sequence[Lanes]) -> Lanes:
        if operation not in OPERATIONS:
            raise NotCompilable(f"no kernel for {operation}")
        return OPERATIONS[operation](*operands)

    def _bias(self, product: Product, k: Any) -> Lanes:
        """The bias of one element; k is known now, or the kernel's own number."""
        run = self.graph.run_of_parameters(product.bias)
        if product.bias is None:
            return Lanes(self.builder, FLOAT(0))
        if run is not None:
            return self._load(self.parameters, self.builder.add(LONG(run), k))
        if not isinstance(k, ir.Constant):
            raise NotCompilable("a long product whose bias is no parameter")
        return self.scalar(product.bias[k.constant])

    def _weight(self, product: Product, row: Any, column: Any) -> Lanes:
        builder = self.builder
        down, across = builder.mul(row, LONG(product.rows)), builder.mul(column, LONG(product.columns))
        return self._load(self.parameters, builder.add(builder.add(LONG(product.at), down), across))

    def _base(self, vector: int) -> None:
        """Bias and whatever else of a product does not differ between particles, once a trajectory."""
        product: Any = self.graph.vectors[vector]
        shared = [(i, self.scalar(n)) for i, n in enumerate(product.x) if self.graph.levels[n] < PARTICLE]
        with self._loop(LONG(product.length)) as k:
            value = self._bias(product, k)
            for i, x in shared:
                value = value + self._weight(product, k, LONG(i)) * x
            self.builder.store(value.value, self.builder.gep(self.bases[vector], [k]))

    def _vector(self, vector: int) -> None:
        """Compute a vector as a whole and keep it."""
        what = self.graph.vectors[vector]
        place = self._reserve(WIDE, what.length)
        if isinstance(what, Elementwise) or (whole := self.graph.whole_vector(what.x)) is None:
            self._prepare(vector)
            with self._loop(LONG(what.length)) as k:
                value = self._element(vector, k, {})
                self.builder.store(value.spread(SIMD_LANES).value, self.builder.gep(place, [k]))
        elif what.length > 8:
            if whole not in self.stored:
                self._vector(whole)
            with self._loop(LONG(what.length)) as row:
                self._sum(what, whole, [row], place)
        else:
            self._prepare(whole)
            self._sum(what, whole, [LONG(row) for row in range(what.length)], place)
        self.stored[vector] = place

    def _sum(self, product: Product, whole: int, rows: Sequence[Any], place: Any) -> None:
        """Some rows of a product with a whole vector, whose elements are computed on the way unless they are stored."""
        builder = self.builder
        sums = [self._reserve(WIDE, 1) for _ in rows]
        for row, total in zip(rows, sums, strict=True):
            builder.store(self._bias(product, row).spread(SIMD_LANES).value, total)
        with self._loop(LONG(self.graph.vectors[whole].length)) as k:
            value = self._element(whole, k, {})
            for row, total in zip(rows, sums, strict=True):
                so_far = Lanes(builder, builder.load(total))
                builder.store((so_far + self._weight(product, row, k) * value).value, total)
        for row, total in zip(rows, sums, strict=True):
            builder.store(builder.load(total), builder.gep(place, [row]))

    def _prepare(self, vector: int) -> None:
        """Compute before a loop over a vector's elements what its body takes as given."""
        what = self.graph.vectors[vector]
        if vector in self.stored:
            return
        if isinstance(what, Elementwise):
            for kind, n in what.operands:
                if kind == "vector":
                    self._prepare(n)
                elif kind == "scalar":
                    self.scalar(n)
        elif self.graph.whole_vector(what.x) is not None:
            self._vector(vector)
        else:
            for n in what.x:
                self.scalar(n)

    def _element(self, vector: int, k: Any, done: dict[int, Lanes]) -> Lanes:
        """Element k of a vector, in the body of a loop over k."""
        if vector in done:
            return done[vector]
        graph, builder = self.graph, self.builder
        what = graph.vectors[vector]
        if vector in self.stored:
            value = self._load(self.stored[vector], k)
        elif isinstance(what, Product):
            value = self._load(self.bases[vector], k)
            for i, n in enumerate(what.x):
                if graph.levels[n] == PARTICLE:
                    value = value + self._weight(what, k, LONG(i)) * self.scalar(n)
        else:
            operands = []
            for kind, n in what.operands:
                if kind == "vector":
                    operands.append(self._element(n, k, done))
                elif kind == "scalar":
                    operands.append(self.scalar(n))
                else:
                    operands.append(self._load(self.parameters, builder.add(LONG(n), k)))
            value = self._operate(what.operation, operands)
        done[vector] = value
        return value
