"""The verdict: solutions in closed form are solved, and none of their spoilt versions is."""

import dataclasses

import pytest
import torch

from pirl_rl.evaluation import Verdict, lines_of, metrics_of, statements_of
from pirl_rl.evaluation.judgement import Difference, Measures, describe, judge
from pirl_rl.evaluation.other_policies import constant_actions, play_open_loop
from pirl_rl.grid import GridSolver
from pirl_rl.operators import generator
from pirl_rl.problems import Exit1D, HalfSpace, Reach1D, Safety1D
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


class Known(Solution):
    """A solution whose V and policy are given functions of tau (N,) and x (N, n)."""

    dtype, device = torch.float32, torch.device("cpu")  # type: ignore[assignment]

    def __init__(self, problem, value=None, policy=None):
        self.problem = problem
        self._value, self._policy = value or problem.exact_value, policy or problem.optimal_control

    def policy(self, tau, x):
        return self._policy(tau, x)

    def raw_value(self, tau, x):
        return self._value(tau, x)

    def residual(self, tau, x, u=None):
        return generator(self._function, self.problem, tau, x, self._policy(tau, x) if u is None else u)[0]

    def gradient(self, tau, x):
        return torch.func.grad(lambda y: self._value(tau, y).sum())(x)

    def _function(self, tau, x):
        return self._value(tau, x).unsqueeze(0)


def judged(solution, dt=0.02, **settings):
    evidence = {"verdict": Verdict(points=100, **settings)(solution, Simulator(solution.problem, dt, 2))}
    return evidence, statements_of(evidence)


@pytest.mark.parametrize("seed", range(2))
def test_few_paths_do_not_make_the_exact_solution_doubtful(seed):
    """With eight paths from each state the noise is 0.11 on average, far above the error that would be doubtful."""
    _, statements = judged(Known(HalfSpace()), rollouts=8, seed=seed)
    assert statements["verdict"] == "solved"


@pytest.mark.parametrize("problem", [Reach1D, Exit1D, HalfSpace])
def test_the_exact_solution_is_solved(problem):
    evidence, statements = judged(Known(problem()))
    assert statements["verdict"] == "solved"
    lines = lines_of(evidence)
    assert len(lines) <= 8
    assert lines[0].startswith("verdict   solved: V agrees with simulation")
    metrics = metrics_of(evidence)
    assert abs(metrics["value_gap"] - metrics["value_gap_noise"]) < 0.01
    assert metrics["success_random"] < metrics["success_learned"]
    assert metrics["success_grid"] == pytest.approx(metrics["success_learned"], abs=0.02)
    assert {*metrics} == {*Verdict().meanings(problem())}


def test_a_policy_that_a_coarse_grid_beats_is_doubtful():
    evidence, statements = judged(Known(Exit1D(), policy=lambda tau, x: -Exit1D().optimal_control(tau, x)))
    assert statements["verdict"] != "solved"
    assert "The policy of a coarse grid succeeds more often, by 0." in statements["verdict_reason"]
    metrics = metrics_of(evidence)
    assert metrics["success_grid"] > metrics["success_learned"] + 0.05


@pytest.mark.parametrize("dim", [2, 3])
def test_the_grid_is_played_with_one_or_two_states(dim):
    evidence, _ = judged(Known(HalfSpace(dim=dim)))
    assert ("success_grid" in metrics_of(evidence)) == (dim == 2)
    assert ("success_grid" in Verdict().meanings(HalfSpace(dim=dim))) == (dim == 2)
    assert ("the policy of a coarse grid 0." in "".join(lines_of(evidence))) == (dim == 2)


class OutOfReach(HalfSpace):
    offset = 50.0


class MoreNoise(HalfSpace):
    def diffusion(self, x, u):
        return 2 * super().diffusion(x, u)


def still(tau, x):
    return torch.zeros_like(x)


def value_of_still(tau, x):
    """The probability that Brownian motion without drift comes to a . x >= 1 within tau."""
    distance = HalfSpace().target_level(x)
    return torch.erfc(distance.clamp(min=0) / (2 * tau).sqrt())


def worst(tau, x):
    return -HalfSpace().optimal_control(tau, x)


def value_of_worst(tau, x):
    """The first passage over the distance d against the drift c: exp(-2 c d) times that with the drift."""
    problem = HalfSpace()
    return problem.exact_value(tau, x) * torch.exp(-2 * problem.speed * problem.target_level(x).clamp(min=0))


SPOILT = {
    "target out of reach": (Known(OutOfReach(), lambda tau, x: 0 * tau), "never reaches the target, nor does"),
    "reversed policy": (Known(HalfSpace(), policy=worst), "constant control"),
    "reversed policy with its own value": (Known(HalfSpace(), value_of_worst, worst), "constant control"),
    "a policy that stands still": (Known(HalfSpace(), value_of_still, still), "succeeds more often"),
    "V too high": (Known(HalfSpace(), lambda tau, x: HalfSpace().exact_value(tau, x) + 0.1), "V is wrong by 0."),
    "V too low": (Known(HalfSpace(), lambda tau, x: HalfSpace().exact_value(tau, x) - 0.1), "V is wrong by 0."),
    "V collapsed": (Known(HalfSpace(), lambda tau, x: 0.4 + 0 * x.sum(-1)), "V is the same at all states"),
    "noise of another size": (Known(MoreNoise(), HalfSpace().exact_value), "V is wrong by 0."),
    "V is not a number": (Known(HalfSpace(), lambda tau, x: tau * torch.nan), "not a number"),
}


@pytest.mark.parametrize("name", SPOILT)
def test_a_spoilt_solution_is_not_solved(name):
    solution, reason = SPOILT[name]
    evidence, statements = judged(solution)
    assert statements["verdict"] in ("doubtful", "failed")
    assert reason in statements["verdict_reason"]
    lines = lines_of(evidence)
    assert len(lines) <= 8
    assert lines[-1].startswith("next      ")


GOOD = Measures(
    success=0.5,
    low=0.49,
    high=0.51,
    random=0.1,
    constant=0.2,
    constant_control=[1.0],
    over_constant=Difference(-0.3, 0.01),
    ahead=Difference(0.0, 0.01),
    grid=Difference(0.0, 0.01),
    finer=Difference(0.0, 0.01),
    gap=0.02,
    gap_error=0.001,
    noise=0.018,
    gap_finer=0.02,
    noise_finer=0.018,
    bias=Difference(0.001, 0.001),
    value_spread=0.4,
    success_spread=0.4,
    still=[],
    gain=0.1,
    gain_at=[0.0],
    states=6,
)


@pytest.mark.parametrize(
    ("changes", "level", "reason"),
    [
        ({"finer": Difference(-0.15, 0.01)}, "doubtful", "With shorter time steps success changes by -0.150."),
        ({"ahead": Difference(0.05, 0.01)}, "doubtful", "one control step ahead"),
        ({"ahead": Difference(-0.05, 0.01)}, None, ""),
        ({"ahead": Difference(0.05, 0.03)}, None, ""),
        ({"ahead": None}, None, ""),
        ({"grid": Difference(0.05, 0.01)}, "doubtful", "The policy of a coarse grid succeeds more often, by 0.050."),
        ({"grid": Difference(-0.05, 0.01)}, None, ""),
        ({"grid": Difference(0.05, 0.03)}, None, ""),
        ({"grid": None}, None, ""),
        ({"gap": 0.05}, "doubtful", "V is wrong by 0.047"),
        ({"gap": 0.05, "gap_error": 0.02}, None, ""),
        ({"bias": Difference(-0.03, 0.005)}, "doubtful", "0.030 below Monte Carlo"),
        ({"bias": Difference(-0.03, 0.02)}, None, ""),
        ({"gap": 0.2}, "failed", "V is wrong by 0.20"),
        ({"over_constant": Difference(0.1, 0.01)}, "failed", "The constant control [1] succeeds more often"),
        ({"success": 0.0, "high": 0.0001, "random": 0.0, "constant": 0.0}, "failed", "nor does a random"),
        ({"success": 0.0, "high": 0.0001, "constant": 0.3}, "failed", "while another control does in 0.3 of the paths"),
        ({"success": 0.0, "high": 0.0001, "random": 0.0, "constant": 0.004}, "failed", "control does in 0.004 of the"),
        ({"success": 0.0, "high": 0.0001, "invariance": True}, "failed", "never stays out of the avoid set"),
        (
            {"success": 2e-3, "high": 3e-3, "random": 1e-3, "constant": 0.0},
            "doubtful",
            "in 0.002 of the paths, and random",
        ),
        ({"success": 2e-3, "high": 3e-3, "constant": 0.3}, "failed", "hardly ever reaches the target, while another"),
        ({"value_spread": 0.001}, "failed", "V is the same at all states"),
        ({"value_spread": 0.001, "success_spread": 0.0}, None, ""),
    ],
)
def test_each_rule(changes, level, reason):
    reasons = judge(dataclasses.replace(GOOD, **changes))
    assert (reasons[0].level if reasons else None) == level
    assert not reasons or reason in reasons[0].why


@pytest.mark.parametrize(
    ("invariance", "advice"),
    [(False, "that the horizon suffices"), (True, "can stay out of the avoid set for the whole horizon")],
)
@pytest.mark.parametrize("success", [0.0, 2e-3])
def test_the_advice_where_hardly_a_path_succeeds_fits_the_objective(invariance, advice, success):
    measures = dataclasses.replace(GOOD, success=success, high=3e-3, random=0.0, constant=0.0, invariance=invariance)
    last = describe(measures, judge(measures))[-1]
    assert last.startswith("next      check the sets with python -m pirl_rl.check, and that ")
    assert last.endswith(advice)


def test_advice_that_several_reasons_share_is_given_once():
    measures = dataclasses.replace(
        GOOD, gap=0.05, over_constant=Difference(0.3, 0.01), ahead=Difference(0.1, 0.01), finer=Difference(0.1, 0.01)
    )
    reasons = judge(measures)
    last = describe(measures, reasons)[-1]
    assert len(reasons) == 4
    assert last.count("train") == 3  # longer, from another seed, and trainer.updates
    assert all(text in last for reason in reasons for text in reason.advice)


def test_controls_that_never_move_are_named_and_eight_lines_suffice():
    measures = dataclasses.replace(
        GOOD, still=[0, 2], gap=0.2, over_constant=Difference(0.3, 0.01), value_spread=0.0, gain_at=[0.0] * 9
    )
    lines = describe(measures, judge(measures))
    assert len(lines) == 8
    assert "control   components 0, 2 of the control never move" in lines
    assert "[0, 0, 0, 0, 0, 0, ...]" in "\n".join(lines)


@pytest.mark.parametrize(
    ("changes", "advised"), [({"states": 2}, True), ({"states": 3}, False), ({"states": 2, "ahead": None}, False)]
)
def test_the_grid_is_advised_for_few_states(changes, advised):
    measures = dataclasses.replace(GOOD, gap=0.05, **changes)
    assert ("method=grid" in describe(measures, judge(measures))[-1]) == advised


def test_open_loop_controls_agree_with_their_closed_form():
    """The best constant of the half-space is the optimal control, and random controls are Brownian motion.

    With 400 states and 32 paths, half of them for the choice, a standard error is at most 0.008.
    """
    problem = HalfSpace()
    rng = torch.Generator().manual_seed(3)
    x = problem.states.sample(400, rng)
    x = x[problem.interior(x)]
    tau = torch.rand(len(x), generator=rng)
    constant, action, random = play_open_loop(Simulator(problem, 0.01, 1), tau, x, 32, seed=0)
    assert torch.equal(problem.controls.denormalize(action), problem.optimal_control(tau[:1], x[:1])[0])
    assert abs(float(constant.mean() - problem.exact_value(tau, x).mean())) < 0.025
    assert abs(float(random.mean() - value_of_still(tau, x).mean())) < 0.025


def test_the_number_of_constant_controls_does_not_grow_with_their_dimension():
    assert len(constant_actions(HalfSpace(dim=2), 0)) == 5
    assert len(constant_actions(HalfSpace(dim=30), 0)) == 5


@pytest.mark.parametrize("settings", [{"points": 7}, {"rollouts": 1}])
def test_too_few_samples_are_refused(settings):
    with pytest.raises(ValueError, match=r"Verdict: expected points >= 8"):
        Verdict(**settings)


def test_a_time_step_that_is_too_long_is_doubtful():
    """A regulator that holds its control for 0.4 s overshoots; the grid's value is that of a control without a hold."""
    solution = GridSolver(Safety1D()).solve()
    assert judged(solution, dt=0.01)[1]["verdict"] == "solved"
    evidence, statements = judged(solution, dt=0.4, rollouts=256)
    assert statements["verdict"] != "solved"
    assert "With shorter time steps success changes by +0." in statements["verdict_reason"]
    assert "look-ahead" not in "".join(lines_of(evidence))  # the grid's policy is the best of its candidates already
