"""`python -m pirl_rl.evaluate`: see `pirl_rl.commands.evaluate`."""

from pirl_rl.commands.evaluate import main

if __name__ == "__main__":
    main()
