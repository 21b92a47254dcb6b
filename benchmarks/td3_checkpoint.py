"""Converts the paper's TD3 networks to a run directory.

    python benchmarks/td3_checkpoint.py WEIGHTS.npz FOLDER

FOLDER becomes a run directory of `drift_td3_random` with the networks alone. `load_run` opens it, and `train` and
`tune` can start from it with start=FOLDER.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from pirl_rl import checkpoint
from pirl_rl.assembly import make_trainer
from pirl_rl.commands.composition import compose
from pirl_rl.configuration import save_config
from pirl_rl.run_directory import RunDirectory


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path)
    parser.add_argument("folder", type=Path)
    arguments = parser.parse_args()
    if arguments.folder.exists():
        parser.error(f"folder: expected a new folder, but {arguments.folder} exists")
    with np.load(arguments.weights, allow_pickle=False) as file:
        weights = {name: torch.from_numpy(file[name]) for name in file.files if name.endswith(("weight", "bias"))}
        update = int(file["itr"])
    config = compose("train", ["+experiment=drift_td3_random", "device=cpu"])
    loss = make_trainer(config).learner.loss
    state = loss.state_dict()
    ours = "{}_network_params.module.layers.{}.{}"
    for kind in ("weight", "bias"):
        for layer in (0, 2, 4):  # our first layer scales the inputs
            state[ours.format("actor", layer + 1, kind)] = weights[f"actor.net.{layer}.{kind}"]
        for layer in (0, 2, 4, 6):
            twins = [weights[f"critic.{twin}_net.net.{layer}.{kind}"] for twin in ("q1", "q2")]
            state[ours.format("qvalue", layer + 1, kind)] = torch.stack(twins)
    own = {name: entry for name, entry in state.items() if not name.startswith(checkpoint.TARGET)}
    loss.load_state_dict(checkpoint.loss_state({"loss": own}))
    save_config(config, arguments.folder)
    checkpoint.save({"loss": own, "update": update}, RunDirectory(arguments.folder).weights(update))


if __name__ == "__main__":
    main()
