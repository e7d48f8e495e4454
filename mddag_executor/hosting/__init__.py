# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Unmodified node programs in this process: finding, running and ending them."""
