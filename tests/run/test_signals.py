"""Signals become a flag while asked to, and only then."""

from __future__ import annotations

import os
import signal
import threading

import pytest

from hrlspec.run.signals import SIGNALS, polled_signals


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_sets_the_flag_and_the_second_does_not_wait(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with polled_signals() as stop:
        assert not stop
        os.kill(os.getpid(), number)
        assert stop
        assert stop.signal_name == number.name
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    assert signal.getsignal(number) is before


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
