"""Products of matrices by the faster library: their precision, when they are chosen, and that trainings use them."""

import pytest
import torch
from small import at_each_update, small_trainer

from pirl_rl import checkpoint, products
from pirl_rl.population import Population
from pirl_rl.products import ONEDNN, fast_products


@pytest.fixture
def setting():
    """The precision that PyTorch allows inside of products on the CPU, which is put back at the end."""
    matmul = ONEDNN.matmul
    before = matmul.fp32_precision
    matmul.fp32_precision = "none"
    products._gains.cache_clear()
    yield matmul
    products._gains.cache_clear()
    matmul.fp32_precision = before


@pytest.mark.parametrize(("rows", "width"), [(64, 16), (1_024, 128)])
def test_fast_products_are_exact_in_single_precision(setting, rows, width):
    """Sums of 128 products of normal numbers have rounding errors of 1e-4 at most; with bfloat16 they have 0.1."""
    rng = torch.Generator().manual_seed(3)
    x, weight = torch.randn(2, rows, width, generator=rng), torch.randn(2, width, width, generator=rng)
    exact = x.double() @ weight.double()
    with fast_products(2, rows, width):
        torch.testing.assert_close((x @ weight).double(), exact, rtol=0, atol=1e-4)


@pytest.mark.parametrize(("times", "allowed", "chosen"), [((2, 1), 10, True), ((1, 1), 10, False), ((2, 1), 0, False)])
def test_products_change_the_library_where_it_is_faster_and_stays_in_single_precision(
    setting, monkeypatch, times, allowed, chosen
):
    """On a processor that multiplies in bfloat16 where that is allowed, they stay with the library that they have."""
    spent = dict(zip(("none", "bf16"), times, strict=True))
    monkeypatch.setattr(products, "_seconds", lambda work: spent[setting.fp32_precision])
    monkeypatch.setattr(products, "LESS_EXACT", allowed)
    x = torch.randn(256, 64, generator=torch.Generator().manual_seed(0))
    setting.fp32_precision = "bf16"
    rounded = (x @ x.mT - (x.double() @ x.mT.double())).abs().max() > 1e-2
    setting.fp32_precision = "none"
    with fast_products(2, 256, 64) as found:
        assert found == (chosen and not rounded and ONEDNN.is_available())
        assert setting.fp32_precision == ("bf16" if found else "none")


def test_fast_products_put_the_setting_back_after_an_error(setting):
    with pytest.raises(RuntimeError, match="stopped"), fast_products(2, 1_024, 128):
        raise RuntimeError("stopped")
    assert setting.fp32_precision == "none"


def test_fast_products_leave_a_setting_of_the_user_as_it_is(setting):
    setting.fp32_precision = "ieee"
    with fast_products(2, 1_024, 128) as found:
        assert not found
        assert setting.fp32_precision == "ieee"
    assert setting.fp32_precision == "ieee"


@pytest.mark.parametrize("together", [False, True], ids=["alone", "population"])
@pytest.mark.skipif(not ONEDNN.is_available(), reason="PyTorch is built without oneDNN")
def test_trainings_multiply_by_the_faster_library(setting, monkeypatch, tmp_path, together):
    monkeypatch.setattr(products, "_gains", lambda *sizes: True)
    trainer, seen = small_trainer(tmp_path, "trainer.updates=3"), []
    at_each_update(trainer, lambda k: seen.append(setting.fp32_precision))
    training = Population([trainer], [checkpoint.global_rng_states()]) if together else trainer
    training.train()
    assert seen == ["bf16"] * 3
    assert setting.fp32_precision == "none"
