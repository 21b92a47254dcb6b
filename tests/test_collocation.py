"""Interior points and the parabolic boundary."""

from __future__ import annotations

import pytest
import torch
from oracles import PROBLEMS, Corner, name
from tensordict import TensorDict

from pirl_rl.errors import ProblemError
from pirl_rl.problems import HalfSpace, RadialExit, Reach1D, Safety1D, VehicleDrift
from pirl_rl.sampling.boundary import BoundarySampler, face_weights
from pirl_rl.sampling.collocation import Collocation, ReplayCollocation
from pirl_rl.sampling.faces import find_faces
from pirl_rl.sets import Box

SAMPLERS = pytest.mark.parametrize("sampler", ["uniform", "sobol"])
problems = pytest.mark.parametrize("problem", [*PROBLEMS, Corner()], ids=name)


def make_rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@problems
@SAMPLERS
def test_interior_points_lie_in_the_box_and_are_masked_where_the_equation_does_not_hold(problem, sampler):
    points = Collocation(problem, 3_000, sampler, widen=1.5).sample(make_rng())
    tau, x, mask = points["tau"], points["state"], points["mask"]
    assert (tau.shape, x.shape, mask.shape) == ((3_000, 1), (3_000, problem.states.dim), (3_000,))
    assert (tau > 0).all()
    assert (tau <= problem.horizon).all()
    assert problem.states.expand(1.5 + 1e-5).contains(x).all()
    assert torch.equal(mask, ~(problem.reached(x) | problem.failed(x) | problem.unreachable(x)))
    assert 0 < mask.sum() < 3_000


@problems
def test_points_outside_time_are_masked(problem):
    x = Collocation(problem, 200).sample(make_rng())["state"]
    x = x[problem.interior(x)][:3]
    x = x[:1].expand(4, -1)
    tau = problem.horizon * torch.tensor([[-0.1], [0.0], [1.0], [1.01]])
    assert Collocation(problem).mask(tau, x).tolist() == [False, False, True, False]


@SAMPLERS
def test_widened_box_is_covered_to_its_edges(sampler):
    x = Collocation(Reach1D(), 4_000, sampler, widen=2.0).sample(make_rng())["state"]
    assert x.abs().max() > 3.95
    assert x.mean().item() == pytest.approx(0, abs=5 * (16 / 3 / 4_000) ** 0.5)


def test_sobol_points_are_more_even_than_random_ones():
    """2^10 scrambled points: each of 32 equal strips of either axis has its share, up to one point."""
    problem = Reach1D()
    points = Collocation(problem, 1024, "sobol", tau_power=1.0).sample(make_rng())
    for unit in (points["tau"] / problem.horizon, (points["state"] + 2) / 4):
        counts = torch.histc(unit, 32, 0, 1)
        assert (counts - 32).abs().max() <= 1
    random = Collocation(problem, 1024, "uniform").sample(make_rng())
    assert (torch.histc((random["state"] + 2) / 4, 32, 0, 1) - 32).abs().max() > 5


@pytest.mark.parametrize("power", [1.0, 2.0])
@SAMPLERS
def test_law_of_tau(sampler, power):
    """E[tau] = T/(power + 1), within five standard errors of random points."""
    tau = Collocation(Reach1D(), 20_000, sampler, tau_power=power).sample(make_rng())["tau"]
    deviation = (4 / (2 * power + 1) - (2 / (power + 1)) ** 2) ** 0.5
    assert tau.mean().item() == pytest.approx(2 / (power + 1), abs=5 * deviation / 20_000**0.5)


@pytest.mark.parametrize("power", [1.0, 2.0])
def test_law_of_tau_on_faces(power):
    """P(tau <= q T) = q^(1/power), within five standard errors."""
    tau = BoundarySampler(Reach1D(), 0, 20_000, tau_power=power).sample(make_rng())["tau"]
    for q in (0.04, 0.25, 0.64):
        share = q ** (1 / power)
        error = 5 * (share * (1 - share) / 20_000) ** 0.5
        assert (tau <= 2 * q).double().mean().item() == pytest.approx(share, abs=error)


@SAMPLERS
def test_same_generator_same_points_and_no_draw_repeats(sampler):
    collocation, rng = Collocation(Reach1D(), 64, sampler), make_rng()
    first, second = collocation.sample(rng), collocation.sample(rng)
    assert torch.equal(first["state"], collocation.sample(make_rng())["state"])
    assert not torch.equal(first["state"], second["state"])


def distance_to_faces(problem, x):
    """|level| of the nearest of the two absorbing sets, in float64."""
    sets = [problem.avoid_level(x.double()).abs()]
    if problem.objective == "reach-avoid":
        sets.append(problem.target_level(x.double()).abs())
    return torch.stack(sets).amin(0)


@problems
def test_faces_lie_on_faces_with_the_value_there(problem):
    points = BoundarySampler(problem, initial=0, faces=2_000).sample(make_rng())
    tau, x, value = points["tau"][:, 0], points["state"], points["value"]
    assert (tau > 0).all()
    assert (tau <= problem.horizon).all()
    assert distance_to_faces(problem, x).max() < 1e-6
    if problem.objective == "invariance":
        assert (value == 0).all()
        return
    on_target = problem.target_level(x.double()).abs() < 1e-6
    assert (value[on_target] == 1).all()
    assert on_target.any()
    if problem.has_avoid_set:
        assert (value[~on_target] == 0).all()
        assert 0.4 < value.mean() < 0.6


def test_every_face_of_a_square_is_found():
    x = BoundarySampler(Corner(), initial=0, faces=2_000).sample(make_rng())["state"]
    for level in ((x - 0.5).abs(), (x + 0.5).abs()):
        assert ((level < 1e-6).float().mean(0) > 0.1).all()


class Coins(Reach1D):
    """Two targets in one level, of which the smaller one has 1/900 of the area."""

    states, controls = Box([-2.0, -2.0], [2.0, 2.0]), Box([-1.0, -1.0], [1.0, 1.0])

    def drift(self, x, u):
        return u

    def diffusion(self, x, u):
        return torch.eye(2, dtype=x.dtype).expand(*x.shape[:-1], 2, 2)

    def target_level(self, x):
        return torch.minimum((x - 1).norm(dim=-1) - 0.6, (x + 1).norm(dim=-1) - 0.02)


def test_a_small_part_of_a_set_has_its_share_of_the_points():
    """Half of the points are found by descent from states everywhere, and half of these end in the small target."""
    x = find_faces(Coins(), make_rng()).points
    assert 0.15 < ((x + 1).norm(dim=-1) < 0.03).float().mean() < 0.35


@pytest.mark.parametrize("problem", [HalfSpace(dim=100), RadialExit(dim=100)], ids=name)
def test_faces_among_a_hundred_states_are_beside_many_states_of_the_box(problem):
    faces = find_faces(problem, make_rng())
    kept = problem.states.contains(faces.points) & problem.states.contains(faces.outside)
    assert len(faces.outside[kept].unique(dim=0)) > 1_000


@problems
def test_initial_points_are_outside_both_sets_at_tau_zero(problem):
    points = BoundarySampler(problem, initial=500, faces=0).sample(make_rng())
    assert (points["tau"] == 0).all()
    assert problem.interior(points["state"]).all()
    assert torch.equal(points["value"], torch.full((500,), float(problem.objective == "invariance")))


def test_sizes_add_up_and_draws_differ():
    sampler, rng = BoundarySampler(Safety1D(), initial=30, faces=50), make_rng()
    first, second = sampler.sample(rng), sampler.sample(rng)
    assert (len(first), int((first["tau"] == 0).sum())) == (80, 30)
    assert not torch.equal(first["state"], second["state"])
    assert torch.equal(first["state"], sampler.sample(make_rng())["state"])


class Current(Reach1D):
    """dX = (u + current) dt + deviation dW in the box [-2, 2]: reach 2 before -2."""

    def __init__(self, current, deviation):
        super().__init__()
        self.current, self.deviation = current, deviation

    def drift(self, x, u):
        return u + self.current

    def diffusion(self, x, u):
        return self.deviation * torch.ones_like(x).unsqueeze(-1)

    def avoid_level(self, x):
        return x[..., 0] + 2.0


@pytest.mark.parametrize(
    ("current", "deviation", "at_target", "at_avoid_set"),
    [
        # Up to speed 1 to the right at both faces: the layer at -2 is deviation^2 / 2, in a box of half width 2.
        (0.0, 0.2, 1.0, 0.02 / 2 / 0.05),
        (0.0, 1.0, 1.0, 1.0),
        # The best control still goes to the left, and crosses the face of the avoid set but not that of the target.
        (-1.5, 0.1, 0.01 / (2 * 0.5) / 2 / 0.05, 1.0),
        # Without noise nothing comes back to a face that paths leave.
        (0.0, 0.0, 1.0, 0.0),
    ],
)
def test_data_on_a_face_count_as_far_as_a_network_resolves_the_layer_there(current, deviation, at_target, at_avoid_set):
    points = BoundarySampler(Current(current, deviation), initial=10, faces=200).sample(make_rng())
    late, value, weight = points["tau"][:, 0] > 0, points["value"], points["weight"]
    assert (weight[~late] == 1).all()
    assert weight[late & (value == 1)].tolist() == pytest.approx([at_target] * int((late & (value == 1)).sum()))
    assert weight[late & (value == 0)].tolist() == pytest.approx([at_avoid_set] * int((late & (value == 0)).sum()))


def test_the_weights_of_a_box_with_several_controls_are_those_of_its_best_corner():
    """The square of side 1 can be entered from all sides, with one control or the other."""
    points = BoundarySampler(Corner(), initial=0, faces=500).sample(make_rng())
    assert (points["weight"] == 1).all()


def test_faces_that_the_problem_gives_have_weight_one():
    assert (BoundarySampler(VehicleDrift(), initial=0, faces=500).sample(make_rng())["weight"] == 1).all()


class Needle(Reach1D):
    """A target of a given half-width, which sampling misses; its level has a slope only outside."""

    def __init__(self, half_width=1e-5):
        super().__init__()
        self.half_width = half_width

    def target_level(self, x):
        return (x[..., 0] - 1).abs() - self.half_width


class MarkedNeedle(Needle):
    def faces(self, count, rng=None):
        return torch.ones(count, 1, dtype=torch.float64), torch.ones(count, dtype=torch.float64)


class Walls(Reach1D):
    """A thick and a thin part of the avoid set."""

    def target_level(self, x):
        return (x[..., 0] - 1.5).abs() - 0.1

    def avoid_constraints(self, x):
        return torch.stack([x[..., 0] + 1.5, (x[..., 0] - 0.5).abs() - 1e-5], -1)


class Nowhere(Reach1D):
    def target_level(self, x):
        return (x[..., 0] - 10).abs() - 0.1


def test_a_set_too_thin_for_sampling_is_found_by_descent():
    points = BoundarySampler(Needle(), initial=0, faces=100).sample(make_rng())
    assert ((points["state"] - 1).abs() - 1e-5).abs().max() < 1e-6
    assert (points["value"] == 1).all()


def test_every_part_of_an_avoid_set_is_found():
    x = BoundarySampler(Walls(), initial=0, faces=3_000).sample(make_rng())["state"]
    for face in (1.4, 1.6, -1.5, 0.5):
        assert ((x - face).abs() < 2e-5).float().mean() > 0.05


@pytest.mark.parametrize("problem", [Needle(1e-9), Nowhere()])
def test_a_set_that_is_not_found_is_named(problem):
    with pytest.raises(
        ProblemError, match=rf"{type(problem).__name__}: no point of the target was found, neither .* nor"
    ):
        BoundarySampler(problem).sample(make_rng())


class Heading(Reach1D):
    """A boat of the speed 1 in any direction beside a wall at x = 0.9: the best heading lies between both bounds."""

    states, controls = Box([-1.0, -1.0], [1.0, 1.0]), Box([-torch.pi], [torch.pi])

    def drift(self, x, u):
        return -torch.stack([u[..., 0].cos(), u[..., 0].sin()], -1)

    def diffusion(self, x, u):
        return 0.1 * torch.eye(2).to(x).expand(*x.shape, 2)

    def target_level(self, x):
        return x[..., 0] + 0.9

    def avoid_level(self, x):
        return 0.9 - x[..., 0]


def test_the_layer_at_a_face_is_that_of_the_best_heading():
    """A boat leaves the wall at x = 0.9 with the speed 1 and the noise 0.1, so that the layer has the width 0.005."""
    problem = Heading()
    points, values = torch.tensor([[0.9, 0.0], [-0.9, 0.0]]), torch.tensor([0.0, 1.0])
    torch.testing.assert_close(face_weights(problem, points, values), torch.tensor([0.005 / 0.05, 1.0]))


class Discs(Reach1D):
    """Many obstacles in a plane; it counts the states at which their levels are asked."""

    states = Box([-1.0, -1.0], [1.0, 1.0])
    centers = torch.stack([*torch.meshgrid(torch.linspace(-0.8, 0.8, 6), torch.linspace(-0.6, 0.6, 3), indexing="ij")])
    asked = 0

    def avoid_constraints(self, x):
        Discs.asked += len(x)
        return (x.unsqueeze(-1) - self.centers.flatten(1).to(x)).norm(dim=-2) - 0.12


def test_the_faces_of_many_parts_are_found_together():
    """Each of 18 discs has its share of the points, and all together are asked at 1,500,000 states at most."""
    faces = find_faces(Discs(), make_rng())
    x = faces.points[faces.values < 0.5]
    distance = (x.unsqueeze(-1) - Discs.centers.flatten(1)).norm(dim=-2)
    count = distance.argmin(-1).bincount(minlength=18)
    assert (distance.amin(-1) - 0.12).abs().max() < 1e-6
    assert (count > 200).all()
    assert Discs.asked < 1_500_000


def test_faces_are_not_searched_before_points_are_drawn():
    """In a training in which the boundary has no weight, none are."""
    Discs.asked = 0
    BoundarySampler(Discs())
    assert Discs.asked == 0


def test_faces_that_the_problem_gives_are_taken():
    points = BoundarySampler(MarkedNeedle(), initial=0, faces=10).sample(make_rng())
    assert torch.equal(points["state"], torch.ones(10, 1))
    assert torch.equal(points["value"], torch.ones(10))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Collocation(Reach1D(), sampler="grid"), "collocation.sampler: .* got 'grid'"),
        (lambda: Collocation(Reach1D(), size=0), "size >= 1"),
        (lambda: Collocation(Reach1D(), widen=0.0), "widen > 0"),
        (lambda: Collocation(Reach1D(), tau_power=0.0), "tau_power > 0"),
        (lambda: BoundarySampler(Reach1D(), tau_power=0.0), "tau_power > 0"),
        (lambda: BoundarySampler(Reach1D(), 0, 0), "boundary: .* got 0 and 0"),
        (lambda: BoundarySampler(Reach1D(), -1, 5), "boundary: .* got -1 and 5"),
    ],
)
def test_errors_name_the_key(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_expanded_box_of_the_sampler():
    assert Collocation(Reach1D(), widen=1.5).box == Box([-3.0], [3.0])


def visited(problem, count=500):
    """Transitions at states outside the sets, at most of the horizon to go."""
    rng = make_rng(3)
    tau = problem.horizon * (0.5 + 0.4 * torch.rand(count, 1, generator=rng))
    x = problem.states.sample(4 * count, rng)
    x = x[problem.interior(x) & ~problem.unreachable(x)][:count]
    return TensorDict({"tau": tau[: len(x)], "state": x}, batch_size=[len(x)])


def normalised(problem, points):
    return torch.cat([2 * points["tau"] / problem.horizon - 1, problem.states.normalize(points["state"])], -1)


@pytest.mark.parametrize("progress", [0.0, 0.5, 1.0])
def test_points_near_visited_ones_move_with_the_schedule(progress):
    """Share and jitter by the distance to the nearest visited point: 8 normal steps of a deviation have the chi law."""
    problem = VehicleDrift()
    replay, size = visited(problem), 4_000
    sampler = ReplayCollocation(problem, size, replay_share=(0.9, 0.5), jitter=(0.01, 0.03))
    points = sampler.sample(make_rng(), replay, progress)
    nearest = torch.cdist(normalised(problem, points), normalised(problem, replay)).amin(1)
    share, jitter = 0.9 - 0.4 * progress, 0.01 + 0.02 * progress
    # Beyond 6 deviations lies 1e-4 of the chi law with 8 degrees of freedom; uniform points are hardly ever that near.
    near = nearest < 6 * jitter
    assert near.double().mean().item() == pytest.approx(share, abs=0.03)
    assert nearest[near].square().mean().sqrt().item() == pytest.approx(8**0.5 * jitter, rel=0.05)
    assert torch.equal(points["mask"], sampler.mask(points["tau"], points["state"]))


def test_times_to_go_stay_within_the_horizon_however_far_they_move():
    problem = Reach1D()
    replay = TensorDict({"tau": torch.full((50, 1), 1.9), "state": torch.zeros(50, 1)}, batch_size=[50])
    points = ReplayCollocation(problem, 4_000, jitter=(3.0, 3.0)).sample(make_rng(), replay, 0.5)
    assert 0 <= points["tau"].min() < 0.1
    assert problem.horizon - 0.1 < points["tau"].max() <= problem.horizon


def test_without_a_replay_all_points_are_uniform():
    problem = Reach1D()
    assert_equal_points(ReplayCollocation(problem, 50).sample(make_rng()), Collocation(problem, 50).sample(make_rng()))


def assert_equal_points(ours, theirs):
    for key in theirs.keys():
        assert torch.equal(ours[key], theirs[key])


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"replay_share": (0.5, 1.5)}, r"collocation.replay_share: expected \[start, end\] from 0 to 1, got"),
        ({"jitter": (-0.1, 0.1)}, "collocation.jitter: expected"),
        ({"jitter": (0.1,)}, "collocation.jitter: expected"),
    ],
)
def test_replay_collocation_names_the_key(kwargs, message):
    with pytest.raises(ValueError, match=message):
        ReplayCollocation(VehicleDrift(), **kwargs)


def test_visited_states_take_their_share_of_the_points_at_the_end_of_time():
    problem = VehicleDrift()
    replay = visited(problem)
    points = BoundarySampler(problem, initial=200, faces=50, replay_share=0.25).sample(make_rng(), replay)
    assert (points["tau"][:200] == 0).all()
    known = (points["state"].unsqueeze(1) == replay["state"]).all(-1).any(-1)
    assert known.tolist() == [True] * 50 + [False] * 200
    assert torch.equal(points["value"][:200], problem.boundary_value(points["state"][:200]))
