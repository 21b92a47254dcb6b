"""What users hand in is checked: states, times to go, and the controls of their policies."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

import pirl_rl
from pirl_rl.errors import ArgumentError
from pirl_rl.problems import DubinsCar

PROBLEM = DubinsCar()  # three states, of which the heading is periodic, one control in [-1.5, 1.5], 4 s
X = torch.tensor([[-1.0, 0.0, 0.0], [1.0, 1.0, 2.0]])


def straight(tau, x):
    return torch.zeros(len(x), 1)


@pytest.mark.parametrize(
    ("policy", "told"),
    [
        (
            lambda tau, x: torch.zeros(len(x), 2),
            r"expected controls of shape \(\d+, 1\) for \d+ states, got \(\d+, 2\)",
        ),
        (lambda tau, x: torch.zeros(len(x)), r"expected controls of shape \(\d+, 1\)"),
        (lambda tau, x: torch.full((len(x), 1), 1.6), r"expected controls in Box\(\[-1\.5\], \[1\.5\]\), got \[1\.6"),
        (lambda tau, x: torch.full((len(x), 1), float("nan")), r"expected controls in .*, got \[nan\] at tau = "),
        (lambda tau, x: np.zeros((len(x), 1)), "expected controls as a tensor, got ndarray"),
    ],
    ids=["columns", "flat", "bounds", "nan", "array"],
)
def test_a_policy_with_wrong_controls_is_refused(policy, told):
    with pytest.raises(ArgumentError, match=f"^policy: {told}"):
        pirl_rl.monte_carlo(PROBLEM, policy, 1.0, X, rollouts=4, dt=0.1)


@pytest.mark.parametrize("control", [-1.5, 1.5, 1.5 * (1 + 1e-6)])
def test_controls_at_their_bounds_are_accepted(control):
    pirl_rl.monte_carlo(PROBLEM, lambda tau, x: torch.full((len(x), 1), control), 1.0, X, rollouts=4, dt=0.1)


@pytest.mark.parametrize(
    ("tau", "x", "told"),
    [
        (4.1, X, r"tau: expected 0 <= tau <= horizon = 4\.0 s, got 4\.1"),
        (-0.1, X, r"tau: expected 0 <= tau"),
        (float("nan"), X, r"tau: expected 0 <= tau"),
        (torch.ones(3), X, r"tau: expected a number or the shape \(2,\) of the states, got \(3,\)"),
        ("long", X, "tau: expected numbers, got str"),
        (1.0, X[:, :2], r"x: expected states of shape \(\*, 3\), got \(2, 2\)"),
        (1.0, X[0], r"x: expected states of shape \(N, 3\), got \(3,\)"),
        (1.0, X * float("nan"), "x: expected finite states"),
        (1.0, [["a", "b", "c"]], "x: expected numbers, got list"),
    ],
)
def test_states_and_times_to_go_that_make_no_sense_are_refused(tau, x, told):
    with pytest.raises(ArgumentError, match=f"^{told}"):
        pirl_rl.monte_carlo(PROBLEM, straight, tau, x, rollouts=4, dt=0.1)


def test_states_far_outside_the_box_are_warned_of_and_angles_are_not(recwarn):
    near, turned = X + torch.tensor([1.0, 0.0, 0.0]), X + torch.tensor([0.0, 0.0, 100.0])
    for x in (near, turned):
        pirl_rl.monte_carlo(PROBLEM, straight, 1.0, x, rollouts=4, dt=0.1)
    assert not [warning for warning in recwarn if "far outside" in str(warning.message)]
    with pytest.warns(UserWarning, match=r"x: some states lie far outside the box of states Box\("):
        pirl_rl.monte_carlo(PROBLEM, straight, 1.0, X * torch.tensor([[9.0], [1.0]]), rollouts=4, dt=0.1)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("default")
        for factors in ([[9.0], [1.0]], [[9.0], [9.0]], [[1.0], [8.0]]):
            pirl_rl.monte_carlo(PROBLEM, straight, 1.0, X * torch.tensor(factors), rollouts=4, dt=0.1)
    assert len([warning for warning in found if "far outside" in str(warning.message)]) == 1
