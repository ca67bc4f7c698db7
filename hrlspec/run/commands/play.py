"""Serves a page on which tasks are typed and carried out: ``hrlspec play``, with ``--help`` for the flags.

Exit status: 2 bad usage or input; 130 interrupted, which is how it ends.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from hrlspec.config import Checked, setting
from hrlspec.run import platform
from hrlspec.run.console import result_console
from hrlspec.run.flags import parse_flags
from hrlspec.run.play.game import Game
from hrlspec.run.play.page import play_page
from hrlspec.run.play.requests import Arrangement, Attempt
from hrlspec.run.play.server import Server
from hrlspec.run.trained import check_named, check_shield, find_trained


@dataclasses.dataclass(frozen=True)
class PlayFlags(Checked):
    """Serves a page, on this machine alone, where you type a task, arrange a layout, and watch an agent carry it out.

    Exactly one of --run and --pretrained says which agent. Ctrl-C ends it.
    """

    run: Path | None = None
    """The run folder of the agent."""
    pretrained: str | None = None
    """An agent that comes along, by its name, such as letter; or the .safetensors file of one."""
    port: int = setting(0, least=0, most=65_535)
    """To listen on, at 127.0.0.1; 0 for any that is free."""
    seed: int = setting(0, least=0, most=2**30)
    """Of the first layout; each new one has the next."""
    greedy: bool = False
    """Take the most likely action and sub-task instead of sampling."""
    shield: bool = False
    """Replace actions that would step on forbidden propositions."""


def main(argv: Sequence[str], *, program: str = "hrlspec play") -> None:
    """The command line.

    Args:
        argv: the arguments.
        program: what to call it in messages.

    Raises:
        UserError: bad usage or input.
        CheckpointError: there is no usable checkpoint.
        AgentFileError: there is no such agent in a file, or it cannot be used.
    """
    flags = parse_flags(PlayFlags, argv, program=program)
    check_named(flags.run, flags.pretrained, None)
    source = find_trained(flags.run, flags.pretrained, None)
    with Server(flags.port) as server:
        platform.prepare()
        trained, _ = source.load()
        if flags.shield:
            check_shield(trained)
        name = flags.pretrained or source.run.resolve().name  # type: ignore[union-attr]  # one of them is given
        game = Game(name, trained, greedy=flags.greedy, shield=flags.shield, kept=not source.foreign)
        game.warm_up()
        offer(server, game, flags.seed)
        result_console().say(f"http://{server.hosts[0]}/ until Ctrl-C")
        server.serve_forever()


def offer(server: Server, game: Game, seed: int) -> None:
    """Has a server answer with a game, which begins with the layout of a seed."""
    server.page = play_page(game, seed).encode()
    server.answers = {
        "/layout": lambda request: game.arranged(Arrangement.read(request)),
        "/episode": lambda request: game.played(Attempt.read(request)),
    }
