"""The console command ``hrlspec``: one sub-command for each module of ``experiments/``.

Libraries that take seconds to load are imported when a command needs them: signals are heard before, and help is quick.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

from hrlspec.run.checkout import check_checkout
from hrlspec.run.errors import UserError, main_guard
from hrlspec.run.heartbeat import answer_supervisor
from hrlspec.run.signals import leave
from hrlspec.version import __version__

COMMANDS = {
    "run": "train an agent, evaluate it on unseen tasks, draw what it does",
    "launch": "the same with several processes of this machine, kept going",
    "evaluate": "evaluate a trained agent on tasks of your own, or draw it",
    "replay": "a page that plays episodes of trained agents, with what they thought",
    "play": "a page, served on this machine, where you type a task and watch an agent carry it out",
    "export": "an agent as a file of parameters and a card that says what it is",
    "runs": "the run folders there are, and how far each has come",
    "sweep": "many runs: a grid of settings and seeds, on this machine or a Ray cluster",
    "compare": "learning curves, results and differing settings of several runs",
    "demo": "the paper's two motivating examples, trained and drawn",
    "reproduce": "the paper's figures, in a checkout of the project",
    "peers": "agents on formulas of others, beside published results, in a checkout",
    "pretrain": "the agents that come along, trained anew, in a checkout of the project",
    "suites": "draw the test suites anew, or check them",
}
_IN_CHECKOUT = ("reproduce", "peers", "pretrain")


def main(argv: Sequence[str] | None = None) -> int:
    """The command ``hrlspec``; returns its exit status.

    Args:
        argv: the arguments, those of the process by default.
    """
    name, *rest = (sys.argv[1:] if argv is None else argv) or [""]
    if name in ("-h", "--help"):
        return main_guard(lambda: print(_help()))
    if name == "--version":
        return main_guard(lambda: print(f"hrlspec {__version__}"))
    return call(name, rest, program=f"hrlspec {name}")


def call(name: str, argv: Sequence[str] | None = None, *, program: str) -> int:
    """Runs a command and returns its exit status; see `main_guard`.

    Args:
        name: one of `COMMANDS`.
        argv: the command's arguments, those of the process by default.
        program: what the user called, for messages.
    """

    def command() -> None:
        answer_supervisor()
        _command(name)(sys.argv[1:] if argv is None else argv, program=program)

    return main_guard(command)


def _help() -> str:
    return "\n".join(
        [
            "usage: hrlspec COMMAND [OPTIONS]",
            "\nZero-shot reinforcement learning from logical specifications.\n\ncommands:",
            *(f"  {command:<10} {about}" for command, about in COMMANDS.items()),
            "\nhrlspec COMMAND --help shows the options; hrlspec --version the version.",
        ]
    )


def _command(name: str) -> Callable[..., None]:
    """The command's main function.

    Raises:
        UserError: there is none, or it cannot run here.
    """
    if name not in COMMANDS:
        raise UserError(f"expected a command, one of {', '.join(COMMANDS)}, found {name!r} (see hrlspec --help)")
    if name in _IN_CHECKOUT:
        check_checkout(name)
        from hrlspec.run.lookup import search_here

        search_here()
    package = "experiments" if name in _IN_CHECKOUT else "hrlspec.run.commands"
    try:
        command: Callable[..., None] = importlib.import_module(f"{package}.{name}").main
    except ModuleNotFoundError as error:
        if error.name not in ("tyro", "rich"):
            raise
        raise UserError('the commands need the extra "cli": pip install "hrlspec[cli]"') from error
    return command


def console() -> NoReturn:
    """The process ``hrlspec``."""
    leave(main())


if __name__ == "__main__":
    console()
