"""Certify a run: exact statistical bounds of what its frozen policy does.

    python -m pirl_rl.certify run=RUN_DIR [claims=[success,threshold,band]] [key=value ...]

Plays new paths of the policy, and writes what follows from them, whatever the law of the paths is, to certificate.json
in the run directory. A certificate counts if it is made once: `picked_from` is the number of runs, or of seeds, out of
which the best one is shown.

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
    trust        modules of your own that the run may import, such as trust=[my_module]

Examples:
    python -m pirl_rl.certify run=runs/reach1d/2026-01-31_12-00-00-0
    python -m pirl_rl.certify run=models/drift claims=[success] at_least=0.3
    python -m pirl_rl.certify run=my_run tau=2 x=[0.0] confidence=0.99
"""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pirl_rl.commands.console import quiet_libraries, reported
from pirl_rl.errors import ConfigError
from pirl_rl.files import replacing
from pirl_rl.progress import announce, helped
from pirl_rl.run_directory import RunDirectory
from pirl_rl.runs.load import load_run
from pirl_rl.runs.run import Run

SETTINGS = {*inspect.signature(Run.certify).parameters} - {"self", "starts"}
"""The arguments of `Run.certify` that have a place on a command line."""


def main(arguments: Sequence[str] | None = None) -> None:
    arguments = sys.argv[1:] if arguments is None else arguments
    if helped(arguments, __doc__):
        return
    quiet_libraries()
    named = [item for item in arguments if item.startswith("run=")]
    folder = Path(named[-1].partition("=")[2]) if named else Path()
    with reported(folder):
        if not named:
            raise ConfigError("run: expected run=RUN_DIR, the directory of a finished run")
        settings = _settings([item for item in arguments if item not in named])
        run = load_run(folder, settings.pop("trust", ()))
        directory = RunDirectory(folder)
        directory.refuse_links()
        announce("playing the policy")
        certificate = run.certify(**settings)
        with replacing(directory.certificate) as file:
            file.write(json.dumps(certificate.to_dict(), indent=2) + "\n")
    for name, claim in certificate.claims.items():
        print(f"{name:<10}" + f"\n{'':<10}".join(claim.sentences))
    print(f"written   {directory.certificate}")


def _settings(arguments: Sequence[str]) -> dict[str, Any]:
    """The arguments of `Run.certify`, and `trust`, from a command line.

    Raises:
        ConfigError: an argument is unknown, or cannot be read.
    """
    known = {*SETTINGS, "trust"}
    for text in arguments:
        if "=" not in text or text.partition("=")[0] not in known:
            raise ConfigError(f"{text}: expected key=value with a key out of {', '.join(sorted(known))}")
    try:
        return OmegaConf.to_container(OmegaConf.from_dotlist([*arguments]))  # type: ignore[return-value]
    except (OmegaConfBaseException, ValueError) as error:
        raise ConfigError(f"certify: {error}") from None
