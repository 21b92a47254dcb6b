"""A substitute for a coding agent, as a program with two files or as a function of the prompt.

It raises the HJB weight of the last result while its reward holds, and else returns to the best result with a smaller
weight.
"""

from __future__ import annotations

import json
import sys

LEAST = 0.1
"""The weight after one that is 0, which no factor raises."""


def advise(prompt: str) -> dict:
    """A plan of one candidate from the record that the prompt shows."""
    record = json.loads(prompt.rsplit("```json", 1)[1].split("```")[0])
    results = [result for one in record["rounds"] for result in one["results"]]
    last = results[-1] if results else record["baseline"]
    held = last["metrics"].get("reward", 0) >= record["baseline"]["metrics"]["reward"] - record["tolerance"]
    begin, factor = (last, 3) if held else (record["baseline"], 0.5)
    td, hjb, boundary = begin["weights"]
    candidate = {
        "name": f"a{len(results) + 1}",
        "start_checkpoint": begin["checkpoint"],
        "schedule_initial": [td, hjb, boundary],
        "schedule_final": [td, factor * last["weights"][1] or LEAST, boundary],
        "schedule_center": 500,
        "schedule_sharpness": 0.02,
    }
    return {"round_note": "again" if "was refused" in prompt else "first", "candidates": [candidate]}


if __name__ == "__main__":
    source, target = sys.argv[1:]
    with open(source, encoding="utf-8") as file:
        plan = advise(file.read())
    with open(target, "w", encoding="utf-8") as file:
        json.dump(plan, file)
