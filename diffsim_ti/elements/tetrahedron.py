"""The linear tetrahedron: what each one adds to forces, to their differential and to the adjoint.

H = sum_a (u_a - u_0) (x) grad N_a, a = 1..3, is the displacement gradient; corner forces f_a = -V P grad N_a go to
`corner[4 e + a]`, and vertices gather them, so that there are no atomics and every run gives the same bits.

Data of tetrahedra lie in blocks of eight. On the CPU a block is worked on at once, each number of the formula being a
vector of eight lanes that becomes vector instructions; elsewhere, and for laws that need a loop, tetrahedra go one by one
over the same data. The last block is filled up with copies of tetrahedron 0, whose corners no vertex gathers.
`scene` is a Bundle of tets, gradients, volumes, coefficients, start, corner_of. Vectors of vertices have four components
(the last is zero), since whole loads and stores of four are what vector units do well.
"""

from functools import lru_cache
from types import SimpleNamespace

import taichi as ti

from diffsim_ti.materials.calculus.tensor import Tensor, inner, sum_of
from diffsim_ti.runtime import LANES, PRECISIONS, at, let, traced

A = ti.template()  # an array or Bundle handed to a Taichi function


class _Block:
    """Eight tetrahedra at once: item b is block b."""

    def __init__(self, fp):
        self.vector, self.lanes = ti.types.vector(4, fp), ti.types.vector(LANES, fp)

    def broadcast(self, number):
        return let(self.lanes(*[number] * LANES))

    def numbers(self, array, first: int, count: int, rows: int, item):
        """`count` numbers from `first` on, of the `rows` that each block has."""
        return [let(at(array, rows * item + first + k)) for k in range(count)]

    def corners(self, vectors, slot, tets, item):
        """[a][d]: component d of the vector at corner a."""
        out = []
        for a in range(4):
            whole = [let(at(vectors, slot, at(tets, 4 * LANES * item + LANES * a + lane))) for lane in range(LANES)]
            out.append([let(self.lanes(*(at(w, d) for w in whole))) for d in range(3)])
        return out

    def store(self, corner, item, forces, zero):
        for a in range(4):
            for lane in range(LANES):
                force = self.vector(*(at(forces[a][d], lane) for d in range(3)), zero)
                at(corner, 4 * LANES * item + 4 * lane + a)._assign(force)

    def put(self, array, rows: int, item, first, numbers):
        for k, number in enumerate(numbers):
            at(array, rows * item + first + k)._assign(number)

    def add(self, array, rows: int, item, numbers):
        for k, number in enumerate(numbers):
            target = at(array, rows * item + k)
            target._assign(target + number)


class _Single:
    """One tetrahedron: item e is tetrahedron e, a lane of its block."""

    def __init__(self, fp):
        self.vector = ti.types.vector(4, fp)

    def broadcast(self, number):
        return number

    def numbers(self, array, first: int, count: int, rows: int, item):
        return [let(at(at(array, rows * (item // LANES) + first + k), item % LANES)) for k in range(count)]

    def corners(self, vectors, slot, tets, item):
        block, lane = item // LANES, item % LANES
        whole = [let(at(vectors, slot, at(tets, 4 * LANES * block + LANES * a + lane))) for a in range(4)]
        return [[let(at(w, d)) for d in range(3)] for w in whole]

    def store(self, corner, item, forces, zero):
        for a in range(4):
            at(corner, 4 * item + a)._assign(self.vector(*forces[a], zero))

    def put(self, array, rows: int, item, first, numbers):
        for k, number in enumerate(numbers):
            at(at(array, rows * (item // LANES) + first + k), item % LANES)._assign(number)

    def add(self, array, rows: int, item, numbers):
        for k, number in enumerate(numbers):
            target = at(at(array, rows * (item // LANES) + k), item % LANES)
            target._assign(target + number)


@lru_cache(maxsize=None)
def element_functions(law, uniform: bool, lanes: bool) -> SimpleNamespace:
    """Functions of one item (a block or a tetrahedron) for a law; `uniform`: one set of coefficients serves all."""
    fp = PRECISIONS[law.precision]
    kind, K = (_Block if lanes else _Single)(fp), len(law.coefficient_names)
    vector = kind.vector

    @traced
    def edges(item, scene, u, s) -> Tensor:
        """Columns u_a - u_0 of slot s."""
        x = kind.corners(u, s, scene.tets, item)
        return Tensor(x[a][d] - x[0][d] for d in range(3) for a in (1, 2, 3))

    @traced
    def gradients_of(item, array) -> Tensor:
        """Rows grad N_1..3."""
        return Tensor(kind.numbers(array, 0, 9, 9, item))

    @traced
    def coefficients_of(item, array) -> list:
        """The law's coefficients (the first block holds them for all if they are uniform)."""
        return kind.numbers(array, 0, K, K, 0 if uniform else item)

    @traced
    def coefficients_at(item, scene, u, s) -> list:
        """What the law takes at slot s of the displacement."""
        return coefficients_of(item, scene.coefficients)

    @traced
    def volume_of(item, array):
        return kind.numbers(array, 0, 1, 1, item)[0]

    @traced
    def store(item, corner, Q) -> None:
        """Columns of Q are minus the forces of corners 1..3; corner 0 balances them."""
        minus, zero = ti.cast(-1, fp), ti.cast(0, fp)
        forces = [[let(minus * Q[d, a]) for d in range(3)] for a in range(3)]
        balance = [let(sum_of(Q[d, a] for a in range(3))) for d in range(3)]
        kind.store(corner, item, [balance, *forces], zero)

    @ti.func
    def gather(i, scene: A, corner: A):
        """Sum of the corners that meet at vertex i, in a fixed order."""
        f = vector(0)
        for c in range(scene.start[i], scene.start[i + 1]):
            f = f + corner[scene.corner_of[c]]
        return f

    @traced
    def forces(item, scene, u, s, corner) -> None:
        """Elastic corner forces at slot s."""
        B = gradients_of(item, scene.gradients)
        P = law.stress(edges(item, scene, u, s) @ B, coefficients_of(item, scene.coefficients))
        store(item, corner, (P * volume_of(item, scene.volumes)) @ B.transpose())

    @traced
    def stiffness(item, scene, u, s, w, corner) -> None:
        """Corner products of the derivative of the elastic force with w (negative semi-definite at rest)."""
        B = gradients_of(item, scene.gradients)
        H, dH = edges(item, scene, u, s) @ B, edges(item, scene, w, 0) @ B
        dP = law.stress_differential(H, dH, coefficients_of(item, scene.coefficients))
        store(item, corner, (dP * volume_of(item, scene.volumes)) @ B.transpose())

    @traced
    def forces_jvp(item, scene, u, s, du, corner, dots) -> None:
        """Change of the corner forces for changes of displacements, coefficients and rest shape."""
        B, B_dot = gradients_of(item, scene.gradients), gradients_of(item, dots.gradients)
        volume, p = volume_of(item, scene.volumes), coefficients_of(item, scene.coefficients)
        D = edges(item, scene, u, s)
        H, dH = D @ B, edges(item, scene, du, 0) @ B + D @ B_dot
        # energies are linear in their coefficients, so the stress of the change is the change of the stress
        dP = law.stress_differential(H, dH, p) + law.stress(H, coefficients_of(item, dots.coefficients))
        change = B * volume_of(item, dots.volumes) + B_dot * volume
        store(item, corner, (dP * volume) @ B.transpose() + law.stress(H, p) @ change.transpose())

    @traced
    def forces_vjp(item, scene, u, s, w, corner, adjoint) -> None:
        """Corner products K w of the symmetric stiffness; adds the adjoint of the coefficients.

        The work of the forces on w is -V P(H) : dH, with dH the displacement gradient of w.
        """
        B, volume = gradients_of(item, scene.gradients), volume_of(item, scene.volumes)
        H, dH = edges(item, scene, u, s) @ B, edges(item, scene, w, 0) @ B
        dP, products = law.stress_differential_and_products(H, dH, coefficients_of(item, scene.coefficients))
        store(item, corner, (dP * volume) @ B.transpose())
        minus = let(ti.cast(-1, fp) * volume)
        kind.add(adjoint.coefficients, K, item, [minus * product for product in products])

    @traced
    def shape_vjp(item, scene, u, s, w, adjoint) -> None:
        """Adds the adjoints of grad N and V: the work is -V P(D B) : (W B)."""
        B, volume = gradients_of(item, scene.gradients), volume_of(item, scene.volumes)
        p = coefficients_of(item, scene.coefficients)
        D, W = edges(item, scene, u, s), edges(item, scene, w, 0)
        H, dH = D @ B, W @ B
        P, dP, minus = law.stress(H, p), law.stress_differential(H, dH, p), ti.cast(-1, fp)
        kind.add(adjoint.gradients, 9, item, ((D.transpose() @ dP + W.transpose() @ P) * let(minus * volume)).numbers)
        kind.add(adjoint.volumes, 1, item, [minus * inner(P, dH)])

    block = ti.types.ndarray(ti.types.vector(LANES, fp), 1)
    types = SimpleNamespace(
        fp=fp,
        vector=vector,
        blocks=block,
        scalars=ti.types.ndarray(fp, 1),
        scalars2=ti.types.ndarray(fp, 2),
        vectors=ti.types.ndarray(vector, 1),
        vectors2=ti.types.ndarray(vector, 2),
        ints=ti.types.ndarray(ti.i32, 1),
    )
    return SimpleNamespace(
        types=types,
        numbers=kind.numbers,
        put=kind.put,
        add=kind.add,
        store_corners=kind.store,
        store=store,
        broadcast=kind.broadcast,
        edges=edges,
        gradients_of=gradients_of,
        coefficients_of=coefficients_of,
        coefficients_at=coefficients_at,
        volume_of=volume_of,
        gather=gather,
        forces=forces,
        stiffness=stiffness,
        forces_jvp=forces_jvp,
        forces_vjp=forces_vjp,
        shape_vjp=shape_vjp,
    )
