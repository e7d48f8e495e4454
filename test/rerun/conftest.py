# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""A recording to run nodes again from."""

import pytest
from std_msgs.msg import Header

from .helpers import write_bag


@pytest.fixture
def bag(tmp_path):
    return write_bag(tmp_path / 'in.mcap', [
        (i * 100, '/points', Header(frame_id=str(i))) for i in range(20)])
