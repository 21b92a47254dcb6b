"""The outer loop: ask for a plan, train its candidates, record the results. It continues from any state on record."""

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
from pirl_rl.outer_loop.candidates import LEADING, Task, make_job, read_result, settle, training_overrides
from pirl_rl.outer_loop.history import History, Result, Round
from pirl_rl.outer_loop.parsing import parse_plan
from pirl_rl.outer_loop.plan import START, Plan
from pirl_rl.outer_loop.processes import Job, Launcher
from pirl_rl.outer_loop.record import Attempt, Record
from pirl_rl.outer_loop.redaction import REMOVED, redact
from pirl_rl.outer_loop.report import describe_result, describe_round

ASKED = 2
"""Number of times that an advisor is asked before the fallback plans the round."""

LONGEST_ANSWER, LONGEST_ERROR = 20_000, 2_000
"""Largest numbers of characters of an answer and of an error that are recorded."""


@dataclass(frozen=True)
class LoopSettings:
    """Settings of an outer loop.

    Attributes:
        rounds: number of rounds up to the milestone.
        candidates: number of candidates in each round.
        updates: number of updates of each candidate's training.
        extra_rounds: largest number of rounds after the milestone, each only if the previous round found a new best.
        start: the checkpoint from which the loop starts.
        train: the user's overrides of every candidate's training.
        trust: modules outside the package that the overrides name.
        final: names of the evaluators that judge a candidate.
        seed: seed of the training, to which each round adds its number.
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
    """An outer loop of rounds, in each of which the candidates of a plan are trained.

    Args:
        settings: number of rounds and candidates, and how candidates are trained.
        record: reads and writes the state of the loop.
        advisor: plans the rounds; if it gives no plan, `Greedy` replaces it for that round.
        launcher: runs the candidates' command lines.
    """

    def __init__(self, settings: LoopSettings, record: Record, advisor: Advisor, launcher: Launcher):
        self.settings, self.record, self.advisor, self.launcher = settings, record, advisor, launcher

    def run(self, history: History) -> History:
        """Run the rounds that a history lacks; returns the complete history."""
        while self._unfinished(history):
            number = len(history.rounds) + 1
            plan = self._plan(number, history)
            results = self._train(number, plan, history)
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
            print(describe_round(history), flush=True)
        return history

    def _unfinished(self, history: History) -> bool:
        done, settings = len(history.rounds), self.settings
        if done < settings.rounds:
            return True
        before = history.model_copy(update={"rounds": history.rounds[:-1]})
        return done < settings.rounds + settings.extra_rounds and history.best != before.best

    def _plan(self, number: int, history: History) -> Plan:
        """The round's plan, read from the record or asked for; every attempt is recorded before the next."""
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
        """Ask once: the advisor, or the fallback if the advisor has failed `ASKED` times."""
        fallback = len(before) >= ASKED
        advisor = Greedy() if fallback else self.advisor
        name, answer = type(advisor).__name__.lower(), ""
        try:
            # An advisor's program may leave files of any content, so its folder is removed after the answer.
            with tempfile.TemporaryDirectory(prefix="advisor-") as folder:
                errors = before[-1].errors if before and not fallback else ()
                answer = advisor.propose(replace(request, folder=Path(folder), errors=errors))
            if not isinstance(answer, str):
                raise PlanError([f"answer: expected text, got {type(answer).__name__}"])
            answer = redact(answer)
            plan = parse_plan(answer, request.history, request.candidates)
            if redact(plan.model_dump()) != plan.model_dump(mode="json"):
                answer = REMOVED
                raise PlanError(["answer: it holds the value of a secret environment variable"])
        except Exception as error:  # no error of an advisor may end the loop
            if fallback:
                raise
            reasons = error.errors if isinstance(error, PlanError) else [f"{type(error).__name__}: {error}"]
            reasons = [redact(reason)[:LONGEST_ERROR] for reason in reasons]
            print(f"round {request.number}: {name} gave no plan: {'; '.join(reasons)[:500]}", flush=True)
            return Attempt(advisor=name, answer=str(answer)[:LONGEST_ANSWER], errors=reasons)
        text = answer if len(answer) <= LONGEST_ANSWER else plan.model_dump_json()
        return Attempt(advisor=name, answer=text)

    def _train(self, number: int, plan: Plan, history: History) -> list[Result]:
        """Train the candidates that have not ended; returns the results of all, in the plan's order."""
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
            print(describe_result(read_result(tasks[done.name]), history), flush=True)

        jobs = []
        for task in tasks.values():
            if task.ended:
                continue
            own = training_overrides(task, settings.final, settings.seed + number)
            jobs.append(make_job(task, [*LEADING, *settings.train, *own], settings.trust))
            print(f"{task.name}: log in {task.log}", flush=True)
        self.launcher.run(jobs, ended)
        return [read_result(task) for task in tasks.values()]
