"""`python -m pirl_rl`, see `pirl_rl.commands.catalogue`."""

from pirl_rl.commands.catalogue import catalogue

if __name__ == "__main__":
    print(catalogue())
