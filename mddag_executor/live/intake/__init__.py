# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
The intake: finds out what became ready, takes it at once, and hands it over as arrivals.

Two backends hand over to the same ``Receiver`` (``arrivals``): ``events`` and ``waitset``. What is
taken from an entity, and what is to be called for it, is the same for both (``sources``); timers
have a queue of their own (``timers``).
"""
