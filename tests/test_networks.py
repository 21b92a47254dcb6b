"""Networks: the initialisation of their first layer."""

from __future__ import annotations

import math

import pytest
import torch
from oracles import name

from pirl_rl.errors import ArgumentError
from pirl_rl.layers import Choice, Dense, LogLevels, Periodic, Scaling, WindowedChoice
from pirl_rl.networks import Actor, Critic
from pirl_rl.problems import DubinsCar, HalfSpace, Pendulum, Reach1D, ZermeloBoat

WIDTH = 512


def networks(problem, **arguments):
    return Actor(problem, (WIDTH,), **arguments), Critic(problem, (WIDTH, 8), **arguments)


def first_dense(network) -> Dense:
    return next(layer for layer in network.layers if isinstance(layer, Dense))


@pytest.mark.parametrize("problem", [ZermeloBoat(), HalfSpace(dim=8)], ids=["2", "8"])
def test_zeros_of_spread_neurons_pass_through_the_box(problem):
    torch.manual_seed(0)
    for network in networks(problem, root_time=True, spread=3.0):
        dense = first_dense(network)
        slope = dense.weight.norm(dim=-1)
        # 2 * 3 * U with U uniform: the mean is 3, and its standard error 3 / sqrt(3 * 512).
        assert slope.max() <= 6 + 1e-5
        assert abs(slope.mean().item() - 3) < 4 * 3 / (3 * WIDTH) ** 0.5
        # A plane meets the box [-1, 1]^d if and only if |b| <= sum |w_i|.
        assert (dense.bias.abs() <= dense.weight.abs().sum(-1)).all()
        # The distances of the planes from the middle spread over the box: U has the standard deviation 1/sqrt(3).
        distance = dense.bias / dense.weight.norm(dim=-1)
        assert abs(distance.std().item() * 3**0.5 - 1) < 0.15
        # Each of n > 2 states has 2/n of the weight of time and its root; in the mean of logarithms no norm counts.
        weight, n = dense.weight.abs().log().mean(0), problem.states.dim
        share = (weight[1 : 1 + n].mean() - torch.cat([weight[:1], weight[1 + n :]]).mean()).exp()
        assert share.item() == pytest.approx(2 / n, rel=0.1)


def test_the_zeros_of_a_periodic_coordinate_lie_on_its_circle():
    torch.manual_seed(0)
    critic = Critic(DubinsCar(), (WIDTH,), spread=3.0)
    dense = first_dense(critic)
    *prefix, _, _ = critic.layers
    assert any(isinstance(layer, Scaling) for layer in prefix)
    # Inputs are tau, x_1, x_2, sin, sqrt(tau), cos: no plane is farther out than box and circle together.
    circle = dense.weight[:, [3, 5]].norm(dim=-1)
    assert (dense.bias.abs() <= dense.weight[:, [0, 1, 2, 4]].abs().sum(-1) + circle + 1e-5).all()


def test_without_a_spread_the_initialisation_is_the_usual_one():
    for spread in (None, 3.0):
        torch.manual_seed(0)
        _, critic = networks(ZermeloBoat(), spread=spread)
        dense = first_dense(critic)
        bound = (6 / (dense.in_features + WIDTH)) ** 0.5
        assert ((dense.bias == 0).all() and (dense.weight.abs() <= bound).all()) == (spread is None)


@pytest.mark.parametrize("spread", [0.0, -1.0])
def test_spreads_that_are_refused(spread):
    with pytest.raises(ArgumentError, match=f"spread: expected a number > 0, or None, got {spread}"):
        Critic(ZermeloBoat(), spread=spread)


def test_an_actor_may_have_the_root_of_time():
    actor = Actor(ZermeloBoat(), root_time=True)
    assert first_dense(actor).in_features == 4
    assert actor(torch.rand(5, 1), torch.rand(5, 2)).shape == (5, 2)


def test_an_actor_chooses_the_number_with_the_largest_score():
    torch.manual_seed(0)
    actor = Actor(HalfSpace(dim=3), (16,), choices=5)
    tau, x = torch.rand(200, 1), torch.randn(200, 3)
    action, scores = actor(tau, x), actor.logits(tau, x).unflatten(-1, (3, 5))
    assert {*action.unique().tolist()} == {-1.0, -0.5, 0.0, 0.5, 1.0}
    index = actor.choice.indices(action)
    assert torch.equal(scores.gather(-1, index.unsqueeze(-1)).squeeze(-1), scores.amax(-1))
    assert torch.equal(actor.choice.combinations(x)[index].squeeze(-1), action)


def test_an_actor_chooses_the_combination_with_the_largest_score():
    torch.manual_seed(0)
    actor = Actor(HalfSpace(dim=4), (16,), choices=3, together=2)
    tau, x = torch.rand(200, 1), torch.randn(200, 4)
    action, scores = actor(tau, x), actor.choice.grouped(actor.logits(tau, x))
    assert scores.shape == (200, 2, 9)
    index = actor.choice.indices(action)
    assert torch.equal(scores.gather(-1, index.unsqueeze(-1)).squeeze(-1), scores.amax(-1))
    pairs = actor.choice.combinations(x)
    assert pairs.tolist() == [[a, b] for a in (-1.0, 0.0, 1.0) for b in (-1.0, 0.0, 1.0)]
    assert torch.equal(pairs[index].flatten(1), action)


def test_coordinates_together_that_are_refused():
    with pytest.raises(ArgumentError, match="together: expected a divisor of the number 3 of controls, got 2"):
        Actor(HalfSpace(dim=3), choices=5, together=2)
    with pytest.raises(ArgumentError, match="together: expected an integer of at least 1, got 0"):
        Choice(5, together=0)


@pytest.mark.parametrize("choices", [1, 2.5])
def test_choices_that_are_refused(choices):
    with pytest.raises(ArgumentError, match=f"choices: expected an integer of at least 2, got {choices}"):
        Choice(choices)


def scores_of(shares):
    """Scores (1, 5) of five numbers, -1 to 1, whose softmax has these shares."""
    return torch.tensor([shares]).log()


@pytest.mark.parametrize(
    ("shares", "window", "output"),
    [
        ([0.45, 0.1, 0.0, 0.1, 0.35], 0.5, -0.5 / 0.55),
        ([0.3, 0.05, 0.0, 0.3, 0.35], 0.5, 0.5 / 0.65),
        ([0.3, 0.4, 0.3, 0.0, 0.0], 0.5, -0.5),
        ([0.3, 0.05, 0.0, 0.3, 0.35], 2.0, 0.175),  # the mean of all
        ([0.3, 0.05, 0.0, 0.3, 0.35], 0.1, 1.0),  # the best alone
    ],
)
def test_a_windowed_choice_is_the_mean_of_the_numbers_in_the_window_with_the_largest_share(shares, window, output):
    layer = WindowedChoice(5, window)
    assert layer(scores_of(shares) + 7.0).item() == pytest.approx(output, abs=1e-6)
    assert layer(scores_of(shares[::-1])).item() == pytest.approx(-output, abs=1e-6)


def test_a_windowed_choice_jumps_between_bounds_over_all_numbers_between_them():
    """From one bound to the other a hyperbolic tangent passes through 0."""
    share = torch.linspace(0.01, 0.99, 99)
    scores = torch.stack([share.log(), torch.full_like(share, -30.0), (1 - share).log()], -1)
    output = WindowedChoice(3, 0.5)(scores).squeeze(-1)
    assert output.abs().min() > 0.999
    assert (output.diff().abs() > 1).sum() == 1


def test_a_windowed_choice_follows_the_scores_smoothly_within_a_window():
    numbers, middle = torch.linspace(-1, 1, 33), torch.linspace(-0.5, 0.5, 101)
    output = WindowedChoice(33, 0.5)(-((numbers - middle.unsqueeze(-1)) ** 2) / 0.02).squeeze(-1)
    torch.testing.assert_close(output, middle, atol=0.01, rtol=0)
    assert output.diff().max() < 0.03


def test_an_actor_with_a_window_has_groups_of_scores():
    torch.manual_seed(0)
    actor = Actor(HalfSpace(dim=3), (16,), choices=9, window=0.5)
    tau, x = torch.rand(200, 1), torch.randn(200, 3)
    action, scores = actor(tau, x), actor.logits(tau, x)
    assert (action.shape, scores.shape) == ((200, 3), (200, 27))
    assert action.abs().max() <= 1
    assert len(action.unique()) > 500
    torch.testing.assert_close(action[:, 1:2], actor.choice(scores[:, 9:18]))


@pytest.mark.parametrize("settings", [{}, {"choices": 3, "together": 3}])
def test_windows_that_are_refused(settings):
    with pytest.raises(ArgumentError, match=r"window: expected choices beside it, and together=1, got window=0\.5"):
        Actor(HalfSpace(dim=3), window=0.5, **settings)
    with pytest.raises(ArgumentError, match=r"window: expected a number > 0, got -0\.5"):
        Actor(HalfSpace(dim=3), choices=5, window=-0.5)


@pytest.mark.parametrize("problem", [Reach1D(), ZermeloBoat(), DubinsCar(), Pendulum()], ids=name)
def test_the_levels_of_the_sets_are_inputs(problem):
    x = problem.states.sample(20_000, torch.Generator().manual_seed(1))
    levels = problem.avoid_constraints(x) if problem.has_avoid_set else x[:, :0]
    if problem.objective == "reach-avoid":
        levels = torch.cat([problem.reached_constraints(x), levels], -1)
    critic = Critic(problem, levels=True, root_time=False)
    scaling = next(layer for layer in critic.layers if isinstance(layer, Scaling))
    inputs = scaling(critic.layers[0](torch.cat([torch.rand(len(x), 1), x], -1)))[:, 1 + problem.states.dim :]
    # They are scaled to the mean 0 and the standard deviation 1 over the box.
    torch.testing.assert_close(inputs, (levels - levels.mean(0)) / levels.std(0), atol=0.1, rtol=0.1)


def test_a_sigmoid_of_logarithms_is_a_layer_of_any_width():
    """l / (l + b) = sigmoid(log l - log b), where asinh(l / w) is log(2 l / w) up to w^2 / (4 l^2)."""
    logs, level = LogLevels(torch.tensor([1e-4])), torch.logspace(-3, 0, 50).unsqueeze(-1)
    feature = logs(level)[:, 1:]
    for width in (1e-3, 1e-2, 1e-1):
        layer = torch.sigmoid(feature - math.log(2 * width / 1e-4))
        torch.testing.assert_close(layer, level / (level + width), atol=1e-3, rtol=0)


@pytest.mark.parametrize("unit", [1e-15, 1.0, 1e15])
def test_derivatives_of_logarithms_stay_in_single_precision_in_any_unit(unit):
    """Against double precision, for levels in m^2 of sets of the size of a cell or of the solar system."""
    level, width = unit * torch.logspace(-4, 2, 50, dtype=torch.float64).unsqueeze(-1), torch.tensor([0.01 * unit])
    single, double = LogLevels(width).logs(level.float()), LogLevels(width).double().logs(level)
    for one, other in zip(single, double, strict=True):
        assert one.isfinite().all()
        torch.testing.assert_close(one.double(), other, rtol=1e-5, atol=0)


def test_logarithms_of_levels_need_levels():
    with pytest.raises(ArgumentError, match="log_levels: expected levels=true"):
        Critic(Reach1D(), log_levels=True)


@pytest.mark.parametrize("problem", [Reach1D(), ZermeloBoat(), DubinsCar(), Pendulum()], ids=name)
def test_logarithms_of_levels_are_scaled_to_the_states_outside_the_sets(problem):
    x = problem.states.sample(20_000, torch.Generator().manual_seed(1))
    critic = Critic(problem, levels=True, log_levels=True, root_time=False)
    first = next(index for index, layer in enumerate(critic.layers) if isinstance(layer, (Dense, Periodic)))
    inputs = critic.layers[:first](torch.cat([torch.rand(len(x), 1), x], -1))[problem.interior(x)]
    plain = first_dense(Critic(problem, levels=True, root_time=False)).in_features - len(problem.states.periodic)
    logs = inputs[:, plain:]
    assert logs.shape[-1] == plain - 1 - problem.states.dim
    low, high = logs.aminmax(dim=0)
    # The ends are those of other states, and the nearest of 20,000 is nearer to a face than that of 4,096.
    torch.testing.assert_close(high, torch.ones_like(high), atol=0.05, rtol=0)
    assert ((low > -2) & (low < -0.9)).all()


class Signed(Reach1D):
    """A target whose level is 1 outside and -1 inside."""

    def target_level(self, x):
        return torch.where(super().target_level(x) <= 0, -1.0, 1.0).to(x)


class Everywhere(Reach1D):
    """A target that holds all of the box, with a level that varies."""

    def target_level(self, x):
        return x[..., 0] - 10


@pytest.mark.parametrize("problem", [Signed(), Everywhere()], ids=name)
def test_logarithms_of_levels_that_say_little_are_finite(problem):
    critic = Critic(problem, levels=True, log_levels=True, spread=3.0)
    x = problem.states.sample(100)
    assert critic(torch.rand(100, 1), x, torch.zeros(100, 1)).isfinite().all()


class Disabled(ZermeloBoat):
    """Avoid constraints of which one is constant and one infinite."""

    def avoid_constraints(self, x):
        far = torch.full_like(x[..., :1], torch.inf)
        return torch.cat([super().avoid_constraints(x), torch.ones_like(far), far], -1)


def test_levels_that_say_nothing_are_left_out():
    ours, other = (first_dense(Critic(problem, levels=True)) for problem in (Disabled(), ZermeloBoat()))
    assert ours.in_features == other.in_features
