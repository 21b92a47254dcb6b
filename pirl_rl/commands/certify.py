"""Certify a run: exact statistical bounds of what its frozen policy does, or a proof.

    python -m pirl_rl.certify run=RUN_DIR [claims=[success,threshold,band]] [key=value ...]
    python -m pirl_rl.certify run=RUN_DIR method=interval [key=value ...]

Plays new paths of the policy, and writes what follows from them, whatever the law of the paths is, to certificate.json
in the run directory. A certificate counts if it is made once: `picked_from` is the number of runs, or of seeds, out of
which the best one is shown. The report of the run is drawn again.

With method=interval it proves a lower bound of the probability of success for all states at once, with certainty, and
writes it to proof.json and proof.npz, with figures. The bound is about continuous feedback, and the statistical claims
are about the simulator, which holds each control for a step. With bounds=[upper] it proves an upper bound for every
policy, which does not depend on the networks, and writes it to limit.json and limit.npz. Problems have at most three
states.

    run          the directory of a finished run
    claims       success: a lower bound of the probability of success;
                 threshold: a c such that almost all states with V > c succeed with a wanted probability;
                 band: an eps such that V is within eps of the probability of success at almost all states
    tau, x       the time to go, and the state, of all starts; by default the law of the evaluator success draws them
    episodes     the number of episodes of success, 100,000 by default
    at_least     the episodes end as soon as this probability is proved, or cannot be
    states       the number of states of threshold and band, 1,000 by default
    rollouts     the number of paths from each of them, 256 by default
    share        the share of states about which threshold and band claim nothing, 0.05 by default
    success      the wanted probability of threshold, 0.9 by default
    dt, substeps, crossing
                 the simulator in which the policy is deployed, by default that of the evaluators
    confidence   the level of each claim, 0.95 by default
    picked_from  the number of runs, or of seeds, that were compared on the same data, 1 by default
    seed         the seed of starts and noise, 0 by default
    corollary    true adds Corollary 1 of the paper as numbers: a diagnostic, which bounds nothing; false by default
    trust        modules of your own that the run may import, such as trust=[my_module]

    With method=interval:
    bounds       lower: a bound of the policy's probability of success from below, the default;
                 upper: one of every policy's from above; [lower,upper]: both
    cells, steps the numbers of cells of the bound along each state and along tau; by default 64 and 60 with up to two
                 states, and 16 and 16 with three
    rounds       the largest number of times that the bound is fitted, to points and then to boxes, 40 by default
    halvings     the number of times that a box may be halved, 10 by default

Examples:
    python -m pirl_rl.certify run=runs/reach1d/2026-01-31_12-00-00-0
    python -m pirl_rl.certify run=models/drift claims=[success] at_least=0.3
    python -m pirl_rl.certify run=my_run tau=2 x=[0.0] confidence=0.99
    python -m pirl_rl.certify run=runs/reach1d/2026-01-31_12-00-00-0 method=interval bounds=[lower,upper]
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pirl_rl.building import trusted_modules
from pirl_rl.commands.console import one_folder, program, read_settings, reported
from pirl_rl.commands.report import draw_again
from pirl_rl.errors import ConfigError, ProofError
from pirl_rl.figures.files import save_figures
from pirl_rl.figures.proof import draw_proof
from pirl_rl.files import replacing
from pirl_rl.progress import announce
from pirl_rl.proofs import LowerBound, UpperBound
from pirl_rl.proofs.proof import LEVELS
from pirl_rl.run_directory import RunDirectory
from pirl_rl.runs.load import load_run
from pirl_rl.runs.run import Run

SETTINGS = {
    "statistical": {*inspect.signature(Run.certify).parameters} - {"self", "starts"},
    "interval": ({*inspect.signature(Run.prove).parameters} - {"self"}) | {"bounds"},
}
"""The arguments of a command line, which are those of `Run.certify`, `Run.prove` and `Run.prove_limit`, by method."""

BOUNDS = ("lower", "upper")
"""The bounds that can be proved."""


@program
def main(arguments: Sequence[str]) -> None:
    with reported(Path()):
        folder = one_folder(arguments, "run", "the directory of a finished run")
    with reported(folder):
        others = [item for item in arguments if not item.startswith("run=")]
        methods = [item.partition("=")[2] for item in others if item.startswith("method=")]
        method = methods[-1] if methods else "statistical"
        settings = _settings(method, [item for item in others if not item.startswith("method=")])
        trust = trusted_modules(settings.pop("trust", None))
        run, directory = load_run(folder, trust), RunDirectory(folder)
        directory.refuse_links()
        directory.require_writable()
        lines = _prove(run, directory, settings) if method == "interval" else _certify(run, directory, settings)
    print("\n".join(lines))
    if run.config.get("report", True):
        draw_again(folder, trust)


def _certify(run: Run, directory: RunDirectory, settings: dict[str, Any]) -> list[str]:
    """Write a statistical certificate, and return what it says."""
    announce("playing the policy")
    certificate = run.certify(**settings)
    with replacing(directory.certificate) as file:
        file.write(json.dumps(certificate.to_dict(), indent=2) + "\n")
    lines = [f"{name:<10}" + f"\n{'':<10}".join(claim.sentences) for name, claim in certificate.claims.items()]
    for name, diagnostic in certificate.diagnostics.items():
        lines += [f"{name}, a diagnostic", *(f"{'':<10}{sentence}" for sentence in diagnostic.sentences)]
    return [*lines, f"written   {directory.certificate}"]


def _prove(run: Run, directory: RunDirectory, settings: dict[str, Any]) -> list[str]:
    """Write proofs and draw them, and return what they say."""
    wanted = settings.pop("bounds", ["lower"])
    if not (isinstance(wanted, list) and wanted and set(wanted) <= {*BOUNDS}):
        raise ConfigError(f"bounds: expected a list of {' and '.join(BOUNDS)}, got {wanted!r}")
    lines = []
    if "lower" in wanted:
        lines += _prove_success(run, directory, settings)
    if "upper" in wanted:
        lines += _prove_limit(run, directory, settings)
    for path in directory.figures.glob("proof*.png"):
        path.unlink()  # of earlier proofs
    lower, upper = _loaded(run.load_proof, directory.bound), _loaded(run.load_limit, directory.limit_bound)
    if lower is not None and upper is not None:
        lines.append(
            f"gap       On average over the box of states the policy is within {upper.gap(lower):.4f} of the best one."
        )
    bounds = [bound for bound in (lower, upper) if bound is not None]
    figures = save_figures(draw_proof(run.solution, bounds), directory.figures) if bounds else []
    return [*lines, *(f"written   {path}" for path in figures)]


def _prove_success(run: Run, directory: RunDirectory, settings: dict[str, Any]) -> list[str]:
    proof = run.prove(**settings)
    found = proof.to_dict()
    lines = [
        f"proved    Under continuous feedback the policy succeeds from {found['best_state']} with "
        f"{run.problem.horizon:g} s to go",
        f"          with probability at least {found['best']:.4f}, and on average over the box of states at least "
        f"{found['mean']:.4f}.",
        *(
            f"          {found[f'share_at_least_{level:g}']:.1%} of it succeed with {level:g} or more."
            for level in LEVELS
        ),
        "          The bound is not about a simulator, which holds each control for a step.",
    ]
    return _written(proof, directory.proof, directory.bound, lines)


def _prove_limit(run: Run, directory: RunDirectory, settings: dict[str, Any]) -> list[str]:
    limit = run.prove_limit(**settings)
    found = limit.to_dict()
    lines = [
        f"limit     No policy succeeds from {found['lowest_state']} with {run.problem.horizon:g} s to go",
        f"          with a probability above {found['lowest']:.4f}, and on average over the box of states none does "
        f"with more than {found['mean']:.4f}.",
        *(
            f"          From {found[f'share_below_{level:g}']:.1%} of it no policy attains {level:g}."
            for level in LEVELS
        ),
        "          The bound does not depend on the networks.",
    ]
    return _written(limit, directory.limit, directory.limit_bound, lines)


def _written(proof: LowerBound | UpperBound, words: Path, function: Path, lines: list[str]) -> list[str]:
    """Write a proof to its two files, of which the function is left out where nothing is proved.

    Args:
        proof: what was found.
        words: the JSON file.
        function: the file of the bound.
        lines: what the proof says if it holds.

    Returns:
        What to print.
    """
    with replacing(words) as file:
        file.write(json.dumps(proof.to_dict(), indent=2) + "\n")
    function.unlink(missing_ok=True)  # of an earlier proof
    lowered = [f"          W is lowered by {proof.margin:.3f}, so that it holds also on these boxes:"]
    lowered += [f"resists   {name}, {len(boxes):,} boxes" for name, boxes in proof.resisted.items()]
    resists = lowered if proof.resisted else []
    if not proof.holds:
        nothing = f"Nothing is proved: with the margin that its conditions need the bound is {proof.TRIVIAL}."
        return [nothing, *resists, f"written   {words}"]
    proof.save(function)
    effort = f"boxes     {proof.boxes:,}, in {proof.seconds:.0f} s"
    return [*lines, *resists, effort, f"written   {words}", f"written   {function}"]


def _loaded(load: Callable[[Path], Any], path: Path) -> Any:
    """The bound in a file; None where there is none, or where it is about other networks or another problem."""
    try:
        return load(path)
    except ProofError:
        return None


def _settings(method: str, arguments: Sequence[str]) -> dict[str, Any]:
    """The arguments of `Run.certify` or `Run.prove`, and `trust`, from a command line.

    Raises:
        ConfigError: the method or an argument is unknown, or an argument cannot be read.
    """
    if method not in SETTINGS:
        raise ConfigError(f"method: expected {' or '.join(SETTINGS)}, got {method!r}")
    known = {*SETTINGS[method], "trust"}
    for text in arguments:
        if "=" not in text or text.partition("=")[0] not in known:
            raise ConfigError(f"{text}: expected key=value with a key out of {', '.join(sorted(known))}")
    return read_settings(arguments)
