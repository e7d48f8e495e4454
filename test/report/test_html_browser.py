# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""HTML reports in headless Chromium: they open without an error, and a miss can be found."""

import os
import shutil
import time

from mddag_executor.replay import replay
from mddag_executor.report import html
from mddag_executor.report.html_tables import MOST_ROWS
import msg_graph
import pytest

from . import runs

pytest.importorskip('bokeh', reason='Bokeh is not installed')
webdriver = pytest.importorskip('selenium.webdriver', reason='selenium is not installed')

pytestmark = pytest.mark.needs('chromium')

FLAGS = (
    '--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
    '--disable-background-networking', '--disable-component-update', '--disable-sync',
    '--disable-dev-shm-usage', '--window-size=1400,1000',
    # whatever a page asked for over the network would fail and be an error on its console
    '--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1')
PATIENCE_S = 60.0


@pytest.fixture(scope='module')
def browser(tmp_path_factory):
    options = webdriver.ChromeOptions()
    options.binary_location = next(filter(None, map(
        shutil.which, ('chromium', 'chromium-browser', 'google-chrome'))))
    for flag in (*FLAGS, f'--user-data-dir={tmp_path_factory.mktemp("profile")}'):
        options.add_argument(flag)
    options.set_capability('goog:loggingPrefs', {'browser': 'ALL'})
    os.environ.setdefault('SE_OFFLINE', 'true')
    driver = webdriver.Chrome(
        options=options, service=webdriver.ChromeService(shutil.which('chromedriver')))
    driver.set_script_timeout(PATIENCE_S)
    driver.set_page_load_timeout(PATIENCE_S)
    yield driver
    driver.quit()


def wait_for(condition):
    end = time.monotonic() + PATIENCE_S
    while True:
        value = condition()
        if value:
            return value
        assert time.monotonic() < end, 'the page does not get there'
        time.sleep(0.02)


def opened(browser, path):
    """Open a report and wait until it is drawn."""
    browser.get(path.as_uri())
    wait_for(lambda: browser.execute_script(
        'return !!(window.mddag && mddag.ready) '
        '|| document.getElementById("mddag-status")?.textContent'))
    assert browser.execute_script('return !!(window.mddag && mddag.ready)')
    return browser


def complaints(browser):
    return [entry['message'] for entry in browser.get_log('browser')
            if entry['level'] not in ('INFO', 'DEBUG')]


def status(browser):
    return browser.execute_script('return document.getElementById("mddag-status")?.textContent')


def bars(browser, column):
    return browser.execute_script(f'return Array.from(mddag.bars.data.{column})')


def write(path, data):
    with path.open('wb') as file:
        html.write(file, data)
    return path


@pytest.fixture(scope='module')
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp('small')
    outcome = replay(runs.by_hand(folder / 'run.mcap', hostile=True))
    return write(folder / 'report.html', html.of_outcome(outcome))


@pytest.fixture(scope='module')
def large(tmp_path_factory):
    """Give a run with many misses."""
    task_set = runs.autoware()
    load, run = runs.simulated(task_set, ms=4500, utilisation=0.98)
    return write(tmp_path_factory.mktemp('large') / 'report.html',
                 html.of_run(task_set, load, run))


def test_a_miss_is_told_and_names_cannot_become_markup(browser, small):
    opened(browser, small)
    texts = [' | '.join(lines) for lines in zip(*(bars(browser, key) for key in 'abcd'))]
    assert len(texts) == 7
    assert texts[5] == (
        '/filter:run | job 2 of /driver, released at 0.020000 s | started 0.027000 s on worker 1, '
        'waited 1 ms, ran 3 ms | MISSED at filter:run: response 10 ms, 2 ms late (deadline 8 ms)')
    assert 'in time at filter:run: response 5 ms, 3 ms of slack' in texts[0]
    assert 'window.hacked=1' in texts[6] and 'declared by no DAG' in texts[6]
    point_at(browser, 'callbacks', 0.032, 0)
    tip = wait_for(lambda: shown_tip(browser))
    assert 'declared by no DAG' in tip and '<img src=x onerror="window.hacked=1">' in tip
    assert browser.execute_script('return window.hacked === undefined')
    assert browser.execute_script('return document.images.length') == 0
    assert complaints(browser) == []


def point_at(browser, name, x, y):
    """Move the mouse to a place of a picture, given as its axes have it."""
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.actions.action_builder import ActionBuilder
    where = browser.execute_script("""
        for (const view of Bokeh.index) {
          if (view.model.name !== arguments[0]) continue;
          view.el.scrollIntoView({block: 'center'});
          const box = view.el.getBoundingClientRect();
          return [box.left + view.frame.x_scale.compute(arguments[1]),
                  box.top + view.frame.y_scale.compute(arguments[2])];
        }""", name, x, y)
    actions = ActionBuilder(browser)
    actions.pointer_action.move_to_location(round(where[0]), round(where[1]) + 1)
    actions.pointer_action.move_to_location(round(where[0]), round(where[1]))
    actions.perform()
    ActionChains(browser).pause(0.05).perform()


def shown_tip(browser):
    """Return the text of the tool tip that is shown."""
    return browser.execute_script("""
        const found = [];
        const search = (root) => root.querySelectorAll('*').forEach((element) => {
          if (element.classList.contains('bk-Tooltip')) {
            found.push((element.shadowRoot || element).textContent);
          }
          if (element.shadowRoot) search(element.shadowRoot);
        });
        search(document);
        return found.join(' ');""")


@pytest.mark.parametrize('scheme', ['dark', 'light'])
def test_a_miss_can_be_found(browser, large, scheme):
    browser.execute_cdp_cmd('Emulation.setEmulatedMedia', {
        'features': [{'name': 'prefers-color-scheme', 'value': scheme}]})
    opened(browser, large)
    shown = browser.execute_script('return Bokeh.documents[0].roots()[0].border_fill_color')
    assert (shown == '#1b1b1d') is (scheme == 'dark')
    first = browser.execute_script('return mddag.missed[0]')
    browser.find_element('id', 'mddag-next').click()
    wait_for(lambda: 'MISSED' in status(browser))
    assert status(browser) == first['text']
    start, end = browser.execute_script('return [mddag.range.start, mddag.range.end]')
    assert start < first['release'] < first['shown'] < end < start + 2
    assert browser.execute_script('return mddag.marks.data.x.length') >= 1
    browser.find_element('id', 'mddag-next').click()
    second = wait_for(lambda: browser.execute_script(
        'return mddag.range.start') != start and status(browser))
    browser.find_element('id', 'mddag-previous').click()
    wait_for(lambda: browser.execute_script('return mddag.range.start') == start)
    assert status(browser) != second
    browser.find_element('id', 'mddag-whole').click()
    wait_for(lambda: browser.execute_script('return mddag.range.start') == 0)
    wanted = browser.execute_script('return mddag.missed[3].text')
    browser.execute_script('document.querySelector("[data-miss=\'3\']").click()')
    wait_for(lambda: status(browser) == wanted)
    assert complaints(browser) == []


def test_many_sinks_are_shown_on_demand_and_found(browser, tmp_path):
    task_set = msg_graph.loads('mddag: 1\nnodes:\n' + ''.join(
        f'  - node: /n{i}\n    callbacks: '
        f'[{{name: t, timer: {10 + i}ms, deadline: 9ms, execution_time: {10 + i}us}}]\n'
        for i in range(60)), 'g.yaml')
    load, run = runs.simulated(task_set, ms=200, utilisation=0.2)
    report = write(tmp_path / 'report.html', html.of_run(task_set, load, run))
    opened(browser, report)

    def shown():
        return browser.execute_script("""
            return [...document.querySelectorAll('#mddag-sinks tbody tr')].filter(
              (row) => row.offsetHeight > 0).map((row) => row.cells[0].textContent);""")

    assert len(shown()) == MOST_ROWS
    browser.find_element('id', 'mddag-search').send_keys('/N5')
    assert sorted(shown()) == ['/n5', *(f'/n5{i}' for i in range(10))]
    browser.find_element('id', 'mddag-search').send_keys('\b\b\b')
    assert len(shown()) == 60
    browser.execute_script('document.querySelector("#mddag-sinks th").click()')
    assert shown() == sorted(f'/n{i}' for i in range(60))
    opened(browser, report)
    browser.find_element('id', 'mddag-all-sinks').click()
    assert len(shown()) == 60 and complaints(browser) == []
