"""The trace of the generator from random vectors: exact on average, with its square and the gradient of that.

For w channels the probes take 2^w values with equal probabilities, so that a mean over all of them is an expectation
and is exact except for rounding.
"""

from __future__ import annotations

import itertools
import shutil

import pytest
import torch
from oracles import PROBLEMS, FullNoise, Winding, make_batch, name, nested_generator, points
from small import PHYSICS, assert_same, at_update, interrupt, resumed, small_trainer
from test_losses import assert_close, gradients, make_loss
from test_operators import RELATIVE, distance, plain, random_critic
from torch import Tensor

from pirl_rl import terms
from pirl_rl.actor_rules import Hamiltonian
from pirl_rl.assembly import make_problem, make_trainer
from pirl_rl.automatic import MOST_COLUMNS, PROBES, choose_probes
from pirl_rl.checkpoint import load
from pirl_rl.commands.composition import compose
from pirl_rl.errors import ArgumentError, Interrupted
from pirl_rl.losses import PIRLLoss
from pirl_rl.networks import Actor, Critic, stack
from pirl_rl.operators import generator, rademacher
from pirl_rl.problems import HalfSpace, Reach1D
from pirl_rl.run_directory import RunDirectory
from pirl_rl.structure import noise_channels
from pirl_rl.terms import target_action

HJB_ALONE = (0.0, 1.0, 0.0)


def all_signs(channels: int, count: int) -> Tensor:
    """The 2^w probes (2^w, N, w) of N = `count` points, the same at all points."""
    signs = torch.tensor(list(itertools.product((-1.0, 1.0), repeat=channels)))
    return signs.unsqueeze(1).expand(-1, count, -1)


def deal(monkeypatch, *dealt: Tensor) -> None:
    """Let the loss draw these probes (k, N, w), one after the other."""
    left = iter(dealt)
    monkeypatch.setattr(terms, "rademacher", lambda *_: next(left))


# The generator


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("layers", [{}, {"levels": True, "root_time": False, "output": None}], ids=["plain", "levels"])
@pytest.mark.parametrize("problem", PROBLEMS, ids=name)
def test_the_mean_over_all_probes_is_exact(problem, layers):
    """Among the problems are state-dependent sigmas, an angle and up to six channels."""
    critic = random_critic(problem, **layers)
    tau, x, action, u = points(problem, 20)
    estimates = generator(critic.at(action), problem, tau, x, u, all_signs(noise_channels(problem), 20))
    exact = nested_generator(plain(critic, action), problem, tau, x, u)
    assert estimates.shape == (2 ** noise_channels(problem), 20)
    assert distance(estimates.mean(0), exact) < RELATIVE


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("problem", [FullNoise(8, 2, 3), Winding()], ids=name)
def test_probes_of_stacked_critics_equal_each_alone(problem):
    critics = [random_critic(problem, seed=seed, levels=True) for seed in range(2)]
    tau, x, action, u = points(problem, 20)
    probes = torch.randn(3, 20, noise_channels(problem), generator=torch.Generator().manual_seed(0))
    both = generator(stack(critics).at(action), problem, tau, x, u, probes)
    assert both.shape == (2, 3, 20)
    for index, critic in enumerate(critics):
        alone = generator(plain(critic, action), problem, tau, x, u, probes)
        assert distance(both[index], alone) < RELATIVE
        assert (alone[0] - alone[1]).norm() > 0.01 * alone.norm()


@pytest.mark.usefixtures("float64")
def test_constant_hessians():
    """V = x^T M x / 2 with the sigma of a problem: each probe gives (sigma xi)^T M (sigma xi) / 2 beside the drift."""
    problem, rng = FullNoise(4, 1, 3), torch.Generator().manual_seed(0)
    tau, x, _, u = points(problem, 20)
    root, probes = torch.randn(4, 4, generator=rng), torch.randn(5, 20, 3, generator=rng)
    matrix = root @ root.mT
    estimates = generator(lambda t, y: ((y @ matrix) * y).sum(-1) / 2, problem, tau, x, u, probes)
    along = torch.einsum("nij,knj->kni", problem.diffusion(x, u), probes)
    by_hand = ((x @ matrix) * problem.drift(x, u)).sum(-1) + ((along @ matrix) * along).sum(-1) / 2
    assert distance(estimates, by_hand) < RELATIVE


def test_probes_are_independent_signs():
    """The means of 40,000 entries and of their products have the standard error 1/200."""
    torch.manual_seed(0)
    probes = rademacher(2, torch.zeros(20_000, 3, dtype=torch.float64), 2)
    assert probes.dtype == torch.float64
    assert (probes.abs() == 1).all()
    flat = probes.movedim(1, 0).flatten(1)
    assert (flat.mean(0).abs() < 4 / 20_000**0.5).all()
    torch.testing.assert_close(flat.mT @ flat / 20_000, torch.eye(4).double(), rtol=0, atol=4 / 20_000**0.5)


def test_probes_of_many_channels_are_independent_signs_too():
    """They come from two random integers each; of 5,000 correlations none is above six standard errors, 6/50."""
    torch.manual_seed(0)
    flat = rademacher(1, torch.zeros(2_500, 3), 100)[0]
    assert (flat.abs() == 1).all()
    torch.testing.assert_close(flat.mT @ flat / 2_500, torch.eye(100), rtol=0, atol=6 / 50)


# The loss


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("count", [2, 3])
def test_the_mean_of_the_loss_over_all_probes_is_exact(count, monkeypatch):
    """Of the values and of all gradients, for independent probes of a state-dependent sigma."""
    problem = FullNoise(3, 1, 2)
    batch, exact = make_batch(problem), make_loss(problem, weights=HJB_ALONE)
    ours = make_loss(problem, weights=HJB_ALONE, hjb_probes=count)
    signs = all_signs(2, 24)
    draws = [torch.stack(drawn) for drawn in itertools.product(signs, repeat=count)]
    deal(monkeypatch, *draws)
    mean = torch.stack([ours.critic_loss(batch)[0] for _ in draws]).mean()
    square = exact.critic_loss(batch)[0]
    assert_close([mean], [square])
    assert_close(gradients(mean, ours.qvalue_network_params), gradients(square, exact.qvalue_network_params))


@pytest.mark.usefixtures("float64")
def test_beyond_delta_the_mean_gradient_is_that_of_the_weighted_square(monkeypatch):
    """The weight min(1, delta/r_0) is averaged over the two probes of r_0, which the two others know nothing of."""
    problem, critics = FullNoise(3, 1, 2), 1
    batch, exact = make_batch(problem), make_loss(problem, critics, HJB_ALONE)
    inside, signs = batch["collocation"], all_signs(2, 24)
    inputs = exact.networks, inside, target_action(exact.networks, inside)
    pairs = [torch.stack(pair) for pair in itertools.product(signs, repeat=2)]
    sizes = torch.stack([exact.hjb.residuals(*inputs, pair)[0].detach().square().mean(0).sqrt() for pair in pairs])
    delta = sizes.median().item()
    weight = (delta / sizes).clamp(max=1).mean(0)
    by_hand = (weight * exact.hjb.residuals(*inputs)[0].square())[inside["mask"]].mean()

    ours = make_loss(problem, critics, HJB_ALONE, hjb_probes=2, hjb_delta=delta)
    deal(monkeypatch, *itertools.chain(*itertools.product(pairs, repeat=2)))
    mean = torch.stack([ours.critic_loss(batch)[0] for _ in range(len(pairs) ** 2)]).mean()
    assert_close(gradients(mean, ours.qvalue_network_params), gradients(by_hand, exact.qvalue_network_params))


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("delta", [None, 0.3])
def test_with_one_channel_the_loss_is_exact(delta):
    """xi^2 = 1, so that nothing is random: value and gradient are those of Huber's loss."""
    problem = Reach1D()
    batch = make_batch(problem)
    exact, ours = (make_loss(problem, weights=HJB_ALONE, hjb_delta=delta, hjb_probes=probes) for probes in (0, 2))
    one, other = (loss.critic_loss(batch)[0] for loss in (exact, ours))
    assert_close([other], [one])
    assert_close(gradients(other, ours.qvalue_network_params), gradients(one, exact.qvalue_network_params))


@pytest.mark.usefixtures("float64")
def test_drawn_probes_leave_no_bias():
    """The mean over 400 draws at 24 points, of the value and of the gradient along the exact one and along random
    directions, differs from the exact one by less than four of its standard errors, which are at most 5 %."""
    problem = FullNoise(6, 2, 5)
    batch, exact = make_batch(problem), make_loss(problem, weights=HJB_ALONE)
    ours = make_loss(problem, weights=HJB_ALONE, hjb_probes=2)

    def flat(loss) -> Tensor:
        value = loss.critic_loss(batch)[0]
        slopes = gradients(value, loss.qvalue_network_params)
        return torch.cat([value.detach().view(1), *(slope.flatten() for slope in slopes)])

    torch.manual_seed(0)
    truth = flat(exact)
    slope = truth[1:] / truth[1:].norm()
    directions = torch.nn.functional.normalize(torch.randn(4, len(slope)), dim=-1)
    probed = torch.block_diag(torch.ones(1, 1), torch.cat([slope[None], directions]))
    drawn = torch.stack([probed @ flat(ours) for _ in range(400)])
    error = drawn.std(0) / len(drawn) ** 0.5
    assert (((drawn.mean(0) - probed @ truth) / error).abs() < 4).all()
    assert (error[:2] < 0.05 * (probed @ truth)[:2]).all()


def test_one_probe_is_refused():
    with pytest.raises(ArgumentError, match=r"loss\.hjb_probes: expected 0 .* or at least 2, .* got 1"):
        make_loss(Reach1D(), hjb_probes=1)


@pytest.mark.slow
@pytest.mark.skipif(not (shutil.which("g++") or shutil.which("clang++")), reason="torch.compile needs a C++ compiler")
@pytest.mark.usefixtures("float64")
def test_compiled_probes_equal_eager_ones(monkeypatch):
    """The stream of random numbers differs under the compiler, hence the given probes."""
    problem, rng = FullNoise(4, 1, 3), torch.Generator().manual_seed(0)
    loss, batch = make_loss(problem, policy_noise=0.0, hjb_probes=2, hjb_delta=0.5), make_batch(problem)
    probes = torch.randn(2, 24, 3, generator=rng)
    monkeypatch.setattr(terms, "rademacher", lambda *_: probes)
    eager, ours = loss.critic_loss(batch)[0], torch.compile(loss.critic_loss, fullgraph=True)(batch)[0]
    torch.testing.assert_close(ours, eager, rtol=1e-6, atol=0)
    for mine, other in zip(*(gradients(value, loss.qvalue_network_params) for value in (ours, eager)), strict=True):
        assert (mine - other).norm() <= 1e-6 * other.norm()


def test_a_loss_with_levels_is_one_program():
    """Traced whole by the compiler's front end; the half-space multiplies its states by a constant vector."""
    problem = HalfSpace(dim=3)
    critic = Critic(problem, (4,), output="Sigmoid", levels=True)
    loss = PIRLLoss(problem, Actor(problem, (4,)), [critic], Hamiltonian(problem), hjb_probes=2)
    traced = torch.compile(loss.critic_loss, backend="eager", fullgraph=True, dynamic=False)
    batch = loss.with_noise(make_batch(problem))
    torch.testing.assert_close(traced(batch), loss.critic_loss(batch))


# Training


def test_a_training_with_probes_repeats_and_resumes_bit_for_bit(tmp_path):
    problem = "env.problem._target_=pirl_rl.problems.HalfSpace"
    settings = (problem, "loss.hjb_probes=2", *PHYSICS, "compile=false")
    small_trainer(tmp_path / "whole", *settings).train()
    first = small_trainer(tmp_path / "cut", *settings)
    at_update(first, 7, interrupt)
    with pytest.raises(Interrupted):
        first.train()
    resumed(tmp_path / "cut", *settings).train()
    assert_same(*(load(tmp_path / part / RunDirectory.LAST) for part in ("cut", "whole")))
    one, other = ((tmp_path / part / "metrics.csv").read_bytes() for part in ("cut", "whole"))
    assert one == other
    assert b"train_hjb_loss" in one


@pytest.mark.parametrize(("dim", "probes"), [(MOST_COLUMNS, 0), (MOST_COLUMNS + 1, PROBES)])
def test_the_number_of_channels_chooses(dim, probes):
    config = compose("train", ["+experiment=halfspace", f"env.problem.dim={dim}"])
    reason = choose_probes(config, make_problem(config))
    assert config.loss.hjb_probes == probes
    assert (f"{PROBES} random vectors in place of {dim} noise channels" in reason) == bool(probes)


@pytest.mark.parametrize(("weight", "printed"), [(0.1, True), (0.0, False)])
def test_the_choice_is_printed_where_the_residual_has_a_weight(weight, printed, capsys):
    small = ("+debug=default", "device=cpu", "logger=none", "compile=false")
    physics = (f"env.problem.dim={MOST_COLUMNS + 1}", f"pirl.final=[1,{weight},0]")
    trainer = make_trainer(compose("train", ["+experiment=halfspace", *small, *physics]))
    assert trainer.learner.loss.hjb.probes == PROBES
    assert ("trace: The HJB residual takes" in capsys.readouterr().out) == printed
