# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Nodes made from a declaration, which publish for real, take the declared times and measure."""
