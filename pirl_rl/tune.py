"""`python -m pirl_rl.tune`, see `pirl_rl.commands.tune`."""

from pirl_rl.commands.tune import main

if __name__ == "__main__":
    main()
