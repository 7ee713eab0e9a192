"""Commands in forks of the process that runs the tests, with standard streams of their own.

A command in a new interpreter first imports for seconds what the tests have imported already. What only the end of an
interpreter does, a fork does here: it waits for threads, and it reports an output that cannot be flushed.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

from lexsplat.__main__ import main
from support.warm_starts import Ended

Streams = tuple[int, int, int]
"""Descriptors of standard input, output and error."""


class Command:
    """``lexsplat WORDS``, or another program with these words, in a fork; standard error goes to a file.

    Args:
        *words: The command and its arguments.
        program: What is run.
        encoding: Of its standard streams.
        heard: Whether standard output has a reader.
        prepare: What the fork does before the command.
    """

    def __init__(
        self,
        *words: str,
        program: Callable[[], int | None] = main,
        encoding: str = "utf-8",
        heard: bool = True,
        prepare: Callable[[], object] = lambda: None,
    ) -> None:
        (their_in, our_in), (our_out, their_out) = os.pipe(), os.pipe()
        self.stdin, self.stdout = open(our_in, "wb"), open(our_out, "rb")  # noqa: SIM115
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        self._status: int | None = None
        if not heard:
            self.stdout.close()
        self._child = os.fork()
        if self._child == 0:
            os.close(our_in)
            if heard:
                os.close(our_out)
            _run(words, program, (their_in, their_out, self._errors.fileno()), encoding, prepare)
        os.close(their_in)
        os.close(their_out)

    def say(self, text: str) -> None:
        """Write to standard input."""
        self.stdin.write(text.encode("utf-8", "surrogateescape"))
        self.stdin.flush()

    def send_signal(self, number: int) -> None:
        os.kill(self._child, number)

    def wait(self, seconds: float = 300) -> int:
        """The exit status, negative if a signal ended it; a command that takes longer is killed."""
        deadline = time.monotonic() + seconds
        while self._status is None:
            done, status = os.waitpid(self._child, os.WNOHANG)
            if done:
                self._status = os.waitstatus_to_exitcode(status)
            elif time.monotonic() > deadline:
                self.send_signal(signal.SIGKILL)
                deadline = float("inf")
            else:
                time.sleep(0.005)
        return self._status

    def ended(self, said: str = "", seconds: float = 300) -> Ended:
        """What it answers to a last line of input and its end."""
        with contextlib.suppress(BrokenPipeError):
            self.say(said)
        with contextlib.suppress(BrokenPipeError):
            self.stdin.close()
        out = b"" if self.stdout.closed else self.stdout.read()
        return Ended(self.wait(seconds), out.decode("utf-8", "replace"), self.errors())

    def errors(self) -> str:
        """What it has written to standard error so far."""
        self._errors.seek(0)
        return self._errors.read().decode("utf-8", "replace")

    def __enter__(self) -> Command:
        return self

    def __exit__(self, *_: object) -> None:
        if self._status is None:
            self.send_signal(signal.SIGKILL)
            self.wait()
        with contextlib.suppress(BrokenPipeError):
            self.stdin.close()
        self.stdout.close()
        self._errors.close()


_RELAY = """
import os, socket, sys
with socket.socket(socket.AF_UNIX) as place:
    place.connect(sys.argv[1])
    socket.send_fds(place, [b"."], [0, 1, 2])
    os._exit(int(place.recv(8) or 1))
"""
"""Hands its standard streams to the command that listens at a socket, and ends with its status."""


@contextlib.contextmanager
def startable(*words: str) -> Iterator[list[str]]:
    """A program with arguments that runs ``lexsplat WORDS`` once in a fork, for those who start it themselves."""
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as listening:
        place = str(Path(folder, "streams"))
        listening.bind(place)
        listening.listen()
        child = os.fork()
        if child == 0:
            connection, _ = listening.accept()
            _, streams, _, _ = socket.recv_fds(connection, 1, 3)
            told = lambda status: connection.send(str(status).encode())  # noqa: E731
            _run(words, main, (streams[0], streams[1], streams[2]), "utf-8", lambda: None, told)
        try:
            yield [sys.executable, "-I", "-S", "-c", _RELAY, place]
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)


def _run(
    words: tuple[str, ...],
    program: Callable[[], int | None],
    streams: Streams,
    encoding: str,
    prepare: Callable[[], object],
    told: Callable[[int], object] = lambda status: None,
) -> None:
    """Run a program on these standard streams, and end the process."""
    status = 1
    try:
        for number, stream in enumerate(streams):
            os.dup2(stream, number)
            os.close(stream)
        sys.stdin = open(0, encoding=encoding, closefd=False)  # noqa: SIM115
        sys.stdout, sys.stderr = (
            open(number, "w", encoding=encoding, errors=errors, closefd=False)  # noqa: SIM115
            for number, errors in ((1, "strict"), (2, "backslashreplace"))
        )
        logging.getLogger().handlers.clear()  # those of pytest
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.environ["TOKENIZERS_PARALLELISM"] = "false"  # else it warns of forks
        prepare()
        sys.argv = ["lexsplat", *words]
        status = program() or 0
        for thread in threading.enumerate():
            if thread is not threading.current_thread() and not thread.daemon:
                thread.join()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        try:
            sys.stdout.flush()
        except OSError:
            traceback.print_exc()
            status = 120  # as an interpreter ends
        sys.stderr.flush()
        told(status)
        os._exit(status)
