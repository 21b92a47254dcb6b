"""`python -m pirl_rl.suite`, see `pirl_rl.commands.suite`."""

from pirl_rl.commands.suite import main

if __name__ == "__main__":
    main()
