"""Reference states: the protocol against slow versions of it, and the committed set."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from pirl_rl.errors import ConfigError
from pirl_rl.evaluation.reference_states import ReferenceStates, displaced, visited_by
from pirl_rl.evaluation.trajectories import closed_loop
from pirl_rl.problems import Reach1D, VehicleDrift
from pirl_rl.problems.drift.reference_states import FILE, NETWORK_BOX, DriftStates, drift_states
from pirl_rl.runs import load
from pirl_rl.sampling.initial_states import UniformStates
from pirl_rl.sets import Box
from pirl_rl.simulator import Simulator

BOX = Box([0.0, -2.0], [2.0, 2.0])
"""Of (tau, x) of reach1d."""


class Still(Reach1D):
    """reach1d without noise."""

    def diffusion(self, x, u):
        return torch.zeros_like(x).unsqueeze(-1)


def push(tau, x):
    return torch.ones_like(x)


def visited(count: int = 60):
    rng = torch.Generator().manual_seed(3)
    return 2 * torch.rand(count, generator=rng), 3 * torch.rand(count, 1, generator=rng) - 1.5


def test_distances_and_groups_are_those_of_brute_force():
    tau, x = visited()
    states = ReferenceStates.from_visited(Reach1D(), tau, x, BOX, torch.Generator().manual_seed(0), 150, 0.4, 4)
    distances = []
    for t, s in zip(states.tau.tolist(), states.x[:, 0].tolist(), strict=True):
        one_by_one = [
            ((t - a) ** 2 + (s - b) ** 2 / 4) ** 0.5 for a, b in zip(tau.tolist(), x[:, 0].tolist(), strict=True)
        ]
        distances.append(sum(sorted(one_by_one)[:4]) / 4)
    assert states.distance.tolist() == pytest.approx(distances, rel=1e-4)
    sizes = states.group.bincount(minlength=5)
    assert sizes.max() - sizes.min() <= 1
    for group in range(4):
        assert states.distance[states.group == group].max() <= states.distance[states.group == group + 1].min()


def test_displacements_are_isotropic_with_uniform_length():
    """From the center of a box so wide that nothing is clipped or terminal; 4 standard errors of 20,000 draws."""
    box, count = Box([0.0, -200.0], [200.0, 100.0]), 20_000
    tau, x = torch.full((1,), 100.0), torch.full((1, 1), -50.0)
    z = box.normalize(
        torch.column_stack(displaced(Reach1D(), tau, x, box, torch.Generator().manual_seed(0), count, 0.3))
    )
    length = z.norm(dim=-1)
    assert len(z) == count
    assert length.max() <= 0.3
    assert length.mean().item() == pytest.approx(0.15, abs=4 * 0.3 / (12 * count) ** 0.5)
    assert z.mean(0).abs().max() < 4 * 0.3 / (6 * count) ** 0.5
    axis, other = z.square().mean(0)
    assert axis.item() == pytest.approx(other.item(), rel=0.05)


def test_displaced_states_are_inside_the_box_and_not_terminal():
    problem, count = Reach1D(), 5_000
    tau, x = visited()
    moved_tau, moved_x = displaced(problem, tau, x, BOX, torch.Generator().manual_seed(0), count, 2.0)
    assert BOX.contains(torch.column_stack([moved_tau, moved_x])).all()
    assert problem.interior(moved_x).all()
    assert (moved_tau > 0).all()
    assert 0 < len(moved_tau) < count


def test_unmoved_states_are_chosen_without_repetition():
    tau, x = visited()
    again = displaced(Reach1D(), tau, x, BOX, torch.Generator().manual_seed(0), len(tau), 0.0)[1]
    assert again.squeeze().sort().values.tolist() == pytest.approx(x.squeeze().sort().values.tolist(), abs=1e-6)


def test_visited_states_of_a_path_without_noise():
    """From x = 1.55 under u = 1 steps of 0.1 reach 2 with the fifth: five states before it, whatever tau was left."""
    start = UniformStates([1.55 - 1e-6], [1.55 + 1e-6], tau="fixed")
    simulator = Simulator(Still(), 0.1, 1, "endpoint")
    tau, x = visited_by(simulator, push, start, 3, torch.Generator().manual_seed(0))
    assert tau.sort(descending=True).values.tolist() == pytest.approx(
        [t for t in (2, 1.9, 1.8, 1.7, 1.6) for _ in "abc"]
    )
    assert (x.squeeze() + tau).tolist() == pytest.approx([3.55] * 15, abs=1e-5)


def test_closed_loop_ends_paths_and_holds_them():
    """One that hits, one whose time is over first, one that began inside the target."""
    simulator, rng = Simulator(Still(), 0.1, 1, "endpoint"), torch.Generator()
    tau, x = torch.tensor([2.0, 0.3, 2.0]), torch.tensor([[1.55], [0.0], [2.5]])
    paths = closed_loop(simulator, push, tau, x, rng)
    assert paths.state.shape == (21, 3, 1)
    assert paths.steps.tolist() == [5, 3, 0]
    assert paths.reached.tolist() == [True, False, True]
    assert not paths.failed.any()
    assert paths.state[-1, :, 0].tolist() == pytest.approx([2.05, 0.3, 2.5], abs=1e-5)
    assert paths.tau[:5, 1].tolist() == pytest.approx([0.3, 0.2, 0.1, 0.0, 0.0], abs=1e-6)


def test_closed_loop_hits_at_the_exact_rate():
    """P(hit 2 from 0 within 2) = 0.6277 under u = 1; with the bridge the simulation is exact. 4 standard errors."""
    simulator = Simulator(Reach1D(), 0.1)
    paths = closed_loop(
        simulator, push, torch.full((8_000,), 2.0), torch.zeros(8_000, 1), torch.Generator().manual_seed(1)
    )
    assert paths.reached.float().mean().item() == pytest.approx(0.6277, abs=4 * (0.6277 * 0.3723 / 8_000) ** 0.5)


def test_what_is_saved_is_loaded(tmp_path):
    tau, x = visited()
    states = ReferenceStates.from_visited(Reach1D(), tau, x, BOX, torch.Generator().manual_seed(0))
    states.save(tmp_path / "states.npz")
    for name, entry in vars(ReferenceStates.load(tmp_path / "states.npz")).items():
        assert torch.equal(entry, getattr(states, name)), name


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"neighbours": 61}, "neighbours: expected 1 to 60"),
        ({"box": Box([0], [1])}, "box: expected 2 axes, tau first, got 1"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    tau, x = visited()
    with pytest.raises(ValueError, match=message):
        ReferenceStates.from_visited(Reach1D(), tau, x, **{"box": BOX, "rng": torch.Generator()} | change)


def test_committed_states():
    """About a twentieth of the 512 end in A, in B or at tau = 0; about a quarter have friction outside the band."""
    states, problem = DriftStates()(), VehicleDrift()
    assert 470 <= len(states.x) <= 505
    assert FILE.stat().st_size < 60_000
    assert problem.interior(states.x).all()
    assert states.tau.min() > 0
    assert NETWORK_BOX.contains(torch.column_stack([states.tau, states.x])).all()
    assert problem.unreachable(states.x).float().mean().item() == pytest.approx(0.25, abs=0.06)
    assert states.group.unique().tolist() == [0, 1, 2, 3, 4]


def hold(tau, x):
    return torch.tensor([0.0, 2300.0]).expand(len(x), 2)


def test_states_of_another_run(monkeypatch):
    """The recipe with the run's own policy, and only for runs of the same problem."""
    problem = VehicleDrift()
    opened = SimpleNamespace(problem=problem, solution=SimpleNamespace(policy=hold))
    monkeypatch.setattr(load, "load_run", lambda folder: opened)
    states = DriftStates("some/run")()
    assert torch.equal(states.x, drift_states(hold).x)
    assert 400 <= len(states.x) < 512
    opened.problem = Reach1D()
    with pytest.raises(ConfigError, match=r"evaluation\.reference: expected a run of VehicleDrift, got some/run"):
        DriftStates("some/run")()
