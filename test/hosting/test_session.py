# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""How a run ends: `Session` by itself, with an executor that only pretends."""

from __future__ import annotations

import sys
import threading
from types import FrameType
from typing import Any

from mddag_executor.hosting.session import Session

DEEPEST = 60
"""So many steps of the interpreter are in `wait` and below before it sleeps, and some more."""


class Idle:
    """An executor that has nothing to run."""

    def __init__(self) -> None:
        self.ended = threading.Event()

    def spin(self) -> None:
        self.ended.wait()

    def shutdown(self, timeout_sec: float) -> bool:
        self.ended.set()
        return True


def stop_after(session: Session, steps: int) -> Any:
    """Return a trace function that stops the session, as a signal's handler would, at a step."""
    left = steps

    def trace(frame: FrameType, event: str, _: Any) -> Any:
        nonlocal left
        frame.f_trace_opcodes = True
        if event == 'opcode':
            left -= 1
            if left == 0:
                session.stop(hurried=True)
        return trace

    return trace


def test_a_signal_stops_a_session_wherever_it_interrupts_the_wait() -> None:
    for steps in range(1, DEEPEST):
        stop_at(steps)


def stop_at(steps: int) -> None:
    session = Session(Idle())  # type: ignore[arg-type]
    answers = []

    def wait() -> None:
        sys.settrace(stop_after(session, steps))
        answers.append(session.wait(0.01))
        sys.settrace(None)
        session.end()

    session.__enter__()
    # A daemon, and no `with`: where one waits for ever, the tests are to end all the same.
    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    thread.join(5.0)
    assert not thread.is_alive(), 'the handler waits for what it has interrupted'
    assert session.clean
    assert len(answers) == 1
