"""`python -m pirl_rl.check`, see `pirl_rl.commands.check`; `pirl_rl.check(...)`, see `pirl_rl.checking.check`.

The command and the function have the same name. So this module can be called, which calls the function.
"""

import sys
from types import ModuleType

from pirl_rl.progress import announce


class _Check(ModuleType):
    def __call__(self, problem, dt=None, substeps=None):
        """The warnings and notes about a problem, whose errors raise: see `pirl_rl.checking.check`."""
        from pirl_rl import api

        return api.check(problem, dt, substeps)


sys.modules[__name__].__class__ = _Check


def main(*arguments) -> None:
    """The command, whose imports take some seconds."""
    from pirl_rl.commands.check import main as command

    command(*arguments)


if __name__ == "__main__":
    announce("loading torch and TorchRL")
    main()
