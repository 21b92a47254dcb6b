"""`python -m pirl_rl.report`, see `pirl_rl.commands.report`."""

from pirl_rl.progress import announce


def main(*arguments) -> None:
    """The command, whose imports take some seconds."""
    from pirl_rl.commands.report import main as command

    command(*arguments)


if __name__ == "__main__":
    announce("loading torch and TorchRL")
    main()
