# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""What would have been: recorded releases and execution times, scheduled again by the core."""
