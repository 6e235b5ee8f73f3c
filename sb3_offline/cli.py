"""The program ``sb3-offline``, which runs one of :mod:`sb3_offline.commands`."""

import argparse
import importlib
import sys

from sb3_offline.commands import COMMANDS
from sb3_offline.data.errors import printable

_EXTRAS = {
    "metaworld": "metaworld",
    "mujoco": "metaworld",
    "matplotlib": "plots",
    "minari": "minari",
    "pyarrow": "imitation",
    "ray": "ray",
    "rliable": "report",
}
"""The extra of this package that installs each optional package."""


def main(argv: list[str] | None = None) -> None:
    """
    Run a command. Errors that the user can mend end the program with one line.

    :param argv: the command line (default: ``sys.argv``)
    """
    argv = sys.argv[1:] if argv is None else argv
    try:
        arguments = _parser(argv[:1]).parse_args(argv)
        arguments.run(arguments)
    except (RuntimeError, ValueError, OSError) as error:
        sys.exit(f"sb3-offline: {printable(str(error))}")
    except ModuleNotFoundError as error:
        extra = _EXTRAS.get((error.name or "").split(".")[0])
        if extra is None:
            raise
        sys.exit(f'sb3-offline: {error}; install it with: pip install "sb3-offline[{extra}]"')
    except Exception as error:
        if type(error).__module__ != "gymnasium.error":
            raise
        sys.exit(f"sb3-offline: {printable(str(error))}")


def _parser(chosen: list[str]) -> argparse.ArgumentParser:
    """
    :param chosen: the command whose options are needed, or an empty list
    :return: a parser that knows all commands, and the options of the chosen one
    """
    parser = argparse.ArgumentParser(prog="sb3-offline", description="Offline reinforcement learning for Stable-Baselines3")
    commands = parser.add_subparsers(required=True, metavar="command")
    for name, text in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        if name in chosen:
            module = importlib.import_module(f"sb3_offline.commands.{name.replace('-', '_')}")
            module.add_arguments(command)
            command.set_defaults(run=module.run)
    return parser


if __name__ == "__main__":
    main()
