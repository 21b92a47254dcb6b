"""Playing for several trainings at once, in one environment whose paths follow the policies of all of them.

A GPU plays the paths of many trainings in the time in which it plays those of one, since most of its time goes into
the launches of kernels. The policies have equal networks, so that `torch.func.vmap` evaluates all of them together.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from pirl_rl.collectors.joint_states import JointStates, StackedNetworks
from pirl_rl.collectors.player import Player
from pirl_rl.collectors.sync import SyncCollector
from pirl_rl.collectors.transitions import ControlVariate, Exploration, PlayedPolicy
from pirl_rl.compilation import Compiled
from pirl_rl.solution import Solution

WAITING = 8
"""The number of batches that are kept for a training which does not take them."""


class JointPlayer:
    """Plays for several collectors, each of which takes its part of every batch.

    Args:
        collectors: collectors of one problem with equal settings and networks, whose environments are `stocked`.
    """

    def __init__(self, collectors: Sequence[SyncCollector]):
        self.collectors, first = collectors, collectors[0]
        seed = int(torch.randint(2**31, (), generator=first.env.rng, device=first.env.device))
        envs = [collector.env for collector in collectors]
        self.player = Player(
            envs[0].joined(JointStates(envs), len(envs), seed),
            JointPolicy([collector.policy for collector in collectors]),  # type: ignore[arg-type]
            len(envs) * first.frames_per_batch,
            len(envs) * first.warmup_frames,
            first.n_steps,
        )
        if first.has_played:
            self.player.skip_random()
        self._settings = first.n_steps, first.exploration_noise
        self._parts: list[deque[TensorDictBase]] = [deque(maxlen=WAITING) for _ in collectors]

    def part(self, index: int) -> TensorDictBase:
        """The transitions (frames_per_batch,) of the next batch of a collector."""
        if not self._parts[index]:
            # A recording writes its next batch into the memory of the one before.
            self._parts = [deque([part.clone() for part in parts], WAITING) for parts in self._parts]
            batch = self._play()
            for own, part in zip(self._parts, batch.chunk(len(self._parts)), strict=True):
                own.append(part)
        return self._parts[index].popleft()

    def close(self) -> None:
        """Stop playing."""
        self.player.close()

    def _play(self) -> TensorDictBase:
        first = self.collectors[0]
        if self._settings != (settings := (first.n_steps, first.exploration_noise)):
            self.player.settle(self.player.env.initial_states, *settings)
            self._settings = settings
        policy: JointPolicy = self.player.policy  # type: ignore[assignment]
        policy.gather()
        return self.player.play()


class JointPolicy(TensorDictModuleBase):
    """The policies of several trainings: path number i N + j of M N paths follows policy i.

    It has the outputs of `PlayedPolicy`.

    Args:
        policies: policies whose networks have equal shapes.
    """

    def __init__(self, policies: Sequence[PlayedPolicy]):
        super().__init__()
        first = policies[0]
        self.in_keys, self.out_keys = list(first.in_keys), list(first.out_keys)  # type: ignore[assignment]
        self.exploration = Exploration(first.exploration.deviation, first.exploration.when)  # type: ignore[arg-type]
        self._members, self._program = len(policies), [StackedPolicies(policies)]  # a list is no module

    def gather(self) -> None:
        """Take over the parameters of all policies, into memory that stays where it is."""
        self._program[0].networks.gather()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tau, state = (tensordict[key].unflatten(0, (self._members, -1)) for key in ("tau", "state"))
        loc, slope = (part.flatten(0, 1) for part in self._program[0](tau, state))
        action = self.exploration(loc, tensordict["is_init"])
        tensordict.set("loc", loc).set("action", action).set("played", action.clone())
        return tensordict.set("slope", slope) if "slope" in self.out_keys else tensordict


class StackedPolicies:
    """The actors and control variates of several trainings in one program.

    Attributes:
        networks: the actors and, with a control variate, the critics.

    Args:
        policies: the policies of M trainings with equal settings, whose networks have equal shapes.
    """

    def __init__(self, policies: Sequence[PlayedPolicy]):
        self.networks = StackedNetworks([self.networks_of(policy) for policy in policies])
        variate = policies[0].control_variate
        self._variate: ControlVariate | None = None
        if variate is not None:
            solution = Solution(variate.simulator.problem, *self.networks.twins)  # type: ignore[arg-type]
            self._variate = ControlVariate(solution, variate.simulator, variate.compiles, variate.limit)
        every = torch.func.vmap(self._of_member, in_dims=(0, 0, 0, None))
        compiles = variate is not None and variate.compiles
        self._every = Compiled(every, "the policy of all members", traced=True) if compiles else every

    def __call__(
        self, tau: Tensor, state: Tensor, params: Sequence[TensorDictBase] | None = None
    ) -> tuple[Tensor, Tensor]:
        """The actions (M, N, m) and the slopes (M, N, n) of V at tau (M, N, 1) and state (M, N, n).

        Args:
            tau, state: the points of each training.
            params: other parameters (M, ...) of the networks than those of the trainings.
        """
        constant = self._variate.simulator.constant_sigma(state.device) if self._variate else None
        return self._every(self.networks.params if params is None else params, tau, state, constant)

    def _of_member(
        self, params: Sequence[TensorDictBase], tau: Tensor, state: Tensor, constant: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """The action (N, m) of one policy and the slope (N, n) of its V."""
        kept = {"preserve_module_state": False}
        actor, *critics = self.networks.twins
        with params[0].to_module(actor, **kept):
            loc = actor(tau, state)
        if self._variate is None:
            return loc, torch.zeros_like(state)
        with params[1].to_module(critics[0], **kept):
            return loc, self._variate(tau, state, loc, constant)

    @staticmethod
    def networks_of(policy: PlayedPolicy) -> list[torch.nn.Module]:
        """The networks of a policy: its actor and, with a control variate, its critic."""
        return [policy.actor, *([] if policy.control_variate is None else [policy.control_variate.critic])]


def share_program(policies: Sequence[PlayedPolicy]) -> None:
    """Let policies that play alone, with equal settings and networks of equal shapes, play one compiled program."""
    variate = policies[0].control_variate
    if variate is None or not variate.compiles:
        return
    program = StackedPolicies(policies[:1])
    for policy in policies:
        own: list[Any] = [TensorDict.from_module(network) for network in StackedPolicies.networks_of(policy)]
        own = [params.data.unsqueeze(0) for params in own]
        policy.play_by(partial(_alone, program, own))


def _alone(
    program: StackedPolicies, params: Sequence[TensorDictBase], tau: Tensor, state: Tensor, constant: Tensor | None
) -> tuple[Tensor, Tensor]:
    loc, slope = program(tau.unsqueeze(0), state.unsqueeze(0), params)
    return loc.squeeze(0), slope.squeeze(0)
