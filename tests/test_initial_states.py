"""Initial states: outside A and B, whole steps to go, reproducible."""

from __future__ import annotations

import math
import pickle

import pytest
import torch
from oracles import PROBLEMS, name

from pirl_rl.errors import ArgumentError, ProblemError
from pirl_rl.networks import Actor, Critic, stack
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems import RadialExit, Reach1D, Safety1D, VehicleDrift, ZermeloBoat
from pirl_rl.problems.drift.starts import EquilibriumStates
from pirl_rl.sampling.faces import NearFaces
from pirl_rl.sampling.initial_states import UniformStates, VisitedStates, sample_interior
from pirl_rl.sampling.undecided import FEW_STEPS, MOST_CHANNELS, UndecidedStates
from pirl_rl.sampling.wider import FARTHEST, WiderStates
from pirl_rl.sets import Box
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

COUNT = 20_000


def draw(problem, states, seed=0, max_steps=20):
    return states.sample(problem, COUNT, max_steps, torch.Generator().manual_seed(seed), torch.float32)


@pytest.mark.parametrize("problem", PROBLEMS, ids=name)
def test_states_are_outside_both_sets_and_inside_the_box(problem):
    steps, x = draw(problem, UniformStates())
    assert x.shape == (COUNT, problem.states.dim)
    assert problem.interior(x).all()
    assert problem.states.expand(1 + 1e-6).contains(x).all()
    assert (steps.min(), steps.max(), steps.dtype) == (1, 20, torch.int64)


def test_uniform_over_what_is_left_of_the_box():
    """Mean and variance on [-2, 2] without [2, 4], within five standard errors."""
    _, x = draw(Reach1D(), UniformStates([-2.0], [4.0]))
    assert x.max() < 2
    assert x.mean().item() == pytest.approx(0, abs=5 * (4 / 3 / COUNT) ** 0.5)
    assert x.var().item() == pytest.approx(4 / 3, abs=5 * (64 / 45 / COUNT) ** 0.5)


def test_a_box_of_starts_must_have_the_states_of_the_problem():
    with pytest.raises(ArgumentError, match="initial_states: expected low and high of 2 numbers, one a state, got 1"):
        draw(ZermeloBoat(), UniformStates([-1.0], [1.0]))


def test_tau_fixed_or_uniform():
    assert (draw(Reach1D(), UniformStates(tau="fixed"))[0] == 20).all()
    counts = torch.bincount(draw(Reach1D(), UniformStates(tau="random"))[0], minlength=21)
    share = (draw(Reach1D(), UniformStates(tau="both"))[0] == 20).double().mean().item()
    assert share == pytest.approx(0.525, abs=5 * (0.25 / COUNT) ** 0.5)
    assert counts[0] == 0
    # Chi-squared with 19 degrees of freedom: above 43.8 with probability 1e-3.
    assert ((counts[1:] - COUNT / 20) ** 2 / (COUNT / 20)).sum() < 43.8


def test_same_generator_same_states():
    first, second, other = (draw(Safety1D(), UniformStates([-3.0], [3.0]), seed)[1] for seed in (0, 0, 1))
    assert torch.equal(first, second)
    assert not torch.equal(first, other)


def test_a_box_inside_the_target_is_refused():
    with pytest.raises(ProblemError, match="Reach1D: no initial state outside"):
        sample_interior(Reach1D(), Box([3.0], [4.0]), 5, torch.Generator(), torch.float32)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"tau": "late"}, "initial_states.tau: expected 'fixed', 'random' or 'both', got 'late'"),
        ({"low": [0.0]}, "give both low and high"),
        ({"low": [1.0], "high": [0.0]}, "low < high"),
    ],
)
def test_errors_name_the_key(kwargs, message):
    with pytest.raises(ValueError, match=message):
        UniformStates(**kwargs)


def around(scale, mixture, tau="random", count=COUNT):
    law = EquilibriumStates(scale, mixture, tau)
    return law.sample(VehicleDrift(), count, 50, torch.Generator().manual_seed(0), torch.float64)


@pytest.mark.parametrize(("kind", "columns"), [(0, {3, 4}), (1, {0, 1}), (2, {0, 1, 3, 4})])
def test_drift_starts_are_displaced_in_their_plane_only(kind, columns):
    problem = VehicleDrift()
    mixture = [0.0, 0.0, 0.0]
    mixture[kind] = 1.0
    _, x = around(1.0, mixture)
    moved = (x - problem.around_equilibrium(x[:, 6])).abs().amax(0)
    assert {i for i in range(7) if moved[i] > 1e-9} == columns
    assert problem.interior(x).all()
    assert not problem.unreachable(x).any()


def test_the_scale_contracts_towards_the_equilibrium():
    """Half of the scale: half of the box around the equilibrium of the state's own friction, filled to its ends."""
    problem = VehicleDrift()
    _, x = around(0.5, (0, 1, 0))
    middle = problem.around_equilibrium(x[:, 6])
    e_y, e_psi = x[:, 0], (x - middle)[:, 1]
    box = problem.planes["e_y_e_psi"].box
    low, high = (0.5 * (end - middle[:, 1]) for end in (box.low[1], box.high[1]))
    assert (e_psi >= low - 1e-12).all()
    assert (e_psi <= high + 1e-12).all()
    assert e_y.abs().max().item() == pytest.approx(1.0, abs=1e-2)
    assert x[:, 6].min().item() == pytest.approx(0.5, abs=1e-3)
    assert x[:, 6].max().item() == pytest.approx(0.6, abs=1e-3)


def test_a_range_of_scales_fills_the_middle_more():
    near = [(around(scale, (0, 1, 0))[1][:, 0].abs() < 0.5).double().mean().item() for scale in (1.0, [0.0, 1.0])]
    # |e_y| = 2 S U, S = 1 or uniform too: P(< 1/2) = 1/4, or 1/4 (1 + log 4) = 0.6 less starts inside the target.
    assert near[0] == pytest.approx(0.25, abs=0.03)
    assert 0.45 < near[1] < 0.6


def test_the_mixture_has_its_shares():
    _, x = around(1.0, (0.3, 0.3, 0.4))
    moved = (x - VehicleDrift().around_equilibrium(x[:, 6])).abs() > 1e-9
    # States redrawn out of the avoid set shift the shares a little.
    assert (moved[:, 0] & ~moved[:, 4]).double().mean().item() == pytest.approx(0.3, abs=0.02)
    assert (moved[:, 4] & ~moved[:, 0]).double().mean().item() == pytest.approx(0.3, abs=0.02)


def test_visited_states_are_moved_by_at_most_the_radius():
    problem, rng = VehicleDrift(), torch.Generator().manual_seed(0)
    others = EquilibriumStates(1.0)
    visited = others.sample(problem, 4, 50, rng, torch.float64)[1]
    _, x = VisitedStates(others, 1.0, 0.2).sample(problem, COUNT, 50, rng, torch.float64, visited)
    box = problem.states
    distance = (box.normalize(x).unsqueeze(1) - box.normalize(visited)).norm(dim=-1).amin(1)
    near = distance <= 0.2 + 1e-9
    # The rest left the band of friction or fell into a set, and was replaced.
    assert near.double().mean() > 0.7
    assert distance[near].max() > 0.19
    assert problem.interior(x).all()
    assert not problem.unreachable(x).any()


def test_visited_states_take_their_share():
    problem, rng = VehicleDrift(), torch.Generator().manual_seed(0)
    law = VisitedStates(EquilibriumStates(1.0), 0.25, 0.0)
    visited = problem.around_equilibrium(torch.tensor([0.55]), e_y=torch.tensor([1.0]))
    _, x = law.sample(problem, COUNT, 50, rng, torch.float32, visited)
    assert (x - visited).abs().amax(-1).lt(1e-5).double().mean().item() == pytest.approx(0.25, abs=0.02)
    none = law.sample(problem, 100, 50, rng, torch.float32)[1]
    assert not (none - visited).abs().amax(-1).lt(1e-5).any()


def test_the_distances_of_states_near_faces_are_log_uniform():
    """A state is 10^-4U D from the face at 2: a decade below has a quarter of these states.

    D is uniform in (0, 4) for the states of the box, and in (0, 6) for those of one twice as wide, of which a quarter
    lie in the target. The mean of log10(D) for D uniform in (0, d) is log10(d) - 1/log(10). The shares have a standard
    error of 0.003.
    """
    _, x = draw(Reach1D(), NearFaces(UniformStates(), 0.7, 4.0))
    distance = 2 - x[:, 0].double()
    assert Reach1D().interior(x).all()
    below = (distance < 4e-3).double().mean().item()
    farthest = (4 * math.log10(4) + 3 * math.log10(6)) / 7
    assert below == pytest.approx(0.7 * (1 - (farthest - math.log10(4e-3) - 1 / math.log(10)) / 4), abs=0.015)
    decades = [((distance > edge) & (distance < 10 * edge)).double().mean().item() for edge in (1e-3, 1e-2)]
    assert decades == pytest.approx([0.7 / 4] * 2, abs=0.015)


@pytest.mark.parametrize("problem", PROBLEMS, ids=name)
def test_states_near_faces_are_outside_both_sets(problem):
    steps, x = draw(problem, NearFaces(UniformStates(), 1.0))
    assert problem.interior(x).all()
    assert (steps.min(), steps.max()) == (1, 20)


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (lambda: EquilibriumStates(2.0), "initial_states.scale"),
        (lambda: EquilibriumStates([0.5, 0.2]), "initial_states.scale"),
        (lambda: EquilibriumStates(1.0, (1, 0)), "initial_states.mixture: expected three shares"),
        (lambda: EquilibriumStates(tau="late"), "initial_states.tau"),
        (lambda: VisitedStates(UniformStates(), 1.5), "0 <= share <= 1"),
        (lambda: NearFaces(UniformStates(), -0.1), "0 <= share <= 1"),
        (lambda: NearFaces(UniformStates(), decades=0.0), "decades > 0"),
        (lambda: WiderStates(UniformStates(), Simulator(Reach1D()), 1.5), "0 <= share <= 1, got 1.5"),
        (
            lambda: UndecidedStates(UniformStates(), Known(), Simulator(Reach1D()), 0.0),
            "0 < floor <= 1, candidates >= 1 and gain >= 0, got 0.0, 4 and 0.0",
        ),
        (
            lambda: UndecidedStates(UniformStates(), Known(), Simulator(Reach1D()), 0.2, 0),
            "candidates >= 1 and gain >= 0, got 0.2, 0 and 0.0",
        ),
        (
            lambda: UndecidedStates(UniformStates(), Known(), Simulator(Reach1D()), gain=math.nan),
            "gain >= 0, got 0.2, 4 and nan",
        ),
    ],
)
def test_laws_name_what_is_wrong(law, message):
    with pytest.raises(ValueError, match=message):
        law()


class Stream(ReachAvoidProblem):
    """A stream of constant speed along x, and beside it a periodic angle that turns; no set is near."""

    states, controls = Box([0.0, -1.0], [1.0, 1.0], periodic=[1]), Box([-1.0], [1.0])

    def __init__(self, horizon: float):
        self.horizon = horizon

    def drift(self, x, u):
        return torch.stack([torch.ones_like(x[..., 0]), u[..., 0]], -1)

    def diffusion(self, x, u):
        return 1e-6 * torch.eye(2, dtype=x.dtype).expand(*x.shape, 2)

    def target_level(self, x):
        return 10 - x[..., 0]


def test_the_wider_box_holds_all_but_a_tail_of_the_states_of_paths():
    """States U + t, with t uniform in (0, T), pass 1 + T - s with probability s^2 / 2T: 2 % at s = 0.1 for T = 1/4.

    The number of looks shifts the quantile by less than their distance, 0.005. With T = 2 the box may only double.
    """
    box = WiderStates(UniformStates(), Simulator(Stream(0.25), 0.005)).box
    assert box.low == (0.0, -1.0)
    assert box.periodic == (1,)
    assert box.high == (pytest.approx(1.15, abs=0.01), 1.0)
    far = WiderStates(UniformStates(), Simulator(Stream(2.0), 0.05)).box
    assert far.high == (pytest.approx(0.5 + FARTHEST / 2), 1.0)


def test_edges_that_move_out_are_announced(capsys):
    WiderStates(UniformStates(), Simulator(Stream(2.0), 0.05))
    assert "starts: Paths leave the box of states" in (text := capsys.readouterr().err)
    assert "from 0 to 1.5 along axis 0." in text
    WiderStates(UniformStates(), Simulator(RadialExit(dim=9), 0.05))
    assert "along axis 5, and along 3 other axes." in capsys.readouterr().err


def test_a_share_of_zero_plays_no_paths(monkeypatch):
    monkeypatch.delattr("pirl_rl.sampling.wider.box_of_paths")
    assert WiderStates(UniformStates(), Simulator(Stream(2.0), 0.05), share=0).box is None


def test_states_from_the_wider_box_take_their_share():
    """Half of the states are uniform in (0, 1.5), so that a sixth of all lies beyond 1."""
    problem = Stream(2.0)
    law = WiderStates(UniformStates(), Simulator(problem, 0.05), share=0.5)
    _, x = law.sample(problem, COUNT, 40, torch.Generator().manual_seed(0), torch.float64)
    assert (x[:, 0] > 1).double().mean().item() == pytest.approx(1 / 6, abs=5 * (5 / 36 / COUNT) ** 0.5)
    assert x[:, 0].max() <= 1.5


def test_where_paths_stay_in_the_box_nothing_is_wider():
    """The avoid set of Safety1D lies inside of the box, so that no path leaves it."""
    problem = Safety1D()
    law = WiderStates(UniformStates(), Simulator(problem, 0.05))
    assert law.box is None
    assert torch.equal(draw(problem, law)[1], draw(problem, UniformStates())[1])


def test_paths_that_turn_do_not_widen_the_box_by_the_scheme():
    """From the corners of the box they come as far as its diagonal, and no farther in ten turns of 40 steps each."""

    class Turn(Stream):
        states = Box([-1.0, -1.0], [1.0, 1.0])

        def drift(self, x, u):
            return 2 * math.pi * torch.stack([x[..., 1], -x[..., 0]], -1)

    box = WiderStates(UniformStates(), Simulator(Turn(10.0), 1 / 40)).box
    assert box is None or max(box.high) < 2**0.5


def test_a_drift_without_a_value_beyond_the_box_does_not_spoil_the_wider_box():
    """Paths end where they leave the box, so that it stays as it is."""

    class Torn(Stream):
        def drift(self, x, u):
            return torch.where(x[..., :1] > 1, math.nan, super().drift(x, u))

    assert WiderStates(UniformStates(), Simulator(Torn(2.0), 0.01)).box is None


def test_paths_of_a_compiled_simulator_are_played_eagerly(monkeypatch):
    """As paths end their number falls, and each number would be compiled by itself."""
    monkeypatch.delattr("pirl_rl.simulator.Compiled")
    assert WiderStates(UniformStates(), Simulator(Stream(2.0), 0.05, compile=True)).box is not None


class Known:
    """V = 1/2 where x > 0 and more than half of the horizon is left, else 1."""

    def value(self, tau, x):
        return torch.where((x[:, 0] > 0) & (tau > 0.5), 0.5, 1.0)

    def residual(self, tau, x):
        raise AssertionError("no residual is asked for without a gain")


def test_undecided_states_come_by_their_weights():
    """A quarter of the candidates has the weight 1, the others 0.25: with many candidates 4 of 7 are undecided.

    Without replacement the share is a little smaller, since the undecided candidates become fewer: with 50 candidates
    for each state by less than 0.01.
    """
    problem, count = Stream(1.0), 2_000
    others = UniformStates([-1.0, -1.0], [1.0, 1.0])
    law = UndecidedStates(others, Known(), Simulator(problem, 0.025), floor=0.25, candidates=50)
    steps, x = law.sample(problem, count, 40, torch.Generator().manual_seed(0), torch.float64)
    assert (steps.shape, x.shape) == ((count,), (count, 2))
    undecided = (x[:, 0] > 0) & (steps > 20)
    assert undecided.double().mean().item() == pytest.approx(4 / 7, abs=0.01 + 4 * (12 / 49 / count) ** 0.5)


class Counted(UniformStates):
    """Uniform states, with the numbers that were asked for."""

    def __init__(self, asked):
        super().__init__()
        self.asked = asked

    def sample(self, problem, count, *others):
        self.asked.append(count)
        return super().sample(problem, count, *others)


@pytest.mark.parametrize(
    ("count", "asked", "drawn", "least", "most"), [(1, 4, 1, 1, 1), (10, 12, 3, 3, 10), (400, 400, 100, 200, 350)]
)
def test_several_draws_share_their_candidates(count, asked, drawn, least, most):
    """Each draw takes a quarter of the same candidates, without replacement.

    If all four draws of 100 took the same states, 100 would differ, and 400 if no two draws had a state in common.
    """
    numbers = []
    law = UndecidedStates(Counted(numbers), Known(), Simulator(Safety1D()))
    steps, x = law.sample(Safety1D(), count, 20, torch.Generator().manual_seed(0), torch.float64)
    assert numbers == [asked]
    assert (len(steps), len(x)) == (count, count)
    draws = x.flatten().split(drawn)
    assert all(len(draw.unique()) == len(draw) for draw in draws)
    assert least <= len(x.unique(dim=0)) <= most


class Wrong(Known):
    """V = 1, with a residual of -0.4 1/s where x > 0, of 1,000 1/s where x < -1/2, and of 0 between."""

    def value(self, tau, x):
        return torch.ones_like(tau)

    def residual(self, tau, x):
        return torch.where(x[:, 0] > 0, -0.4, torch.where(x[:, 0] < -0.5, 1e3, 0.0))


def test_states_at_which_the_equation_does_not_hold_come_more_often():
    """With T = 2 s and the gain 1/2 the weights are 1/4 + 0.4, 1/4 + 1, where the largest residual counts, and 1/4."""
    problem, count = Stream(2.0), 2_000
    others = UniformStates([-1.0, -1.0], [1.0, 1.0])
    law = UndecidedStates(others, Wrong(), Simulator(problem, 0.05), floor=0.25, candidates=50, gain=0.5)
    x = law.sample(problem, count, 40, torch.Generator().manual_seed(0), torch.float64)[1][:, 0]
    shares = [(x > 0).double().mean().item(), (x < -0.5).double().mean().item()]
    total = 2 * 0.65 + 1.25 + 0.25
    assert shares == pytest.approx([2 * 0.65 / total, 1.25 / total], abs=0.015 + 4 * (0.25 / count) ** 0.5)


def test_with_many_noise_channels_the_residual_is_left_out():
    """`Wrong` would draw half of the states with the weight 1.25 or more."""
    problem = RadialExit(dim=MOST_CHANNELS + 1)
    simulator = Simulator(problem, 0.05)
    plain, weighted = (UndecidedStates(UniformStates(), Wrong(), simulator, gain=gain) for gain in (0.0, 0.5))
    assert torch.equal(draw(problem, weighted)[1], draw(problem, plain)[1])


@pytest.mark.parametrize(("steps", "compiled"), [(FEW_STEPS, True), (FEW_STEPS + 1, False)])
def test_the_residual_is_compiled_where_episodes_are_short(steps, compiled, monkeypatch):
    """Rounding moves a weight by a millionth, so that hardly a state changes."""
    problem = RadialExit(dim=2)
    torch.manual_seed(0)
    solution = Solution(problem, Actor(problem), stack([Critic(problem)]))
    simulator = Simulator(problem, problem.horizon / steps)
    drawn, said = [], []
    monkeypatch.setattr("pirl_rl.compilation.announce", said.append)
    for compile in (False, True):
        law = UndecidedStates(UniformStates(), solution, simulator, gain=2.0, compile=compile)
        rng = torch.Generator().manual_seed(0)
        drawn.append(law.sample(problem, 500, steps, rng, torch.float32)[1])
    assert (drawn[0] == drawn[1]).all(-1).double().mean() > 0.99
    assert said == ["compiling the residual of V at initial states"] * compiled


def test_networks_that_have_diverged_give_equal_weights():
    class Diverged:
        def value(self, tau, x):
            return torch.full_like(tau, math.nan)

        residual = value

    _, x = draw(Safety1D(), UndecidedStates(UniformStates(), Diverged(), Simulator(Safety1D()), gain=1.0))
    assert Safety1D().interior(x).all()


@pytest.mark.parametrize("compile", [False, True])
def test_copies_for_other_processes_draw_with_equal_weights(compile):
    law = UndecidedStates(UniformStates(), Known(), Simulator(Safety1D()), compile=compile)
    law = pickle.loads(pickle.dumps(law))
    assert torch.equal(draw(Safety1D(), law)[1], draw(Safety1D(), UniformStates())[1])


def test_a_thin_interior_is_found():
    """A ball takes 0.25 % of the cube with ten states, so that a thousand draws leave some of 2,000 states outside."""

    class Ball(Safety1D):
        states = Box([-1.0] * 10, [1.0] * 10)

        def avoid_level(self, x):
            return 1 - x.norm(dim=-1)

    x = sample_interior(Ball(), Ball.states, 2_000, torch.Generator().manual_seed(0), torch.float32)
    assert x.shape == (2_000, 10)
    assert (x.norm(dim=-1) < 1).all()
    # The radius is that of a uniform law in the ball: r^10 has the mean 1/2 and the standard deviation 1/12^0.5.
    assert x.norm(dim=-1).double().pow(10).mean().item() == pytest.approx(0.5, abs=5 / (12 * 2_000) ** 0.5)
