"""The loop: ask for a plan, run its candidates, keep the results; goes on wherever its record stands."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from jinja2 import TemplateError

from pirl_rl.errors import ConfigError, PlanError
from pirl_rl.outer_loop import prompt
from pirl_rl.outer_loop.advisors import Advisor, Request
from pirl_rl.outer_loop.advisors.greedy import Greedy
from pirl_rl.outer_loop.candidates import LEADING, Task, job, overrides, result, settle
from pirl_rl.outer_loop.history import History, Result, Round
from pirl_rl.outer_loop.parsing import parse_plan
from pirl_rl.outer_loop.plan import START, Plan
from pirl_rl.outer_loop.processes import Job, Launcher
from pirl_rl.outer_loop.record import Attempt, Record
from pirl_rl.outer_loop.redaction import REMOVED, redact
from pirl_rl.outer_loop.report import line, verdict

ASKED = 2
"""Times that an advisor is asked before the fallback steps in."""

LONGEST_ANSWER, LONGEST_ERROR = 20_000, 2_000
"""Characters of an answer and of an error that are recorded."""


@dataclass(frozen=True)
class LoopSettings:
    """What a loop is to do.

    Attributes:
        rounds: number of rounds up to the milestone.
        candidates: number of candidates in each round.
        updates: length of each candidate's training.
        extra_rounds: further rounds past the milestone, each only if the round before found a new best.
        start: the checkpoint from which the loop goes on.
        train: the user's overrides of every candidate's training.
        trust: modules outside the package that these name.
        final: names of the evaluators that judge a candidate.
        seed: of the training; each round adds its number.
    """

    rounds: int
    candidates: int
    updates: int
    extra_rounds: int
    start: Path
    train: Sequence[str] = ()
    trust: Sequence[str] = ()
    final: Sequence[str] = ()
    seed: int = 0


class Loop:
    """Rounds of continuations.

    Args:
        settings: number of rounds and candidates, and how candidates are trained.
        record: where everything is kept and found again.
        advisor: plans; `Greedy` steps in for one that fails.
        launcher: runs the candidates' command lines.
    """

    def __init__(self, settings: LoopSettings, record: Record, advisor: Advisor, launcher: Launcher):
        self.settings, self.record, self.advisor, self.launcher = settings, record, advisor, launcher

    def run(self, history: History) -> History:
        """Add the rounds that are missing to a history."""
        while self._goes_on(history):
            number = len(history.rounds) + 1
            plan = self._plan(number, history)
            results = self._carry_out(number, plan, history)
            attempts = self.record.attempts(number)
            one = Round(
                number=number,
                advisor=attempts[-1].advisor,
                note=plan.round_note,
                fallback="; ".join(attempts[ASKED - 1].errors) if len(attempts) > ASKED else "",
                results=results,
            )
            self.record.write_round(one)
            history = history.model_copy(update={"rounds": [*history.rounds, one]})
            print(verdict(history), flush=True)
        return history

    def _goes_on(self, history: History) -> bool:
        done, settings = len(history.rounds), self.settings
        if done < settings.rounds:
            return True
        before = history.model_copy(update={"rounds": history.rounds[:-1]})
        return done < settings.rounds + settings.extra_rounds and history.best != before.best

    def _plan(self, number: int, history: History) -> Plan:
        """The round's plan, asked for unless it is there; every asking is on record before the next."""
        plan = self.record.plan(number)
        if plan is not None:
            try:
                return parse_plan(plan.model_dump_json(), history, self.settings.candidates)
            except PlanError as error:  # changed by hand
                raise ConfigError(f"{self.record.folder(number) / 'plan.json'}: {error}") from None
        request = Request(
            number=number,
            candidates=self.settings.candidates,
            updates=self.settings.updates,
            history=history,
            prompt=self._prompt(number, history),
            folder=self.record.folder(number),
        )
        attempts = self.record.attempts(number)
        while not attempts or attempts[-1].errors:
            attempts.append(self._ask(request, attempts))
            self.record.write_attempts(number, attempts)
        plan = parse_plan(attempts[-1].answer, history, self.settings.candidates)
        self.record.write_plan(number, plan)
        return plan

    def _prompt(self, number: int, history: History) -> str:
        text = self.record.prompt(number)
        if text is None:
            settings, context = self.settings, self.record.context()
            try:
                text = prompt.render(
                    history,
                    rounds=settings.rounds,
                    candidates=settings.candidates,
                    updates=settings.updates,
                    context=context,
                )
            except (TemplateError, OSError) as error:
                raise ConfigError(f"{prompt.TEMPLATE}: {error}") from None
            self.record.write_prompt(number, text)
        return redact(text)

    def _ask(self, request: Request, before: Sequence[Attempt]) -> Attempt:
        """Ask once more, the fallback once the advisor has had its turns."""
        fallback = len(before) >= ASKED
        advisor = Greedy() if fallback else self.advisor
        name, answer = type(advisor).__name__.lower(), ""
        try:
            # What a program leaves behind may hold anything, so that none of it stays.
            with tempfile.TemporaryDirectory(prefix="advisor-") as folder:
                errors = before[-1].errors if before and not fallback else ()
                answer = advisor.propose(replace(request, folder=Path(folder), errors=errors))
            if not isinstance(answer, str):
                raise PlanError([f"answer: expected text, got {type(answer).__name__}"])
            answer = redact(answer)
            plan = parse_plan(answer, request.history, request.candidates)
            if redact(plan.model_dump()) != plan.model_dump(mode="json"):
                answer = REMOVED
                raise PlanError(["answer: it spells out the value of a secret environment variable"])
        except Exception as error:  # whatever an advisor does, the loop goes on
            if fallback:
                raise
            reasons = error.errors if isinstance(error, PlanError) else [f"{type(error).__name__}: {error}"]
            reasons = [redact(reason)[:LONGEST_ERROR] for reason in reasons]
            print(f"round {request.number}: {name} gave no plan: {'; '.join(reasons)[:500]}", flush=True)
            return Attempt(advisor=name, answer=str(answer)[:LONGEST_ANSWER], errors=reasons)
        text = answer if len(answer) <= LONGEST_ANSWER else plan.model_dump_json()
        return Attempt(advisor=name, answer=text)

    def _carry_out(self, number: int, plan: Plan, history: History) -> list[Result]:
        """Run the candidates that have not ended; the results of all, in the plan's order."""
        settings = self.settings
        tasks = {}
        for candidate in plan.candidates:
            start = history.checkpoints[candidate.start_checkpoint]
            path = (
                settings.start if candidate.start_checkpoint == START else self.record.run(candidate.start_checkpoint)
            )
            name, folder = f"{number:03d}/{candidate.name}", self.record.candidates(number) / candidate.name
            tasks[name] = Task(name, folder, candidate, start, path, settings.updates)

        def ended(done: Job, code: int) -> None:
            settle(tasks[done.name], code)
            print(line(result(tasks[done.name]), history), flush=True)

        jobs = []
        for task in tasks.values():
            if task.ended:
                continue
            own = overrides(task, settings.final, settings.seed + number)
            jobs.append(job(task, [*LEADING, *settings.train, *own], settings.trust))
            print(f"{task.name}: log in {task.log}", flush=True)
        self.launcher.run(jobs, ended)
        return [result(task) for task in tasks.values()]
