"""Actor and critics: multilayer perceptrons whose first layer scales the inputs to [-1, 1].

They take the sine and the cosine of a periodic coordinate, so that they have its period exactly, with all derivatives.

The parameters may have leading axes, over which `forward` broadcasts. With weights stacked as (critics, out, in), as in
TorchRL's losses, one call evaluates all critics and returns (critics, N, 1).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from pirl_rl.errors import ArgumentError
from pirl_rl.layers import Choice, WindowedChoice
from pirl_rl.perceptrons import initialise_xavier, perceptron, spread_zeros
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sets import Box


class Actor(nn.Module):
    """The policy pi(tau, x): maps tau (N, 1), in s, and x (N, n) to the control (N, m), normalised to [-1, 1].

    Args:
        problem: gives the numbers of states and controls, and the horizon.
        hidden: widths of the hidden layers.
        activation: name of a layer of `torch.nn`.
        scaling: box of states that the first layer maps to [-1, 1]^n; default `problem.states`, which gives the periods
            of periodic axes in any case.
        root_time: whether sqrt(tau) is an input beside tau, see `RootTime`.
        spread: the mean slope of the neurons of the first layer in the scaled inputs. Their zeros then pass through
            points that are uniform in the box. None takes the usual initialisation, for which all zeros pass near the
            middle of the box.
        levels: whether the levels of the constraints of A and B are inputs too, see `Levels`.
        log_levels: whether the logarithms of these levels are inputs beside them, see `LogLevels`.
        choices: None makes each coordinate of the control a hyperbolic tangent. With an integer of at least 2 it is one
            of so many numbers evenly spaced over [-1, 1], bounds included, each of which has a score, see `Choice`. The
            control may then jump between two of them along a surface, where a hyperbolic tangent has to pass through
            all between them. It has no gradient, so that only `BestControl` can train it.
        together: the number of coordinates of the control that are chosen together, with one score for each combination
            of their numbers. Where the best control changes in several coordinates at once, they then jump along the
            same surface.
        window: with a number above 0, a coordinate is the mean of those of its `choices` numbers that lie so close to
            the best one, see `WindowedChoice`. Where the best control changes many times in a training, that is the
            mean of those that are alike.

    Raises:
        ArgumentError: `activation` is not the name of a layer of `torch.nn`, `spread` is not positive, `log_levels` is
            given without `levels`, `choices` is no integer of at least 2, `together` does not divide the number of
            controls, or a `window` is negative, or given without `choices` or beside `together` > 1.
    """

    def __init__(
        self,
        problem: ReachAvoidProblem,
        hidden: Sequence[int] = (32, 32),
        activation: str = "ReLU",
        scaling: Box | None = None,
        root_time: bool = False,
        spread: float | None = None,
        levels: bool = False,
        log_levels: bool = False,
        choices: int | None = None,
        together: int = 1,
        window: float = 0.0,
    ):
        super().__init__()
        outputs = problem.controls.dim
        if window and (choices is None or together > 1):
            got = f"window={window}, choices={choices} and together={together}"
            raise ArgumentError(f"window: expected choices beside it, and together=1, got {got}")
        self.choice = None if choices is None else Choice(choices, together)
        if choices is not None and window:
            self.choice = WindowedChoice(choices, window)
        if self.choice:
            if outputs % together:
                raise ArgumentError(f"together: expected a divisor of the number {outputs} of controls, got {together}")
            outputs = outputs // together * self.choice.choices**together
        output = self.choice or "Tanh"
        self.layers = perceptron(
            problem, 0, hidden, outputs, activation, output, root_time, scaling, levels, log_levels
        )
        spread_zeros(self.layers, spread, problem, 0)

    def logits(self, tau: Tensor, state: Tensor) -> Tensor:
        """The input of the last layer: (N, m) of the hyperbolic tangent, or the scores of the choices, see `Choice`."""
        return self.layers[:-1](torch.cat([tau, state], -1))

    def forward(self, tau: Tensor, state: Tensor) -> Tensor:
        return self.layers[-1](self.logits(tau, state))


class Critic(nn.Module):
    """Q(tau, x, u) or V(tau, x): maps tau (N, 1), in s, x (N, n) and the normalised u (N, m) to a probability (N, 1).

    Args:
        problem: gives the numbers of states and controls, and the horizon.
        hidden: widths of the hidden layers.
        activation: name of a layer of `torch.nn`; `PIRLLoss` needs a C^2 one.
        action_input: True makes a critic Q(tau, x, u), as in the paper. False makes a critic V(tau, x), which ignores
            the action. Its derivatives are those of the value of the policy, so that played actions must have no noise.
        root_time: whether sqrt(tau) is an input beside tau, see `RootTime`.
        output: "Sigmoid" keeps the output in (0, 1), as in the paper, but attains 0 or 1 at a face only in the limit of
            infinite weights. None is a linear output, which attains both.
        scaling: box of states that the first layer maps to [-1, 1]^n; default `problem.states`, which gives the periods
            of periodic axes in any case.
        spread: the mean slope of the neurons of the first layer in the scaled inputs. Their zeros then pass through
            points that are uniform in the box. None takes the usual initialisation, for which all zeros pass near the
            middle of the box.
        levels: whether the levels of the constraints of A and B are inputs too, see `Levels`.
        log_levels: whether the logarithms of these levels are inputs beside them, see `LogLevels`.

    Raises:
        ArgumentError: `activation` or `output` is not the name of a layer of `torch.nn`, `spread` is not positive, or
            `log_levels` is given without `levels`.
    """

    def __init__(
        self,
        problem: ReachAvoidProblem,
        hidden: Sequence[int] = (32, 32, 32),
        activation: str = "Tanh",
        action_input: bool = False,
        root_time: bool = True,
        output: Literal["Sigmoid"] | None = None,
        scaling: Box | None = None,
        spread: float | None = None,
        levels: bool = False,
        log_levels: bool = False,
    ):
        super().__init__()
        self.action_input = action_input
        controls = problem.controls.dim if action_input else 0
        self.layers = perceptron(
            problem, controls, hidden, 1, activation, output, root_time, scaling, levels, log_levels
        )
        initialise_xavier(self.layers)
        spread_zeros(self.layers, spread, problem, controls)

    def inputs(self, tau: Tensor, state: Tensor, action: Tensor) -> Tensor:
        """The input (N, d) of the first layer: (tau, x, u), or (tau, x) for a critic V(tau, x)."""
        return torch.cat([tau, state, action] if self.action_input else [tau, state], -1)

    def logits(self, tau: Tensor, state: Tensor, action: Tensor) -> Tensor:
        """The output (N, 1) before the sigmoid of the last layer, for a critic with output "Sigmoid"."""
        return self.layers[:-1](self.inputs(tau, state, action))

    def forward(self, tau: Tensor, state: Tensor, action: Tensor) -> Tensor:
        return self.layers(self.inputs(tau, state, action))

    def at(self, action: Tensor) -> CriticValue:
        """The function V(tau, x) = Q(tau, x, action) with the action (N, m) frozen."""
        return CriticValue(self, action)


def stack(critics: Sequence[Critic]) -> Critic:
    """One critic whose parameters have a leading axis over `critics`, as in TorchRL's losses."""
    twin = copy.deepcopy(critics[0])
    for layer, *layers in zip(twin.layers, *(critic.layers for critic in critics), strict=True):
        for key in layer._parameters:
            setattr(layer, key, nn.Parameter(torch.stack([getattr(one, key) for one in layers]).detach()))
        for key in layer._buffers:
            setattr(layer, key, torch.stack([getattr(one, key) for one in layers]))
    return twin


def unstack(critic: Critic) -> list[Critic]:
    """The critics, with parameters of their own, that `stack` has made one of."""
    critics = []
    for i in range(len(next(critic.parameters()))):
        one = copy.deepcopy(critic)
        for layer in one.layers:
            for key in layer._parameters:
                setattr(layer, key, nn.Parameter(getattr(layer, key)[i].detach()))
            for key in layer._buffers:
                setattr(layer, key, getattr(layer, key)[i])
        critics.append(one)
    return critics


class CriticValue:
    """A critic at a frozen action: maps tau (N,) and x (N, n) to V (N,), or (critics, N) with stacked parameters.

    Args:
        critic: the critic.
        action: the action (N, m), normalised to [-1, 1].
    """

    def __init__(self, critic: Critic, action: Tensor):
        self.critic, self.action = critic, action

    def __call__(self, tau: Tensor, x: Tensor) -> Tensor:
        return self.critic(tau.unsqueeze(-1), x, self.action).squeeze(-1)
