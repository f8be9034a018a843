import signal
import threading

import pytest

from sb3_flock.training.signals import GracefulShutdown


@pytest.fixture(autouse=True)
def _default_handlers():
    """A background job inherits an ignored SIGINT; the handlers of before are set again at the end."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def work(number, caught):
    with GracefulShutdown().waiting() as signals:
        signal.raise_signal(number)
        caught.append(signals.caught)  # reached: the signal waits


@pytest.mark.parametrize(
    ("number", "raised", "code"),
    [(signal.SIGINT, KeyboardInterrupt, None), (signal.SIGTERM, SystemExit, 143), (signal.SIGHUP, SystemExit, 129)],
)
def test_a_signal_that_nothing_acted_on_acts_at_the_end(number, raised, code):
    caught, handler = [], signal.getsignal(number)
    with pytest.raises(raised) as error:
        work(number, caught)
    assert caught == [number]
    assert signal.getsignal(number) is handler
    assert getattr(error.value, "code", None) == code


def test_a_second_signal_acts_at_once():
    steps = []

    def impatient():
        with GracefulShutdown().waiting():
            signal.raise_signal(signal.SIGTERM)
            steps.append("first")
            signal.raise_signal(signal.SIGINT)
            steps.append("second")

    with pytest.raises(SystemExit):  # as the first one asked
        impatient()
    assert steps == ["first"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_without_a_signal_nothing_is_raised_and_the_handlers_are_set_again():
    with GracefulShutdown().waiting() as signals:
        assert signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    assert signals.caught is None
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_ignored_signal_stays_ignored():
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as under nohup
    with GracefulShutdown().waiting() as signals:
        signal.raise_signal(signal.SIGINT)
        assert signals.caught is None
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_in_another_thread_nothing_is_delayed():
    entered, leave = threading.Event(), threading.Event()

    def train():
        with GracefulShutdown().waiting():
            entered.set()
            leave.wait(10)

    thread = threading.Thread(target=train)
    thread.start()
    entered.wait(10)
    try:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    finally:
        leave.set()
        thread.join()
