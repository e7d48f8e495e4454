# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""rclpy for the duration of a command: initialised, and what this package logs with it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
import os
import re
import sys
import tempfile

from mddag_executor.errors import UsageError
from mddag_executor.hosting.loading import ros_arguments
import rclpy
from rclpy.context import Context
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.logging import get_logger
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import get_default_context, try_shutdown


@contextmanager
def initialised(
    ros_args: Sequence[str] | None = None, context: Context | None = None
) -> Iterator[Context]:
    """
    Keep a context initialised, by default the default one.

    rclpy's signal handlers are not installed: they would take Ctrl-C from the summary.

    :raises UsageError: when rclpy refuses the arguments, cannot make its log directory, or is
        initialised already.
    """
    if (context or get_default_context()).ok():
        raise UsageError('rclpy is initialised already in this process: call rclpy.shutdown() '
                         'before the run')
    try:
        _init(context, ros_arguments(ros_args))
    except Exception as error:
        reason = re.sub(r', at /\S+:\d+', '', str(error).split('\n')[0])
        raise UsageError(
            f'--ros-args {" ".join(ros_args)}: {reason}: correct it, or leave it out' if ros_args
            else f'rclpy: {reason}: correct the environment, for instance HOME or ROS_LOG_DIR'
        ) from error
    try:
        yield context or get_default_context()
    finally:
        try_shutdown(context=context)


@contextmanager
def quiet_log(errors_only: bool) -> Iterator[None]:
    """
    Let this package log errors only, if that is wanted; the logs of nodes stay as they are.

    A level that the user gives this package with ``--ros-args --log-level`` is stronger.
    """
    logger = get_logger('mddag_executor')
    if errors_only:
        logger.set_level(LoggingSeverity.ERROR)
    try:
        yield
    finally:
        if errors_only:
            logger.set_level(LoggingSeverity.UNSET)


def _init(context: Context | None, arguments: list[str]) -> None:
    """
    Initialise a context.

    Output of native code on standard error is shown only when there is no exception: else it is
    the same once more.
    """
    init = partial(rclpy.init, args=arguments, context=context,
                   signal_handler_options=SignalHandlerOptions.NO)
    if sys.stderr is None:  # it was closed when the process started
        init()
        return
    sys.stderr.flush()
    with tempfile.TemporaryFile() as kept:
        stderr = os.dup(2)
        os.dup2(kept.fileno(), 2)
        try:
            init()
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
        kept.seek(0)
        os.write(2, kept.read())
