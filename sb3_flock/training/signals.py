"""SIGINT, SIGTERM and SIGHUP during a training: the training saves first, then stops."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

_SIGNALS = [signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]
"""An interrupt, a request to end, and a terminal that closes, which Windows does not have."""


class GracefulShutdown:
    """Delays these signals until the training has saved; a second signal acts at once.

    Python delivers signals to the main thread alone: in any other thread nothing is delayed.
    """

    def __init__(self) -> None:
        self.caught: int | None = None

    @contextlib.contextmanager
    def waiting(self) -> Iterator[GracefulShutdown]:
        """Delay signals within the context; a signal still pending at its end acts then."""
        if threading.current_thread() is not threading.main_thread():
            yield self
            return
        before = {number: signal.getsignal(number) for number in _SIGNALS}
        taken = {number: handler for number, handler in before.items() if handler != signal.SIG_IGN}  # as under nohup
        for number in taken:
            signal.signal(number, self._keep)
        try:
            yield self
        finally:
            for number, handler in taken.items():
                signal.signal(number, handler)
        if self.caught is not None:
            self.act()

    def _keep(self, number: int, frame: FrameType | None) -> None:
        if self.caught is not None:
            self.act()
        self.caught = number

    def act(self) -> None:
        """Raise what the caught signal asks for.

        :raises KeyboardInterrupt: for SIGINT
        :raises SystemExit: for the others, with 128 and the signal's number as the code
        """
        assert self.caught is not None
        if self.caught == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + self.caught)
