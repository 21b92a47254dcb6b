"""An advisor of one's own: it raises the weight of the HJB loss step by step."""

from pirl_rl.errors import ArgumentError
from pirl_rl.outer_loop.advisors import Request
from pirl_rl.outer_loop.advisors.continuation import starts
from pirl_rl.outer_loop.plan import Candidate, Plan


class Ladder:
    """Each candidate of a loop ends with a higher weight of the HJB loss than the candidate before it.

    Args:
        factor: the ratio of one weight to the one before it, above 1.

    Raises:
        ArgumentError: a factor that is not above 1.
    """

    def __init__(self, factor: float = 1.5):
        if not factor > 1:
            raise ArgumentError(f"advisor.factor: expected a number above 1, got {factor}")
        self.factor = factor

    def propose(self, request: Request) -> str:
        """A plan for one round as JSON, which the loop checks before it uses it."""
        candidates = []
        for start in starts(request.history, request.candidates):  # the best checkpoints so far
            td, hjb, boundary = start.weights
            rung = len(request.history.results) + len(candidates) + 1
            candidates.append(
                Candidate(
                    name=f"rung-{rung}",
                    start_checkpoint=str(start.checkpoint),
                    schedule_initial=start.weights,
                    schedule_final=(td, hjb * self.factor**rung, boundary),
                    schedule_center=request.updates / 2,
                    schedule_sharpness=10 / request.updates,
                )
            )
        plan = Plan(round_note=f"The HJB weight rises by {self.factor} each time.", candidates=candidates)
        return plan.model_dump_json(exclude_none=True)
