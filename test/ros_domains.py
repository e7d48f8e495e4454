# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""ROS domains that tests running at the same time do not share."""

import os
import socket

# Domains above 101 collide with the ephemeral ports of Linux; low ones are what people use.
DOMAINS = range(40, 102)


def claim_domain():
    """
    Return a domain that no other process claims, and what claims it until it is closed.

    Both are None if every domain is claimed.
    """
    start = os.getpid() % len(DOMAINS)
    for domain in (*DOMAINS[start:], *DOMAINS[:start]):
        # A name without a file: it is gone with the process, and reaches as far as DDS does.
        claim = socket.socket(socket.AF_UNIX)
        try:
            claim.bind(f'\0mddag-test-domain-{domain}')
        except OSError:
            claim.close()
        else:
            return domain, claim
    return None, None
