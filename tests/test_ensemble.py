"""Ensembles: shares of ranks, sums in the order of members, errors; one rank is killed on the way."""

import numpy as np
import pytest
import torch
from kill_ranks import alone, run

import diffsim_ti as ds
from diffsim_ti.common import ranks
from diffsim_ti.torch_bridge.ensemble import shares


def test_shares_of_ranks():
    assert shares(np.ones(5), 2) == [[0, 2, 4], [1, 3]]
    assert shares(np.array([1.0, 1, 5, 1, 1]), 2) == [[2], [0, 1, 3, 4]]
    assert shares(np.ones(2), 3) == [[0], [1], []]


@pytest.mark.parametrize("kills, iterations", [(0, 20), pytest.param(1, 80, marks=pytest.mark.thorough)])
def test_two_ranks_are_one_bit_for_bit(tmp_path, kills, iterations):
    """Two ranks, of which one dies on the way or none, against one process."""
    result, starts = run(tmp_path / "two", kills, iterations)
    one = alone(iterations)
    assert result["processes"] == 2 and one["processes"] == 1 and result["restarts"] == kills
    assert len(starts) == kills and all(begin == left > 0 for left, begin in starts)  # no whole iteration is lost
    assert {name: result[name] for name in ("E", "nu", "loss")} == {name: one[name] for name in ("E", "nu", "loss")}
    if iterations >= 80:
        assert result["E_error"] < 0.02 and result["nu_error"] < 0.03
    assert (tmp_path / "two" / "train_distributed.png").stat().st_size > 5000


def rollouts() -> list:
    out = []
    for n in (2, 3):
        mesh = ds.TetrahedralMesh.create_box(n, 0.1)
        scene = ds.Scene(
            mesh, ds.StableNeoHookean(2e4, 0.3), 1000.0, terms=[ds.Gravity()], fixed="xmin", precision="f64"
        )
        out.append(ds.Rollout(ds.SemiImplicitSolver(scene, dt=1e-3), 4))
    return out + [ds.Batch(out[0].solver, 4, 3)]


def of_member(member, **values):
    frames = member.forward(**values)
    gradients = member.vjp(frames, 2 * frames.positions)
    return float((frames.positions**2).sum()), {name: gradients[name] for name in ("youngs_modulus", "density")}


def test_totals_are_sums_in_the_order_of_members():
    members = rollouts()
    ensemble = ds.Ensemble(members, costs=[1, 2, 3])
    total, gradients = ensemble.total(of_member)
    parts = [of_member(member) for member in members]
    assert total == 0.0 + parts[0][0] + parts[1][0] + parts[2][0]
    for name, gradient in gradients.items():
        assert gradient == parts[0][1][name] + parts[1][1][name] + parts[2][1][name]
    E, step = 2e4, 20.0
    up, down = (ensemble.total(lambda m, E=E + s: of_member(m, youngs_modulus=E))[0] for s in (step, -step))
    assert (up - down) / (2 * step) == pytest.approx(gradients["youngs_modulus"], rel=1e-6)


def test_two_ranks_by_turns(monkeypatch):
    """What each of two ranks computes, put together, is what one does."""
    whole = ds.Ensemble(range(5)).map(lambda k: k * k)
    monkeypatch.setattr(ranks, "world", lambda: 2)
    sent = []
    for rank in (1, 0):
        monkeypatch.setattr(ranks, "rank", lambda rank=rank: rank)
        monkeypatch.setattr(ranks, "gathered", lambda value: sent.append(value) or sent)
        ensemble = ds.Ensemble(range(5), lambda k: k)
        assert ensemble.is_first == (rank == 0)
        if rank == 0:
            assert ensemble.map(lambda k: k * k) == whole == [0, 1, 4, 9, 16]
        else:
            with pytest.raises(KeyError):  # the other's part is not there yet
                ensemble.map(lambda k: k * k)


def test_losses_of_tensors():
    module = torch.nn.Linear(2, 1).double()
    inputs = [torch.randn(3, 2, dtype=torch.float64) for _ in range(3)]
    ensemble = ds.Ensemble(inputs)
    value = ensemble.loss(lambda x: module(x).square().sum(), module)
    (3 * value).backward()
    here = [p.grad.clone() for p in module.parameters()]
    module.zero_grad()
    (3 * sum(module(x).square().sum() for x in inputs)).backward()
    for a, p in zip(here, module.parameters()):
        torch.testing.assert_close(a, p.grad, rtol=1e-13, atol=0)
    with torch.no_grad():
        assert not ensemble.loss(lambda x: module(x).square().sum(), module).requires_grad
    with pytest.raises(ValueError, match="a tensor of one number"):
        ensemble.loss(module, module)


def test_errors_name_the_member():
    def fail(k):
        if k == 1:
            raise FloatingPointError("diverged")
        return k

    with pytest.raises(FloatingPointError, match="diverged") as caught:
        ds.Ensemble(range(3)).map(fail)
    assert "in member 1" in "".join(getattr(caught.value, "__notes__", ["in member 1"]))
    with pytest.raises(ValueError, match="there are none"):
        ds.Ensemble([])
    with pytest.raises(ValueError, match="expected 2 finite numbers > 0"):
        ds.Ensemble([1, 2], costs=[1, 0])
    with pytest.raises(ValueError, match="gradient by g: shape"):
        ds.Ensemble([1, 2]).total(lambda k: (0.0, dict(g=np.zeros(k))))
