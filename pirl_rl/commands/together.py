"""Train several commands of `python -m pirl_rl.train` side by side in one process, as members of a population.

    python -m pirl_rl.commands.together COMMAND [COMMAND ...]

`python -m pirl_rl.tune population=true` starts it for the candidates of a round. Each COMMAND is a JSON object with the
"arguments" of a command and its "log". It leaves the run directory that it would leave alone. One that cannot be
trained says so in its log, and the others go on. What concerns all of them goes to the terminal.
"""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig

from pirl_rl import checkpoint
from pirl_rl.commands.composition import compose
from pirl_rl.commands.console import quiet_libraries, reported
from pirl_rl.commands.directory import begin, new_directory, show
from pirl_rl.commands.train import prepare, reopened
from pirl_rl.errors import INTERRUPTED, Interrupted
from pirl_rl.machine import keep_freed_memory
from pirl_rl.population import Population
from pirl_rl.trainer import Trainer


class Member(NamedTuple):
    """A run of the population: its log, its trainer with the random numbers that it begins with, its configuration, and
    the modules that this may name."""

    log: Path
    trainer: Trainer
    numbers: dict[str, Any]
    config: DictConfig
    trust: list[str]


def train_together(commands: Sequence[dict[str, Any]]) -> None:
    """Train commands as a population.

    Args:
        commands: the "arguments" of each command, of which the first is `resume=DIR` or one is `hydra.run.dir=DIR`, and
            its "log".

    Raises:
        Interrupted: on SIGINT, after a checkpoint of each run.
        ArgumentError: the runs differ in more than a population can train, see `Population`.
    """
    keep_freed_memory()
    members: list[Member] = []
    with contextlib.ExitStack() as stack:
        for command in commands:
            with _logged(Path(command["log"])):
                members.append(stack.enter_context(_entered(command["arguments"], Path(command["log"]))))
        if not members:
            return
        population = Population([member.trainer for member in members], [member.numbers for member in members])
        for index, (member, summary) in enumerate(zip(members, population.train(), strict=True)):
            with _logged(member.log):
                if summary is None:
                    raise population.errors[index]
                show(member.trainer, summary, member.config, member.trust)


@contextlib.contextmanager
def _entered(arguments: Sequence[str], log: Path) -> Iterator[Member]:
    """The run of a command, whose directory is locked meanwhile."""
    key, _, path = arguments[0].partition("=")
    if key == "resume":
        with reopened(Path(path), arguments[1:]) as (trainer, config, trust):
            yield Member(log, trainer, checkpoint.global_rng_states(), config, trust)
        return
    parsed = OverridesParser.create().parse_overrides(list(arguments))
    [folder] = [Path(str(entry.value())) for entry in parsed if entry.key_or_group == "hydra.run.dir"]
    pairs = zip(arguments, parsed, strict=True)
    overrides = [text for text, entry in pairs if not entry.key_or_group.startswith("hydra.")]
    config = compose("train", overrides)
    with new_directory(folder):
        trust, problem = prepare(config, overrides)
        trainer = begin(config, folder, overrides, trust, problem)
        yield Member(log, trainer, checkpoint.global_rng_states(), config, trust)


@contextlib.contextmanager
def _logged(log: Path) -> Iterator[None]:
    """Append what is printed to a log, and errors as messages, which end nothing else."""
    with (
        log.open("a", encoding="utf-8") as file,
        contextlib.redirect_stdout(file),
        contextlib.redirect_stderr(file),
        contextlib.suppress(SystemExit),
        reported(log.with_suffix("")),
    ):
        yield


def main() -> None:
    quiet_libraries()
    with reported(Path()):
        try:
            train_together([json.loads(text) for text in sys.argv[1:]])
        except (Interrupted, KeyboardInterrupt):
            print("stopped; the outer loop resumes the runs", file=sys.stderr)
            sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
