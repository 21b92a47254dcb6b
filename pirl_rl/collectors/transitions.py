"""The policy that collectors play, and n-step transitions from batches of steps.

With `control_variate`, the noise of the physics is taken out of the returns. Over the steps k of a return, the return

    y = sum_k r_k + (1 - d) V(tau_n, x_n) - sum_k grad V(tau_k, x_k) . (sigma dW)_k         Eq. (control_variate)

has the same mean as without the last sum, whatever V is, because sigma dW, summed in each step until the path ends, has
mean zero given all that came before. Where V is exact, Ito's formula says that the last sum is the
deviation of the return from its mean, up to the size of a step. So the returns become more certain while V is learned.
The cost is one gradient of V at each step, for any number of noise channels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from pirl_rl.compilation import Compiled
from pirl_rl.errors import ArgumentError
from pirl_rl.sigma import transposed_times
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

TRANSITION = ("tau", "state", "action", "loc", *(("next", key) for key in ("tau", "state", "reward", "terminated")))
"""The entries of a transition that the loss reads; "loc" is the output of the actor, "action" the played action."""

LEAST_DEVIATION = 1e-6
"""A deviation of V in one step that is always allowed, so that nothing is divided by zero where V is 0 or 1."""


class Exploration(nn.Module):
    """Adds clipped Gaussian noise to actions in [-1, 1].

    Args:
        deviation: standard deviation of the noise, >= 0.
        when: "always", or "start" for noise on the first step of an episode only. An n-step return then has noise in no
            action but the one whose value it estimates (exploring starts, Sutton and Barto, Reinforcement Learning,
            2nd ed., Sec. 5.3).

    Raises:
        ArgumentError: `deviation` is negative, or `when` is unknown.
    """

    def __init__(self, deviation: float, when: Literal["always", "start"]):
        super().__init__()
        if deviation < 0 or when not in ("always", "start"):
            raise ArgumentError(
                "collector: expected exploration_noise >= 0 and exploration 'always' or 'start', "
                f"got {deviation!r} and {when!r}"
            )
        self.deviation, self.when = deviation, when

    def forward(self, loc: Tensor, is_init: Tensor) -> Tensor:
        """The played action (N, m) for the actor's output `loc` (N, m) and `is_init` (N, 1) bool."""
        noise = self.deviation * torch.randn_like(loc)
        return (loc + (noise if self.when == "always" else noise * is_init)).clamp(-1, 1)


class ControlVariate(nn.Module):
    """Notes grad V(tau, x) at each step, by which the noise of the physics is taken out of the returns.

    A slope that is too steep adds noise in place of taking it out, and in many dimensions V would learn ever steeper
    slopes from such returns. So the slope is shortened where the deviation |sigma^T grad V| sqrt(dt) of V in one step
    exceeds a share of 2 sqrt(V (1 - V)): V is a martingale between 0 and 1, and near these bounds it moves little. The
    factor is known before the step, so that the means of the returns stay as they are.

    Args:
        solution: gives V, the mean of its critics.
        simulator: gives sigma and the length of a control step.
        compile: whether the actor and the slope are compiled, as one program, where they are played. Where that fails,
            they run eagerly after one warning.
        limit: the largest deviation of V in one step where V = 1/2, > 0.

    Raises:
        ArgumentError: `limit` is not positive.
    """

    def __init__(self, solution: Solution, simulator: Simulator, compile: bool, limit: float = 0.2):
        super().__init__()
        if not limit > 0:
            raise ArgumentError(f"collector.control_variate.limit: expected a number > 0, got {limit}")
        self.critic, self.simulator, self.limit, self.compiles = solution.critic, simulator, limit, compile

    def forward(self, tau: Tensor, state: Tensor, action: Tensor, constant: Tensor | None) -> Tensor:
        """The slope (N, n) of V, per unit of the state, at tau (N, 1) and state (N, n), at a frozen action (N, m).

        Compiled code cannot find `constant`, which is `simulator.constant_sigma(tau.device)`, and is given it.
        """
        value, controls = self.critic.at(action), self.simulator.problem.controls

        def summed(x: Tensor) -> tuple[Tensor, Tensor]:
            v = value(tau.squeeze(-1), x).mean(0)
            return v.sum(), v

        slope, v = torch.func.grad(summed, has_aux=True)(state)
        sigma = self.simulator.sigma(state, controls.denormalize(action), constant)
        deviation = transposed_times(sigma, slope).square().sum(-1).sqrt() * self.simulator.dt**0.5
        bound = (2 * self.limit * (v * (1 - v)).clamp(min=0).sqrt()).clamp(min=LEAST_DEVIATION)
        slope = slope * (bound / torch.maximum(deviation, bound)).unsqueeze(-1)
        # Where levels or sigma have no number the noise stays in the return: the slope is chosen before the step.
        return torch.where(slope.isfinite().all(-1, keepdim=True), slope, 0.0)


class PlayedPolicy(TensorDictModuleBase):
    """The actor followed by the noise and, if there is one, the control variate, as a policy for collectors.

    It writes "loc", the actor's output (N, m), the "action" (N, m) and, with a control variate, "slope" (N, n).
    "played" repeats the action, so that steps of this policy can be told from random ones.
    """

    def __init__(self, actor: nn.Module, exploration: Exploration, control_variate: ControlVariate | None = None):
        super().__init__()
        self.actor, self.exploration, self.control_variate = actor, exploration, control_variate
        self.in_keys = ["tau", "state", "is_init"]
        self.out_keys = ["loc", "action", "played", *([] if control_variate is None else ["slope"])]
        self._compiled: Callable[..., tuple[Tensor, Tensor]] | None = None

    def play_by(self, program: Callable[..., tuple[Tensor, Tensor]]) -> None:
        """Play a program that maps tau, state and `constant_sigma` to the actor's output and the slope of V."""
        self._compiled = program

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tau, state = tensordict["tau"], tensordict["state"]
        if self.control_variate is None:
            loc = self.actor(tau, state)
        else:
            if self.control_variate.compiles and self._compiled is None:
                # Not before the first call, because copies of this module are sent to other processes.
                self._compiled = Compiled(self._with_slope, "the policy with its control variate")
            constant = self.control_variate.simulator.constant_sigma(state.device)  # type: ignore[arg-type]
            loc, slope = (self._compiled or self._with_slope)(tau, state, constant)
            tensordict.set("slope", slope)
        action = self.exploration(loc, tensordict["is_init"])
        return tensordict.set("loc", loc).set("action", action).set("played", action.clone())

    def _with_slope(self, tau: Tensor, state: Tensor, constant: Tensor | None) -> tuple[Tensor, Tensor]:
        loc = self.actor(tau, state)
        return loc, self.control_variate(tau, state, loc, constant)  # type: ignore[misc]


class Transitions:
    """Turns a batch (envs, steps) into transitions (envs * steps,) with n-step returns without discount.

    "next" is the state n steps later, or the last one of the episode or of the batch if that ends earlier. Its "reward"
    is the sum of the rewards until then. If a control variate noted the slope of V, the reward has the last sum of
    Eq. (control_variate) subtracted; it then need not lie in [0, 1].

    Args:
        n_steps: the length of returns, in control steps.

    Raises:
        ArgumentError: `n_steps` is below 1.
    """

    def __init__(self, n_steps: int):
        if n_steps < 1:
            raise ArgumentError(f"collector.n_steps: expected at least 1, got {n_steps}")
        self.n_steps = n_steps

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        batch = _without_random(batch)
        gain = (batch["slope"] * batch["next", "noise"]).sum(-1, keepdim=True) if "slope" in batch.keys() else None
        batch = batch.select(*TRANSITION)
        following: TensorDictBase = batch.get("next")
        reward, ended = following["reward"], following["terminated"]
        total = reward.clone()
        # TorchRL's MultiStep replaces the next state but not `terminated`, and would bootstrap from absorbed states.
        end = torch.arange(batch.shape[1], device=ended.device).expand(batch.shape).unsqueeze(-1)
        for _ in range(self.n_steps - 1):
            more = ~ended.gather(1, end) & (end < batch.shape[1] - 1)
            end = end + more
            total = total + reward.gather(1, end) * more
        if gain is not None:
            until = gain.cumsum(1)
            total = total - (until.gather(1, end) - until + gain)
        batch["next"] = following.gather(1, end.squeeze(-1)).set("reward", total)
        return batch.reshape(-1)


def _without_random(batch: TensorDictBase) -> TensorDictBase:
    """The batch, where random actions of a warm-up are their own "loc" and have no slope: they come from no actor.

    TorchRL leaves earlier outputs of the policy beside random actions, and worker processes may change from random
    actions to the policy within a batch.
    """
    batch = batch.copy()
    if "loc" not in batch.keys():
        return batch.set("loc", batch["action"])
    if "played" in batch.keys():
        own = torch.eq(batch["played"], batch["action"]).all(-1, keepdim=True)
        batch = batch.set("loc", torch.where(own, batch["loc"], batch["action"]))
        if "slope" in batch.keys():
            batch = batch.set("slope", torch.where(own, batch["slope"], 0.0))
    return batch
