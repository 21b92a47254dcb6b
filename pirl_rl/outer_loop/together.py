"""A launcher that trains all candidates of a round in one process, as a population."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence

from pirl_rl.files import replacing
from pirl_rl.outer_loop.processes import Job, Processes
from pirl_rl.outer_loop.redaction import redact

PROGRAM = "pirl_rl.commands.together"
"""The module that trains the jobs."""

LOG = "population.log"
"""The file beside the logs of the jobs with what concerns all of them."""

LAST_LINES = 20
"""The number of its lines that the log of each job gets where the process failed."""


class Together:
    """Runs jobs `python -m pirl_rl.train ...` in one process, whose losses are evaluated for all of them at once.

    Args:
        processes: runs that process.
    """

    def __init__(self, processes: Processes):
        self.processes = processes

    def run(self, jobs: Sequence[Job], ended: Callable[[Job, int], None]) -> None:
        if not jobs:
            return

        def all_ended(one: Job, code: int) -> None:
            text = redact(one.log.read_text(encoding="utf-8", errors="replace"))
            with replacing(one.log) as file:
                file.write(text)
            last = text.splitlines()[-LAST_LINES:] if code else []
            for job in jobs:
                with job.log.open("a", encoding="utf-8") as log:
                    log.writelines(f"{line}\n" for line in last)
                # A job whose run is complete has a summary, which counts in place of the exit code.
                ended(job, code or 1)

        # Each job is one argument, since a file would keep the secrets that a command may have.
        texts = [json.dumps({"arguments": job.command[3:], "log": str(job.log)}) for job in jobs]
        command = (sys.executable, "-m", PROGRAM, *texts)
        self.processes.run([Job("population", command, jobs[0].log.with_name(LOG))], all_ended)
