"""Muon against its definition and torch's own, and which parameters it takes."""

from __future__ import annotations

import pytest
import torch
from small import small_trainer
from torch import nn

from pirl_rl.errors import ArgumentError
from pirl_rl.learner import Learner
from pirl_rl.optimizers import RATE, Muon, optimizers, orthogonal


@pytest.mark.parametrize("shape", [(3, 64, 64), (48, 64), (64, 48), (2, 2, 8, 16)])
def test_orthogonal_keeps_the_singular_vectors_and_levels_the_singular_values(shape):
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    u, s, vh = torch.linalg.svd(matrix, full_matrices=False)
    levelled = u.mT @ orthogonal(matrix) @ vh.mT
    torch.testing.assert_close(levelled, levelled.diagonal(dim1=-2, dim2=-1).diag_embed(), atol=1e-8, rtol=0)
    values = levelled.diagonal(dim1=-2, dim2=-1)
    large = s > 0.1 * s[..., :1]
    assert values[large].min() > 0.6
    assert values.max() < 1.25


def test_steps_agree_with_those_of_torch():
    start = torch.randn(16, 8, generator=torch.Generator().manual_seed(0))
    ours, theirs = nn.Parameter(torch.stack([start, 2 * start])), nn.Parameter(start.clone())
    steps = Muon([ours], 1e-2), torch.optim.Muon([theirs], RATE * 1e-2, weight_decay=0.0)
    for k in range(20):
        gradient = torch.randn(16, 8, generator=torch.Generator().manual_seed(k))
        ours.grad, theirs.grad = torch.stack([gradient, 3 * gradient]), gradient
        for optimizer in steps:
            optimizer.step()
    # torch rounds to bfloat16, with 8 bits; a gradient of another scale takes the same steps.
    moved = [(ours[0] - start), (ours[1] - 2 * start), (theirs - start)]
    assert (moved[0] - moved[2]).norm() < 0.02 * moved[2].norm()
    torch.testing.assert_close(moved[0], moved[1], atol=1e-5, rtol=0)


def test_weights_take_the_same_steps_together_as_each_alone():
    """In double precision, since products of stacked matrices may add up in another order."""
    rng = torch.Generator().manual_seed(0)
    start = [torch.randn(shape, generator=rng, dtype=torch.float64) for shape in ((2, 8, 8), (2, 8, 6), (2, 8, 8))]
    together, alone = ([nn.Parameter(entry.clone()) for entry in start] for _ in range(2))
    steps = Muon(together, 1e-2), *(Muon([weight], 1e-2) for weight in alone)
    for _ in range(3):
        for weight, other in zip(together, alone, strict=True):
            weight.grad = other.grad = torch.randn(weight.shape, generator=rng, dtype=torch.float64)
        for optimizer in steps:
            optimizer.step()
    for weight, other, begin in zip(together, alone, start, strict=True):
        assert (weight - begin).norm() > 0.1
        torch.testing.assert_close(weight, other, rtol=0, atol=1e-12)


def test_muon_takes_the_weights_between_hidden_layers_and_adam_the_rest(tmp_path):
    loss = small_trainer(tmp_path, "critic.hidden=[8,8,8]", "actor.hidden=[8]").learner.loss
    [adam, muon] = optimizers(loss.qvalue_network_params, 1e-3, "muon")
    assert {tuple(weight.shape[-2:]) for weight in muon.param_groups[0]["params"]} == {(8, 8)}
    taken = [id(weight) for one in (adam, muon) for weight in one.param_groups[0]["params"]]
    assert sorted(taken) == sorted(id(weight) for weight in loss.qvalue_network_params.parameters())
    assert len(muon.param_groups[0]["params"]) == 2
    assert len(optimizers(loss.actor_network_params, 1e-3, "muon")) == 1


def test_a_checkpoint_of_another_optimizer_is_refused(tmp_path):
    adam = small_trainer(tmp_path / "adam", "learner.optimizer=adam").learner
    muon = small_trainer(tmp_path / "muon", "learner.optimizer=muon").learner
    with pytest.raises(ArgumentError, match=r"learner\.optimizer: the checkpoint has the state of 1"):
        muon.load_state_dict(adam.state_dict())


def test_an_unknown_optimizer_is_refused(tmp_path):
    loss = small_trainer(tmp_path).learner.loss
    with pytest.raises(ArgumentError, match=r"learner\.optimizer: expected 'adam' or 'muon', got 'sgd'"):
        Learner(loss, optimizer="sgd")  # type: ignore[arg-type]
