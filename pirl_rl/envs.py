"""Reach-avoid problems as TorchRL environments: the additive-reward problem of the paper's Proposition 1.

A batch of paths in one TensorDict: "tau" (*, 1), the time to go, is part of the state; "state" (*, n) in SI units;
"action" (*, m) is the control in [-1, 1] coordinates; "is_init" (*, 1) marks an episode's first state. A and B absorb,
so every end, the horizon's too, is a `terminated`. The reward is l_eps of the last state: 1 on success, else 0 with the
hard payoff.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem, check_problem
from pirl_rl.sampling.initial_states import InitialStates, UniformStates
from pirl_rl.simulator import Simulator, exit_value


class ReachAvoidEnv(EnvBase):
    """A vectorised environment over `num_envs` independent paths of one problem.

    Args:
        problem: the physics.
        dt: control step, s.
        substeps: integration steps in it.
        crossing: "bridge" or "endpoint", see `pirl_rl.simulator`.
        initial_states: the law of episodes' starts.
        num_envs: batch size.
        seed: of the environment's own random generator; drawn from torch's where None.
        device: of all tensors.

    Raises:
        ProblemError: a problem that contradicts itself, e.g. sets that overlap.
        ValueError: step sizes out of range.
    """

    _supports_set_state = True

    def __init__(
        self,
        problem: ReachAvoidProblem,
        dt: float = 0.1,
        substeps: int = 1,
        crossing: str = "bridge",
        initial_states: InitialStates | None = None,
        num_envs: int = 256,
        seed: int | None = None,
        device: torch.device | str = "cpu",
    ):
        check_problem(problem)
        if not (isinstance(num_envs, int) and num_envs >= 1):
            raise ArgumentError(f"num_envs: expected an integer >= 1, got {num_envs!r}")
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.problem = problem
        self.simulator = Simulator(problem, dt, substeps, crossing)  # type: ignore[arg-type]
        self.initial_states: InitialStates = initial_states or UniformStates()
        self.max_steps = round(problem.horizon / dt)
        self._make_specs()
        self.rng = torch.Generator(device=self.device)
        self.set_seed(int(torch.empty((), dtype=torch.int64).random_().item()) if seed is None else seed)

    def recipe(self, seed: int) -> Callable[[], ReachAvoidEnv]:
        """A picklable call that builds this environment again, with another seed, on the CPU."""
        steps = {name: getattr(self.simulator, name) for name in ("dt", "substeps", "crossing")}
        envs = self.batch_size[0]
        return partial(
            ReachAvoidEnv, self.problem, **steps, initial_states=self.initial_states, num_envs=envs, seed=seed
        )

    def _make_specs(self) -> None:
        problem, bs, device = self.problem, self.batch_size, self.device
        one, n, m = (torch.Size((*bs, width)) for width in (1, problem.states.dim, problem.controls.dim))
        self.observation_spec = Composite(
            tau=Bounded(0.0, problem.horizon, one, device=device),
            state=Unbounded(n, device=device),
            is_init=Categorical(2, one, dtype=torch.bool, device=device),
            shape=bs,
            device=device,
        )
        self.action_spec = Bounded(-1.0, 1.0, m, device=device)
        self.reward_spec = Bounded(0.0, 1.0, one, device=device)
        flag = Categorical(2, one, dtype=torch.bool, device=device)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), shape=bs, device=device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        visited = None
        if tensordict is not None and "_reset" in tensordict.keys() and "state" in tensordict.keys():
            visited = tensordict["state"][~tensordict["_reset"].reshape(-1)]
        steps, state = self.initial_states.sample(
            self.problem, self.batch_size[0], self.max_steps, self.rng, torch.get_default_dtype(), visited
        )
        none = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        return TensorDict(
            {
                "tau": (steps * self.simulator.dt).to(state.dtype).unsqueeze(-1),
                "state": state,
                "is_init": ~none,
                "done": none,
                "terminated": none.clone(),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        tau, dt = tensordict["tau"], self.simulator.dt
        # Whole steps to go are recovered from tau, so that rounding never adds or drops a step.
        steps = torch.round(tau / dt) - 1
        u = self.problem.controls.denormalize(tensordict["action"])
        step = self.simulator.step(tensordict["state"], u, self.rng)
        terminated = (step.reached | step.failed).unsqueeze(-1) | (steps <= 0)
        return TensorDict(
            {
                "tau": (steps * dt).clamp(min=0),
                "state": step.state,
                "is_init": torch.zeros_like(terminated),
                "reward": exit_value(self.problem, step).unsqueeze(-1) * terminated,
                "done": terminated,
                "terminated": terminated.clone(),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.rng.manual_seed(seed)
