"""The page of recorded episodes: its data say what was recorded, and it is one small file that loads nothing."""

from __future__ import annotations

import html.parser
import itertools
import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from hrlspec import checkpoint
from hrlspec.evaluation import ltl_suite
from hrlspec.evaluation.episodes import Episodes
from hrlspec.evaluation.recording import Deliberation, Record, Standing
from hrlspec.run.commands import replay
from hrlspec.run.errors import main_guard
from hrlspec.run.folder import open_run
from hrlspec.run.replay.data import Played, _automaton, page_data
from hrlspec.run.replay.page import SCRIPTS, page
from hrlspec.run.run_flags import experiments_of, parse_run
from hrlspec.spec import TaskState
from tests.agent_files.made import write_tiny
from tests.bare import Bare
from tests.run import tiny
from tests.run.replays import EPISODES, LETTER, at, played, tasks_of


def test_the_data_say_what_was_recorded() -> None:
    layouts, runs, data = played()
    assert [run["name"] for run in data["runs"]] == ["first", "last"]
    for run, some in zip(data["runs"], runs, strict=True):
        for i, episode in enumerate(run["episodes"]):
            record, steps = some.record, episode["steps"]
            assert steps == some.episodes.steps[i]
            assert episode["outcome"] == ("satisfied" if some.episodes.success[i] else "violated")
            rows = np.concatenate([record.before.position[:1, i], record.after.position[:steps, i]])
            np.testing.assert_array_equal(episode["places"], rows[:, ::-1].T + 0.5)
            for t in range(steps):
                assert at(episode["labels"], t) == [np.flatnonzero(record.before.labels[t, i]).tolist()]
                assert at(episode["standing"], t)[1] == record.before.state.node[t, i]
                assert at(episode["edges"], t) == [record.high.edge[t, i]]
                assert episode["values"][t] == round(float(record.value[t, i]), 3)
            assert episode["rewards"] == [[int(t), 1] for t in np.flatnonzero(record.reward[:steps, i])]
            decided = np.flatnonzero(record.high.made[:steps, i]).tolist()
            assert [decision["step"] for decision in episode["decisions"]] == decided
    first, last = (run["episodes"][0]["decisions"][0] for run in data["runs"])
    assert [branch[0] for branch in first["branches"]] == [branch[0] for branch in last["branches"]] == [1, 2]
    assert first["branches"][0][1] > first["branches"][1][1]
    assert last["branches"][0][1] < last["branches"][1][1]
    assert data["tasks"][0]["reach"][1:3] == [[0], [1]]
    names = {shape["name"] for shape in data["scenes"][0]["shapes"]}
    assert names == {*LETTER.propositions}
    assert len(data["scenes"]) == len(layouts) == EPISODES


def test_jumps_are_among_the_moves() -> None:
    suite = ltl_suite("some", "FG a", LETTER, forever=True)
    moves = _automaton(suite.automata, LETTER.propositions)["moves"]
    assert {(move["from"], move["to"], move["if"], move["accepts"]) for move in moves} == {
        (0, 1, "ε", False),
        (1, 1, "a", True),
        (1, 2, "!a", False),
    }


def test_an_automaton_comes_with_its_moves_and_the_trees_of_the_states_that_were_visited() -> None:
    _, (some, _), data = played(ltl=True)
    automaton = data["automaton"]
    where = {(move["from"], move["to"]): move["if"] for move in automaton["moves"]}
    steps = some.episodes.steps
    for i in range(EPISODES):
        seen = [int(some.record.before.task[0, i]), *some.record.after.task[: steps[i], i].tolist()]
        assert [change[1] for change in data["runs"][0]["episodes"][i]["standing"]] == [
            row for number, row in enumerate(seen) if not number or row != seen[number - 1]
        ]
        for t, (here, there) in enumerate(itertools.pairwise(seen)):
            if here != there:  # the condition of the move holds, in a world of one letter at a time
                (label,) = np.flatnonzero(some.record.after.labels[t, i])
                assert LETTER.propositions[label] in where[here, there].split(" | ")
        assert {*seen} <= {*data["tasks"]}
    assert len(automaton["satisfied"]) == len(automaton["violated"]) == 1


def test_a_world_that_cannot_be_drawn_has_no_scene() -> None:
    layouts, runs, data = played()
    bare = page_data(Bare(LETTER), "task", tasks_of(ltl=False), layouts, runs)
    assert bare["scenes"] == [None] * EPISODES
    (episode, *_), (drawn, *_) = (some["runs"][0]["episodes"] for some in (bare, data))
    assert episode == {**drawn, "places": None}


def test_the_page_is_one_small_file_that_refers_to_nothing() -> None:
    _, _, data = played()
    text = page(data)
    assert len(text.encode()) < 200_000
    assert not re.search(r"https?:|//[a-z]|@import|url\((?!#)", text)
    found: list[tuple[str, dict[str, str | None]]] = []
    parser = html.parser.HTMLParser()
    parser.handle_starttag = lambda tag, attributes: found.append((tag, dict(attributes)))  # type: ignore[method-assign]
    parser.feed(text)
    assert [attributes.get("href") for tag, attributes in found if tag == "link"] == ["data:,"]
    assert not [attributes for _, attributes in found if "src" in attributes]
    assert len({attributes["id"] for _, attributes in found if "id" in attributes}) == sum("id" in x for _, x in found)


def test_ten_episodes_of_a_thousand_steps_beside_ten_others_are_less_than_a_megabyte() -> None:
    data = page_data(LETTER, "task", tasks_of(ltl=False), *_long(horizon=1000, num_episodes=10))
    assert 100_000 < len(page(data).encode()) < 1_000_000


def _long(horizon: int, num_episodes: int) -> tuple[np.ndarray, list[Played]]:
    """Layouts and episodes in which everything that is measured differs at each step."""
    draw = np.random.default_rng(0)
    lead, nodes = (horizon, num_episodes), tasks_of(ltl=False).num_nodes
    layouts = np.repeat(played()[0][:1], num_episodes, 0)
    standing = Standing(
        position=draw.uniform(0, 6, (*lead, 2)),
        labels=draw.random((*lead, 5)) < 0.01,
        task=np.zeros(lead, int),
        state=TaskState(np.zeros(lead, int), np.zeros((*lead, nodes), bool), np.zeros(lead, int)),
    )
    nothing = np.zeros((*lead, nodes))
    high = Deliberation(np.zeros(lead, bool), np.ones(lead, int), nothing > 0, nothing[..., 0], nothing, nothing)
    record = Record(np.ones(lead, bool), standing, standing, high, nothing, draw.random(lead), np.zeros(lead))
    none = np.zeros(num_episodes)
    ended = Episodes(none > 0, none > 0, np.full(num_episodes, horizon), none, none, none > 0)
    return layouts, [Played(name, "drawn", ended, record) for name in ("one", "other")]


def test_text_of_a_task_cannot_end_the_script_it_stands_in() -> None:
    _, _, data = played()
    text = page({**data, "formula": "</script><script>alert(1)</script>"})
    assert text.count("</script>") == 2  # the record's and the program's
    assert "&lt;/script&gt;" in text
    (record,) = re.findall(r'<script type="application/json" id="record">(.*?)</script>', text)
    assert json.loads(record)["formula"] == "</script><script>alert(1)</script>"


def test_every_script_is_in_the_page() -> None:
    folder = Path(replay.__file__).parents[1] / "replay"
    assert {file.name for file in folder.glob("*.js")} == {*SCRIPTS}


# --- The command line. ---

ONE = ("--run", "run")
TO = ("--out", "page.html")
BAD_FLAGS: list[tuple[Sequence[str], str]] = [
    ((*ONE, "--spec", "achieve a"), "--out"),
    ((*TO, "--spec", "achieve a"), "expected one --run or --pretrained, or two different ones, found none"),
    ((*TO, *ONE), "expected either --spec or --ltl, found neither"),
    ((*TO, *ONE, "--spec", "achieve a", "--ltl", "F a"), "expected either --spec or --ltl, found both"),
    ((*TO, *ONE, "--spec", "achieve a", "--forever"), "--forever goes with --ltl"),
    ((*TO, *ONE, *ONE, "--spec", "achieve a"), "or two different ones, found run and run"),
    (
        (*TO, *ONE, "--run", "walk", "--run", "x", "--spec", "achieve a"),
        "or two different ones, found run and",
    ),
    ((*TO, *ONE, "--run", "walk", "--spec", "achieve a"), "run is of letter, walk of walk; side by side"),
    ((*TO, "--run", "nowhere", "--spec", "achieve a"), "nowhere is not a run folder"),
    ((*TO, *ONE, "--spec", "achieve a"), "no checkpoint in run"),
    ((*TO, *ONE, "--spec", ""), "found no formula"),
    ((*TO, *ONE, "--spec", "achieve z"), "--spec, line 1, column 9"),
    ((*TO, *ONE, "--ltl", "F (a"), "--ltl, line 1, column 5"),
    ((*TO, *ONE, "--ltl", "GF (a & G b)", "--forever"), "G F (a & G b) is none of what is read for ever"),
    ((*TO, *ONE, "--spec", "achieve a", "--episodes", "0"), "--episodes is 0"),
    ((*TO, *ONE, "--spec", "achieve a", "--episodes", "51"), "--episodes is 51"),
    ((*TO, *ONE, "--spec", "achieve a", "--seed", "-1"), "--seed is -1"),
    (("--out", "page.png", *ONE, "--spec", "achieve a"), "--out page.png: expected a file that ends in .html"),
    (("--out", "folder.html", *ONE, "--spec", "achieve a"), "--out folder.html: expected a file, found a folder"),
    (("--out", "file/page.html", *ONE, "--spec", "achieve a"), "cannot write to file: "),
]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working directory with runs that were begun, of two worlds, and one with parameters, also in a file."""
    folder = tmp_path_factory.mktemp("place")
    for name, flags in (("run", []), ("walk", ["--env", "walk"]), ("fresh", tiny.arguments(folder / "fresh"))):
        ((experiment, path),) = experiments_of(parse_run(["--out", str(folder / name), *flags]))
        with open_run(path, experiment, tensorboard=False):
            pass
    checkpoint.save(folder / "fresh" / "checkpoints", 3, {"params": write_tiny(folder / "it.safetensors", experiment)})
    (folder / "folder.html").mkdir()
    (folder / "file").write_text("x")
    return folder


@pytest.mark.parametrize(("flags", "message"), BAD_FLAGS, ids=[" ".join(flags)[:70] for flags, _ in BAD_FLAGS])
def test_bad_input(
    flags: Sequence[str],
    message: str,
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(place)
    before = {path: path.stat().st_mtime_ns for path in place.rglob("*")}
    assert main_guard(lambda: replay.main(flags)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert message in err
    assert {path: path.stat().st_mtime_ns for path in place.rglob("*")} == before


def test_the_command(place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(place)
    agents = "--run fresh --pretrained it.safetensors"
    flags = f"{agents} --spec|achieve a; (achieve b or achieve c)|--episodes 2 --out pages/one.html"
    spec = flags.split("|")
    replay.main([*spec[0].split(), spec[1], *spec[2].split()])
    assert "pages/one.html: 2 episodes in " in capsys.readouterr().out
    text = Path("pages/one.html").read_text()
    (record,) = re.findall(r'<script type="application/json" id="record">(.*?)</script>', text)
    data = json.loads(record)
    assert (data["formula"], data["world"]) == (spec[1], "letter")
    assert [(run["name"], run["method"], len(run["episodes"])) for run in data["runs"]] == [
        ("fresh", "ours", 2),
        ("it.safetensors", "ours", 2),
    ]
    assert data["runs"][0]["episodes"] == data["runs"][1]["episodes"]  # it is the same agent
