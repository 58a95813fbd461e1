"""Optimisations that survive: state files that are whole or not there, resumed runs that equal uninterrupted ones."""

import copy
import hashlib
import io
import math
import os
import time
from collections.abc import Callable
from pathlib import Path

from diffsim_ti.common import ranks
from diffsim_ti.common.progress import progress
from diffsim_ti.common.public import Public
from diffsim_ti.common.warn import warn
from diffsim_ti.mesh import TetrahedralMesh
from diffsim_ti.torch_bridge.autograd import torch

KEYS = ("iteration", "losses", "seconds", "best_loss", "best", "module", "optimizer", "random")
MAGIC = b"diffsim_ti optimisation state, version 1\n"


def save_state(path: str | Path, mesh: TetrahedralMesh, state: dict) -> None:
    """Write tensors, numbers and state_dicts to `path`, as a whole or not at all; the file before it stays as `.previous`.

    The file carries its version, the mesh's content hash and a checksum. If writing fails (disk full, read-only), the old
    files are as they were, the temporary one is removed, and the exception goes on.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    payload = io.BytesIO()
    torch.save(state, payload)
    body = mesh.content_hash.encode() + b"\n" + payload.getvalue()
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(MAGIC + hashlib.sha256(body).hexdigest().encode() + b"\n" + body)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            os.replace(path, _previous(path))
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def load_state(path: str | Path, mesh: TetrahedralMesh) -> dict | None:
    """The state at `path`; where that file is refused, the one before it, with a warning; None if there is neither.

    Raises ValueError with the reasons if there are files but none is good: truncated, foreign, of another version or mesh.
    """
    path, reasons = Path(path), []
    for candidate in (path, _previous(path)):
        if candidate.exists():
            try:
                state = _read(candidate, mesh)
            except ValueError as error:
                reasons.append(f"{candidate}: {error}")
                continue
            if reasons:
                warn(f"{reasons[0]}; using {candidate}")
            return state
    if reasons:
        raise ValueError("no usable state: " + "; ".join(reasons) + "; delete the file to start again")
    return None


def _previous(path: Path) -> Path:
    return path.with_name(path.name + ".previous")


def _read(path: Path, mesh) -> dict:
    data = path.read_bytes()
    if not data.startswith(MAGIC):
        first = data.split(b"\n", 1)[0][:60]
        kind = "written by another version" if first.startswith(MAGIC[:20]) else "not a saved state"
        raise ValueError(f"{kind}: it begins with {first!r}, expected {MAGIC.strip()!r}")
    digest, _, body = data[len(MAGIC) :].partition(b"\n")
    if hashlib.sha256(body).hexdigest().encode() != digest:
        raise ValueError("truncated or damaged: its checksum does not fit")
    known, _, payload = body.partition(b"\n")
    if known != mesh.content_hash.encode():
        raise ValueError(f"made for another mesh: {known.decode()[:12]}, this one is {mesh.content_hash[:12]}")
    state = torch.load(io.BytesIO(payload), weights_only=True)
    if not isinstance(state, dict):
        raise ValueError(f"holds a {type(state).__name__}, expected a dict of names")
    return state


class Optimization(metaclass=Public):
    """A loop around a torch optimiser that saves, resumes, and keeps the best.

    module: holds the parameters; path: state file, resumed from if it is there; None keeps nothing. A resumed run is
    bitwise the uninterrupted one (parameters, optimiser, random numbers). `losses` has the loss before each iteration.
    Of several ranks (`diffsim_ti.Ensemble`) the first one reads and writes the file, and all begin with what it has.
    clip: largest norm of the whole gradient, which is scaled back to it. patience: end where so many iterations brought no
    lower loss.
    `best_loss` the lowest, whose parameters `restore_best()` brings back; `seconds` counts all parts of the run.
    """

    def __init__(
        self,
        module: torch.nn.Module,
        optimizer: torch.optim.Optimizer,
        mesh: TetrahedralMesh,
        path: str | Path | None = None,
        save_every: int = 1,
        clip: float | None = None,
        patience: int | None = None,
    ):
        self.clip, self.patience = clip, patience
        self.module, self.optimizer, self.mesh, self.path, self.save_every = module, optimizer, mesh, path, save_every
        self.iteration, self.losses, self.seconds = 0, [], 0.0
        state, error = ranks.from_first(self._found() if ranks.is_first() else None)
        if error is not None:
            raise error
        module.load_state_dict(state["module"])
        torch.set_rng_state(state["random"])
        if "iteration" in state:
            self.iteration, self.losses, self.seconds = state["iteration"], state["losses"], state["seconds"]
            self.best_loss, self._best = state["best_loss"], state["best"]
            optimizer.load_state_dict(state["optimizer"])
        else:
            self.best_loss, self._best = math.inf, copy.deepcopy(module.state_dict())

    def __repr__(self) -> str:
        lowest = f", the lowest loss {self.best_loss:.6g}" if self.losses else ""
        return f"Optimization({self.iteration} iterations in {self.seconds:.3g} s{lowest}, state in {self.path})"

    def _found(self) -> tuple[dict, ValueError | None]:
        """(the state of the file, or that of a new run; what is wrong with it)"""
        try:
            state = None if self.path is None else load_state(self.path, self.mesh)
        except ValueError as error:
            return {}, error
        if state is None:
            return dict(module=self.module.state_dict(), random=torch.get_rng_state()), None
        missing = [name for name in KEYS if name not in state]
        if not missing:
            return state, None
        return {}, ValueError(
            f"{self.path}: a state without {', '.join(missing)}; another program has written it: take another path, or "
            "delete the file to start again"
        )

    def run(
        self, loss: Callable[[], torch.Tensor], iterations: int, after: Callable | None = None, title: str | None = None
    ) -> "Optimization":
        """Go on until `iterations` iterations are done in all; loss() makes the graph anew each time.

        after(value): called after each iteration with the loss before it, for instance to draw. title: of a bar in a
        terminal.

        Raises FloatingPointError if the loss is not finite, and lets the simulator's errors through; the parameters are
        then the best ones so far.
        """

        def closure():
            self.optimizer.zero_grad()
            value = loss()
            if not torch.isfinite(value):
                raise FloatingPointError(f"iteration {self.iteration}: the loss is {value.item()}; take smaller steps")
            value.backward()
            if self.clip is not None:
                groups = self.optimizer.param_groups
                torch.nn.utils.clip_grad_norm_([p for group in groups for p in group["params"]], self.clip)
            return value

        with progress(title or "optimisation", iterations, bar=title is not None) as show:
            while self.iteration < iterations and not self.is_stuck():
                value = self._iterate(closure)
                show(self.iteration, f"loss {value:.4g}")
                if after is not None:
                    after(value)
                if self.path is not None and (self.iteration % self.save_every == 0 or self.iteration == iterations):
                    self.save()
        return self

    def _iterate(self, closure: Callable) -> float:
        start, before = time.perf_counter(), copy.deepcopy(self.module.state_dict())
        try:
            value = self.optimizer.step(closure).item()
        except (ValueError, FloatingPointError):
            self.restore_best()
            raise
        self.losses.append(value)
        if value < self.best_loss:
            self.best_loss, self._best = value, before
        self.iteration += 1
        self.seconds += time.perf_counter() - start
        return value

    def is_stuck(self) -> bool:
        """Whether the last `patience` iterations brought no lower loss."""
        n = self.patience
        return n is not None and len(self.losses) > n and min(self.losses[-n:]) >= min(self.losses[:-n])

    def save(self) -> None:
        """Write the state file; of several ranks the first one does."""
        if not ranks.is_first():
            return
        state = {name: getattr(self, name) for name in ("iteration", "losses", "seconds", "best_loss")}
        state |= dict(best=self._best, module=self.module.state_dict(), optimizer=self.optimizer.state_dict())
        save_state(self.path, self.mesh, state | dict(random=torch.get_rng_state()))

    def restore_best(self) -> None:
        """Bring back the parameters of the lowest loss."""
        self.module.load_state_dict(self._best)
