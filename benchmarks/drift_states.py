"""Makes the reference states of the drifting problem, `pirl_rl/problems/drift/reference_states.npz`.

    python benchmarks/drift_states.py WEIGHTS/refnet_td3rand_10M.npz [--seed SEED] [--out FILE]

Recipes and models were chosen on the draws 0, which is the file of the package, to 8. The draws 11 to 18, in
`benchmarks/draws`, are for figures that are published: nothing was chosen on them.

The recipe in `pirl_rl.problems.drift.reference_states` is the paper's protocol for its table of accuracy, with another
seed. The paper's TD3 policy for a random horizon plays 1,024 episodes without exploration noise. They start from the
paper's distribution of full scale (friction uniform in [0.5, 0.6]; 30% displaced in the beta-r plane, 30% in the
e_y-e_psi plane, 40% in both) with 1 to 50 steps to go, in the paper's simulator (Euler steps of 0.1 s, exits at end
points). Of the states before each step, 512 are moved in a random direction of the paper's network coordinates (tau and
all seven states scaled to [-1, 1]) by a length uniform in [0, 0.40] and clipped. States in the closed target or avoid
set, or with tau = 0, are dropped. Five groups of equal size follow from the mean distance to the ten nearest visited
states.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from drift_baselines import Baseline

from pirl_rl.problems.drift.reference_states import FILE, drift_states


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=FILE)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    baseline = Baseline(arguments.weights)
    states = drift_states(baseline.policy, arguments.seed)
    states.save(arguments.out)
    outside = baseline.problem.unreachable(states.x).float().mean()
    print(f"{len(states.x)} states, {outside:.1%} with friction outside the band, in {arguments.out}")


if __name__ == "__main__":
    main()
