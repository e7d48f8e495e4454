# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Programs that do nothing."""

import threading


class Idle:
    """An executor that has nothing to run."""

    def __init__(self):
        self.ended = threading.Event()

    def spin(self):
        self.ended.wait()

    def shutdown(self, timeout_sec):
        self.ended.set()
        return True
