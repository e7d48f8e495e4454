# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""HTML reports in headless Chromium: they open without an error, and a miss can be found."""

import os
import shutil
import time

from mddag_executor import replay
from mddag_executor.report import html
from mddag_executor.report.html_tables import MOST_ROWS
import msg_graph
import pytest

from . import runs

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
    texts = [text.replace('\n', ' | ') for text in browser.execute_script(
        'return mddag.data.executions.name.map((_, i) => mddag.barText(i))')]
    assert len(texts) == 7
    assert texts[5] == (
        '/filter:run | job 2 of /driver, released at 0.020000 s | started 0.027000 s on worker 1, '
        'waited 1 ms, ran 3 ms | MISSED at filter:run: response 10 ms, 2 ms late (deadline 8 ms)')
    assert 'in time at filter:run: response 5 ms, 3 ms of slack' in texts[0]
    assert 'window.hacked=1' in texts[6] and 'declared by no DAG' in texts[6]
    point_at(browser, 'callbacks', 32 * runs.MS, 4)
    tip = wait_for(lambda: shown_tip(browser))
    assert 'declared by no DAG' in tip and '<img src=x onerror="window.hacked=1">' in tip
    assert browser.execute_script('return window.hacked === undefined')
    assert browser.execute_script('return document.images.length') == 0
    assert complaints(browser) == []


def point_at(browser, name, ns, line):
    """Move the mouse to a time on a line of a picture."""
    from selenium.webdriver.common.actions.action_builder import ActionBuilder
    where = browser.execute_script("""
        const {canvas} = mddag.pictures[arguments[0]];
        canvas.scrollIntoView({block: 'center'});
        const box = canvas.getBoundingClientRect();
        return [box.left + mddag.xOf(canvas.clientWidth)(arguments[1]),
                box.top + (arguments[2] + 0.5) * 17];
        """, name, ns, line)
    actions = ActionBuilder(browser)
    actions.pointer_action.move_to_location(round(where[0]), round(where[1]) + 1)
    actions.pointer_action.move_to_location(round(where[0]), round(where[1]))
    actions.perform()


def shown_tip(browser):
    """Return the text of the tool tip that is shown."""
    return browser.execute_script("""
        const tip = document.getElementById('mddag-tip');
        return tip.hidden ? '' : tip.textContent;""")


def colours_of(browser, name):
    """
    Return how many pixels of a picture have each colour.

    They are those of a copy: Chromium complains of a page that reads a canvas again and again, as
    this does until a slow machine has drawn it.
    """
    return browser.execute_script("""
        const canvas = document.getElementById(`mddag-${arguments[0]}`), found = {};
        const {width, height} = canvas;
        const copy = new OffscreenCanvas(width, height).getContext(
          '2d', {willReadFrequently: true});
        copy.drawImage(canvas, 0, 0);
        const {data} = copy.getImageData(0, 0, width, height);
        for (let i = 0; i < data.length; i += 4) {
          const colour = '#' + [0, 1, 2].map(
            (c) => data[i + c].toString(16).padStart(2, '0')).join('');
          if (data[i + 3] === 255) found[colour] = (found[colour] || 0) + 1;
        }
        return found;""", name)


def view(browser):
    return browser.execute_script('return [mddag.view.from, mddag.view.to]')


def press(browser, key):
    from selenium.webdriver.common.action_chains import ActionChains
    ActionChains(browser).send_keys(key).perform()


@pytest.mark.parametrize('scheme', ['dark', 'light'])
def test_a_miss_can_be_found(browser, large, scheme):
    browser.execute_cdp_cmd('Emulation.setEmulatedMedia', {
        'features': [{'name': 'prefers-color-scheme', 'value': scheme}]})
    opened(browser, large)
    red = browser.execute_script('return mddag.colours().missed')
    assert red == {'dark': '#ff5b52', 'light': '#d7191c'}[scheme]
    for name in ('overview', 'workers', 'callbacks'):
        wait_for(lambda name=name: colours_of(browser, name).get(red, 0) > 50)
    for part in ('#mddag-lines', '#mddag-next', 'body'):        # nothing stays white
        lightness = browser.execute_script("""
            return getComputedStyle(document.querySelector(arguments[0])).backgroundColor
              .match(/[0-9]+/g).slice(0, 3).map(Number)""", part)
        assert (max(lightness) < 140) is (scheme == 'dark'), part
    first = browser.execute_script('return mddag.missed[0]')
    browser.find_element('id', 'mddag-next').click()
    wait_for(lambda: 'MISSED' in status(browser))
    assert status(browser) == first['text']
    start, end = view(browser)
    assert start < first['release'] < first['shown'] < end < start + 2e9
    browser.find_element('id', 'mddag-next').click()
    second = wait_for(lambda: view(browser)[0] != start and status(browser))
    browser.find_element('id', 'mddag-previous').click()
    wait_for(lambda: view(browser)[0] == start)
    assert status(browser) != second
    press(browser, 'n')
    wait_for(lambda: status(browser) == second)
    press(browser, '0')
    assert view(browser) == [0, 4.5e9]
    press(browser, '+')
    assert view(browser) == [1.125e9, 3.375e9]
    browser.find_element('id', 'mddag-whole').click()
    wanted = browser.execute_script('return mddag.missed[3].text')
    browser.find_element('css selector', '[data-miss="3"]').send_keys('\ue007')     # Enter
    wait_for(lambda: status(browser) == wanted)
    assert complaints(browser) == []


def test_misses_are_sorted_and_searched(browser, large):
    opened(browser, large)

    def shown():
        return browser.execute_script("""
            return [...document.querySelectorAll('#mddag-misses tbody tr')].filter(
              (row) => !row.hidden).map((row) => Number(row.dataset.miss));""")

    late = browser.execute_script('return mddag.missed.map((m) => m.shown - m.deadline)')
    title = browser.find_element('xpath', '//*[@id="mddag-misses"]//th[.="late by"]')
    title.click()
    assert [late[i] // 1e7 for i in shown()] == sorted(
        (each // 1e7 for each in late), reverse=True)
    title.send_keys('\ue007')
    assert [late[i] // 1e7 for i in shown()] == sorted(each // 1e7 for each in late)
    browser.find_element('css selector', '#mddag-misses input').send_keys('no such sink')
    assert shown() == []


def test_a_table_is_used_by_keyboard(browser, large):
    """Tab reaches one row of a table, and the arrows reach the others, as sorted and searched."""
    opened(browser, large)

    def stops():
        return browser.execute_script("""
            return [...document.querySelectorAll('tr')].filter(
              (row) => row.tabIndex === 0 && row.offsetHeight > 0).map(
              (row) => [row.dataset.dag || '', row.closest('tbody').rows[0] === row]);""")

    def chosen():
        return browser.execute_script('return document.activeElement.rowIndex')

    assert [first for _, first in stops()] == [True, True]      # a miss and a sink
    browser.find_element('css selector', '#mddag-misses th:last-child').send_keys('\ue007\t')
    down, up, end, enter = '\ue015', '\ue013', '\ue010', '\ue007'
    where = [chosen()]
    for key in (down, down, up, up, up, end):
        press(browser, key)
        where.append(chosen())
    rows = browser.execute_script('return mddag.missed.length')
    assert where == [1, 2, 3, 2, 1, 1, rows]
    press(browser, enter)
    wanted = browser.execute_script(
        'return mddag.missed[Number(document.activeElement.dataset.miss)].text')
    wait_for(lambda: status(browser) == wanted)
    sink = browser.find_element('css selector', '#mddag-sinks tbody tr:last-child')
    dag = sink.get_attribute('data-dag')
    browser.find_element('css selector', '#mddag-sinks input').send_keys(dag)
    assert stops()[1][0] == dag
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
    search = browser.find_element('css selector', '#mddag-sinks input')
    search.send_keys('/N5')
    assert sorted(shown()) == ['/n5', *(f'/n5{i}' for i in range(10))]
    browser.execute_script('document.querySelector("#mddag-sinks th:nth-child(2)").click()')
    assert sorted(shown()) == ['/n5', *(f'/n5{i}' for i in range(10))]      # still searched
    search.send_keys('\b\b\b')
    assert len(shown()) == 60
    browser.execute_script('document.querySelector("#mddag-sinks th").click()')
    assert shown() == sorted(f'/n{i}' for i in range(60))
    opened(browser, report)
    browser.find_element('css selector', '#mddag-sinks .all').click()
    assert len(shown()) == 60

    def lines():
        return browser.execute_script(
            'return mddag.pictures.callbacks.lines.map((line) => line.label)')

    assert len(lines()) == 60
    browser.find_element('css selector', '[data-dag="/n7"]').click()     # its DAG alone
    assert lines() == ['n7:t, every 17 ms']
    wanted = browser.find_element('id', 'mddag-lines')
    wanted.clear()
    wanted.send_keys('n5')
    assert len(lines()) == 11 and complaints(browser) == []
