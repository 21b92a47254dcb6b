"""`python -m pirl_rl.train`, see `pirl_rl.commands.train`; `pirl_rl.train(...)`, see `pirl_rl.api.train`.

The command and the function have the same name. So this module can be called, which calls the function.
"""

import sys
from types import ModuleType

from pirl_rl.progress import announce


class _Train(ModuleType):
    def __call__(self, problem_or_experiment, *, folder=None, **settings):
        """Train a problem or an experiment and return its `Run`: see `pirl_rl.api.train`."""
        from pirl_rl import api

        return api.train(problem_or_experiment, folder=folder, **settings)


sys.modules[__name__].__class__ = _Train


def main(*arguments) -> None:
    """The command, whose imports take some seconds."""
    from pirl_rl.commands.train import main as command

    command(*arguments)


if __name__ == "__main__":
    announce("loading torch and TorchRL")
    main()
