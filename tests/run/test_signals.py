"""Signals become a flag while asked to, and only then."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import pytest

from hrlspec.run import signals
from hrlspec.run.signals import SIGNALS, ended_by_signals, polled_signals


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What would be said where the process would end."""
    said: list[str] = []
    monkeypatch.setattr(signals, "_end", said.append)
    return said


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_sets_the_flag_and_the_second_does_not_wait(number: signal.Signals, ends: list[str]) -> None:
    before = signal.getsignal(number)
    with polled_signals("go on") as stop:
        assert not stop
        os.kill(os.getpid(), number)
        assert stop
        assert stop.signal_name == number.name
        stop.wait(1e6)
        assert not ends
        os.kill(os.getpid(), number)
        assert ends == ["go on"]
    assert signal.getsignal(number) is before


def test_with_nothing_to_save_the_first_does_not_wait(ends: list[str]) -> None:
    with polled_signals("go on") as stop:
        stop.patient = False
        os.kill(os.getpid(), signal.SIGINT)
        assert ends == ["go on"]


def test_the_innermost_context_hears(ends: list[str]) -> None:
    with ended_by_signals("outside"):
        with polled_signals() as stop:
            os.kill(os.getpid(), signal.SIGINT)
        assert stop
        assert not ends
        os.kill(os.getpid(), signal.SIGTERM)
        assert ends == ["outside"]
    assert not [thread for thread in threading.enumerate() if thread.name == "signals"]


BUSY = """
import ctypes, os, signal, sys, threading
from hrlspec.run.signals import ended_by_signals, polled_signals
def twice():
    os.kill(os.getpid(), signal.SIGINT)
    os.kill(os.getpid(), signal.SIGTERM)
with ended_by_signals(), polled_signals("go on") as stop:
    threading.Timer(0.1, twice).start()
    ctypes.CDLL(None).sleep(100)  # like a compiler: no instruction of Python's in the main thread
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no such function")
def test_what_keeps_the_main_thread_busy_does_not_keep_the_process() -> None:
    ended = subprocess.run([sys.executable, "-c", BUSY], capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "interrupted: go on\n")


def test_the_handlers_come_back_after_an_error() -> None:
    before = [signal.getsignal(number) for number in SIGNALS]
    with pytest.raises(ZeroDivisionError), polled_signals():
        raise ZeroDivisionError
    assert [signal.getsignal(number) for number in SIGNALS] == before


def test_another_thread_gets_a_flag_that_stays_unset() -> None:
    seen: list[bool] = []

    def work() -> None:
        with polled_signals() as stop:
            seen.append(bool(stop))

    before = [signal.getsignal(number) for number in SIGNALS]
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]
    assert [signal.getsignal(number) for number in SIGNALS] == before


LEAVING = """
import atexit, os, signal, time
from hrlspec.run.signals import leave
atexit.register(lambda: (os.kill(os.getpid(), signal.SIGINT), time.sleep(100)))
leave(0)
"""


def test_nothing_is_raised_while_the_interpreter_clears_up() -> None:
    ended = subprocess.run([sys.executable, "-c", LEAVING], capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (-signal.SIGINT, "", "")
