"""`python -m pirl_rl.evaluate`, see `pirl_rl.commands.evaluate`; `pirl_rl.evaluate(...)`, see `pirl_rl.api.evaluate`.

The command and the function have the same name. So this module can be called, which calls the function.
"""

import sys
from types import ModuleType

from pirl_rl.progress import announce


class _Evaluate(ModuleType):
    def __call__(self, run, *, trust=(), **settings):
        """Evaluate a run again and return its metrics: see `pirl_rl.api.evaluate`."""
        from pirl_rl import api

        return api.evaluate(run, trust=trust, **settings)


sys.modules[__name__].__class__ = _Evaluate


def main(*arguments) -> None:
    """The command, whose imports take some seconds."""
    from pirl_rl.commands.evaluate import main as command

    command(*arguments)


if __name__ == "__main__":
    announce("loading torch and TorchRL")
    main()
