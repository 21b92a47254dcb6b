"""`python -m pirl_rl.export`, see `pirl_rl.commands.export`."""

from pirl_rl.commands.export import main

if __name__ == "__main__":
    main()
