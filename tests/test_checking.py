"""The checker: mistakes that are put into problems of the suite are named, and the suite itself gives no alarm."""

import math
import re

import numpy as np
import pytest
import torch

import pirl_rl
import pirl_rl.errors
from benchmarks.kinds import Orbit
from pirl_rl import Box, Plane, ReachAvoidProblem, payoffs, problems
from pirl_rl.checking import Finding, check, examine, report
from pirl_rl.commands.check import main
from pirl_rl.errors import ProblemError
from pirl_rl.problems import DoubleIntegrator, DubinsCar, HalfSpace, Pendulum, Reach1D, ZermeloBoat
from pirl_rl.sets import band
from pirl_rl.structure import controlled_channels, is_control_affine
from pirl_rl.switching import switching


class WrongShape(ZermeloBoat):
    def drift(self, x, u):
        return super().drift(x, u)[..., 0]


class DoublePrecision(ZermeloBoat):
    def drift(self, x, u):
        return super().drift(x, u).double()


class Numpy(ZermeloBoat):
    def target_level(self, x):
        return np.hypot(x[..., 0].numpy(), x[..., 1].numpy()) - 0.5


class Raises(ZermeloBoat):
    def diffusion(self, x, u):
        return torch.eye(2) @ torch.ones(3)


class ChangesStates(ZermeloBoat):
    def drift(self, x, u):
        x[..., 0] *= 2
        return super().drift(x, u)


class ChangesControls(ZermeloBoat):
    def drift(self, x, u):
        u.clamp_(-0.5, 0.5)
        return super().drift(x, u)


class MixesTheBatch(ZermeloBoat):
    def drift(self, x, u):
        return super().drift(x - x.mean(0), u)


class FirstAxis(DoubleIntegrator):
    def drift(self, x, u):
        return torch.stack([x[:, 1], u[:, 0]], -1)


class Undefined(ZermeloBoat):
    def drift(self, x, u):
        return super().drift(x, u) * x[..., :1].sqrt()


class Infinite(ZermeloBoat):
    def diffusion(self, x, u):
        return super().diffusion(x, u) / x[..., :1, None]


class UndefinedBeyond(Pendulum):
    def drift(self, x, u):
        return super().drift(x, u) + 0 * (self.states.high[1] - x[..., 1:]).sqrt()


class UndefinedLevel(Pendulum):
    def avoid_level(self, x):
        return super().avoid_level(x) + 0 * x[..., 0].log()


class Overlap(Reach1D):
    """The states from 2 to 2.5 lie in both sets."""

    def avoid_level(self, x):
        return (x[..., 0] - 2).abs() - 0.5


class DrownedTarget(Reach1D):
    def avoid_level(self, x):
        return self.target_level(x) - 0.1


class EmptyTarget(ZermeloBoat):
    def target_level(self, x):
        return (x**2).sum(-1) + 1


class FarTarget(ZermeloBoat):
    def target_level(self, x):
        return (x - 100).norm(dim=-1) - 1


class TargetNextToTheBox(Reach1D):
    def target_level(self, x):
        return (x[..., 0] - 1.8 * self.states.high[0]).abs() - 0.1 * self.states.high[0]


class AvoidsEverything(Pendulum):
    def avoid_level(self, x):
        return x[..., 0] - 100


class ReversedTarget(Reach1D):
    def target_level(self, x):
        return -super().target_level(x)

    states = Box([-1.2], [1.2])


class ReversedAvoid(ZermeloBoat):
    def avoid_level(self, x):
        return 0.1 - (x - x.new_tensor([3.0, 0.0])).norm(dim=-1)

    def target_level(self, x):
        return (x - x.new_tensor([3.0, 0.0])).norm(dim=-1) - 0.05


class EitherShoal(ZermeloBoat):
    """A shoal is meant where both levels are at most 0; as constraints, one is enough for the avoid set."""

    def avoid_constraints(self, x):
        return torch.stack([x[..., 0] - 1.0, x[..., 1] + 0.5], -1)


class Indicator(ZermeloBoat):
    def target_level(self, x):
        return torch.where(super().target_level(x) <= 0, -1.0, 1.0).to(x)


class FlatTarget(ZermeloBoat):
    def target_level(self, x):
        return super().target_level(x).clamp(min=0).square()


class FlatWall(ZermeloBoat):
    """One of the constraints of the avoid set is flat."""

    def avoid_constraints(self, x):
        first, *others = super().avoid_constraints(x).unbind(-1)
        return torch.stack([first**3, *others], -1)


class ClampedTarget(ZermeloBoat):
    """A level may be 0 all over the set."""

    def target_level(self, x):
        return super().target_level(x).clamp(min=0)


class NumberAsPayoff(ZermeloBoat):
    payoff = 2


class ClassAsPayoff(ZermeloBoat):
    payoff = payoffs.Indicator


class DetachedLevel(ZermeloBoat):
    def target_level(self, x):
        return super().target_level(x.detach())


class RandomDrift(ZermeloBoat):
    def drift(self, x, u):
        return super().drift(x, u) + 0.1 * torch.randn_like(x)


class KeepsCount(ZermeloBoat):
    count = 0

    def drift(self, x, u):
        self.count += 1
        return super().drift(x, u) * self.count


class NoControl(ZermeloBoat):
    def drift(self, x, u):
        return super().drift(x, torch.zeros_like(u))


class OneIdleControl(HalfSpace):
    def drift(self, x, u):
        return torch.cat([u[..., :1], torch.zeros_like(u[..., 1:])], -1)


class NoNoise(ZermeloBoat):
    def diffusion(self, x, u):
        return 0 * super().diffusion(x, u)


class NoiseOfAStep(ZermeloBoat):
    dt = 0.01

    def diffusion(self, x, u):
        return super().diffusion(x, u) * math.sqrt(self.dt)


class MoveOfAStep(ZermeloBoat):
    def drift(self, x, u):
        delta_t = 0.01
        return super().drift(x, u) * delta_t


class Milliseconds(DoubleIntegrator):
    horizon = 1e-9


class UndeclaredAngle(DubinsCar):
    states = Box(DubinsCar.states.low, DubinsCar.states.high)


class AngleOfOneTurn(UndeclaredAngle):
    """Its target asks for a heading of the box, and does not know that of the next turn."""

    def target_level(self, x):
        return torch.maximum(super().target_level(x), band(x[..., 2], 0.0, 1.0))


class NoPeriod(DubinsCar):
    def drift(self, x, u):
        return super().drift(x, u) + x[..., 2:]


class Stiff(DoubleIntegrator):
    def drift(self, x, u):
        return torch.stack([x[..., 1], u[..., 0] - 1e6 * x[..., 1] ** 3], -1)


class Endless(ZermeloBoat):
    horizon = math.inf


class NoHorizon(ZermeloBoat):
    horizon = None


class ListOfControls(ZermeloBoat):
    controls = ([-1.0, -1.0], [1.0, 1.0])


class PeriodicControl(ZermeloBoat):
    controls = Box(ZermeloBoat.controls.low, ZermeloBoat.controls.high, periodic=[0])


class UnknownObjective(ZermeloBoat):
    objective = "reach"


class WrongAnswer(Reach1D):
    def exact_value(self, tau, x):
        return 1 - super().exact_value(tau, x)


class RaisesInItsAnswer(Reach1D):
    def exact_value(self, tau, x):
        raise ZeroDivisionError("no series")


class ForbiddenControl(Reach1D):
    def optimal_control(self, tau, x):
        return torch.full_like(x, 100.0)


class WrongPlane(DubinsCar):
    @property
    def planes(self):
        box = Box([-1.0, -1.0], [1.0, 1.0])
        return {"xy": Plane(("x", "y"), box, lambda points: points, lambda states: states)}


class ThinTarget(DoubleIntegrator):
    def target_constraints(self, x):
        return x.abs() - 1e-4


class TwoTargets(DoubleIntegrator):
    def target_level(self, x):
        return x.norm(dim=-1) - 0.1


class UndefinedBranch(ZermeloBoat):
    def avoid_level(self, x):
        return torch.where(x[..., 0] > 0, 2 - x[..., 0].sqrt(), 2.0 - x[..., 0])


class OnOff(DoubleIntegrator):
    def drift(self, x, u):
        return super().drift(x, u.sign())


class RandomNoise(ZermeloBoat):
    def diffusion(self, x, u):
        return 1e-10 * torch.randn(1, dtype=x.dtype) * super().diffusion(x, u)


class FarFromTheOrigin(HalfSpace):
    """Metres in a grid of the map: single precision has steps of half a metre there."""

    horizon = 100.0

    def __init__(self):
        super().__init__(dim=2)
        self.states = Box([5_400_000.0, 0.0], [5_400_100.0, 100.0])

    def target_level(self, x):
        return 5_400_080.0 - x[..., 0]

    def exact_value(self, tau, x):
        return None

    def optimal_control(self, tau, x):
        return None


FAULTS = [
    (WrongShape, "error", "drift", "expected shape"),
    (DoublePrecision, "error", "drift", "float32"),
    (Numpy, "error", "target_level", "ndarray"),
    (Raises, "error", "diffusion", "RuntimeError"),
    (ChangesStates, "error", "drift", "x to stay as it is"),
    (ChangesControls, "error", "drift", "u to stay as it is"),
    (MixesTheBatch, "error", "drift", "other states of a batch"),
    (FirstAxis, "error", "drift", "arranged"),
    (Undefined, "error", "drift", "expected finite numbers"),
    (Infinite, "error", "diffusion", "expected finite numbers"),
    (UndefinedBeyond, "warning", "drift", "beyond the box"),
    (UndefinedLevel, "error", "avoid_level", "expected finite numbers"),
    (Overlap, "warning", "target_level", "count as failures"),
    (DrownedTarget, "error", "target_level", "one that lies in it"),
    (EmptyTarget, "error", "target_level", "no point of the target was found"),
    (FarTarget, "error", "target_level", "no point of the target was found"),
    (TargetNextToTheBox, "warning", "target_level", "outside the box"),
    (AvoidsEverything, "error", "states", "none in the box"),
    (ReversedTarget, "warning", "target_level", "must be <= 0 inside"),
    (ReversedAvoid, "warning", "avoid_level", "must be <= 0 inside"),
    (EitherShoal, "note", "avoid_constraints", "fills (7[5-9]|8[0-5])% of the box; .* at least one of"),
    (Indicator, "warning", "target_level", "derivative is 0"),
    (FlatTarget, "warning", "target_level", "no slope at a face of the target"),
    (FlatWall, "warning", "avoid_constraints", "no slope at a face of the avoid set"),
    (NumberAsPayoff, "error", "payoff", "expected one of pirl_rl.payoffs, got 2"),
    (ClassAsPayoff, "error", "payoff", "got <class"),
    (DetachedLevel, "warning", "target_level", "derivative is 0"),
    (OnOff, "warning", "drift", "derivative is 0"),
    (UndefinedBranch, "error", "avoid_level", "A branch of torch.where that is not taken"),
    (RandomNoise, "error", "diffusion", "random numbers"),
    (FarFromTheOrigin, "warning", "states", "along axis 0 .* apart in single precision"),
    (RandomDrift, "error", "drift", "random numbers"),
    (KeepsCount, "error", "drift", "keeps a state"),
    (NoControl, "warning", "drift", "no control changes"),
    (OneIdleControl, "warning", "drift", r"controls \[1\]"),
    (NoNoise, "warning", "diffusion", "noise is 0 everywhere"),
    (NoiseOfAStep, "warning", "diffusion", "it uses dt"),
    (MoveOfAStep, "warning", "drift", "it uses delta_t"),
    (Milliseconds, "warning", "drift", "in the whole horizon"),
    (UndeclaredAngle, "warning", "states", r"periodic=\[2\]"),
    (AngleOfOneTurn, "note", "states", r"drift and noise repeat .* periodic=\[2\]"),
    (NoPeriod, "error", "states", "both ends"),
    (Stiff, "warning", "drift", "ten times as many"),
    (Endless, "error", "horizon", "finite"),
    (NoHorizon, "error", "horizon", "finite"),
    (ListOfControls, "error", "controls", "Box"),
    (PeriodicControl, "error", "controls", "only states may be periodic"),
    (UnknownObjective, "error", "objective", "invariance"),
    (WrongAnswer, "error", "exact_value", "expected the payoff"),
    (RaisesInItsAnswer, "error", "exact_value", "got ZeroDivisionError: no series"),
    (ForbiddenControl, "error", "optimal_control", "expected controls in"),
    (WrongPlane, "error", "planes", "plane 'xy'"),
    (TwoTargets, "error", "target_level", "another set than target_constraints"),
    (ThinTarget, "warning", "target_level", "thinner than a step"),
]


@pytest.mark.parametrize(("faulty", "level", "part", "message"), FAULTS, ids=[fault[0].__name__ for fault in FAULTS])
def test_a_fault_is_named_with_its_method_and_place(faulty, level, part, message):
    findings = [finding for finding in examine(faulty()) if finding.level == level]
    assert any(
        finding.subject == f"{faulty.__name__}.{part}" and re.search(message, finding.message) for finding in findings
    ), report(examine(faulty()))


LONG = ("VehicleDrift", "VehicleDrift3")
"""Problems whose check takes long; the vehicle's physics have tests of their own."""

SUITE = [
    pytest.param(getattr(problems, name), id=name, marks=[pytest.mark.slow] * (name in LONG))
    for name in problems.__all__
]


@pytest.mark.parametrize("problem", SUITE)
def test_the_suite_gives_no_alarm(problem):
    assert report(examine(problem()), ["error", "warning"]) == ""


def test_a_level_that_is_zero_all_over_its_set_gives_no_alarm():
    assert "no slope" not in report(examine(ClampedTarget()))


def test_steps_are_checked_by_the_scheme_that_plays_them():
    """Two Euler steps of 0.25 s turn a state by 0.3 rad and out by 0.02, which those of second order do not."""

    class Turn(DoubleIntegrator):
        def drift(self, x, u):
            return 0.6 * torch.stack([x[..., 1], -x[..., 0]], -1) + 0.01 * u

    stiff = {
        crossing: "ten times as many" in report(examine(Turn(), 0.5, 2, crossing))
        for crossing in ("bridge", "endpoint")
    }
    assert stiff == {"bridge": False, "endpoint": True}


def test_thirty_dimensions_give_no_alarm():
    assert report(examine(HalfSpace(dim=30)), ["error", "warning"]) == ""


def test_large_units_give_no_alarm():
    """In 100 km and an hour, a move by 2 pi metres changes nothing that shows, but is no period."""
    assert report(examine(Orbit()), ["error", "warning"]) == ""


def test_a_point_and_a_line_are_shown():
    finding = next(finding for finding in examine(DrownedTarget()) if finding.level == "error")
    assert re.search(
        r"DrownedTarget.target_level \(.*, line \d+\): expected a target outside .* For example at x = \[",
        str(finding),
    )
    undefined = next(finding for finding in examine(Undefined()) if finding.level == "error")
    assert undefined.point is not None
    assert undefined.point[0] < 0
    line = int(undefined.place.rpartition(" ")[2])
    with open(__file__, encoding="utf-8") as file:
        assert "def drift" in file.read().splitlines()[line - 1]


def test_of_many_coordinates_the_first_are_shown():
    point = tuple(float(i) for i in range(100))
    assert str(Finding("note", "Long.drift", "slow.", point=point)) == (
        "Long.drift: slow. For example at x = [0, 1, 2, 3, 4, 5, 6, 7, ... (100 coordinates)]."
    )
    assert str(Finding("note", "Short.drift", "slow.", point=point[:8])).endswith("at x = [0, 1, 2, 3, 4, 5, 6, 7].")


def test_an_exception_is_shown_with_the_line_that_raised_it():
    (finding,) = [finding for finding in examine(Raises()) if finding.level == "error"]
    line = int(finding.place.rpartition(" ")[2])
    with open(__file__, encoding="utf-8") as file:
        assert "torch.ones(3)" in file.read().splitlines()[line - 1]


def test_the_function_returns_warnings_and_raises_errors():
    (warning,) = pirl_rl.check(NoNoise())
    assert warning.subject == "NoNoise.diffusion"
    with pytest.raises(pirl_rl.errors.ProblemError, match=r"EmptyTarget\.target_level"):
        pirl_rl.check(EmptyTarget())
    with pytest.raises(pirl_rl.errors.ProblemError, match=r"EmptyTarget\.target_level"):
        pirl_rl.check(EmptyTarget)


def test_given_steps_are_checked():
    assert examine(Pendulum(), dt=0.02, substeps=4) == examine(Pendulum())
    assert "ten times as many" in report(examine(Pendulum(), dt=0.5, substeps=1), ["warning"])


def test_the_command_prints_findings_and_ends_with_an_exit_code(capsys):
    for name in ("pirl_rl.problems:HalfSpace", "pirl_rl.problems.HalfSpace"):
        main([name, "dim=3"])
        printed = capsys.readouterr().out
        assert "HalfSpace: 0 errors, 0 warnings, 0 notes in" in printed
        assert "time     Control step 0.0025 s, 400 in the horizon, with 2 integration steps." in printed
    with pytest.raises(SystemExit) as caught:
        main([f"{__name__}:FarTarget"])
    assert caught.value.code == 1
    assert "error    FarTarget.target_level (test_checking.py, line" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "expected one argument without a sign of equality, the class of a problem"),
        (["nowhere:Problem"], "no module 'nowhere'"),
        (["pirl_rl.problems:Nothing"], "has no class 'Nothing'"),
        (["problems"], "expected my_module:MyProblem, got 'problems'"),
        (["pirl_rl.problems"], "expected a subclass of pirl_rl.ReachAvoidProblem"),
        (["env.problem._target_=my_module.MyProblem"], "got env.problem._target_=my_module.MyProblem"),
        (["pirl_rl:Box"], "expected a subclass of pirl_rl.ReachAvoidProblem"),
        (["pirl_rl.problems:HalfSpace", "size=3"], "unexpected keyword argument 'size'"),
        (["pirl_rl.problems:HalfSpace", "dim=0"], "HalfSpace.dim: expected an integer >= 1"),
    ],
)
def test_a_wrong_command_is_one_line(arguments, message, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_an_error_in_the_body_of_a_class_is_told_from_a_missing_class(tmp_path, monkeypatch, capsys):
    source = "import pirl_rl\nclass Empty(pirl_rl.ReachAvoidProblem):\n    states = pirl_rl.Box([], [])\n"
    (tmp_path / "empty_box.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(SystemExit):
        main(["empty_box:Empty"])
    assert "error: Box: low and high need the same length >= 1, got 0 and 0" in capsys.readouterr().err


def test_training_checks_first_and_leaves_nothing_behind(tmp_path):
    folder = tmp_path / "run"
    with pytest.raises(pirl_rl.errors.ProblemError, match=r"FarTarget\.target_level"):
        pirl_rl.train(FarTarget(), folder=folder)
    assert not folder.exists()


class Hollow(ReachAvoidProblem):
    """Physics and a target whose formulas have no number inside the avoid set, at the centre of the box."""

    horizon, states, controls = 2.0, Box([-1.0, -1.0], [1.0, 1.0]), Box([-1.0], [1.0])

    def drift(self, x, u):
        return torch.stack([u[..., 0] + 0 * self.gap(x), -self.gap(x)], -1)

    def diffusion(self, x, u):
        return torch.diag_embed(torch.stack([0.3 + 0 * x[..., 0], 0.1 + 0.1 * self.gap(x)], -1))

    def target_level(self, x):
        return 0.8 - self.gap(x)

    def avoid_level(self, x):
        return x.square().sum(-1) - 0.09

    def gap(self, x):
        return (x.square().sum(-1) - 0.04).sqrt()


def test_physics_is_asked_only_outside_the_sets():
    """What the choices of a training see of it is that of states outside, too."""
    assert check(Hollow()) == []
    assert controlled_channels(Hollow()) == [[]]
    assert is_control_affine(Hollow())
    assert switching(Hollow()).joint == 0
    with pytest.raises(ProblemError, match=r"Bare.drift .*expected finite numbers, got NaN"):
        check(type("Bare", (Hollow,), {"avoid_level": ReachAvoidProblem.avoid_level})())
