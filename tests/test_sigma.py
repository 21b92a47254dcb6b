"""Products with sigma, whether it is one expanded matrix or one matrix for each state."""

from __future__ import annotations

import pytest
import torch

from pirl_rl.sigma import times, transposed_times


@pytest.mark.parametrize("one", [True, False], ids=["one matrix", "one for each state"])
def test_products_are_those_of_matrices(one):
    rng = torch.Generator().manual_seed(0)
    sigma = torch.randn((3, 2) if one else (5, 3, 2), generator=rng, dtype=torch.float64).expand(5, 3, 2)
    z, a = (torch.randn(5, width, generator=rng, dtype=torch.float64) for width in (2, 3))
    torch.testing.assert_close(times(sigma, z), torch.einsum("nij,nj->ni", sigma, z))
    torch.testing.assert_close(transposed_times(sigma, a), torch.einsum("nij,ni->nj", sigma, a))
