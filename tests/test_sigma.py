"""Products with sigma, whether it is one expanded matrix or one matrix for each state."""

from __future__ import annotations

import pytest
import torch

from pirl_rl.sigma import constant_matrix, times, transposed_times


@pytest.mark.parametrize("one", [True, False], ids=["one matrix", "one for each state"])
def test_products_are_those_of_matrices(one):
    rng = torch.Generator().manual_seed(0)
    sigma = torch.randn((3, 2) if one else (5, 3, 2), generator=rng, dtype=torch.float64).expand(5, 3, 2)
    z, a = (torch.randn(5, width, generator=rng, dtype=torch.float64) for width in (2, 3))
    torch.testing.assert_close(times(sigma, z), torch.einsum("nij,nj->ni", sigma, z))
    pair = torch.randn(2, 5, 2, generator=rng, dtype=torch.float64)
    torch.testing.assert_close(times(sigma, pair), torch.einsum("nij,knj->kni", sigma, pair))
    torch.testing.assert_close(transposed_times(sigma, a), torch.einsum("nij,ni->nj", sigma, a))


def test_there_may_be_no_states():
    sigma = torch.eye(3, 2).expand(0, 3, 2)
    assert times(sigma, torch.zeros(0, 2)).shape == (0, 3)
    assert transposed_times(sigma, torch.zeros(0, 3)).shape == (0, 2)


def in_place(x, u):
    sigma = 0.3 * torch.eye(2).to(x).repeat(len(x), 1, 1)
    sigma[:, 0, 0] = sigma[:, 0, 0] + (x[:, 0] > 100)
    return sigma


def branch(x, u):
    return (2.0 if x.max() > 100 else 1.0) * torch.eye(2).to(x).expand(len(x), 2, 2)


def through_numpy(x, u):
    return torch.eye(2).to(x) * torch.from_numpy(x[:, :1].numpy()).unsqueeze(-1)


@pytest.mark.parametrize(
    ("diffusion", "constant"),
    [
        (lambda x, u: 0.3 * torch.eye(2).to(x).expand(*x.shape, 2), True),
        (lambda x, u: torch.diag_embed(0.3 * torch.ones_like(x)), True),
        (lambda x, u: 0.3 * x.new_tensor([[1.0, 0.0], [0.0, 1.0]]).expand(*x.shape, 2), True),
        (lambda x, u: torch.diag_embed(0.3 + 0.0 * x), False),
        (lambda x, u: 0.3 * torch.eye(2).to(x) * u.unsqueeze(-1), False),
        # Another noise in a part of the box that no sample shows.
        (lambda x, u: 0.3 * torch.eye(2).to(x) * torch.where(x[:, :1, None] > 100, 2.0, 1.0), False),
        (in_place, False),
        (branch, False),
        (through_numpy, False),
    ],
)
def test_a_constant_sigma_is_one_that_computes_with_no_entry_of_its_arguments(diffusion, constant):
    rng = torch.Generator().manual_seed(0)
    x, u = (torch.rand(8, width, generator=rng, dtype=torch.float64) for width in (2, 1))
    found = constant_matrix(diffusion, x, u)
    if not constant:
        assert found is None
    else:
        torch.testing.assert_close(found, 0.3 * torch.eye(2, dtype=torch.float64), atol=1e-8, rtol=0)
