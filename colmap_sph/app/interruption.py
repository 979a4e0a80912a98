"""Ctrl-C, SIGTERM and the end of the terminal end the program within two seconds, whatever it is at.

Python tells the main thread of a signal only between two steps of Python code, and a worker cannot be stopped in
the middle of a kernel. As all files appear only when they are complete, the process may be ended at any moment.
"""

import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from colmap_sph.platforms.processes import ENDING, exit_code_of

# Seconds for the orderly end, in which workers may finish what they have begun, and for the last words.
_GRACE = 1.2
_LAST_WORDS = 0.3


class Interrupted(KeyboardInterrupt):
    """A signal asks for the end.

    Attributes
    ----------
    signal_number : int
    """

    def __init__(self, signal_number: int) -> None:
        super().__init__(f"signal {signal_number}")
        self.signal_number = signal_number

    @property
    def exit_code(self) -> int:
        """What a shell reports of a program that this signal ended."""
        return exit_code_of(self.signal_number)


@contextmanager
def stop_on_signals(last_words: Callable[[Interrupted], None]) -> Iterator[None]:
    """Raise `Interrupted` at the signals `ENDING`; where that takes too long, end the process.

    Outside of the main thread, which alone receives signals, nothing is changed.

    Parameters
    ----------
    last_words : callable
        Called in a thread of its own before the process is ended: to say so, and to flush what is buffered.
    """
    # A shell without job control has background jobs ignore SIGINT, and nohup is meant to.
    wanted = [number for number in ENDING if signal.getsignal(number) is not signal.SIG_IGN]
    if threading.current_thread() is not threading.main_thread() or not wanted:
        yield
        return
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    finished = threading.Event()
    told = threading.Event()

    def stop(number: int, _: FrameType | None) -> None:
        if not told.is_set():  # once is enough: a second one would only disturb the orderly end
            told.set()
            raise Interrupted(number)

    def watch() -> None:
        while received := receiver.recv(1):
            if received[0] in wanted and not finished.wait(_GRACE):
                _end_process(Interrupted(received[0]), last_words)

    before = {number: signal.signal(number, stop) for number in wanted}
    # The system writes a signal's number there at once, even while the main thread is inside a library.
    wakeup = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        finished.set()
        signal.set_wakeup_fd(wakeup)
        for number, handler in before.items():
            signal.signal(number, handler)
        sender.close()
        watcher.join()
        receiver.close()


def _end_process(stop: Interrupted, last_words: Callable[[Interrupted], None]) -> None:
    # Whoever is inside the terminal's or the log's lock must not keep the process alive.
    speaker = threading.Thread(target=last_words, args=(stop,), daemon=True)
    speaker.start()
    speaker.join(_LAST_WORDS)
    os._exit(stop.exit_code)
