"""A walker that is to be tried by hand, and a server for it, for tests of what they answer."""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Iterator

from hrlspec.api import TrainedAgent
from hrlspec.run.commands.play import offer
from hrlspec.run.play.game import Game
from hrlspec.run.play.server import Server
from hrlspec.tasks.rewards import reward_machine
from tests.evaluation.scripted import manner, walker
from tests.run.replays import LETTER

SEED = 5
"""Of the first layout."""
AGENT = TrainedAgent(walker(LETTER), manner(), reward_machine(LETTER.propositions))


@functools.cache
def game() -> Game:
    return Game("walker", AGENT, greedy=True, shield=False, kept=False)


@contextlib.contextmanager
def serving() -> Iterator[Server]:
    with Server(0) as server:
        offer(server, game(), SEED)
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
