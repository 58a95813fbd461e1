"""From what a user names (E, nu, density, rest shape ...) to what kernels read, with the chain rule both ways."""

from dataclasses import dataclass, fields

import numpy as np

from diffsim_ti.rows import Rows
from diffsim_ti.terms import ExternalForce


@dataclass
class Derived:
    """What kernels read; also used for tangents and adjoints of the same numbers. None: the scene has no such thing."""

    displacement: np.ndarray  # (num_vertices, 3) [m]
    velocity: np.ndarray  # (num_vertices, 3) [m/s]
    coefficients: np.ndarray  # (K,) or (num_tetrahedra, K)
    mass: np.ndarray  # (num_vertices,) [kg]
    parameters: np.ndarray  # the numbers of all terms, one after the other
    rest: np.ndarray  # (num_vertices, 3) [m]
    gradients: np.ndarray  # (num_tetrahedra, 3, 3), rows grad N_1..3 [1/m]
    volumes: np.ndarray  # (num_tetrahedra,) [m^3]
    forces: np.ndarray | None = None  # (1 or steps, k, 3) [N]
    motion: np.ndarray | None = None  # (steps + 1, num_fixed, 3) [m]
    path: np.ndarray | None = None  # displacements of obstacles, (steps + 1, num_moving, 3) [m]

    def zeros(self) -> "Derived":
        """The same shapes, all zero."""
        parts = {f.name: getattr(self, f.name) for f in fields(self)}
        return Derived(**{k: None if v is None else np.zeros_like(v) for k, v in parts.items()})


def rest_shape(X: np.ndarray, tetrahedra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows grad N_1..3 (num_tetrahedra, 3, 3) and volumes of linear tetrahedra at X: B = D^-1, V = det D / 6."""
    D = np.moveaxis(X[tetrahedra[:, 1:]] - X[tetrahedra[:, :1]], 1, 2)
    volumes = np.linalg.det(D) / 6
    if not np.all(volumes > 0):
        worst = int(np.argmin(volumes))
        raise ValueError(
            f"rest_positions turn tetrahedron {worst} inside out (volume {volumes[worst]:.3g} m^3, "
            f"{(~(volumes > 0)).sum()} in all); take a smaller step in the rest shape"
        )
    return np.linalg.inv(D), volumes


class Inputs:
    """The numbers of a scene that a gradient can be asked for: names, values, what kernels make of them.

    `values`: dict of float64 arrays. Names: initial_positions, initial_velocities, the material's own inputs, density,
    rest_positions, and those of the terms. prescribed_motion and paths of obstacles join per run, sampled at its steps.
    """

    def __init__(self, scene, density, initial_positions, initial_velocities):
        self.scene, self.mesh, self._rest = scene, scene.mesh, None
        n = self.mesh.num_vertices
        velocities = np.zeros(3) if initial_velocities is None else initial_velocities
        values = {
            "initial_positions": self.mesh.vertices if initial_positions is None else initial_positions,
            "initial_velocities": np.broadcast_to(np.asarray(velocities, np.float64), (n, 3)),
            **scene.material.values(self.mesh),
            "density": density,
        }
        self._names = []  # {a term's own name: its name here}, for each term in the order of the scene's list
        for term in scene.terms:
            self._names.append({name: self._free_name(name, values) for name in term.values})
            values |= {self._names[-1][name]: value for name, value in term.values.items()}
        named = dict(zip(scene.terms, self._names))
        self._numbered = [(t, named[t]) for t in scene.ordered_terms if not isinstance(t, ExternalForce)]
        self.parameters = Rows({term: sum(value.size for value in term.values.values()) for term, _ in self._numbered})
        self._forces = next((named[t]["external_forces"] for t in scene.terms if isinstance(t, ExternalForce)), None)
        self.paths = []  # names of the moving obstacles' paths, which join per run
        for term in scene.moving:
            self.paths.append(self._free_name(term.path_name, dict.fromkeys(self.paths)))
        values["rest_positions"] = self.mesh.vertices
        self.values = {name: value.copy() for name, value in self.check(values).items()}  # the caller's may change

    @staticmethod
    def _free_name(name: str, taken: dict) -> str:
        number = 2
        candidate = name
        while candidate in taken:
            candidate, number = f"{name}_{number}", number + 1
        return candidate

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.values)

    def names_of(self, place: int) -> dict[str, str]:
        """{own name: name here} of the inputs of the term at a place of the scene's list."""
        term, paths = self.scene.terms[place], dict(zip(self.scene.moving, self.paths))
        return self._names[place] | ({term.path_name: paths[term]} if term in paths else {})

    def check(self, values: dict) -> dict:
        """Float64 arrays of the right shapes, or ValueError naming expected and got."""
        n, m = self.mesh.num_vertices, self.mesh.num_tetrahedra
        out = {}
        for name, value in values.items():
            value = np.asarray(value, np.float64)
            if not np.all(np.isfinite(value)):
                raise ValueError(f"{name} must be finite: {(~np.isfinite(value)).sum()} of {value.size} values are not")
            if name in ("initial_positions", "initial_velocities", "rest_positions") and value.shape != (n, 3):
                raise ValueError(f"{name}: expected shape ({n}, 3), got {value.shape}")
            if name == "density":
                if value.shape not in ((), (m,)):
                    raise ValueError(f"density: expected one number or shape ({m},), got {value.shape}")
                if not np.all(value > 0):
                    raise ValueError(f"density must be > 0 [kg/m^3], got {value.min()}")
            known = getattr(self, "values", {}).get(name)
            if known is not None and name != "prescribed_motion" and known.shape != value.shape:
                same_kind = name == "external_forces" and value.ndim in (2, 3) and value.shape[-2:] == known.shape[-2:]
                uniform = name not in ("density", *self.scene.material.inputs) or value.shape not in ((), (m,))
                if uniform and not same_kind:
                    raise ValueError(f"{name}: expected shape {known.shape}, got {value.shape}")
            out[name] = value
        return out

    def derive(self, values: dict) -> Derived:
        """What kernels read."""
        X = values["rest_positions"]
        gradients, volumes = self._rest_of(X)
        displacement = values["initial_positions"] - X
        velocity = np.array(values["initial_velocities"])
        velocity[self.scene.fixed] = 0
        parameters, forces = np.zeros(max(self.parameters.total, 1)), None
        for term, names in self._numbered:
            parameters[self.parameters.of(term)] = np.concatenate([values[name].ravel() for name in names.values()])
        if self._forces is not None:
            forces = values[self._forces]
            forces = forces[None] if forces.ndim == 2 else forces
        material_values = {name: values[name] for name in self.scene.material.inputs}
        return Derived(
            displacement,
            velocity,
            self.scene.material.coefficients(material_values),
            self._to_vertices(values["density"] * volumes / 4),
            parameters,
            X,
            gradients,
            volumes,
            forces,
            values.get("prescribed_motion"),
            np.stack([values[name] for name in self.paths], 1) if self.paths and self.paths[0] in values else None,
        )

    @property
    def rest_gradients(self) -> np.ndarray:
        """grad N_1..3 of each tetrahedron of the mesh [1/m], shape (num_tetrahedra, 3, 3)."""
        return self._rest_of(self.values["rest_positions"])[0]

    def _rest_of(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows grad N_1..3 and volumes at X; those of the mesh itself are kept."""
        if X is not self.values["rest_positions"] and not np.array_equal(X, self.mesh.vertices):
            return rest_shape(X, self.mesh.tetrahedra)
        if self._rest is None:
            self._rest = rest_shape(self.mesh.vertices, self.mesh.tetrahedra)
        return self._rest

    def _to_vertices(self, per_tetrahedron: np.ndarray) -> np.ndarray:
        tets = self.mesh.tetrahedra
        return np.bincount(tets.ravel(), np.repeat(per_tetrahedron, 4), self.mesh.num_vertices)

    def derive_jvp(self, values: dict, dots: dict) -> Derived:
        """Change of what kernels read for changes `dots` of some inputs."""
        base = self.derive(values)
        out, B, V, tets = base.zeros(), base.gradients, base.volumes, self.mesh.tetrahedra
        dX = dots.get("rest_positions", 0.0)
        out.displacement += dots.get("initial_positions", 0.0) - dX
        out.velocity += dots.get("initial_velocities", 0.0)
        out.velocity[self.scene.fixed] = 0
        out.rest += dX
        if "rest_positions" in dots:
            dD = np.moveaxis(dX[tets[:, 1:]] - dX[tets[:, :1]], 1, 2)
            out.gradients = -B @ dD @ B
            out.volumes = V * np.einsum("eij,eji->e", B, dD)
        out.mass = self._to_vertices((dots.get("density", 0.0) * V + values["density"] * out.volumes) / 4)
        for term, names in self._numbered:
            numbers = [np.ravel(dots.get(name, np.zeros_like(values[name]))) for name in names.values()]
            out.parameters[self.parameters.of(term)] = np.concatenate(numbers)
        if self._forces in dots:
            out.forces = out.forces + np.reshape(dots[self._forces], (-1,) + out.forces.shape[1:])
        material = self.scene.material
        out.coefficients = material.coefficients_jvp(
            {name: values[name] for name in material.inputs},
            {name: np.broadcast_to(dots.get(name, 0.0), values[name].shape) for name in material.inputs},
        )
        if out.motion is not None and "prescribed_motion" in dots:
            out.motion = np.array(dots["prescribed_motion"])
        if out.path is not None:
            out.path = np.stack([np.broadcast_to(dots.get(name, 0.0), values[name].shape) for name in self.paths], 1)
        return out

    def derive_vjp(self, values: dict, adj: Derived, wanted) -> dict:
        """Adjoints of the wanted inputs for adjoints of what kernels read; coefficients come per tetrahedron."""
        B, V = self._rest_of(values["rest_positions"])
        tets, material, out = self.mesh.tetrahedra, self.scene.material, {"initial_positions": adj.displacement}
        if "initial_velocities" in wanted:
            out["initial_velocities"] = np.array(adj.velocity)
            out["initial_velocities"][self.scene.fixed] = 0
        if any(name in wanted for name in material.inputs):
            out |= material.coefficients_vjp({name: values[name] for name in material.inputs}, adj.coefficients)
        if "density" in wanted or "rest_positions" in wanted:
            mass = adj.mass[tets].sum(1) / 4
            out["density"] = V * mass if values["density"].ndim else (V * mass).sum()
        for term, names in self._numbered:
            at = self.parameters.of(term).start
            for name in names.values():
                out[name] = adj.parameters[at : at + values[name].size].reshape(values[name].shape)
                at += values[name].size
        if self._forces is not None:
            out[self._forces] = adj.forces[0] if values[self._forces].ndim == 2 else adj.forces
        if adj.motion is not None:
            out["prescribed_motion"] = adj.motion
        if adj.path is not None:
            out |= {name: adj.path[:, k] for k, name in enumerate(self.paths)}
        if "rest_positions" in wanted:
            Bt = np.swapaxes(B, 1, 2)
            volumes = adj.volumes + values["density"] * mass
            D_adj = -Bt @ adj.gradients @ Bt + (V * volumes)[:, None, None] * Bt
            corners = np.swapaxes(D_adj, 1, 2)  # one row per edge, the derivative by X_a - X_0
            X_adj = adj.rest - adj.displacement
            np.add.at(X_adj, tets[:, 1:].ravel(), corners.reshape(-1, 3))
            np.add.at(X_adj, tets[:, 0], -corners.sum(1))
            out["rest_positions"] = X_adj
        return {name: np.asarray(out[name]) for name in wanted}
