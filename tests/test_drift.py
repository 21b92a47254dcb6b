"""The drifting problems: golden rows of the physics, equilibria, published figures, faces and planes."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from pirl_rl.payoffs import LipschitzPayoff
from pirl_rl.problems import VehicleDrift, VehicleDrift3
from pirl_rl.problems.drift import equilibria, vehicle
from pirl_rl.problems.drift.env import DriftEnv
from pirl_rl.simulator import Simulator

GOLDEN = np.load(Path(__file__).parent / "data" / "drift_golden.npz")
DEGREE = math.pi / 180
PROBLEM = VehicleDrift()


def golden(key: str) -> Tensor:
    return torch.from_numpy(GOLDEN[key])


def assert_columns_agree(ours: Tensor, theirs: Tensor, tolerance: float):
    """Relative error, with the tolerance times each column's largest entry as its floor."""
    floor = theirs.abs().amax(0)
    assert ((ours - theirs).abs() <= tolerance * torch.maximum(theirs.abs(), floor)).all()


# Tyres


def test_tyre_curves():
    slip, friction, push = golden("slip"), golden("friction")[:, None], golden("drive")[:, None]
    front = vehicle.fiala(slip.tan(), slip.sign(), vehicle.FRONT_STIFFNESS, friction * vehicle.FRONT_LOAD)
    torch.testing.assert_close(front, golden("front"), rtol=1e-9, atol=1e-9)
    rears = []
    for mu in friction:
        drive = vehicle.drive_force(push, mu)
        sliding = ((mu * vehicle.REAR_LOAD) ** 2 - drive**2).sqrt()
        rears.append(vehicle.fiala(slip.tan(), slip.sign(), vehicle.REAR_STIFFNESS, sliding))
    # The root of a difference: with 0.1% of the friction circle left, rounding is magnified 500 times.
    torch.testing.assert_close(torch.stack(rears), golden("rear"), rtol=1e-9, atol=1e-9)


def test_axle_forces_are_those_of_the_slip_angles():
    """Against atan2 and the polynomial, as the formulas are published; slips beyond 90 degrees included."""
    rng = torch.Generator().manual_seed(0)
    v_x, v_y, r, delta, friction = (
        low + (high - low) * torch.rand(2_000, generator=rng, dtype=torch.float64)
        for low, high in ((0.1, 15.0), (-15.0, 15.0), (-3.0, 3.0), (-1.2, 1.2), (0.3, 1.0))
    )
    drive = 5_000 * friction

    def polynomial(alpha: Tensor, stiffness: float, sliding: Tensor) -> Tensor:
        z = alpha.tan()
        inner = stiffness * z - stiffness**2 * z.abs() * z / (3 * sliding) + stiffness**3 * z**3 / (27 * sliding**2)
        return torch.where(z.abs() < 3 * sliding / stiffness, inner, sliding * alpha.sign())

    alpha_f = delta - torch.atan2(v_y + vehicle.FRONT_ARM * r, v_x)
    alpha_r = -torch.atan2(v_y - vehicle.REAR_ARM * r, v_x)
    assert (alpha_f.abs() > math.pi / 2).sum() > 50
    front = polynomial(alpha_f, vehicle.FRONT_STIFFNESS, friction * vehicle.FRONT_LOAD)
    rear = polynomial(alpha_r, vehicle.REAR_STIFFNESS, ((friction * vehicle.REAR_LOAD) ** 2 - drive**2).sqrt())
    # 1e-9 of forces up to 8 kN; the polynomial cancels near its end, and so do angles in a tangent near 90 degrees.
    ours = vehicle.front_force(v_x, v_y, r, delta.tan(), friction), vehicle.rear_force(v_x, v_y, r, friction, drive)
    torch.testing.assert_close(ours[0], front, rtol=1e-9, atol=1e-6)
    torch.testing.assert_close(ours[1], rear, rtol=1e-9, atol=1e-6)


# The seven-state car


def test_drift_and_diffusion():
    x, u = golden("state"), golden("control")
    assert_columns_agree(PROBLEM.drift(x, u), golden("drift"), 1e-9)
    # The table holds sigma in float32.
    sigma = golden("sigma").diag()[:, :6].expand(len(x), 7, 6)
    torch.testing.assert_close(PROBLEM.diffusion(x, u), sigma, rtol=1e-7, atol=0)


def test_one_step_without_noise():
    class Quiet(VehicleDrift):
        noise = (0.0,) * 6

    x, u, moved = golden("state"), golden("control"), golden("next")
    step = Simulator(Quiet(), 0.1, 1, "endpoint").step(x, u)
    known = (x[:, 6] >= 0.25) & (x[:, 6] <= 1.05)  # the table clips friction, the problem fails there
    assert known.sum() > 240
    assert_columns_agree(step.state[known], moved[known], 1e-12)
    assert step.failed[~known].all()


def test_single_precision_is_as_good_as_it_can_be():
    """1e-5 of a column's scale: rounding is magnified up to 500 times by the root of what drive leaves of friction, and
    the force it leaves is then small."""
    x, u = golden("state"), golden("control")
    ours = PROBLEM.drift(x.float(), u.float())
    assert ours.dtype == torch.float32
    assert_columns_agree(ours.double(), PROBLEM.drift(x.float().double(), u.float().double()), 1e-5)
    inside = VehicleDrift3.states.sample(1_000, torch.Generator().manual_seed(0))
    control = VehicleDrift3.controls.sample(1_000, torch.Generator().manual_seed(1))
    exact = VehicleDrift3().drift(inside.double(), control.double())
    assert_columns_agree(VehicleDrift3().drift(inside, control).double(), exact, 1e-5)


def test_membership():
    """Every label but of rows within 1e-3 of a face, where another interpolation of the equilibria may decide."""
    x = golden("member")
    for ours, theirs, margin in (
        (PROBLEM.reached(x), golden("is_target"), golden("target_margin")),
        (PROBLEM.failed(x), golden("is_unsafe"), golden("unsafe_margin")),
    ):
        clear = margin.abs() > 1e-3
        assert (theirs[clear & (margin.abs() < 1e-2)]).sum() > 40
        assert torch.equal(ours[clear], theirs[clear])


@pytest.mark.parametrize("kind", [VehicleDrift, VehicleDrift3])
def test_smoothed_levels_of_a_fresh_problem(kind):
    """The first call lies inside a transform of torch.func, where no equilibrium could be solved."""
    hard, smooth = kind(), kind(payoff=LipschitzPayoff(0.01))
    plane = hard.planes["beta_r"]
    x = plane.embed(plane.box.sample(2_000, torch.Generator().manual_seed(0), torch.float64))
    inner = smooth.reached(x)
    assert hard.reached(x)[inner].all()
    assert 0 < inner.sum() < hard.reached(x).sum()


def test_equilibria():
    """State and control at eleven frictions, the band's ends among them, all in the target; and the curves, which err
    by 1e-6 at most between knots."""
    for friction, _, e_psi, v_x, v_y, beta, r, delta, force in GOLDEN["equilibria"]:
        x, u = equilibria.equilibrium(friction)
        np.testing.assert_allclose(x, [0, e_psi, v_x, v_y, r, delta, friction], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(u, [0, force], rtol=1e-6)
        assert PROBLEM.reached(torch.from_numpy(x))
        curves = PROBLEM.equilibrium_curves(torch.tensor(friction, dtype=torch.float64))
        np.testing.assert_allclose(curves, [beta, r, delta], rtol=0, atol=1e-6)
    knots = np.linspace(*PROBLEM.friction_band, equilibria.KNOTS)
    # Curvature, and the error with it, falls with friction: the first intervals are the worst.
    between = ((knots[1:] + knots[:-1]) / 2)[[*range(8), *range(8, equilibria.KNOTS - 1, 16)]]
    exact = np.stack([equilibria.equilibrium(friction)[0] for friction in between])
    curves = torch.stack(PROBLEM.equilibrium_curves(torch.from_numpy(between)), -1)
    np.testing.assert_allclose(curves, exact[:, [1, 4, 5]] * [-1, 1, 1], rtol=0, atol=1e-6)


def test_the_equilibrium_is_open_loop_unstable():
    """Known eigenvalues +2.84 and +0.115 1/s at friction 0.55; the path adds the pair +-i r, held inputs two zeros."""
    x, u = (torch.from_numpy(entry) for entry in equilibria.equilibrium(0.55))
    jacobian = torch.autograd.functional.jacobian(lambda state: PROBLEM.drift(state, u), x)
    eigenvalues = sorted(torch.linalg.eigvals(jacobian).tolist(), key=lambda value: -value.real)
    assert eigenvalues[0].real == pytest.approx(2.84, abs=0.005)
    assert eigenvalues[1].real == pytest.approx(0.115, abs=0.0005)
    assert max(abs(value.real) for value in eigenvalues[2:6]) < 1e-9
    assert eigenvalues[6].real < 0


def test_unreachable_is_friction_outside_the_band():
    x = golden("member")
    outside = (x[:, 6] < 0.5) | (x[:, 6] > 0.6)
    assert torch.equal(PROBLEM.unreachable(x), outside)
    assert 50 < outside.sum() < len(x) - 50
    assert not PROBLEM.reached(x)[outside].any()
    u = PROBLEM.controls.sample(len(x), torch.Generator().manual_seed(0), torch.float64)
    assert (PROBLEM.drift(x, u)[:, 6] == 0).all()
    assert (PROBLEM.diffusion(x, u)[:, 6] == 0).all()


@pytest.mark.parametrize("count", [1, 1001])
def test_faces(count):
    """Points on the faces, and through the face met every vertex control drives inwards: the level falls in time."""
    x, value = PROBLEM.faces(count, torch.Generator().manual_seed(0))
    assert x.shape == (count, 7)
    assert ((value == 0) | (value == 1)).all()
    assert value.sum() == count // 2
    assert not PROBLEM.unreachable(x).any()
    for levels, own, pick in (
        (PROBLEM.target_constraints, x[value == 1], torch.argmax),
        (PROBLEM.avoid_constraints, x[value == 0], torch.argmin),
    ):
        for delta_rate in (-1.5, 1.5):
            for force in (1000.0, 5000.0):
                rates = PROBLEM.drift(own, own.new_tensor([delta_rate, force]).expand(len(own), 2))
                level, slope = levels(own), torch.func.jvp(levels, (own,), (rates,))[1]
                met = pick(level, -1, keepdim=True)
                assert (level.gather(-1, met).abs() <= 1e-12).all()
                assert (slope.gather(-1, met) < 0).all()
        if count > 1:  # e_y, e_psi, v_x, beta and r of the target; e_y, e_psi, v_x, r and beta of the avoid set
            assert len(met.unique()) == 5


@pytest.mark.parametrize("problem", [VehicleDrift(), VehicleDrift3()], ids=lambda problem: type(problem).__name__)
def test_planes(problem):
    """Project undoes embed; embed of the equilibrium's coordinates is the equilibrium, in the target."""
    center = equilibria.equilibrium(0.55)[0] if isinstance(problem, VehicleDrift) else problem.equilibrium[0]
    center = torch.from_numpy(center)
    for plane in problem.planes.values():
        points = plane.box.sample(100, torch.Generator().manual_seed(0), torch.float64)
        x = plane.embed(points)
        assert x.shape == (100, problem.states.dim)
        torch.testing.assert_close(plane.project(x), points, rtol=0, atol=1e-12)
        # Up to what the curves between knots leave.
        torch.testing.assert_close(plane.embed(plane.project(center)), center, rtol=0, atol=1e-6)
        assert problem.reached(plane.embed(plane.project(center)))
        assert plane.embed(points.float()).dtype == torch.float32


# The three-state car


def test_published_equilibrium():
    """All digits of Hindiyeh and Gerdes: v_x = 8 m/s, delta = -12 degrees, friction 0.55."""
    (beta, r, v_x), (delta, force) = VehicleDrift3(friction=0.55).equilibrium
    assert (v_x, delta) == (8.0, -12 * DEGREE)
    assert beta / DEGREE == pytest.approx(-20.44, abs=0.005)
    assert r == pytest.approx(0.600, abs=0.0005)
    assert force == pytest.approx(2293, abs=0.5)
    v_x, v_y, yaw, tan_delta, friction, drive = torch.tensor(
        [v_x, v_x * math.tan(beta), r, math.tan(delta), 0.55, force], dtype=torch.float64
    )
    assert vehicle.front_force(v_x, v_y, yaw, tan_delta, friction).item() == pytest.approx(3807, abs=0.5)
    assert vehicle.rear_force(v_x, v_y, yaw, friction, drive).item() == pytest.approx(4469, abs=0.5)


def test_three_states_are_the_seven_where_the_wheels_point_ahead():
    """With delta = 0 the missing cosine is 1: same r', v_x', and beta' = d/dt atan2(v_y, v_x), at any friction."""
    for friction in (0.4, 0.55, 0.9):
        problem, rng = VehicleDrift3(friction=friction), torch.Generator().manual_seed(0)
        x = problem.states.sample(500, rng, torch.float64)
        u = problem.controls.sample(500, rng, torch.float64)
        u[:, 0] = 0
        beta, r, v_x = x.unbind(-1)
        zero, v_y = torch.zeros_like(r), v_x * beta.tan()
        whole = torch.stack([zero, zero, v_x, v_y, r, zero, torch.full_like(r, friction)], -1)
        _, _, along, across, turn, _, _ = PROBLEM.drift(whole, u).unbind(-1)
        slip = torch.func.jvp(torch.atan2, (v_y, v_x), (across, along))[1]
        torch.testing.assert_close(problem.drift(x, u), torch.stack([slip, turn, along], -1), rtol=1e-9, atol=1e-9)


def test_sets_of_three_states():
    problem = VehicleDrift3()
    beta, r, v_x = problem.equilibrium[0]
    inside = [[beta + 3.9 * DEGREE, r - 0.19, v_x + 0.49], [beta - 3.9 * DEGREE, r + 0.19, v_x - 0.49]]
    beside = [[beta + 4.1 * DEGREE, r, v_x], [beta, r + 0.21, v_x], [beta, r, v_x - 0.51]]
    avoid = [[45.1 * DEGREE, r, v_x], [-45.1 * DEGREE, r, v_x], [beta, 2.51, v_x], [beta, r, 2.99], [beta, r, 25.01]]
    x = torch.tensor([*inside, *beside, *avoid], dtype=torch.float64)
    assert problem.reached(x).tolist() == [True] * 2 + [False] * 8
    assert problem.failed(x).tolist() == [False] * 5 + [True] * 5
    # The target of another friction is around its own equilibrium.
    other = VehicleDrift3(friction=0.8)
    x = torch.from_numpy(other.equilibrium[0])
    assert other.reached(x)
    assert not problem.reached(x)


def test_an_equilibrium_beyond_the_drive_force_is_refused():
    with pytest.raises(ArithmeticError, match=r"no drift equilibrium found at friction 1\.05"):
        VehicleDrift3(friction=1.05)


def test_environment():
    env = DriftEnv(num_envs=8, seed=0, substeps=10)
    assert type(env.problem) is VehicleDrift
    assert env.simulator.substeps == 10
    assert env.rollout(3, break_when_any_done=False)["state"].shape == (8, 3, 7)
