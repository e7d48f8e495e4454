# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Results for people: tables now, pictures to come."""
