"""Trying an agent by hand: what the server answers, whom it refuses, and what the command says."""

from __future__ import annotations

import http.client
import json
import os
import queue
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from hrlspec.api import TrainedAgent
from hrlspec.evaluation import record_episodes, suite_from_text
from hrlspec.run.commands import play
from hrlspec.run.errors import main_guard
from hrlspec.run.play.game import Game
from hrlspec.run.play.requests import MOST_TEXT, Arrangement, RequestError
from hrlspec.run.play.server import MOST_BODY, Server
from hrlspec.run.replay import recorder
from tests.bare import Bare
from tests.evaluation.scripted import manner, walker
from tests.run.replays import LETTER
from tests.run.served import AGENT, SEED, serving

TASK = "achieve a; achieve b ensuring not c"
ASKED = {"language": "spec", "task": TASK, "seed": SEED, "places": None, "draw": 0}


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving() as started:
        yield started


def ask(
    server: Server, path: str, body: bytes | None = None, headers: Mapping[str, str] | None = None
) -> tuple[int, Any]:
    """Status, and the page or the object that was answered; None as a header leaves it out."""
    origin = {"Origin": f"http://{server.hosts[0]}", "Content-Type": "application/json"}
    sent = {**(origin if body is not None else {}), **(headers or {})}
    request = urllib.request.Request(f"http://{server.hosts[0]}{path}", body, sent)
    try:
        with urllib.request.urlopen(request, timeout=120) as answer:
            status, kind, text = answer.status, answer.headers.get_content_type(), answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            status, kind, text = error.code, error.headers.get_content_type(), error.read().decode()
    return status, json.loads(text) if kind == "application/json" else text


def post(server: Server, path: str, request: Any, **headers: str) -> tuple[int, Any]:
    return ask(server, path, json.dumps(request).encode(), headers)


def test_the_page(server: Server) -> None:
    status, text = ask(server, "/")
    assert status == 200
    assert '<textarea id="task"' in text
    assert "connect-src 'self';" in text
    assert "https:" not in text
    assert "http:" not in text


def test_an_episode_is_what_the_agent_does(server: Server) -> None:
    """The same as recorded without padding, programs, and server."""
    status, data = post(server, "/episode", ASKED)
    assert (status, data["notes"], data["formula"]) == (200, [], TASK)
    key = jax.random.split(jax.random.key(SEED), 1)
    layouts = jax.vmap(LETTER.sample_layout, (0, None))(key, LETTER.default_params)
    tasks = suite_from_text("task", TASK, LETTER.propositions).trees
    ended, record = jax.device_get(
        record_episodes(jax.random.key(1), AGENT.agent, AGENT.params, AGENT.rewards, tasks, layouts, greedy=True)
    )
    (run,) = data["runs"]
    (episode,) = run["episodes"]
    steps = int(ended.steps[0])
    assert (episode["outcome"], episode["steps"]) == ("satisfied", steps)
    rows = np.concatenate([record.before.position[:1, 0], record.after.position[:steps, 0]])
    np.testing.assert_array_equal(episode["places"], rows[:, ::-1].T + 0.5)


def test_every_task_and_layout_takes_the_same_program(server: Server) -> None:
    before = recorder._record_program.cache_info().misses
    for task, seed in (("achieve d", 1), ("achieve a; (achieve b or achieve c) ensuring not d", 2)):
        assert post(server, "/episode", {**ASKED, "task": task, "seed": seed})[0] == 200
    assert recorder._record_program.cache_info().misses <= max(before, 1)


def test_a_formula(server: Server) -> None:
    status, data = post(server, "/episode", {**ASKED, "language": "ltl", "task": "F (a & F b) & G !c"})
    assert status == 200
    assert data["automaton"]["satisfied"]
    status, data = post(server, "/episode", {**ASKED, "language": "ltl", "task": "GF a", "forever": True})
    assert status == 200
    assert data["runs"][0]["episodes"][0]["rounds"] > 1


@pytest.mark.parametrize(
    ("language", "task", "column", "message"),
    [
        ("spec", "achieve z", 9, "unknown proposition 'z'"),
        ("spec", "achieve a;", 11, "found the end"),
        ("spec", " ", None, "found no formula"),
        ("spec", "; ".join(["(achieve a or achieve b)"] * 6), 2, "max_nodes is 64"),
        ("ltl", "F (a", 5, "expected"),
        ("ltl", "F (a & \ud800)", 8, "expected a proposition"),
    ],
)
def test_a_task_that_cannot_be_read(server: Server, language: str, task: str, column: int | None, message: str) -> None:
    status, said = post(server, "/episode", {**ASKED, "language": language, "task": task})
    assert status == 422
    assert message in said["message"]
    assert (said["line"], said["column"]) == (column and 1, column)


def test_what_is_odd_about_a_task_comes_with_it(server: Server) -> None:
    _, data = post(server, "/episode", {**ASKED, "task": "achieve a or achieve (a and b)"})
    (note,) = data["notes"]
    assert "shadows" in note


def test_a_layout_is_changed_and_played(server: Server) -> None:
    _, drawn = post(server, "/layout", {"seed": SEED, "places": None})
    places = [place for _, *place in drawn["things"]]
    first = drawn["things"][0]
    free = next([x + 0.5, 0.5] for x in range(1, 7) if [x + 0.5, 0.5] not in places)
    wanted = [free, *places[1:]]
    status, moved = post(server, "/layout", {"seed": SEED, "places": wanted})
    assert status == 200
    assert moved["things"] == [[first[0], *free], *drawn["things"][1:]]
    shapes = {(shape["name"], shape["x"], shape["y"]) for shape in moved["scene"]["shapes"]}
    assert shapes == {tuple(thing) for thing in moved["things"]}
    _, data = post(server, "/episode", {**ASKED, "places": wanted})
    assert data["scenes"] == [moved["scene"]]


PLACES: list[tuple[Any, str]] = [
    ([[0.5, 0.5]] * 10, "two letters are in one cell"),
    ([[0.5, 0.5]], "found 1 places, 10 things can be moved"),
    ([[7.5, 0.5]] * 10, "outside of the grid"),
    ([[-1, 0.5]] * 10, "outside of the grid"),
    ([[1e300, 0.5]] * 10, "expected two numbers"),
    ([[float("nan"), 0.5]] * 10, "expected two numbers"),
    ([[float("inf"), 0.5]] * 10, "expected two numbers"),
    ([[10**400, 0.5]] * 10, "expected two numbers"),
    ([[True, 0.5]] * 10, "expected two numbers"),
    ([[1, 2, 3]], "expected two numbers"),
    ([1, 2], "expected two numbers"),
    ("abc", "no list of pairs"),
    ([[1, 2]] * 1001, "no list of pairs"),
    ([], "found 0 places"),
]


@pytest.mark.parametrize(("places", "message"), PLACES)
@pytest.mark.parametrize("path", ["/layout", "/episode"])
def test_layouts_that_cannot_be(server: Server, path: str, places: Any, message: str) -> None:
    status, said = post(server, path, {**ASKED, "places": places})
    assert (status, message in said["message"]) == (422, True), said


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": -1}, "seed is -1"),
        ({"seed": 2**31}, "seed is 2147483648"),
        ({"seed": 1.5}, "seed is 1.5"),
        ({"seed": True}, "seed is True"),
        ({"draw": None}, "draw is None"),
        ({"language": "python"}, "language is 'python'"),
        ({"language": ["x" * 100]}, "..., expected spec or ltl"),
        ({"task": 5}, "task is 5"),
        ({"task": "a" * (MOST_TEXT + 1)}, f"{MOST_TEXT} are possible"),
        ({"forever": True}, "forever goes with ltl"),
        ({"forever": "yes", "language": "ltl"}, "forever goes with ltl"),
    ],
)
def test_requests_that_cannot_be_meant(server: Server, change: Mapping[str, Any], message: str) -> None:
    status, said = post(server, "/episode", {**ASKED, **change})
    assert (status, message in said["message"]) == (422, True), said


@pytest.mark.parametrize("body", [b"", b"{", b"[1]", b"\xff", b"[" * 50_000, b'{"seed": ' + b"9" * 5000 + b"}"])
def test_bodies_that_are_no_object(server: Server, body: bytes) -> None:
    assert ask(server, "/layout", body)[0] == 422


@pytest.mark.parametrize("host", ["example.org", "127.0.0.1", "127.0.0.1:1", "localhost", "[::1]", ""])
@pytest.mark.parametrize("path", ["/", "/layout"])
def test_it_answers_to_its_own_name_alone(server: Server, host: str, path: str) -> None:
    """Another name may have been bound to this address, by a page that then reads what it gets."""
    body = None if path == "/" else b"{}"
    status, said = ask(server, path, body, {"Host": host})
    assert (status, said) == (421, {"message": f"this is {server.hosts[0]}"})


def test_it_is_localhost_too(server: Server) -> None:
    assert ask(server, "/", None, {"Host": server.hosts[1]})[0] == 200
    assert post(server, "/layout", ASKED, Host=server.hosts[1], Origin=f"http://{server.hosts[1]}")[0] == 200


@pytest.mark.parametrize("origin", ["http://example.org", "null", "", "https://127.0.0.1", "http://127.0.0.1:1"])
def test_other_pages_are_refused(server: Server, origin: str) -> None:
    status, said = post(server, "/episode", ASKED, Origin=origin)
    assert (status, said) == (403, {"message": "another page sent this"})


def raw(server: Server, head: str, body: bytes = b"") -> int:
    """The status that a request as it stands is answered with."""
    with socket.create_connection(server.server_address, timeout=30) as connection:
        connection.sendall(head.replace("\n", "\r\n").encode() + b"\r\n\r\n" + body)
        answer = http.client.HTTPResponse(connection)
        answer.begin()
        return answer.status


def test_bodies_of_no_length_or_too_long_a_one_are_not_read(server: Server) -> None:
    host = server.hosts[0]
    head = f"POST /layout HTTP/1.1\nHost: {host}\nOrigin: http://{host}\nContent-Type: application/json"
    assert raw(server, head) == 411
    assert raw(server, f"{head}\nContent-Length: -1") == 411
    assert raw(server, f"{head}\nTransfer-Encoding: chunked", b"2\r\n{}\r\n0\r\n\r\n") == 411
    assert raw(server, f"{head}\nContent-Length: {MOST_BODY + 1}") == 413
    assert raw(server, f"{head}\nContent-Length: {'9' * 5000}") == 413
    assert raw(server, head.replace("\nOrigin: http://" + host, "") + "\nContent-Length: 2", b"{}") == 403
    assert post(server, "/layout", ASKED, **{"Content-Type": "text/plain"})[0] == 415


def test_nothing_else_is_there(server: Server) -> None:
    for path in ("/other", "/layout", "/../etc/passwd", "/?x"):
        assert ask(server, path)[0] == 404
    for path in ("/", "/other", "/layout/"):
        assert post(server, path, ASKED)[0] == 404
    assert raw(server, f"PUT / HTTP/1.1\nHost: {server.hosts[0]}") == 501
    status, _ = ask(server, "/")
    assert status == 200  # it goes on


def test_it_listens_on_the_loopback_alone(server: Server) -> None:
    assert server.server_address[0] == "127.0.0.1"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing, but chooses the address that others see
        except OSError:
            pytest.skip("this machine has no other address")
        address = probe.getsockname()[0]
    if address.startswith("127."):
        pytest.skip("this machine has no other address")
    with socket.socket() as caller:
        caller.settimeout(5)
        assert caller.connect_ex((address, server.server_address[1])) != 0


def test_mistakes_of_the_program_are_said_and_do_not_end_it(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: queue.Queue[BaseException | None] = queue.Queue()

    def broken(request: Mapping[str, Any]) -> Any:
        raise ZeroDivisionError(request["seed"])

    monkeypatch.setattr(server, "answers", {"/layout": broken})
    monkeypatch.setattr(server, "handle_error", lambda *_: shown.put(sys.exception()))
    assert post(server, "/layout", ASKED) == (500, {"message": "a mistake in hrlspec: ZeroDivisionError"})
    assert isinstance(shown.get(timeout=60), ZeroDivisionError)
    assert ask(server, "/")[0] == 200


def test_a_world_that_can_do_less_is_played_in_random_layouts() -> None:
    bare = Bare(LETTER)
    game = Game("walker", TrainedAgent(walker(bare), manner(), AGENT.rewards), greedy=True, shield=False, kept=False)
    assert game.arranged(Arrangement(3, None)) == {"seed": 3, "scene": None, "agent": None, "things": []}
    with pytest.raises(RequestError, match="nothing can be moved in the layouts of bare letter"):
        game.arranged(Arrangement(3, np.zeros((1, 2))))


# --- The command line. ---

LETTERS = ("--pretrained", "letter")
BAD_FLAGS: list[tuple[Sequence[str], str]] = [
    ((), "expected exactly one of --run and --pretrained, found none"),
    ((*LETTERS, "--run", "x"), "expected exactly one of --run and --pretrained, found both"),
    (("--pretrained", "nobody"), "cannot use nobody"),
    (("--run", "nowhere"), "nowhere is not a run folder"),
    ((*LETTERS, "--port", "65536"), "--port is 65536"),
    ((*LETTERS, "--port", "-1"), "--port is -1"),
    ((*LETTERS, "--seed", "-1"), "--seed is -1"),
    ((*LETTERS, "--host", "0.0.0.0"), "--host"),
]


@pytest.mark.parametrize(("flags", "message"), BAD_FLAGS, ids=[" ".join(flags) or "none" for flags, _ in BAD_FLAGS])
def test_bad_input(flags: Sequence[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main_guard(lambda: play.main(flags)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert message in err


def test_a_port_that_is_in_use(server: Server, capsys: pytest.CaptureFixture[str]) -> None:
    port = server.server_address[1]
    assert main_guard(lambda: play.main([*LETTERS, "--port", str(port)])) == 2
    out, err = capsys.readouterr()
    assert (out, err) == ("", f"error: --port {port}: it is in use; choose another, or 0 for any that is free\n")


@pytest.mark.slow
def test_the_command_until_ctrl_c() -> None:
    command = [sys.executable, "-m", "experiments.play", *LETTERS]
    environ = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environ) as process:
        assert process.stdout is not None
        address = process.stdout.readline().split()[0]
        with urllib.request.urlopen(address) as answer:
            assert "<title>Play: letter</title>" in answer.read().decode()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (130, "", "interrupted\n")
