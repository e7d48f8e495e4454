# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""Headless Chromium for the tests of what people look at."""

from __future__ import annotations

import os
import shutil

import pytest

CHROMIUM = shutil.which('chromium') or shutil.which('chromium-browser') \
    or shutil.which('google-chrome')
DRIVER = shutil.which('chromedriver')
FLAGS = (
    '--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
    '--disable-background-networking', '--disable-component-update', '--disable-sync',
    '--disable-dev-shm-usage', '--window-size=1400,1000',
    # whatever a page asked for over the network would fail and be an error on its console
    '--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1')
PATIENCE_S = 60.0


@pytest.fixture(scope='module')
def browser(tmp_path_factory):
    webdriver = pytest.importorskip('selenium.webdriver', reason='selenium is not installed')
    from selenium.webdriver.chrome.service import Service
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    profile = tmp_path_factory.mktemp('profile')
    for flag in (*FLAGS, f'--user-data-dir={profile}'):
        options.add_argument(flag)
    options.set_capability('goog:loggingPrefs', {'browser': 'ALL'})
    os.environ.setdefault('SE_OFFLINE', 'true')
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    driver.set_script_timeout(PATIENCE_S)
    driver.set_page_load_timeout(PATIENCE_S)
    yield driver
    driver.quit()
