"""The page on which an agent is tried: the player's, with a form for the task and a layout to arrange."""

from __future__ import annotations

import string
from importlib import resources

from hrlspec.run.play.game import Game
from hrlspec.run.play.requests import MOST_TEXT, Arrangement
from hrlspec.run.replay.page import player_page, script_json

TEMPLATES = ("play.html", "play.css", "play.js")


def play_page(game: Game, seed: int) -> str:
    """The page.

    Args:
        game: what answers its requests.
        seed: of the layout that it begins with.
    """
    form, style, script = ((resources.files(__package__) / name).read_text(encoding="utf-8") for name in TEMPLATES)
    begin = {
        "world": game.env.name,
        "names": game.env.propositions,
        "examples": {language: game.example(language) for language in game.languages},
        "arrangement": game.arranged(Arrangement(seed, None)),
    }
    filled = string.Template(form).substitute(most=MOST_TEXT, begin=script_json(begin))
    return player_page("Play", game.name, None, form=filled, style=style, scripts=[script], connects="'self'")
