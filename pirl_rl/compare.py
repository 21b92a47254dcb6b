"""`python -m pirl_rl.compare`, see `pirl_rl.runs.compare`."""

from pirl_rl.runs.compare import main

if __name__ == "__main__":
    main()
