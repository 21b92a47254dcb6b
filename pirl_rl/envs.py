"""Reach-avoid problems as TorchRL environments, with the additive reward of Proposition 1 of the paper.

A TensorDict contains a batch of N paths:

- "tau" (N, 1): the time to go, in s, which is a part of the state. Every step is dt long but the last of an episode,
  which is shorter where dt does not divide tau and ends at tau = 0;
- "state" (N, n): the state x, in SI units;
- "action" (N, m): the control, normalised to [-1, 1];
- "noise" (N, n): sigma dW of the last control step, in the units of the state, see `Step.noise`;
- "is_init" (N, 1): whether the state is the first of its episode;
- "reward" (N, 1): l_eps at the last state of an episode, else 0.

A and B absorb, and the horizon is a part of the problem, so that every end of an episode is a `terminated`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from pirl_rl import recording
from pirl_rl.errors import ArgumentError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.initial_states import InitialStates, UniformStates
from pirl_rl.sampling.supply import Stock, Supply
from pirl_rl.simulator import Simulator, Step, exit_value
from pirl_rl.structure import check_problem


class ReachAvoidEnv(EnvBase):
    """A vectorised environment over `num_envs` independent paths of one problem.

    Args:
        problem: the physics.
        dt: the length of a control step, in s.
        substeps: the number of integration steps in a control step.
        crossing: "bridge" or "endpoint", see `pirl_rl.simulator`.
        initial_states: the distribution of the initial states of episodes; default `UniformStates`.
        num_envs: the number of paths N.
        seed: the seed of the random generator; None draws one from torch's default generator.
        device: the device of all tensors.
        compile_simulator: whether the simulator is compiled. Where that fails, it runs eagerly after one warning.
            (TorchRL's own argument `compile` would compile a whole step with its resets, which breaks into pieces.)

    Attributes:
        stocked: whether a step asks nothing of the device, as a recording of its kernels needs it, see `Stock`; this is
            so on a GPU.

    Raises:
        ProblemError: the problem contradicts itself, see `check_problem`.
        ArgumentError: a step size or `num_envs` is out of range, or `crossing` is unknown.
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
        compile_simulator: bool = False,
    ):
        check_problem(problem)
        if not (isinstance(num_envs, int) and num_envs >= 1):
            raise ArgumentError(f"num_envs: expected an integer >= 1, got {num_envs!r}")
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.problem = problem
        self.simulator = Simulator(problem, dt, substeps, crossing, compile_simulator)  # type: ignore[arg-type]
        self._initial_states = initial_states or UniformStates()
        self.supply, self.stock, self.stocked = Supply(num_envs), Stock(), recording.records(self.device)
        self.max_steps = self.simulator.clock.max_steps
        self._make_specs()
        self.rng = torch.Generator(device=self.device)
        self.set_seed(int(torch.empty((), dtype=torch.int64).random_().item()) if seed is None else seed)

    @property
    def initial_states(self) -> InitialStates:
        """The distribution of the initial states of episodes; another one counts from the next reset."""
        return self._initial_states

    @initial_states.setter
    def initial_states(self, distribution: InitialStates) -> None:
        if distribution is not self._initial_states:
            self._initial_states, self.supply = distribution, Supply(self.supply.size)
            self.stock = Stock(self.stock.groups)

    def recipe(self, seed: int) -> Callable[[], ReachAvoidEnv]:
        """A picklable function that builds a copy of this environment on the CPU, with the given seed."""
        steps = {name: getattr(self.simulator, name) for name in ("dt", "substeps", "crossing")}
        others = {"initial_states": self.initial_states, "num_envs": self.batch_size[0], "seed": seed}
        return partial(ReachAvoidEnv, self.problem, **steps, **others, compile_simulator=bool(self.simulator.compile))

    def joined(self, initial_states: InitialStates, copies: int, seed: int) -> ReachAvoidEnv:
        """An environment on the same device with the paths of several copies of this one."""
        make: Any = self.recipe(seed)
        joint = make(initial_states=initial_states, num_envs=copies * self.batch_size[0], device=self.device)
        joint.stock = Stock(copies)
        return joint

    def _make_specs(self) -> None:
        problem, bs, device = self.problem, self.batch_size, self.device
        one, n, m = (torch.Size((*bs, width)) for width in (1, problem.states.dim, problem.controls.dim))
        self.observation_spec = Composite(
            tau=Bounded(0.0, problem.horizon, one, device=device),
            state=Unbounded(n, device=device),
            noise=Unbounded(n, device=device),
            is_init=Categorical(2, one, dtype=torch.bool, device=device),
            shape=bs,
            device=device,
        )
        self.action_spec = Bounded(-1.0, 1.0, m, device=device)
        self.reward_spec = Bounded(0.0, 1.0, one, device=device)
        flag = Categorical(2, one, dtype=torch.bool, device=device)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), shape=bs, device=device)

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Start new episodes where one has ended.

        TorchRL's method hides all states from `_reset`. Here the distribution of the initial states sees those of the
        paths that go on.
        """
        if self.stocked:
            return self._restarted(tensordict)
        return self.reset(tensordict, set_state=False) if self.any_done(tensordict) else tensordict

    def stock_up(self, steps: int, visited: Tensor | None = None) -> None:
        """Draw initial states for the episodes that begin within the next steps, if the environment is `stocked`.

        Args:
            steps: the number of steps.
            visited: states (k, n) of the paths that are under way.
        """
        self.stock.fill(steps, self.batch_size[0], lambda count: self._draw(count, visited))

    def _restarted(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The TensorDict with a new episode, from the stock, where one has ended."""
        ended, tau, state = tensordict["done"], tensordict["tau"], tensordict["state"]
        steps, started = self.stock.take(ended.squeeze(-1), lambda count: self._draw(count, state))
        fresh = {
            "tau": torch.where(ended, self.simulator.clock.time(steps).to(tau).unsqueeze(-1), tau),
            "state": torch.where(ended, self.problem.states.wrap(started.to(state)), state),
            "noise": torch.where(ended, 0.0, tensordict["noise"]),
            "is_init": ended | tensordict["is_init"],
            "done": torch.zeros_like(ended),
            "terminated": torch.zeros_like(ended),
        }
        return tensordict.copy().update(fresh)

    def _draw(self, count: int, visited: Tensor | None) -> tuple[Tensor, Tensor]:
        dtype = torch.get_default_dtype()
        return self.initial_states.sample(self.problem, count, self.max_steps, self.rng, dtype, visited)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        size, dtype = (*self.batch_size, self.problem.states.dim), torch.get_default_dtype()
        ended = torch.ones(self.batch_size, dtype=torch.bool, device=self.device)
        tau, state = (torch.zeros(shape, dtype=dtype, device=self.device) for shape in ((*self.batch_size, 1), size))
        visited = None
        if tensordict is not None and {"_reset", "tau", "state"} <= set(tensordict.keys()):
            ended = tensordict["_reset"].reshape(-1)
            tau, state = tensordict["tau"].clone(), tensordict["state"].clone()
            visited = state[~ended]
        steps, started = self.supply.take(int(ended.sum()), lambda count: self._draw(count, visited))
        tau[ended] = self.simulator.clock.time(steps).to(tau).unsqueeze(-1)
        state[ended] = self.problem.states.wrap(started.to(state))
        none = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        return TensorDict(
            {
                "tau": tau,
                "state": state,
                "noise": torch.zeros_like(state),
                "is_init": ~none,
                "done": none,
                "terminated": none.clone(),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        tau, x, clock = tensordict["tau"], tensordict["state"], self.simulator.clock
        steps, shortfall = clock.split(tau)
        u = self.problem.controls.denormalize(tensordict["action"])
        step = self.simulator.step(x, u, self.rng, dt=clock.length(steps, shortfall).squeeze(-1).to(x))
        terminated = (step.reached | step.failed).unsqueeze(-1) | (steps <= 1)
        reward, ends = torch.zeros_like(x[..., :1]), terminated.squeeze(-1)
        if self.stocked:  # asking the device which paths end would cost more than the payoff of all of them
            reward = torch.where(terminated, exit_value(self.problem, step).unsqueeze(-1), 0.0)
        elif ends.any():  # the payoff of the few paths that end costs far less than that of all paths
            reward[ends] = exit_value(self.problem, Step(*(entry[ends] for entry in step))).unsqueeze(-1)
        return TensorDict(
            {
                "tau": clock.time(steps - 1, shortfall).to(tau),
                "state": step.state,
                "noise": step.noise,
                "is_init": torch.zeros_like(terminated),
                "reward": reward,
                "done": terminated,
                "terminated": terminated.clone(),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.rng.manual_seed(seed)
            self.supply, self.stock = Supply(self.supply.size), Stock(self.stock.groups)
