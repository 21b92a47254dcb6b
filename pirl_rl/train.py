"""`python -m pirl_rl.train`: see `pirl_rl.commands.train`."""

from pirl_rl.commands.train import main

if __name__ == "__main__":
    main()
