"""Wiring of the controls: event handlers, background work, and values set by the server."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from lexsplat.runtime.errors import LexsplatError

logger = logging.getLogger("lexsplat")


class EventRunner:
    """Runs event handlers and background work, and reports their errors.

    Args:
        report: Receives an error message, or None when a handler succeeds.
    """

    def __init__(self, report: Callable[[str | None], None]) -> None:
        self._report = report
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="lexsplat-viewer")
        self._latest: dict[str, Callable[[], None]] = {}

    def on(self, register: Callable[[Any], Any], handler: Callable[[Any], None]) -> None:
        """Call ``handler(client)`` when a page uses a control. Changes made by the server itself are ignored."""

        def run(event: Any) -> None:
            if event.client is not None:
                self.run(lambda: handler(event.client))

        register(run)

    def later(self, subject: str, work: Callable[[], None]) -> None:
        """Run ``work`` in the background, unless newer work about the same subject is queued before it starts."""
        self._latest[subject] = work

        def run() -> None:
            if self._latest.get(subject) is work:
                del self._latest[subject]
                self.run(work, background=True)

        with contextlib.suppress(RuntimeError):  # raised after `stop`
            self._worker.submit(run)

    def run(self, work: Callable[[], None], background: bool = False) -> None:
        """Run ``work`` and report an error in one line. Success clears the message, except in the background."""
        try:
            work()
            if not background:
                self._report(None)
        except LexsplatError as error:
            self._report(str(error))
        except (TimeoutError, RuntimeError, ValueError) as error:
            logger.warning("viewer: %s", error)
            self._report(f"Failed: {error}")

    def wait(self) -> None:
        """Wait until the background work is done."""
        self._worker.submit(lambda: None).result()

    def stop(self) -> None:
        """Finish the current background work and drop the rest."""
        self._worker.shutdown(wait=True, cancel_futures=True)


def set_value(control: Any, value: object) -> None:
    """Set the value of a control (viser annotates it as read-only)."""
    control.value = value
