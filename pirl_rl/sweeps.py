"""`python -m pirl_rl.sweeps`, see `pirl_rl.runs.sweeps`."""

from pirl_rl.runs.sweeps import main

if __name__ == "__main__":
    main()
