// What draws the pictures of a report while they are zoomed and moved.
//
// Theory of operation: the page holds every execution in compressed columns (see html_data.py).
// Whenever a range changes, the executions in view are looked up by binary search. Few of them are
// drawn as they are; many are added up by line and interval, and a bar is as high as the line was
// busy, in the colour of the least slack in it. So what is drawn never grows with the run.
// Times are in units of 100 ns, in pictures in seconds.
'use strict';
(() => {
  const EXACT = 4000;                   // executions drawn one by one at most
  const CELLS = 24000;                  // lines times intervals otherwise
  const KINDS = ['late', 'not completed when the run ended', 'expired', 'aborted', 'failed'];
  const CLASSES = [                     // by slack over deadline: less than, colour
    [0, '#d7191c'], [0.1, '#fd8d3c'], [0.25, '#fec44f'], [0.5, '#9ecae1'], [Infinity, '#3182bd']];
  const UNKNOWN = 5, COLOURS = [...CLASSES.map((c) => c[1]), '#969696'];
  const element = (id) => document.getElementById(id);
  const meta = JSON.parse(element('mddag-meta').textContent);
  const SECOND = 1e9 / meta.unit_ns;
  const {lower, spans, unpack} = window.mddagColumns;
  let c = null;                         // columns by name
  let longest = 0, slack = null, ratio = null, least = null, released = null, missed = [];
  let shown = null;                     // when each miss is shown, ascending

  // --- data --------------------------------------------------------------------------------------

  function prepare() {
    const n = c.start.length, last = new Float64Array(meta.rows.length);
    for (let i = 0; i < n; i++) {
      c.job[i] = last[c.row[i]] += c.job[i];
      if (c.took[i] > longest) longest = c.took[i];
    }
    const ofDag = spans(c.release_dag, meta.dags.length);
    released = (dag, job) => {
      const at = lower(c.release_job, job, ...ofDag[dag]);
      return at < ofDag[dag][1] && c.release_job[at] === job ? c.release_time[at] : NaN;
    };
    const ofSink = spans(c.verdict_sink, meta.sinks.length);
    const verdict = (sink, job) => {
      const at = lower(c.verdict_job, job, ...ofSink[sink]);
      return at < ofSink[sink][1] && c.verdict_job[at] === job ? at : -1;
    };
    slack = new Float64Array(n).fill(NaN);
    ratio = new Uint8Array(n).fill(UNKNOWN);
    least = new Int32Array(n).fill(-1);
    for (let i = 0; i < n; i++) {
      for (const sink of meta.rows[c.row[i]].sinks) {
        const at = verdict(sink, c.job[i]);
        if (at < 0) continue;
        const value = c.verdict_kind[at] ? -Infinity : c.verdict_slack[at];
        if (value >= slack[i]) continue;
        slack[i] = value;
        least[i] = at;
        ratio[i] = classOf(value, meta.sinks[sink].deadline);
      }
    }
    for (let i = 0; i < c.verdict_job.length; i++) {
      if (c.verdict_kind[i] || c.verdict_slack[i] < 0) missed.push(jobOf(i));
    }
    missed = missed.filter((m) => !isNaN(m.release)).sort((a, b) => a.shown - b.shown);
    shown = Float64Array.from(missed, (miss) => miss.shown);
  }

  function classOf(value, deadline) {
    return CLASSES.findIndex(([limit]) => value / deadline < limit);
  }

  function jobOf(at) {                  // what is known of a verdict
    const sink = meta.sinks[c.verdict_sink[at]], job = c.verdict_job[at];
    const release = released(sink.dag, job), deadline = release + sink.deadline;
    const kind = c.verdict_kind[at];
    const completed = kind ? null : deadline - c.verdict_slack[at];
    return {at, sink: c.verdict_sink[at], job, release, deadline, completed, kind,
            row: sink.row, shown: completed === null ? deadline : completed};
  }

  // --- words -------------------------------------------------------------------------------------

  function time(units) {
    const ns = Math.abs(units) * meta.unit_ns, sign = units < 0 ? '-' : '';
    for (const [scale, unit] of [[1e9, 's'], [1e6, 'ms'], [1e3, 'us']]) {
      if (ns >= scale) return `${sign}${+(ns / scale).toPrecision(5)} ${unit}`;
    }
    return `${sign}${ns} ns`;
  }

  const instant = (units) => `${(units / SECOND).toFixed(6)} s`;

  function verdictText(at) {
    const job = jobOf(at), name = meta.sinks[job.sink].name;
    const due = `deadline ${time(meta.sinks[job.sink].deadline)}`;
    if (job.kind) return `MISSED at ${name}: ${KINDS[job.kind]} (${due})`;
    const left = c.verdict_slack[at];
    return `${left < 0 ? 'MISSED' : 'in time'} at ${name}: response ` +
      `${time(job.completed - job.release)}, ${left < 0 ? time(-left) + ' late' :
        time(left) + ' of slack'} (${due})`;
  }

  function facts(i) {
    const row = meta.rows[c.row[i]], dag = row.dag < 0 ? null : meta.dags[row.dag];
    const release = dag === null ? NaN : released(row.dag, c.job[i]);
    return [
      row.name,
      dag === null ? 'declared by no DAG' : `job ${c.job[i]} of ${dag}` +
        (isNaN(release) ? '' : `, released at ${instant(release)}`),
      `ready ${instant(c.start[i] - c.wait[i])}, started ${instant(c.start[i])}, ` +
        (c.worker[i] < 0 ? 'on a spare thread' :
          meta.worker_names[c.worker[i]] || `worker ${c.worker[i]}`),
      `waited ${time(c.wait[i])}, ran ${time(c.took[i])}`,
      least[i] < 0 ? (dag === null ? '' : 'no verdict known') : verdictText(least[i])];
  }

  // --- pictures ----------------------------------------------------------------------------------

  const COLUMNS = ['left', 'right', 'bottom', 'top', 'colour', 'edge', 'a', 'b', 'd', 'e', 'f'];
  const empty = (names) => Object.fromEntries(names.map((name) => [name, []]));

  function bar(data, left, right, middle, height, colour, edge, lines) {
    const values = [left / SECOND, right / SECOND, middle - height / 2, middle + height / 2,
                    colour, edge, ...lines];
    COLUMNS.forEach((name, i) => data[name].push(values[i]));
  }

  function inView(x0, x1) {
    return [lower(c.start, x0 - longest), lower(c.start, x1)];
  }

  function exact(view, x0, x1) {        // null when there are too many
    const data = empty(COLUMNS), [from, to] = inView(x0, x1);
    const found = [];
    for (let i = from; i < to; i++) {
      if (c.start[i] + c.took[i] < x0) continue;
      if (found.length >= EXACT) return null;
      found.push(i);
    }
    const pixel = (x1 - x0) / 1200;
    for (const i of found) {
      const colour = COLOURS[ratio[i]];     // a frame would hide what is narrow
      bar(data, c.start[i], c.start[i] + Math.max(c.took[i], pixel), view.y(i), 0.8, colour,
          c.took[i] > 5 * pixel ? '#444444' : colour, facts(i));
    }
    return data;
  }

  function sums(view, x0, x1) {
    const [from, to] = inView(x0, x1);
    const n = Math.max(60, Math.min(600, Math.floor(CELLS / view.lines)));
    const width = (x1 - x0) / n, size = view.lines * n;
    const busy = new Float64Array(size), count = new Uint32Array(size);
    const worst = new Uint8Array(size).fill(UNKNOWN);
    for (let i = from; i < to; i++) {
      const start = Math.max(c.start[i], x0), end = Math.min(c.start[i] + c.took[i], x1);
      if (end < start) continue;
      const base = view.y(i) * n, last = Math.min(n - 1, Math.floor((end - x0) / width));
      for (let b = Math.floor((start - x0) / width); b <= last; b++) {
        busy[base + b] += Math.min(end, x0 + (b + 1) * width) - Math.max(start, x0 + b * width);
        count[base + b]++;
        if (ratio[i] < worst[base + b]) worst[base + b] = ratio[i];
      }
    }
    const data = empty(COLUMNS);
    for (let y = 0; y < view.lines; y++) {
      for (let b = 0; b < n; b++) {
        const at = y * n + b;
        if (!count[at]) continue;
        const share = Math.min(1, busy[at] / width);
        bar(data, x0 + b * width, x0 + (b + 1) * width, y, 0.12 + 0.72 * share,
            COLOURS[worst[at]], 'rgba(0,0,0,0)',
            [`${count[at]} executions in ${time(width)}`, `busy ${(100 * share).toFixed(1)} %`,
             worst[at] === 0 ? 'with a missed deadline' : '', 'zoom in to see each', '']);
      }
    }
    return data;
  }

  function marks(view, x0, x1) {
    const data = empty(['x', 'y', 'a', 'b', 'd', 'e', 'f']);
    const seen = missed.slice(lower(shown, x0), lower(shown, x1 + 1));
    const step = Math.max(1, Math.ceil(seen.length / 1500));
    for (let i = 0; i < seen.length; i += step) {
      const miss = seen[i];
      [miss.shown / SECOND, view.markY(miss), meta.rows[miss.row].name,
       `job ${miss.job} of ${meta.dags[meta.rows[miss.row].dag]}, released at ` +
       instant(miss.release), verdictText(miss.at), '', '']
        .forEach((value, k) => data[Object.keys(data)[k]].push(value));
    }
    return data;
  }

  function draw(view) {
    const x0 = view.range.start * SECOND, x1 = view.range.end * SECOND;
    if (!(x1 > x0)) return;
    const one = exact(view, x0, x1);
    view.bars.data = one || sums(view, x0, x1);
    view.marks.data = marks(view, x0, x1);
    view.exact = one !== null;
    element('mddag-detail').textContent = one !== null ?
      'Each bar is one execution, in the colour of the least slack that it leads to.' :
      'Many executions are in view: a bar is as high as its line was busy, in the colour of the ' +
      'least slack in it. Zoom in to see each execution.';
  }

  // --- putting it together -----------------------------------------------------------------------

  const NARROW = 700;                   // pixels, as in html.css
  const brief = (labels) => window.innerWidth > NARROW ? labels : new Map(
    [...(labels.entries ? labels.entries() : Object.entries(labels))].map(([y, text]) => {
      const name = text.split(', every ')[0];
      return [Number(y), name.length > 18 ? '…' + name.slice(-17) : name];
    }));

  function fit(model) {                 // leave most of a narrow screen to the pictures
    if (window.innerWidth > NARROW) return;
    for (const name of ['workers', 'callbacks']) {
      const axis = model(`${name}_axis`);
      axis.major_label_text_font_size = '9px';
      axis.major_label_overrides = brief(axis.major_label_overrides);
    }
    for (const name of ['overview', 'workers', 'callbacks']) model(name).min_border_left = 110;
  }

  function start(doc) {
    const model = (name) => doc.get_model_by_name(name);
    fit(model);
    const later = (work) => {           // once for each frame, however often it is asked for
      let asked = false;
      return () => {
        if (asked) return;
        asked = true;
        requestAnimationFrame(() => { asked = false; work(); });
      };
    };
    const range = model('timeline_range');
    const ys = meta.rows.map((row) => row.y);
    const workerLine = (worker) => meta.worker_lines[
      worker < 0 || worker >= meta.workers ? meta.workers : worker];
    const views = [
      {name: 'workers', lines: Math.max(...meta.worker_lines) + 1, y: (i) => workerLine(c.worker[i]),
       markY: () => 0},
      {name: 'callbacks', lines: Math.max(0, ...ys) + 1, y: (i) => ys[c.row[i]],
       markY: (miss) => ys[miss.row]}];
    for (const view of views) {
      Object.assign(view, {range, bars: model(`${view.name}_bars`),
                           marks: model(`${view.name}_marks`)});
    }
    const boxes = ['job', 'late'].map((kind) =>
      ['workers', 'callbacks'].map((name) => model(`${name}_${kind}`)));

    function show(from, to) {
      const margin = Math.max(1, to - from) * 0.15;
      range.setv({start: (from - margin) / SECOND, end: (to + margin) / SECOND});
    }

    function showMiss(miss) {
      const deadline = miss.deadline / SECOND, end = miss.shown / SECOND;
      for (const box of boxes[0]) {
        box.setv({left: miss.release / SECOND, right: deadline, visible: true});
      }
      for (const box of boxes[1]) {
        box.setv({left: deadline, right: end, visible: end > deadline});
      }
      element('mddag-status').textContent =
        `job ${miss.job} of ${meta.dags[meta.sinks[miss.sink].dag]}: ${verdictText(miss.at)}`;
      show(miss.release, Math.max(miss.shown, miss.deadline));
    }

    const redraw = later(() => views.forEach(draw));
    range.properties.start.change.connect(redraw);
    range.properties.end.change.connect(redraw);
    views.forEach(draw);

    function step(forward) {
      let now = (range.start + range.end) / 2 * SECOND;
      if ((range.end - range.start) * SECOND > 0.9 * meta.duration) {
        now = forward ? -Infinity : Infinity;
      }
      const times = missed.map((m) =>
        (m.release + Math.max(m.shown, m.deadline)) / 2);
      const near = SECOND / 1e6;
      let best = null;
      missed.forEach((miss, i) => {
        const ahead = forward ? times[i] - now : now - times[i];
        if (ahead > near && (best === null || ahead < best.ahead)) best = {ahead, miss};
      });
      if (best) showMiss(best.miss);
      else element('mddag-status').textContent = 'there is no further missed deadline';
    }
    element('mddag-next').addEventListener('click', () => step(true));
    element('mddag-previous').addEventListener('click', () => step(false));
    element('mddag-whole').addEventListener('click', () =>
      range.setv({start: 0, end: Math.max(1, meta.duration) / SECOND}));
    const find = ([sink, job]) => missed.find((m) => m.sink === sink && m.job === job);
    document.querySelectorAll('[data-miss]').forEach((line) =>
      line.addEventListener('click', () => {
        const miss = find(meta.misses[Number(line.dataset.miss)]);
        if (miss) showMiss(miss);
        else element('mddag-status').textContent = 'the detail around this miss was left out';
        element('mddag-timeline').scrollIntoView({behavior: 'smooth'});
      }));
    window.mddag = {meta, columns: c, missed, views, range, step, ready: true};
  }

  async function main() {
    if (typeof DecompressionStream === 'undefined') {
      throw new Error('this browser is too old: use one of 2023 or newer');
    }
    c = await unpack(meta.columns, element('mddag-data').textContent);
    prepare();
    const wait = () => {
      const doc = window.Bokeh && Bokeh.documents.find((d) => d.get_model_by_name('timeline_range'));
      if (!doc || !Bokeh.index || !document.querySelector('.mddag-plot *')) {
        return setTimeout(wait, 30);
      }
      return start(doc);
    };
    wait();
  }

  main().catch((error) => {
    element('mddag-status').textContent = `The pictures cannot be drawn: ${error.message}`;
    throw error;
  });
})();
