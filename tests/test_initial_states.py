"""Initial states: outside A and B, whole steps to go, reproducible."""

from __future__ import annotations

import pytest
import torch
from oracles import PROBLEMS, name

from pirl_rl.initial_states import UniformStates, sample_interior
from pirl_rl.problem import ProblemError
from pirl_rl.problems import Reach1D, Safety1D
from pirl_rl.sets import Box

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


def test_tau_fixed_or_uniform():
    assert (draw(Reach1D(), UniformStates(tau="fixed"))[0] == 20).all()
    counts = torch.bincount(draw(Reach1D(), UniformStates(tau="random"))[0], minlength=21)
    assert counts[0] == 0
    # Chi-squared with 19 degrees of freedom: above 43.8 with probability 1e-3.
    assert ((counts[1:] - COUNT / 20) ** 2 / (COUNT / 20)).sum() < 43.8


def test_same_generator_same_states():
    first, second, other = (draw(Safety1D(), UniformStates([-3.0], [3.0]), seed)[1] for seed in (0, 0, 1))
    assert torch.equal(first, second)
    assert not torch.equal(first, other)


def test_a_box_inside_the_target_is_refused():
    with pytest.raises(ProblemError, match=r"Reach1D: no state outside .* found in Box\(\[3.0\], \[4.0\]\)"):
        sample_interior(Reach1D(), Box([3.0], [4.0]), 5, torch.Generator(), torch.float32)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"tau": "late"}, "initial_states.tau: expected 'fixed' or 'random', got 'late'"),
        ({"low": [0.0]}, "give both low and high"),
        ({"low": [1.0], "high": [0.0]}, "low < high"),
    ],
)
def test_errors_name_the_key(kwargs, message):
    with pytest.raises(ValueError, match=message):
        UniformStates(**kwargs)
