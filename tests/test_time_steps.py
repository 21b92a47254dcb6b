"""Rates of problems in which they are known, and the time steps that follow from them."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pirl_rl.assembly import make_evaluation_simulator, make_problem, make_trainer
from pirl_rl.automatic import choose_paths, choose_playing, choose_time_steps, choose_updates
from pirl_rl.commands.composition import compose
from pirl_rl.configuration import load_config, save_config
from pirl_rl.errors import ArgumentError, ConfigError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems import Reach1D, Safety1D, ZermeloBoat
from pirl_rl.rates import across_box, across_sets, control_rate, fastest_rate
from pirl_rl.sets import Box
from pirl_rl.simulator import Simulator
from pirl_rl.time_steps import LEAST_SHARE, LOST, STEPS, TOLERANCE, propose_time_steps


class Linear(ReachAvoidProblem):
    """dX = (-rates X + U) dt + noise dW in the box [-1, 1]^n times `unit`; the target is far away.

    Args:
        rates: the n rates of decay, in 1/s.
        noise: sigma, the same for all coordinates.
        horizon: T, in s.
        unit: the length of one in the coordinates of the box.
    """

    controls = Box([-1.0], [1.0])

    def __init__(self, rates: list[float], noise: float = 0.01, horizon: float = 2.0, unit: float = 1.0):
        super().__init__(horizon=horizon)
        self.rates, self.noise, self.unit = torch.tensor(rates, dtype=torch.float64), noise * unit, unit
        self.states = Box([-unit] * len(rates), [unit] * len(rates))

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return 0.1 * self.unit * u - self.rates.to(x) * x

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        n = x.shape[-1]
        return (self.noise * torch.eye(n).to(x)).expand(*x.shape, n)

    def target_level(self, x: Tensor) -> Tensor:
        return 9 - x[..., 0] / self.unit


class Faster(Linear):
    """The same process in a time that runs `pace` times as fast."""

    def __init__(self, pace: float, *arguments, horizon: float = 2.0):
        super().__init__(*arguments, horizon=horizon / pace)
        self.pace = pace

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return self.pace * super().drift(x, u)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return self.pace**0.5 * super().diffusion(x, u)


class Ball(Linear):
    """Without rates; the target is a ball that fills 4e-6 of the box."""

    def __init__(self, noise: float, center: float = 0.5):
        super().__init__([0.0] * 3, noise, horizon=1.0)
        self.center = center

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.zeros_like(x)

    def target_level(self, x: Tensor) -> Tensor:
        return 100 * ((x - self.center).norm(dim=-1) - 0.02)


class Bowl(Ball):
    """The same ball as a level that has no slope at its deepest point."""

    def target_level(self, x: Tensor) -> Tensor:
        return (x - self.center).square().sum(-1) - 0.02**2


def sampled(problem, count: int = 2000):
    rng = torch.Generator().manual_seed(0)
    return problem.states.sample(count, rng, torch.float64), problem.controls.sample(count, rng, torch.float64)


def test_rates_of_a_linear_system():
    """The median of |a x| for x uniform in [-1, 1] is a/2: five standard errors of the median, 1/(2 sqrt(N)) each."""
    problem = Linear([40.0, 1.0], noise=0.3)
    x, u = sampled(problem)
    move = across_box(problem, x, u)
    # The box is two wide, and the control adds 0.1 at most.
    assert move.speed == pytest.approx(40 / 2 / 2, abs=40 / 2 * 5 / (2 * 2000**0.5) + 0.05)
    assert move.spread == pytest.approx(0.3 / 2)
    assert fastest_rate(problem, x, u) == pytest.approx(40, rel=1e-6)


def test_rates_of_an_oscillator_and_of_a_chain():
    class Oscillator(Linear):
        def drift(self, x, u):
            return torch.stack([7 * x[..., 1], -7 * x[..., 0]], -1)

    class Chain(Linear):
        def drift(self, x, u):
            return torch.stack([x[..., 1], 0 * x[..., 0]], -1)

    for kind, rate in ((Oscillator, 7.0), (Chain, 0.0)):
        problem = kind([0.0, 0.0])
        assert fastest_rate(problem, *sampled(problem)) == pytest.approx(rate, abs=1e-3)


def test_rates_across_sets_are_those_of_their_depths():
    """Reach1D: the target starts at 2 and, within twice the box, is 2 deep; the drift is |u| <= 1 and sigma is 1."""
    (move,) = across_sets(Reach1D(), *sampled(Reach1D()))
    assert move.across == "the target"
    assert move.speed == pytest.approx(0.5 / 2, rel=0.1)
    assert move.spread == pytest.approx(1 / 2, rel=1e-3)
    # Two faces, each with a set behind it that is 1 deep within twice the box.
    assert [round(move.spread, 3) for move in across_sets(Safety1D(), *sampled(Safety1D()))] == [1.0, 1.0]


@pytest.mark.parametrize("kind", [Ball, Bowl])
@pytest.mark.parametrize("center", [0.0, 0.5, -0.7])
def test_a_thin_target_is_found_by_descent(center, kind):
    """From the face to the center the level falls by its depth in 0.02: 0.1 of noise move it by 5 depths in 1 s."""
    problem = kind(0.1, center)
    x, u = sampled(problem, 1000)
    assert not problem.reached(x).any()
    (move,) = across_sets(problem, x, u)
    assert move.spread == pytest.approx(0.1 / 0.02, rel=0.1)


class Driven(Linear):
    """The control drives the first of two coordinates, and the noise the second, or both."""

    def __init__(self, noise: tuple[float, float], speed: float):
        super().__init__([0.0, 0.0], horizon=1.0)
        self.both, self.speed = torch.tensor(noise, dtype=torch.float64), speed

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat([self.speed * u, 0 * u], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag_embed(self.both.to(x).expand_as(x))


@pytest.mark.parametrize(("noise", "rate"), [((2.0, 0.0), 1.0), ((2.0, 9.0), 1.0), ((0.0, 2.0), 0.0)])
def test_the_control_rate_has_drift_and_noise_of_one_coordinate(noise, rate):
    """A speed of at most 2 and a noise of 2 in a box of the width 2: 1 times 1 squared."""
    problem = Driven(noise, 2.0)
    x, u = sampled(problem)
    u[::2] = u[::2].sign()
    assert control_rate(problem, x, u) == pytest.approx(rate)


class Shaken(Driven):
    """The control changes the noise of the second coordinate, too, where nothing is at stake."""

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return super().diffusion(x, u) + torch.diag_embed(torch.cat([0 * u, 0.1 * u], -1))


@pytest.mark.parametrize(("speed", "steps"), [(0.9, 400), (1.1, 800), (1.9, 800), (2.1, 1_600), (9.0, 1_600)])
def test_noise_that_depends_on_the_control_and_meets_a_strong_one_asks_for_short_steps(speed, steps):
    """A noise of 1.7 moves a tenth of the box in 1/72 s, so that the control alone limits the step."""
    limit = LOST / LEAST_SHARE * 400 / (1.7**2 / 4) * 2
    found = propose_time_steps(Shaken((1.7, 0.0), speed * limit))
    assert found.dt == pytest.approx(1 / steps)
    assert found.substeps == (1 if steps == 1_600 else 2)
    assert ("Holding the control" in found.reason) == (steps > 400)


class Kept(Safety1D):
    """Stay in |x| < 1 with a speed of at most `speed`, with two states or more in |x| < 1 and |y| < 3, ..."""

    def __init__(self, speed: float, dim: int = 1):
        super().__init__()
        self.speed = speed
        self.states = Box([-1.0, *[-3.0] * (dim - 1)], [1.0, *[3.0] * (dim - 1)])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat([self.speed * u, 0 * x[..., 1:]], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.eye(x.shape[-1]).to(x).expand(*x.shape, x.shape[-1])

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return torch.stack([1.0 - x[..., 0], 1.0 + x[..., 0]], -1)


@pytest.mark.parametrize(("horizon", "steps"), [(2.0, 400), (4.0, 800), (12.0, 1_600)])
def test_a_control_that_must_not_be_held_for_long_asks_for_short_steps(horizon, steps):
    """Holding loses more where the horizon is longer: about 0.0013, 0.0035 and 0.007 with 400 steps."""
    problem = Kept(1.0)
    problem.horizon = horizon
    found = propose_time_steps(problem)
    assert found.dt == pytest.approx(horizon / steps)
    assert found.substeps == (1 if steps == 1_600 else 2)
    assert ("Holding the control" in found.reason) == (steps > 400)
    assert propose_time_steps(problem, holding=False).dt == pytest.approx(horizon / 400)


@pytest.mark.parametrize(("dim", "steps"), [(2, 800), (3, 400)])
def test_with_many_states_control_steps_stay_long(dim, steps):
    problem = Kept(1.0, dim)
    problem.horizon = 4.0
    assert propose_time_steps(problem).dt == 4.0 / steps


def test_a_slow_system_has_the_longest_steps():
    steps = propose_time_steps(Linear([0.2, 0.1]))
    assert (steps.dt, steps.substeps) == (2.0 / 400, 2)
    assert "400 in the horizon" in steps.reason
    assert "limit" not in steps.reason


def test_a_stiff_system_has_substeps_that_resolve_it():
    """Against exp(-a t): the error of the proposal is accepted, and half as many sub-steps are too few."""
    problem = Linear([200.0, 1.0])
    steps = propose_time_steps(problem, dt=0.05)
    assert steps.dt == 0.05
    assert steps.substeps >= 0.05 * 200
    x, u = sampled(problem)
    a, drive = problem.rates, 0.1 * u
    decay = torch.exp(-a * 0.05)
    exact = x * decay + drive / a * (1 - decay)
    error = (Simulator(problem, 0.05, steps.substeps).flow(x, u) - exact).abs().amax(-1) / 2
    # Ten times as many steps of second order have a hundredth of the error, so that the difference is 99/100 of it.
    assert error.quantile(0.95) <= 1.05 * TOLERANCE
    half = (Simulator(problem, 0.05, steps.substeps // 2).flow(x, u) - exact).abs().amax(-1) / 2
    assert steps.substeps // 2 < 0.05 * 200 or half.quantile(0.95) > TOLERANCE


def test_steps_of_euler_are_checked_as_such():
    """A turn by a = 0.3 rad in k steps ends too far out by a^2/2k, or is off by a^3/6k^2 with steps of second order.

    States at the 95 % quantile lie about 1.2 from the center, and the error may be 0.002.
    """

    class Turn(Linear):
        def drift(self, x, u):
            return 0.6 * torch.stack([x[..., 1], -x[..., 0]], -1)

    problem = Turn([0.0, 0.0])
    substeps = {crossing: propose_time_steps(problem, 0.5, crossing=crossing)[1] for crossing in ("bridge", "endpoint")}
    assert substeps == {"bridge": 2, "endpoint": 32}


def test_a_stiff_system_has_short_control_steps():
    """Speeds of 50 box widths a second ask for 1 ms, so that the bound of 800 steps holds."""
    steps = propose_time_steps(Linear([200.0, 1.0]))
    assert steps.dt == 2.0 / STEPS[-1]
    assert "more than 800 steps are not proposed" in steps.reason


@pytest.mark.parametrize(("noise", "steps"), [(0.3, 400), (2.8, 400), (3.2, 600)])
def test_noise_moves_a_tenth_of_the_box(noise, steps):
    """sigma sqrt(dt) <= 0.1 * 2: at most 0.0039 s for a sigma of 3.2."""
    found = propose_time_steps(Linear([0.0], noise))
    assert found.dt == 2.0 / steps
    assert noise * found.dt**0.5 <= 0.2 + 1e-12


def test_a_thin_target_limits_the_control_step():
    """sigma sqrt(dt) <= 0.5 * 0.02: at most 0.0021 s for a sigma of 0.22, to the precision of the descent."""
    found = propose_time_steps(Ball(0.22))
    assert "across the target limit" in found.reason
    assert 1 / found.dt == pytest.approx(500)


@pytest.mark.parametrize("rates", [[0.3, 0.1], [30.0, 1.0]])
def test_the_choice_depends_on_no_unit(rates):
    """Neither on the unit of time, nor on that of the state."""
    base = propose_time_steps(Linear(rates, 0.3))
    quick = propose_time_steps(Faster(10.0, rates, 0.3))
    assert 10 * quick.dt == pytest.approx(base.dt)
    assert quick.substeps == base.substeps
    long = propose_time_steps(Linear(rates, 0.3, unit=1000.0))
    assert long[:2] == base[:2]


def test_what_is_given_is_kept():
    problem = Linear([30.0, 1.0])
    assert propose_time_steps(problem, dt=0.3)[0] == 0.3
    assert propose_time_steps(problem, substeps=3)[1] == 3
    assert propose_time_steps(problem, dt=0.3, substeps=3)[:2] == (0.3, 3)
    with pytest.raises(ArgumentError, match="dt: expected 0 < dt <= horizon"):
        propose_time_steps(problem, dt=3.0)
    with pytest.raises(ArgumentError, match="substeps: expected an integer >= 1"):
        propose_time_steps(problem, substeps=0)


def own(*overrides: str):
    return compose("train", ["+experiment=own", "env.problem._target_=pirl_rl.problems.Safety1D", *overrides])


def test_auto_is_replaced_by_numbers_that_are_printed_and_kept(tmp_path, capsys):
    """The fewest steps in a horizon of 2 s are 400. Evaluators and readers see the numbers."""
    config = own("logger=none")
    assert (config.env.dt, config.env.substeps) == ("auto", "auto")
    trainer = make_trainer(config)
    assert (config.env.dt, config.env.substeps) == (0.005, 2)
    assert (config.evaluation.simulator.dt, config.evaluation.simulator.substeps) == (0.005, 2)
    assert trainer.simulator.dt == trainer.collector.env.simulator.dt == 0.005
    assert "time: Control step 0.005 s, 400 in the horizon, with 2 integration steps." in capsys.readouterr().out
    save_config(config, tmp_path)
    assert "auto" not in str(load_config(tmp_path).env)
    make_trainer(load_config(tmp_path))
    assert "time:" not in capsys.readouterr().out


def test_a_number_beside_auto_is_kept(capsys):
    config = own("env.dt=0.3")
    choose_time_steps(config, Safety1D())
    assert (config.env.dt, config.env.substeps) == (0.3, 2)
    config = own("env.substeps=3")
    choose_time_steps(config, Safety1D())
    assert (config.env.dt, config.env.substeps) == (0.005, 3)
    capsys.readouterr()
    config = own("env.dt=0.3", "env.substeps=2")
    choose_time_steps(config, Safety1D())
    assert capsys.readouterr().out == ""
    with pytest.raises(ConfigError, match=r"env\.dt: expected float, got 'soon'"):
        choose_time_steps(own("env.dt=soon"), Safety1D())


@pytest.mark.parametrize(
    ("typed", "numbers"),
    [
        ([], (2_048, 10, 20)),
        (["env.dt=0.0025"], (1_024, 20, 40)),
        (["env.dt=0.00125"], (512, 40, 80)),
        (["env.dt=0.3"], (2_048, 10, 20)),
        (["env.dt=0.00125", "pirl.n_steps=4", "env.num_envs=64"], (64, 4, 8)),
    ],
)
def test_paths_advance_as_far_between_updates_with_short_control_steps(typed, numbers):
    config = own(*typed)
    choose_time_steps(config, Safety1D())
    choose_playing(config, Safety1D())
    assert (config.env.num_envs, config.collector.n_steps, config.stages[1].n_steps) == numbers
    assert config.collector.frames_per_batch % config.env.num_envs == 0


@pytest.mark.parametrize(
    ("experiment", "updates"),
    [
        ("reach1d", 4_600),
        ("zermelo", 6_900),
        ("dubins", 8_000),
        ("cartpole", 14_500),
        ("quadrotor", 19_767),
        ("halfspace", 9_444),
    ],
)
def test_the_length_of_a_run_follows_the_number_of_states(experiment, updates):
    typed = [f"+experiment={experiment}", *(["env.problem.dim=100"] if experiment == "halfspace" else [])]
    config = compose("train", typed)
    choose_updates(config, make_problem(config))
    assert config.trainer.updates == updates
    config = compose("train", [*typed, "trainer.updates=7"])
    choose_updates(config, make_problem(config))
    assert config.trainer.updates == 7


@pytest.mark.parametrize(
    ("experiment", "episodes", "rollouts"),
    [("reach1d", 10_000, 256), ("quadrotor", 10_000, 256), ("halfspace", 1_250, 32)],
)
def test_evaluation_plays_fewer_paths_where_they_cost_more(experiment, episodes, rollouts):
    """A path of the half-space has 400 steps of 2 integration steps of 100 coordinates."""
    typed = [f"+experiment={experiment}", *(["env.problem.dim=100"] if experiment == "halfspace" else [])]
    config = compose("train", typed)
    problem = make_problem(config)
    choose_time_steps(config, problem)
    choose_paths(config, problem, make_evaluation_simulator(config, problem))
    assert (config.evaluation.success.episodes, config.evaluation.calibration.rollouts) == (episodes, rollouts)
    assert config.evaluation.progress.episodes == episodes // 5


def test_numbers_of_paths_that_are_given_stay():
    config = compose("train", ["+experiment=reach1d", "evaluation.success.episodes=77"])
    choose_time_steps(config, Safety1D())
    choose_paths(config, Safety1D(), make_evaluation_simulator(config, Safety1D()))
    assert (config.evaluation.success.episodes, config.evaluation.progress.episodes) == (77, 15)


class Rocks(ZermeloBoat):
    """The boat among rocks, which are parts of one avoid set."""

    def __init__(self, *rocks: float):
        super().__init__()
        self.rocks = rocks

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return torch.stack([(x - rock).norm(dim=-1) - 0.02 for rock in self.rocks], -1)


def test_the_parts_of_a_set_have_the_rates_that_each_has_alone():
    rng = torch.Generator().manual_seed(0)
    x, u = (box.sample(500, rng, torch.float64) for box in (ZermeloBoat.states, ZermeloBoat.controls))
    rocks = (-0.3, 0.1, 0.4)
    together = across_sets(Rocks(*rocks), x, u)
    assert len(together) == 1 + len(rocks)
    assert together[1:] == [across_sets(Rocks(rock), x, u)[1] for rock in rocks]
