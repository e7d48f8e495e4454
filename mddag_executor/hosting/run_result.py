# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""The result of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

from mddag_executor.core.requirements import not_met
from mddag_executor.core.tally import total
from mddag_executor.core.tolerances import not_tolerated
from mddag_executor.errors import MddagError
from mddag_executor.results import runs
from mddag_executor.results.sinks import Requirements


@dataclass(frozen=True)
class ProgramEnd:
    """
    How a program ended.

    :ivar spec: its name, as after ``--node``.
    :ivar status: the exit status that it would have by itself; None: its main has not ended.
    :ivar message: what Python would print about its end: an exception, or the text of `sys.exit`.
    """

    spec: str
    status: int | None
    message: str = ''


@dataclass(frozen=True)
class RunResult:
    """
    The result of a run that has ended.

    :ivar values: all of it (``to_json``).
    :ivar programs: how each program ended; empty with several processes.
    :ivar warnings: lines about the run, each with what to do.
    :ivar error: what a node raised; ``hosting.run`` raises it.
    :ivar observed: what several processes put together.
    :ivar has_started: False: a signal has ended it before all of its programs had started.
    """

    values: dict[str, Any]
    programs: tuple[ProgramEnd, ...] = ()
    warnings: tuple[str, ...] = ()
    error: BaseException | None = None
    observed: Mapping[str, Any] | None = None
    has_started: bool = True

    @property
    def dags(self) -> dict[str, runs.DividedDag]:
        """Return the counts of each DAG and its sinks."""
        dags: dict[str, runs.DividedDag] = self.values['dags']
        return dags

    @property
    def callbacks(self) -> dict[str, runs.CallbackCounts]:
        """Return the counts of each callback."""
        callbacks: dict[str, runs.CallbackCounts] = self.values['callbacks']
        return callbacks

    @property
    def requirements(self) -> Requirements:
        """Return the counts of the requirements of paths."""
        requirements: Requirements = self.values['requirements']
        return requirements

    @property
    def in_time(self) -> bool:
        """
        Return whether the deadlines and requirements held.

        They did if there were results, and no more were missed than the declaration tolerates.
        """
        due = total(self.dags).due or self.requirements
        return bool(due) and not not_tolerated(self.dags) and not not_met(self.requirements)

    @property
    def status(self) -> int:
        """Return the exit status that `mddag run` has for this run, without --fail-on-miss."""
        if isinstance(self.error, KeyboardInterrupt):
            return 130
        if self.error is not None and not isinstance(self.error, SystemExit):
            return self.error.status if isinstance(self.error, MddagError) else 70
        return next((each.status for each in self.programs if each.status), 0)

    def to_json(self) -> runs.RunResult | runs.RunOfProcessesResult:
        """Return the result for `json.dump`, as `mddag run --json` writes it."""
        return cast('runs.RunResult | runs.RunOfProcessesResult', self.values)
