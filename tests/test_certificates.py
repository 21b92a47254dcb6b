"""Statistical certificates: exact levels by enumeration, and claims on problems whose probabilities are known."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from scipy.stats import binom

from pirl_rl import certify as certify_command
from pirl_rl import load_run
from pirl_rl.certificates import (
    Certificate,
    Deployed,
    LawOfStarts,
    OneStart,
    SafeThreshold,
    SuccessBound,
    ValueBand,
    anytime_lower_bound,
    anytime_upper_bound,
    certify,
    lower_bound,
    make_certifiers,
    order_of_quantile,
    upper_bound,
)
from pirl_rl.errors import ArgumentError
from pirl_rl.problems import Exit1D, HalfSpace, Reach1D
from pirl_rl.sampling.initial_states import UniformStates
from pirl_rl.simulator import Simulator

LAW = LawOfStarts(UniformStates())


class Known:
    """Stands for a `Solution`: the optimal control, and the exact value moved by a number."""

    dtype, device = torch.float64, torch.device("cpu")

    def __init__(self, problem, moved=0.0):
        self.problem, self.moved = problem, moved

    def policy(self, tau, x):
        control = self.problem.optimal_control(tau, x)
        return torch.zeros(len(x), self.problem.controls.dim, dtype=x.dtype) if control is None else control

    def exact(self, tau, x):
        return self.problem.exact_value(tau, x)

    def value(self, tau, x):
        return (self.exact(tau, x) + self.moved).clamp(0, 1)

    def arrays(self):
        return {"moved": np.array(self.moved)}


def reach1d() -> tuple[Known, Simulator]:
    """With u = 1 a single step with a bridge has the exact law of the exit."""
    problem = Reach1D()
    return Known(problem), Simulator(problem, dt=problem.horizon)


def exit1d() -> tuple[Known, Simulator]:
    problem = Exit1D()
    return Known(problem), Simulator(problem, dt=problem.horizon / 20)


def halfspace() -> tuple[Known, Simulator]:
    problem = HalfSpace(dim=5)
    return Known(problem), Simulator(problem, dt=problem.horizon)


@pytest.mark.parametrize("trials", [1, 7, 60])
@pytest.mark.parametrize("confidence", [0.9, 0.95])
def test_clopper_and_pearson_hold_at_every_probability(trials, confidence):
    """By enumeration of all outcomes; somewhere the level is used up to a third."""
    counts = np.arange(trials + 1)
    low, high = lower_bound(counts, trials, confidence), upper_bound(counts, trials, confidence)
    p = np.linspace(0.001, 0.999, 999)[:, None]
    weight = binom.pmf(counts, trials, p)
    for wrong in ((weight * (low > p)).sum(1), (weight * (high < p)).sum(1)):
        assert wrong.max() <= 1 - confidence + 1e-12
        assert wrong.max() > (1 - confidence) / 3
    assert low[0] == 0
    assert high[-1] == 1
    assert np.allclose(low, 1 - high[::-1])


def test_clopper_and_pearson_known_values():
    """With n successes out of n the bound is (1 - confidence)^(1/n)."""
    assert lower_bound(59, 59, 0.95) == pytest.approx(0.05 ** (1 / 59))
    assert upper_bound(0, 299, 0.95) == pytest.approx(1 - 0.05 ** (1 / 299))


@pytest.mark.parametrize("p", [0.02, 0.3, 0.9])
def test_the_anytime_bound_holds_at_all_numbers_of_trials_together(p):
    """The probability that it ever exceeds p within 300 trials, by recursion over the numbers of successes."""
    alive = np.array([1.0])  # the probabilities of s successes so far without an error
    for n in range(1, 301):
        alive = np.append(alive * (1 - p), 0) + np.insert(alive * p, 0, 0)
        wrong = [anytime_lower_bound(s, n, 0.9) > p for s in range(n + 1)]
        alive[wrong] = 0
    assert 0.005 < 1 - alive.sum() <= 0.1


def test_the_anytime_bound_closes_in_and_mirrors():
    bounds = [anytime_lower_bound(7 * n // 10, n, 0.95) for n in (10, 100, 1_000, 100_000)]
    assert bounds == sorted(bounds)
    assert 0.69 < bounds[-1] < 0.7
    assert bounds[-1] < lower_bound(70_000, 100_000, 0.95)
    assert anytime_upper_bound(3, 10, 0.95) == pytest.approx(1 - anytime_lower_bound(7, 10, 0.95))
    assert anytime_lower_bound(0, 5, 0.95) == 0
    assert 0 < anytime_lower_bound(5, 5, 0.95) < 1


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_the_order_of_a_quantile_is_the_smallest_that_holds(share):
    """The k-th smallest of n is below the quantile with P(Bin(n, 1 - share) >= k)."""
    for n in (20, 59, 200):
        order = order_of_quantile(n, share, 0.95)
        if order is None:
            assert binom.sf(n - 1, n, 1 - share) > 0.05
        else:
            assert binom.sf(order - 1, n, 1 - share) <= 0.05 < binom.sf(order - 2, n, 1 - share)
    assert order_of_quantile(58, 0.05, 0.95) is None  # 0.95^58 = 0.051
    assert order_of_quantile(59, 0.05, 0.95) == 59  # 0.95^59 = 0.048


def test_claims_about_a_known_value():
    """Each bound is on the right side, and not far."""
    solution, simulator = reach1d()
    claims = certify(solution, simulator, LAW, make_certifiers(("success", "band"), 20_000, None, 400, 400, 0.1, 0.9))
    success, band = claims.claims["success"], claims.claims["band"]
    tau, x = LAW.draw(Deployed(solution, simulator), 200_000, torch.Generator().manual_seed(3))
    truth = solution.exact(tau, x).mean().item()
    assert truth - 0.01 < success.lower < truth
    assert success.sentences[2].count("is not refuted") == 1
    # Of a perfect V only the width of the bounds at the states is left, some 3 sqrt(p (1 - p) / 400).
    assert 0 < band.upper < 0.08


def test_a_raised_value_is_refuted_and_widens_the_band():
    solution, simulator = reach1d()
    solution.moved = 0.1
    certificate = certify(solution, simulator, LAW, {"success": SuccessBound(20_000), "band": ValueBand(400, 400)})
    assert "is refuted" in certificate.claims["success"].sentences[2]
    assert certificate.claims["band"].upper > 0.1


def test_a_threshold_is_proved_where_success_is_likely():
    """On reach1d with tau = 2, success has probability p exactly where V > p."""
    solution, simulator = reach1d()
    starts = LawOfStarts(UniformStates(), tau=2.0)
    claim = certify(solution, simulator, starts, {"threshold": SafeThreshold(2_000, 500, success=0.6)}).claims[
        "threshold"
    ]
    assert claim.holds
    assert claim.upper is not None
    assert 0.55 < claim.upper < 0.7
    impossible = certify(solution, simulator, starts, {"threshold": SafeThreshold(200, 50, success=0.999)})
    assert not impossible.claims["threshold"].holds
    assert "No threshold" in impossible.claims["threshold"].sentences[0]


def test_episodes_end_when_the_question_is_answered():
    """P = 0.6277 at tau = 2, x = 0."""
    solution, simulator = reach1d()
    start = OneStart(2.0, (0.0,))
    claims = certify(
        solution,
        simulator,
        start,
        {"far": SuccessBound(100_000, 0.4), "near": SuccessBound(100_000, 0.6), "not": SuccessBound(100_000, 0.7)},
    ).claims
    assert claims["far"].samples == 1_000
    assert claims["far"].samples < claims["near"].samples < 100_000
    assert claims["far"].holds
    assert claims["near"].holds
    assert not claims["not"].holds
    assert claims["not"].samples < 100_000
    assert claims["near"].lower < 0.6277


def test_a_choice_among_runs_costs_confidence():
    solution, simulator = reach1d()
    alone, best = (
        certify(solution, simulator, LAW, {"success": SuccessBound(2_000)}, picked_from=k).claims["success"]
        for k in (1, 5)
    )
    assert best.lower == pytest.approx(lower_bound(round(best.estimate * 2_000), 2_000, 0.99))
    assert best.lower < alone.lower
    assert "5 runs" in best.sentences[0]


def test_the_certificate_names_the_networks_and_is_plain_json():
    solution, simulator = reach1d()
    certifiers = {"success": SuccessBound(100)}
    first, again = (certify(solution, simulator, LAW, certifiers) for _ in range(2))
    assert json.loads(json.dumps(first.to_dict())) == again.to_dict()
    solution.moved = 1e-9
    assert isinstance(first, Certificate)
    assert certify(solution, simulator, LAW, certifiers).networks != first.networks
    assert math.isfinite(first.claims["success"].lower or math.nan)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"confidence": 1.0}, "confidence: expected a number between 0 and 1"),
        ({"picked_from": 0}, "picked_from: expected an integer >= 1"),
        ({"starts": OneStart(2.0, (0.0,)), "certifiers": {"band": ValueBand()}}, "starts: expected a law"),
        ({"certifiers": {"success": SuccessBound(10), "band": ValueBand(10)}}, "states: expected more of them"),
        ({"certifiers": {"threshold": SafeThreshold(1)}}, "states: expected an integer >= 2, got 1"),
    ],
)
def test_wrong_arguments_are_refused_before_a_path_is_played(change, message, monkeypatch):
    monkeypatch.setattr(Deployed, "successes", None)
    solution, simulator = reach1d()
    arguments = {"starts": LAW, "certifiers": {"success": SuccessBound(10)}} | change
    with pytest.raises(ArgumentError, match=message):
        certify(solution, simulator, **arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"claims": ["sucess"]}, "claims: expected a list of names out of success, threshold, band"),
        ({"claims": "band"}, "claims"),
        ({"episodes": 0}, "episodes: expected an integer >= 1, got 0"),
        ({"at_least": 1.2}, "at_least: expected a number between 0 and 1"),
        ({"share": 0.0}, "share"),
        ({"rollouts": 2.5}, "rollouts"),
        ({"success": 1}, "success: expected a number between 0 and 1"),
    ],
)
def test_wrong_claims_are_refused(arguments, message):
    given = {"claims": ["success"], "episodes": 10, "at_least": None, "states": 100, "rollouts": 10, "share": 0.1}
    with pytest.raises(ArgumentError, match=message):
        make_certifiers(**given | {"success": 0.9} | arguments)


REPETITIONS = 1_000
MOST = 65
"""The largest number of wrong 95% bounds out of 1,000; more than 65 have a probability of 0.015 at a level of 5%."""


@pytest.mark.slow
@pytest.mark.parametrize("make", [reach1d, exit1d, halfspace])
class TestLevels:
    """1,000 certificates each, with a level of 95%, against exact probabilities; pytest -rP shows the counts."""

    @staticmethod
    def certificates(make, certifiers, picked_from=1, starts=LAW):
        solution, simulator = make()
        for seed in range(REPETITIONS):
            yield certify(solution, simulator, starts, certifiers, picked_from=picked_from, seed=seed).claims

    @staticmethod
    def truth(make, count=400_000):
        solution, simulator = make()
        tau, x = LAW.draw(Deployed(solution, simulator), count, torch.Generator().manual_seed(1))
        return solution.value(tau, x).numpy(), solution.exact(tau, x).numpy()

    def test_success(self, make):
        exact = self.truth(make)[1].mean()
        wrong = sum(
            claims["success"].lower > exact for claims in self.certificates(make, {"success": SuccessBound(500)})
        )
        print(f"wrong: {wrong} of {REPETITIONS}")
        assert 20 <= wrong <= MOST  # 20: a bound of 95% from 500 episodes is nearly as wrong as it may be

    def test_success_at_a_random_stopping_time(self, make):
        """The episodes end when a probability is proved that is a little above the truth, or never."""
        exact = self.truth(make)[1].mean()
        certifiers = {"success": SuccessBound(4_000, float(exact) + 0.002)}
        claims = [claims["success"] for claims in self.certificates(make, certifiers)]
        wrong, early = sum(claim.lower > exact for claim in claims), sum(claim.samples < 4_000 for claim in claims)
        print(f"wrong: {wrong} of {REPETITIONS}, {early} of which ended early")
        assert wrong <= MOST

    def test_threshold(self, make):
        """Of the states above the threshold, at most a tenth may have a probability below 0.6."""
        value, exact = self.truth(make)
        wrong = proved = 0
        for claims in self.certificates(make, {"threshold": SafeThreshold(400, 64, 0.1, 0.6)}):
            if claims["threshold"].holds:
                proved += 1
                wrong += (exact[value > claims["threshold"].upper] < 0.6).mean() > 0.1
        print(f"wrong: {wrong} of {REPETITIONS}, {proved} of which proved a threshold")
        assert proved > 500
        assert wrong <= MOST

    def test_band(self, make):
        """Against a V that is wrong by up to 0.2."""
        solution, simulator = make()
        solution.value = lambda tau, x: (solution.exact(tau, x) + 0.2 * torch.sin(9 * x[:, 0])).clamp(0, 1)
        tau, x = LAW.draw(Deployed(solution, simulator), 400_000, torch.Generator().manual_seed(1))
        error = (solution.value(tau, x) - solution.exact(tau, x)).abs().numpy()
        certifiers = {"band": ValueBand(200, 256, 0.1)}
        wrong = 0
        for seed in range(REPETITIONS):
            claim = certify(solution, simulator, LAW, certifiers, seed=seed).claims["band"]
            wrong += (error > claim.upper).mean() > 0.1
        print(f"wrong: {wrong} of {REPETITIONS}")
        assert wrong <= MOST

    def test_best_of_five(self, make):
        """Five policies that are equally good, of which the one with the largest bound is shown."""
        exact, wrong = self.truth(make)[1].mean(), 0
        solution, simulator = make()
        for repetition in range(REPETITIONS):
            bounds = [
                certify(
                    solution, simulator, LAW, {"success": SuccessBound(200)}, picked_from=5, seed=5 * repetition + k
                )
                for k in range(5)
            ]
            wrong += max(bound.claims["success"].lower for bound in bounds) > exact
        print(f"wrong: {wrong} of {REPETITIONS}")
        assert wrong <= MOST

    def test_a_raised_value_is_exposed(self, make):
        """V raised by 0.1, in 99 of 100 certificates."""
        exposed = 0
        for seed in range(100):
            solution, simulator = make()
            solution.moved = 0.1
            claim = certify(solution, simulator, LAW, {"success": SuccessBound(10_000)}, seed=seed).claims["success"]
            exposed += "is refuted" in claim.sentences[2]
        print(f"exposed: {exposed} of 100")
        assert exposed >= 99


def test_the_command_writes_what_python_returns(trained, in_process):
    """The same seed gives the same certificate, and the file belongs to the networks of the run."""
    code, text = in_process(certify_command)(f"run={trained}", "episodes=200", "states=100", "rollouts=8", "share=0.2")
    assert code == 0, text
    written = json.loads((trained / "certificate.json").read_text())
    run = load_run(trained)
    certificate = run.certify(episodes=200, states=100, rollouts=8, share=0.2)
    assert written == certificate.to_dict()
    assert [*written["claims"]] == ["success", "threshold", "band"]
    assert all(sentence in text for claim in written["claims"].values() for sentence in claim["sentences"])
    assert written["networks"] == Deployed(run.solution, run.simulator).digest()


def test_one_start_from_the_command_line(trained, in_process):
    code, text = in_process(certify_command)(f"run={trained}", "tau=2", "x=[0.5]", "episodes=100", "dt=0.5")
    assert code == 0, text
    assert "from the state [0.5] with 2 s to go" in text
    assert "held for 0.5 s" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "run: expected run=RUN_DIR"),
        (["run=a", "run=b"], "run: expected run=RUN_DIR once, the directory of a finished run, got a and b"),
        (["run={}", "states"], "states: expected key=value with a key out of at_least"),
        (["run={}", "claims=[proof]"], "claims: expected a list of names out of success, threshold, band"),
        (["run={}", "x=[0,1]"], r"x: expected states of shape (\*, 1), got (1, 2)"),
        (["run={}", "tau=3"], "tau: expected 0 <= tau <= horizon = 2.0 s"),
        (["run={}", "dt=5"], "dt: expected 0 < dt <= horizon"),
        (["run={}", "seed=-1"], "seed: expected an integer"),
        (["run={}", "seed=one"], "seed: expected an integer"),
        (["run=nowhere"], "nowhere"),
    ],
)
def test_a_wrong_command_is_one_sentence(arguments, message, trained, in_process):
    code, text = in_process(certify_command)(*(argument.format(trained) for argument in arguments))
    assert code == 1
    assert "Traceback" not in text
    assert message.replace("\\", "") in text
