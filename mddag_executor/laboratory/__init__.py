# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Many runs and the questions before the first one: evaluate, generate, assign, test."""
