"""Answers to a name that is not there: the right one that is nearest to it, and all that there are."""

from collections.abc import Iterable

from diffsim_ti.common.answers import answer

# words of other programs and of other ears, each with what it may be called here
_ELSEWHERE = """
arch: backend; axis: normal direction; body: mesh; boundary_conditions: fixed; bulk: bulk_modulus; cells: tetrahedra;
centre: center; color: colour; colors: colours; delta_t: dt; device: backend; dhat: width; dirichlet: fixed;
dtype: precision; elements: tetrahedra; faces: triangles; file: path; filename: path; fixed_vertices: fixed;
forces: terms; g: gravity; k: stiffness; kappa: stiffness bulk_modulus; lambda_: lam; lame_lambda: lam; lame_mu: mu;
law: material; loads: terms; margin: width; max_iter: max_iterations; maxiter: max_iterations; mu: friction;
n_steps: steps; nodes: vertices; num_steps: steps; pinned: fixed; poisson: poissons_ratio; r: radius; rho: density;
shear_modulus: mu; step_size: dt; tets: tetrahedra; thickness: width; time_step: dt; timestep: dt; tol: tolerance;
trajectory: path; v0: initial_velocities; verts: vertices; viscosity: shear_viscosity; x0: initial_positions;
y: height; young: youngs_modulus
"""
ELSEWHERE = {word.strip(): names.split() for word, names in (x.split(":") for x in _ELSEWHERE.split(";"))}


def edits(a: str, b: str) -> int:
    """How many letters to insert, leave out, replace or swap with their neighbours lead from one word to another."""
    before, row = [], list(range(len(b) + 1))
    for i, x in enumerate(a, 1):
        before, last, row = row, before, [i]
        for j, y in enumerate(b, 1):
            row.append(min(before[j] + 1, row[-1] + 1, before[j - 1] + (x != y)))
            if i > 1 and j > 1 and x == b[j - 2] and a[i - 2] == y:
                row[-1] = min(row[-1], last[j - 2] + 1)
    return row[-1]


def nearest(name: str, names: Iterable[str]) -> str | None:
    """Which of the names was meant: that with the fewest slips, at most one in three letters; then what other programs say
    for it, or what has a word in common. None: none is near."""
    names = list(dict.fromkeys(names))
    if not names:
        return None
    slips = {x: edits(name.lower(), x.lower()) for x in names}
    best = min(names, key=slips.__getitem__)
    if 0 < slips[best] <= 1 and min(len(name), len(best)) > 2:
        return best
    for known in ELSEWHERE.get(name.lower(), ()):
        if known in names:
            return known
    if slips[best] <= max(1, len(name) // 3):
        return best
    parts = set(name.lower().split("_"))
    shared = {x: len(parts & set(x.lower().replace(".", "_").split("_"))) for x in names}
    best = max(names, key=lambda x: (shared[x], -slips[x]))
    return best if shared[best] else None


def no_such(what: str, name: object, names: Iterable[str], owner: str) -> str:
    """The sentence for a name that `owner` does not have, `what` being an input, an output ..."""
    names = list(names)
    near = nearest(str(name), names)
    meant = f"; did you mean {near!r}?" if near else ""
    return f"no {what} named {name!r}; {owner} has {', '.join(names)}{meant}"


def check_arguments(owner: str, given: Iterable[str], names: Iterable[str]) -> None:
    """Raise TypeError for an argument that `owner` does not take."""
    names = list(names)
    for name in given:
        if name not in names:
            if said := answer(owner, name):
                raise TypeError(f"{owner} has no argument {name!r}: {said}")
            near = nearest(name, names)
            meant = f"; did you mean {near!r}?" if near else "."
            raise TypeError(f"{owner} has no argument {name!r}{meant} It takes {', '.join(names) or 'none'}")
