"""PIRLLoss against TorchRL's own TD3Loss, bit for bit, and against the paper's formulas written by hand."""

from __future__ import annotations

import copy
import shutil

import pytest
import torch
from oracles import PROBLEMS, FullNoise, make_batch, name, nested_generator, points
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import SoftUpdate, TD3Loss

from pirl_rl.actor_rules import ActorRule, ClippedSurrogate, Hamiltonian, LookAhead, Q, Sum
from pirl_rl.errors import ArgumentError
from pirl_rl.internals import FusedSoftUpdate
from pirl_rl.losses import PIRLLoss
from pirl_rl.networks import Actor, Critic
from pirl_rl.operators import advection, generator
from pirl_rl.problems import Reach1D, VehicleDrift
from pirl_rl.schedules import WEIGHTS
from pirl_rl.simulator import Simulator

RELATIVE = 1e-10
some_problems = pytest.mark.parametrize("problem", [Reach1D(), FullNoise(8, 2, 3)], ids=name)


def networks(problem, critics: int = 2):
    torch.manual_seed(3)
    nets = [Actor(problem, (8, 8), "Tanh"), *(Critic(problem, (9, 7), action_input=True) for _ in range(critics))]
    for parameter in nn.ModuleList(nets).parameters():
        nn.init.normal_(parameter, std=0.5)
    return nets[0], nets[1:]


def target_networks(problem, critics: int = 2):
    actor, nets = networks(problem, critics)
    for key, parameter in nn.ModuleList([actor, *nets]).named_parameters():
        _move(key.split("."), parameter.data)
    return actor, nets


def make_loss(problem, critics: int = 2, weights=(1.0, 1.0, 1.0), rule: ActorRule | None = None, **kwargs) -> PIRLLoss:
    """Squared residuals and TD3's smoothing noise where a test says nothing else."""
    kwargs = {"policy_noise": 0.2, "hjb_delta": None, **kwargs, **dict(zip(WEIGHTS, weights, strict=True))}
    loss = PIRLLoss(problem, *networks(problem, critics), rule or Sum([Q(), Hamiltonian(problem)]), **kwargs)
    for params in (loss.target_actor_network_params, loss.target_qvalue_network_params):
        for key, entry in params.data.items(True, True):
            _move(key, entry)
    return loss


def _move(key, entry):
    """Targets are other weights than the online ones, so that a confusion of the two shows; scalings are buffers."""
    if key[-1] in ("weight", "bias"):
        entry.mul_(0.9).add_(0.05)


def td3_twin(loss: PIRLLoss) -> TD3Loss:
    """TorchRL's loss with the same parameters and targets, built from other networks."""
    actor, critics = networks(loss.problem, loss.num_qvalue_nets)
    for parameter in nn.ModuleList([actor, *critics]).parameters():
        nn.init.zeros_(parameter)
    one = torch.ones(loss.problem.controls.dim)
    nets = [TensorDictModule(critic, ["tau", "state", "action"], ["state_action_value"]) for critic in critics]
    td3 = TD3Loss(
        TensorDictModule(actor, ["tau", "state"], ["action"]),
        nets if len(nets) > 1 else nets[0],
        bounds=(-one, one),
        num_qvalue_nets=len(critics),
        policy_noise=loss.policy_noise,
        noise_clip=loss.noise_clip,
        loss_function="l2",
    )
    td3.make_value_estimator(gamma=1.0)
    for key in ("actor_network_params", "qvalue_network_params"):
        for prefix in ("", "target_"):
            getattr(td3, prefix + key).data.copy_(getattr(loss, prefix + key).data)
    return td3


def gradients(value, params):
    return torch.autograd.grad(value, list(params.parameters()), allow_unused=True, materialize_grads=True)


def assert_close(ours, theirs):
    for mine, other in zip(ours, theirs, strict=True):
        assert (mine - other).norm() <= RELATIVE * other.norm()
    assert any(other.norm() > 0 for other in theirs)


# Weights (1, 0, 0)


@some_problems
@pytest.mark.parametrize("critics", [1, 2])
def test_td_alone_is_td3loss_bit_for_bit(problem, critics):
    loss, batch = make_loss(problem, critics, weights=(1.0, 0.0, 0.0)), make_batch(problem)
    td3 = td3_twin(loss)
    torch.manual_seed(11)
    ours, parts = loss.critic_loss(batch)
    torch.manual_seed(11)
    theirs, _ = td3.value_loss(batch["replay"])
    assert torch.equal(ours, theirs)
    assert torch.equal(parts["td_loss"], theirs)
    for mine, other in zip(
        gradients(ours, loss.qvalue_network_params), gradients(theirs, td3.qvalue_network_params), strict=True
    ):
        assert other.norm() > 0
        assert torch.equal(mine, other)


@some_problems
def test_actor_by_q_is_td3loss_bit_for_bit(problem):
    loss, batch = make_loss(problem, rule=Q()), make_batch(problem)
    td3 = td3_twin(loss)
    ours, theirs = loss.actor_loss(batch)[0], td3.actor_loss(batch["replay"])[0]
    assert torch.equal(ours, theirs)
    for mine, other in zip(
        gradients(ours, loss.actor_network_params), gradients(theirs, td3.actor_network_params), strict=True
    ):
        assert other.norm() > 0
        assert torch.equal(mine, other)


@some_problems
def test_forward_returns_both_losses_and_their_parts(problem):
    loss, batch = make_loss(problem, weights=(0.5, 0.25, 2.0)), make_batch(problem)
    torch.manual_seed(11)
    out = loss(batch)
    assert set(out.keys()) == {"loss_actor", "loss_qvalue", "td_loss", "hjb_loss", "boundary_loss"}
    expected = 0.5 * out["td_loss"] + 0.25 * out["hjb_loss"] + 2 * out["boundary_loss"]
    torch.testing.assert_close(out["loss_qvalue"], expected)
    assert torch.equal(out["loss_actor"], loss.actor_loss(batch)[0])


@pytest.mark.usefixtures("float64")
@some_problems
def test_one_critic_without_smoothing_is_ddpg(problem):
    loss, replay = make_loss(problem, 1, (1.0, 0.0, 0.0), policy_noise=0.0), make_batch(problem)["replay"]
    actor, (critic,) = target_networks(problem, 1)
    following = replay["next"]
    value = critic(following["tau"], following["state"], actor(following["tau"], following["state"]))
    target = following["reward"] + torch.where(following["terminated"], 0.0, value)
    _, (critic,) = networks(problem, 1)
    by_hand = (critic(replay["tau"], replay["state"], replay["action"]) - target.detach()).square().mean()
    ours, _ = loss.critic_loss(make_batch(problem).select("replay"))
    assert_close([ours], [by_hand])
    assert_close(gradients(ours, loss.qvalue_network_params), [grad[None] for grad in gradients(by_hand, critic)])


# Weights (0, 1, 0) and (0, 0, 1)


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("hjb_noise", [0.0, 0.4])
@pytest.mark.parametrize("problem", PROBLEMS, ids=name)
def test_hjb_alone_by_hand(problem, hjb_noise):
    batch = make_batch(problem)
    loss = make_loss(problem, weights=(0.0, 1.0, 0.0), hjb_noise=hjb_noise, hjb_noise_clip=0.5, policy_noise=0.0)
    inside, (actor, _) = batch["collocation"], target_networks(problem)
    action = actor(inside["tau"], inside["state"]).detach()
    torch.manual_seed(11)
    action = (action + (hjb_noise * torch.randn_like(action)).clamp(-0.5, 0.5)).clamp(-1, 1)[inside["mask"]]
    kept = inside[inside["mask"]]
    _, critics = networks(problem)
    by_hand = torch.zeros(())
    for critic in critics:
        residual = nested_generator(
            lambda tau, x, critic=critic: critic(tau[:, None], x, action)[:, 0],
            problem,
            kept["tau"][:, 0],
            kept["state"],
            problem.controls.denormalize(action),
        )
        by_hand = by_hand + residual.square().mean()
    torch.manual_seed(11)
    ours, _ = loss.critic_loss(batch)
    assert_close([ours], [by_hand])
    assert_same_gradients(ours, loss, by_hand, critics)


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("problem", PROBLEMS, ids=name)
def test_boundary_alone_by_hand(problem):
    loss, batch = make_loss(problem, weights=(0.0, 0.0, 1.0)), make_batch(problem)
    edge, (actor, _) = batch["boundary"], target_networks(problem)
    action = actor(edge["tau"], edge["state"]).detach()
    _, critics = networks(problem)
    by_hand = sum(
        (edge["weight"] * (critic(edge["tau"], edge["state"], action)[:, 0] - edge["value"]).square()).mean()
        for critic in critics
    )
    ours, _ = loss.critic_loss(batch)
    assert_close([ours], [by_hand])
    assert_same_gradients(ours, loss, by_hand, critics)


def assert_same_gradients(ours, loss, by_hand, critics):
    theirs = [gradients(by_hand, critic) for critic in critics]
    stacked = [torch.stack(pair) for pair in zip(*theirs, strict=True)]
    assert_close(gradients(ours, loss.qvalue_network_params), stacked)


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("shift", [0.5, torch.nan])
def test_masked_points_do_not_count(shift):
    problem = FullNoise(3, 1, 2)
    loss, batch = make_loss(problem, weights=(0.0, 1.0, 0.0), rule=Hamiltonian(problem)), make_batch(problem)
    other = copy.deepcopy(batch)
    other["collocation", "state"][~batch["collocation", "mask"]] += shift
    assert not torch.equal(other["collocation", "state"], batch["collocation", "state"])
    for term in (loss.critic_loss, loss.actor_loss):
        assert_close([term(other)[0]], [term(batch)[0]])
    batch["collocation", "mask"].zero_()
    ours, _ = loss.critic_loss(batch)
    assert ours == 0
    assert all((grad == 0).all() for grad in gradients(ours, loss.qvalue_network_params))


@pytest.mark.usefixtures("float64")
def test_residuals_beyond_delta_count_linearly():
    """2 delta (|r| - delta/2) there, r^2 below."""
    problem = FullNoise(3, 1, 2)
    batch = make_batch(problem)
    points = batch["collocation"][batch["collocation"]["mask"]]
    loss = make_loss(problem, weights=(0.0, 1.0, 0.0))
    actor, _ = target_networks(problem)
    action = actor(points["tau"], points["state"])
    u = problem.controls.denormalize(action)
    size = generator(loss.solution().critic.at(action), problem, points["tau"][:, 0], points["state"], u).abs()
    delta = size.median().item()
    expected = torch.where(size <= delta, size**2, 2 * delta * (size - delta / 2)).sum(0).mean()
    bounded = make_loss(problem, weights=(0.0, 1.0, 0.0), hjb_delta=delta)
    assert_close([bounded.critic_loss(batch)[0]], [expected])


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("probes", [0, 2])
def test_a_residual_is_counted_in_changes_of_v_within_its_time(probes):
    """Within t seconds V changes by t times the residual, which counts linearly beyond delta."""
    problem = FullNoise(3, 1, 2)
    batch, alone = make_batch(problem), {"weights": (0.0, 1.0, 0.0), "hjb_probes": probes}

    def value(**kwargs):
        torch.manual_seed(0)
        return make_loss(problem, **alone, **kwargs).critic_loss(batch)[0]

    assert_close([value(hjb_time=3.0)], [9 * value()])
    assert_close([value(hjb_time=3.0, hjb_delta=0.6)], [9 * value(hjb_delta=0.2)])


@pytest.mark.parametrize("time", [0.0, -1.0, float("inf"), float("nan")])
def test_a_time_that_is_not_positive_is_refused(time):
    with pytest.raises(ArgumentError, match=r"loss\.hjb_time: expected a finite number > 0"):
        make_loss(Reach1D(), hjb_time=time)


@pytest.mark.usefixtures("float64")
def test_errors_on_the_boundary_beyond_delta_count_linearly():
    problem = FullNoise(3, 1, 2)
    batch = make_batch(problem)
    edge, (actor, _) = batch["boundary"], target_networks(problem)
    action, (_, critics) = actor(edge["tau"], edge["state"]), networks(problem)
    values = torch.stack([critic(edge["tau"], edge["state"], action)[:, 0] for critic in critics])
    size = (values - edge["value"]).abs()
    delta = size.median().item()
    errors = torch.where(size <= delta, size**2, 2 * delta * (size - delta / 2)).sum(0)
    expected = (edge["weight"] * errors).mean()
    bounded = make_loss(problem, weights=(0.0, 0.0, 1.0), boundary_delta=delta)
    assert_close([bounded.critic_loss(batch)[0]], [expected])


# Critics


@some_problems
def test_a_critic_of_v_ignores_the_action(problem):
    tau, x, action, _ = points(problem, 20)
    v, q = (Critic(problem, (9, 7), action_input=action_input) for action_input in (False, True))
    assert torch.equal(v(tau[:, None], x, action), v(tau[:, None], x, -action))
    assert not torch.equal(q(tau[:, None], x, action), q(tau[:, None], x, -action))


def test_a_sigmoid_keeps_probabilities_and_a_linear_output_does_not():
    problem = Reach1D()
    tau, x, action, _ = points(problem, 200)
    linear, sigmoid = (Critic(problem, (9, 7), output=output) for output in (None, "Sigmoid"))
    nn.init.normal_(linear.layers[-1].weight, std=2.0)
    sigmoid.load_state_dict(linear.state_dict())
    value = linear(tau[:, None], x, action)
    assert value.min() < 0
    assert value.max() > 1
    assert torch.equal(sigmoid(tau[:, None], x, action), torch.sigmoid(value))


@pytest.mark.parametrize("rule", [Q(), Sum([Hamiltonian(Reach1D()), Q()])], ids=["q", "sum"])
def test_critics_of_v_refuse_an_actor_that_ascends_q(rule):
    problem = Reach1D()
    nets = [Critic(problem, (4,), action_input=action_input) for action_input in (True, False)]
    with pytest.raises(ValueError, match=r"expected critic\.action_input=true, got false"):
        PIRLLoss(problem, Actor(problem), nets, rule)
    PIRLLoss(problem, Actor(problem), nets[1:], Hamiltonian(problem))


# The actor's rules


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("problem", PROBLEMS, ids=name)
def test_hamiltonian_by_hand(problem):
    loss, batch = make_loss(problem, rule=Hamiltonian(problem)), make_batch(problem)
    kept = batch["collocation"][batch["collocation"]["mask"]]
    actor, critics = networks(problem)
    action = actor(kept["tau"], kept["state"])
    x, frozen = kept["state"].clone().requires_grad_(), action.detach()
    value = sum(critic(kept["tau"], x, frozen)[:, 0] for critic in critics) / len(critics)
    (slope,) = torch.autograd.grad(value.sum(), x, create_graph=True)
    hessian = torch.stack([torch.autograd.grad(entry.sum(), x, retain_graph=True)[0] for entry in slope.unbind(-1)], -1)
    u = problem.controls.denormalize(action)
    sigma = problem.diffusion(kept["state"], u)
    trace = (sigma @ sigma.mT * hessian.detach()).sum((-2, -1))
    by_hand = -((problem.drift(kept["state"], u) * slope.detach()).sum(-1) + trace / 2).mean()
    ours, _ = loss.actor_loss(batch)
    assert_close(gradients(ours, loss.actor_network_params), gradients(by_hand, actor))
    assert all((grad == 0).all() for grad in gradients(loss.actor_loss(batch)[0], loss.qvalue_network_params))


@pytest.mark.usefixtures("float64")
def test_sum_adds_the_objectives():
    problem = FullNoise(3, 2, 2)
    batch = make_batch(problem)
    q, hamiltonian, both = (
        gradients(loss.actor_loss(batch)[0], loss.actor_network_params)
        for loss in (make_loss(problem, rule=rule) for rule in (Q(), Hamiltonian(problem), None))
    )
    assert_close(both, [a + b for a, b in zip(q, hamiltonian, strict=True)])


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("problem", [Reach1D(), VehicleDrift()], ids=name)
@pytest.mark.parametrize("steps", [1, 3])
def test_look_ahead_by_hand(problem, steps):
    """Each state alone: Euler steps under the actor until the path meets a set or time is up, then the mean of the
    critics there, 1 in the target."""
    simulator = Simulator(problem, problem.horizon / 10, 4, "endpoint")
    loss = make_loss(problem, rule=LookAhead(steps, simulator))
    batch, dt = make_batch(problem), simulator.dt
    replay = batch["replay"]
    replay["tau"] = dt * torch.arange(len(replay), dtype=torch.float64).remainder(10).unsqueeze(-1)
    actor, critics = networks(problem)
    loss.actor_network_params.data.copy_(TensorDict.from_module(TensorDictModule(actor, ["tau"], ["action"])).data)
    total, ended = 0.0, set()
    for tau, x in zip(replay["tau"], replay["state"], strict=True):
        for _ in range(steps):
            if tau < dt / 2 or not problem.interior(x):
                ended.add("time" if tau < dt / 2 else "set")
                break
            u = problem.controls.denormalize(actor(tau.unsqueeze(0), x.unsqueeze(0)))[0]
            for _ in range(4):
                x = x + problem.drift(x, u) * dt / 4
            tau = tau - dt
        inputs = tau.unsqueeze(0), x.unsqueeze(0), actor(tau.unsqueeze(0), x.unsqueeze(0)).detach()
        values = [critic(*inputs).squeeze() for critic in critics]
        total = total + (torch.ones(()) if problem.reached(x) else sum(values) / 2)
    expected = -total / len(replay)
    ours = loss.actor_loss(batch)[0]
    assert "set" in ended or problem.states.dim == 1
    assert "time" in ended
    assert_close([ours], [expected])
    assert_close(gradients(ours, loss.actor_network_params), torch.autograd.grad(expected, list(actor.parameters())))
    assert_no_gradient_for_critics(loss, batch)


@pytest.mark.usefixtures("float64")
def test_clipped_surrogate_by_hand():
    """min(rho A, clip(rho) A) row by row with torch's own Gaussian; rows on both sides of both clips."""
    problem = FullNoise(3, 2, 2)
    loss, batch = surrogate_loss(problem), make_batch(problem, 200)
    replay = batch["replay"]
    following = replay["next"]
    torch.manual_seed(5)
    replay["loc"] = (loss.solution().actor(replay["tau"], replay["state"]) + 0.3 * torch.randn(len(replay), 2)).detach()
    replay["action"] = replay["loc"] + 0.4 * torch.randn(len(replay), 2)
    actor, critics = v_networks(problem)
    value = [sum(net(td["tau"], td["state"], td["state"]) for net in critics) / 2 for td in (replay, following)]
    advantage = (following["reward"] + torch.where(following["terminated"], 0.0, value[1]) - value[0]).detach()
    advantage = (advantage / advantage.std()).squeeze(-1)
    centers = actor(replay["tau"], replay["state"]), replay["loc"]
    new, old = (torch.distributions.Normal(center, 0.4).log_prob(replay["action"]).sum(-1) for center in centers)
    rows, kinds = [], set()
    for ratio, a in zip((new - old).exp(), advantage, strict=True):
        clipped = min(max(ratio, torch.tensor(0.7)), torch.tensor(1.3))
        rows.append(min(ratio * a, clipped * a))
        kinds.add((bool(a > 0), 0 if clipped == ratio else 1 if ratio > 1 else -1))
    assert len(kinds) == 6
    expected = -torch.stack(rows).mean()
    ours = loss.actor_loss(batch)[0]
    assert_close([ours], [expected])
    assert_close(gradients(ours, loss.actor_network_params), torch.autograd.grad(expected, list(actor.parameters())))
    assert_no_gradient_for_critics(loss, batch)


@pytest.mark.usefixtures("float64")
def test_clipped_surrogate_climbs_the_slope_of_the_return():
    """Where the played policy is the actor itself, the gradient is that of E[A] in its output: a reward b . a of one
    step gives b divided by A's deviation, |b| sigma. Four standard errors of 200,000 draws are 0.9 %."""
    problem = FullNoise(3, 2, 2)
    loss, sigma, count = surrogate_loss(problem), 0.4, 200_000
    torch.manual_seed(6)
    tau, x = torch.full((count, 1), 0.5), problem.states.sample(1).double().expand(count, -1)
    loc = loss.solution().actor(tau, x).detach()
    played, slope = loc + sigma * torch.randn(count, 2), torch.tensor([0.6, -0.8])
    ended = torch.ones(count, 1, dtype=torch.bool)
    following = {"tau": tau, "state": x, "reward": (played @ slope).unsqueeze(-1), "terminated": ended}
    batch = {"replay": {"tau": tau, "state": x, "loc": loc, "action": played, "next": following}}
    ours = gradients(loss.actor_loss(TensorDict(batch))[0], loss.actor_network_params)
    actor, _ = v_networks(problem)
    along = -(actor(tau[:1], x[:1]) @ (slope / sigma)).sum()
    by_hand = torch.autograd.grad(along, list(actor.parameters()))
    error = sum((a - b).square().sum() for a, b in zip(ours, by_hand, strict=True)).sqrt()
    assert error <= 0.009 * sum(b.square().sum() for b in by_hand).sqrt()


def surrogate_loss(problem) -> PIRLLoss:
    return PIRLLoss(problem, *v_networks(problem), ClippedSurrogate(deviation=0.4, clip=0.3))


def test_clipped_surrogate_without_returns_is_refused():
    problem = Reach1D()
    with pytest.raises(ValueError, match="expected a weight of the TD loss above 0"):
        surrogate_loss(problem).actor_loss(TensorDict({"replay": make_batch(problem)["replay"].exclude("next")}))


def assert_no_gradient_for_critics(loss, batch):
    loss.zero_grad()
    loss.actor_loss(batch)[0].backward()
    assert all(entry.grad is None for entry in loss.qvalue_network_params.parameters())


@pytest.mark.usefixtures("float64")
def test_look_ahead_follows_the_hamiltonian_as_the_step_shrinks():
    """(V(x_dt) - V(x)) / dt has the gradient of f . grad V in the actor's parameters, to first order in dt."""
    problem, batch = FullNoise(3, 2, 2), make_batch(FullNoise(3, 2, 2), 8)
    batch["replay", "tau"] = torch.full_like(batch["replay", "tau"], 1.0)
    kept = batch["replay"][problem.interior(batch["replay", "state"])]

    def slope(dt):
        simulator = Simulator(problem, dt, 1, "endpoint")
        # Critics of V: Q's own dependence on it is no part of either.
        loss = PIRLLoss(problem, *v_networks(problem), LookAhead(1, simulator))
        value = loss.actor_loss(TensorDict({"replay": kept}))[0]
        return torch.cat([entry.flatten() / dt for entry in gradients(value, loss.actor_network_params)])

    first_order = Hamiltonian(problem)
    first_order.operator = advection
    loss = PIRLLoss(problem, *v_networks(problem), first_order)
    limit = loss.actor_loss(TensorDict({"replay": kept}))[0]
    exact = torch.cat([entry.flatten() for entry in gradients(limit, loss.actor_network_params)])
    errors = [((slope(dt) - exact).norm() / exact.norm()).item() for dt in (1e-2, 1e-3)]
    assert errors[0] < 0.1
    assert errors[1] == pytest.approx(errors[0] / 10, rel=0.2)


def v_networks(problem):
    torch.manual_seed(3)
    return Actor(problem, (8, 8), "Tanh"), [Critic(problem, (9, 7), action_input=False) for _ in range(2)]


@pytest.mark.usefixtures("float64")
@some_problems
def test_logit_penalty_by_hand(problem):
    plain, batch = make_loss(problem, rule=Q()), make_batch(problem)
    ours = make_loss(problem, rule=Q(), logit_penalty=0.3)
    action = plain.solution().actor(batch["replay", "tau"], batch["replay", "state"])
    expected = plain.actor_loss(batch)[0] + 0.3 * action.atanh().square().mean()
    assert_close([ours.actor_loss(batch)[0]], [expected])


@pytest.mark.usefixtures("float64")
@some_problems
def test_cross_entropy_and_mean_target_by_hand(problem):
    torch.manual_seed(3)
    nets = [Critic(problem, (9, 7), action_input=True, output="Sigmoid") for _ in range(2)]
    kwargs = {"policy_noise": 0.0, "td_criterion": "cross_entropy", "target_critics": "mean"}
    loss, batch = PIRLLoss(problem, Actor(problem, (8,), "Tanh"), nets, Q(), **kwargs), make_batch(problem)
    replay = batch["replay"]
    following = replay["next"]
    action = loss.solution().actor(following["tau"], following["state"])
    values = [net(following["tau"], following["state"], action) for net in nets]
    # Payoffs and their mean stay probabilities: one of the two ends a path.
    following["reward"] = following["reward"] * following["terminated"]
    target = (following["reward"] + ~following["terminated"] * (values[0] + values[1]) / 2).detach()
    expected = 0.0
    for net in nets:
        p = net(replay["tau"], replay["state"], replay["action"])
        expected = expected - (target * p.log() + (1 - target) * (1 - p).log()).mean()
    assert_close([loss.critic_loss(batch)[1]["td_loss"]], [expected.detach()])


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"td_criterion": "absolute"}, "td_criterion: expected one of squares, cross_entropy, got 'absolute'"),
        ({"td_criterion": "cross_entropy"}, "needs critics with output 'Sigmoid'"),
        ({"target_critics": "max"}, "target_critics: expected 'min' or 'mean', got 'max'"),
        ({"rule": ClippedSurrogate(0.2)}, "actor_rule: ClippedSurrogate takes advantages over V"),
    ],
)
def test_wrong_arguments_are_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_loss(Reach1D(), **kwargs)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ClippedSurrogate(0.0), r"actor_rule.deviation: expected a standard deviation > 0, got 0\.0"),
        (lambda: ClippedSurrogate(0.2, clip=0.0), r"actor_rule.clip: expected a number > 0, got 0\.0"),
        (lambda: LookAhead(0, Simulator(Reach1D())), "actor_rule.steps: expected at least 1, got 0"),
        (lambda: Sum([]), "actor_rule.rules: expected at least one rule, got none"),
    ],
)
def test_wrong_arguments_of_a_rule_are_named(make, message):
    with pytest.raises(ArgumentError, match=message):
        make()


def test_clipped_surrogate_needs_the_noise_that_is_played():
    critic = v_networks(Reach1D())[1][0]
    ClippedSurrogate(0.2).check(critic, exploration_noise=0.2)
    with pytest.raises(ArgumentError, match=r"exploration_noise = 0\.1, got 0\.2"):
        ClippedSurrogate(0.2).check(critic, exploration_noise=0.1)


def test_a_relu_critic_is_refused_by_name():
    problem = Reach1D()
    with pytest.raises(ArgumentError, match="got ReLU"):
        PIRLLoss(problem, Actor(problem), [Critic(problem, (4,), "ReLU")], Hamiltonian(problem))


# Weights


def test_weights_move_in_place_and_are_saved():
    problem = Reach1D()
    loss, batch = make_loss(problem, weights=(0.0, 1.0, 0.0)), make_batch(problem)
    buffer, before = loss.hjb_weight, loss.critic_loss(batch)[0]
    loss.hjb_weight = 0.25
    assert loss.hjb_weight is buffer
    torch.testing.assert_close(loss.critic_loss(batch)[0], before / 4)
    other = make_loss(problem, weights=(1.0, 0.0, 0.0))
    other.load_state_dict(loss.state_dict())
    assert [getattr(other, key).item() for key in WEIGHTS] == [0.0, 0.25, 0.0]


@pytest.mark.slow
@pytest.mark.skipif(not (shutil.which("g++") or shutil.which("clang++")), reason="torch.compile needs a C++ compiler")
@pytest.mark.usefixtures("float64")
def test_compiled_equals_eager_and_follows_the_weights():
    """Without smoothing noise, whose stream differs under the compiler."""
    problem = FullNoise(3, 1, 2)
    loss, batch = make_loss(problem, policy_noise=0.0), make_batch(problem)
    compiled = torch.compile(loss.critic_loss, fullgraph=True)
    for weights in ((1.0, 1.0, 1.0), (0.1, 0.7, 2.0)):
        for key, weight in zip(WEIGHTS, weights, strict=True):
            setattr(loss, key, weight)
        eager = loss.critic_loss(batch)[0]
        ours = compiled(batch)[0]
        torch.testing.assert_close(ours, eager, rtol=1e-6, atol=0)
        for mine, other in zip(
            gradients(ours, loss.qvalue_network_params), gradients(eager, loss.qvalue_network_params), strict=True
        ):
            assert (mine - other).norm() <= 1e-6 * other.norm()


@some_problems
def test_targets_move_as_torchrl_s_updater_moves_them(problem):
    """Both updaters start with targets that equal the networks, which are changed before the step."""
    states = []
    for networks in ((), ("actor_network", "qvalue_network")):
        loss = make_loss(problem)
        updates = [FusedSoftUpdate(loss, network, tau=0.3) for network in networks] or [SoftUpdate(loss, tau=0.3)]
        for params in (loss.actor_network_params, loss.qvalue_network_params):
            for key, entry in params.data.items(True, True):
                _move(key, entry)
        for update in updates:
            update.step()
        states.append(loss.state_dict())
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(entry, states[1][key]) for key, entry in states[0].items())
    moved = states[1]
    targets = [key for key in moved if key.startswith("target_") and key.endswith("weight")]
    assert targets
    assert not any(torch.equal(moved[key], moved[key.removeprefix("target_")]) for key in targets)
