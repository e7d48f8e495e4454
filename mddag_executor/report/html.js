// Moves the timelines of a report to missed deadlines; times are in seconds.
'use strict';
(() => {
  const DARK = window.matchMedia('(prefers-color-scheme: dark)').matches;
  const element = (id) => document.getElementById(id);
  const meta = JSON.parse(element('mddag-meta').textContent);

  // The texts about jobs and executions, from the tables of the page.
  function time(ns) {
    let found = '';
    for (const [scale, unit] of [[1, 'ns'], [1e3, 'us'], [1e6, 'ms'], [1e9, 's']]) {
      const value = Number((ns / scale).toPrecision(4));
      found = `${value} ${unit}`;
      if (Math.abs(value) < 1000) break;
    }
    return found;
  }

  function jobText(dag, job, release) {
    if (dag < 0) return 'declared by no DAG';
    const text = `job ${job} of ${meta.dags[dag]}`;
    return isNaN(release) ? text : `${text}, released at ${release.toFixed(6)} s`;
  }

  function verdictText([sink, , , , deadline, response, verdict]) {
    const name = meta.short[sink], due = `(deadline ${time(deadline)})`;
    if (response === null) return `MISSED at ${name}: ${verdict} ${due}`;
    const slack = deadline - response;
    const how = slack < 0 ? `${time(-slack)} late` : `${time(slack)} of slack`;
    return `${slack < 0 ? 'MISSED' : 'in time'} at ${name}: response ${time(response)}, ${how} ${due}`;
  }

  function fillTexts(bars, marks) {     // a to d: the lines of a tool tip
    const d = bars.data, all = (column, text) => Array.from(column, text);
    d.a = all(d.name, (name) => meta.names[name]);
    d.b = all(d.job, (job, i) => jobText(d.dag[i], job, d.release[i]));
    d.c = all(d.worker, (worker, i) => {
      const where = worker < 0 ? 'a spare thread' : meta.workers[worker] || `worker ${worker}`;
      return `started ${d.left[i].toFixed(6)} s on ${where}, waited ` +
        `${time(Math.round(d.waited[i] * 1e9))}, ran ${time(Math.round((d.right[i] - d.left[i]) * 1e9))}`;
    });
    d.d = all(d.verdict, (verdict, i) => verdict >= 0 ? verdictText(meta.verdicts[verdict])
      : d.name[i] < meta.declared ? 'no verdict known' : '');
    const m = marks.data, of = all(m.verdict, (verdict) => meta.verdicts[verdict]);
    m.a = of.map(([sink]) => meta.names[sink]);
    m.b = of.map(([, ...job]) => jobText(...job));
    m.c = of.map(verdictText);
    m.d = of.map(() => '');
  }

  const missed = meta.missed.map((place) => {
    const verdict = meta.verdicts[place], [, dag, job, release, deadline, response] = verdict;
    return {release, deadline: release + deadline / 1e9, shown: release + (response ?? deadline) / 1e9,
            text: `${jobText(dag, job, release)}: ${verdictText(verdict)}`};
  });

  // The table of sinks: search, sort, and the rows that are not in the page at first.
  function sinks() {
    const table = document.querySelector('#mddag-sinks table');
    if (!table) return;
    const body = table.tBodies[0], search = element('mddag-search');
    const titles = [...table.tHead.rows[0].cells], button = element('mddag-all-sinks');

    function all() {
      for (const row of body.rows) row.hidden = false;
      if (button) button.remove();
    }

    const units = {ns: 1, us: 1e3, ms: 1e6, s: 1e9};
    function value(row, column) {
      if (column === titles.length - 1) return Number(row.dataset.reached);
      const text = row.cells[column].textContent, found = /^([-+\d.]+)(?: (\S+))?$/.exec(text);
      if (text === '-') return -Infinity;
      return found ? Number(found[1]) * (units[found[2]] || 1) : text;
    }

    if (button) button.addEventListener('click', all);
    search.addEventListener('input', () => {
      all();
      const wanted = search.value.toLowerCase();
      for (const row of body.rows) {
        row.hidden = !`${row.cells[0].textContent} ${row.cells[1].textContent}`
          .toLowerCase().includes(wanted);
      }
    });
    let last = null;
    titles.forEach((title, column) =>
      title.addEventListener('click', () => {
        all();
        const turn = last === column ? -1 : 1;
        last = turn === 1 ? column : null;
        const sign = column < 2 ? turn : -turn;       // names from a, figures from the largest
        body.append(...[...body.rows].sort((one, other) => {
          const a = value(one, column), b = value(other, column);
          return sign * (a < b ? -1 : a > b ? 1 : 0);
        }));
      }));
  }

  function darken(doc) {                // the pictures, where the reader prefers dark pages
    for (const model of doc.roots()) {
      model.setv({background_fill_color: '#202022', border_fill_color: '#1b1b1d',
                  outline_line_color: '#555'});
      if (model.title) model.title.text_color = '#ddd';
      for (const axis of [...model.below, ...model.left]) {
        axis.setv({major_label_text_color: '#bbb', axis_label_text_color: '#bbb',
                   axis_line_color: '#777', major_tick_line_color: '#777'});
      }
      for (const part of model.center) {
        if ('grid_line_color' in part && part.grid_line_color) part.grid_line_color = '#3a3a3d';
        if (part.fill_color === '#eeeeee') part.fill_color = '#333336';
      }
    }
  }

  function start(doc) {
    const model = (name) => doc.get_model_by_name(name);
    fillTexts(model('executions'), model('marks'));
    if (DARK) darken(doc);
    const range = model('timeline_range');
    const boxes = (kind) => ['workers', 'callbacks'].map((name) => model(`${name}_${kind}`));

    function show({release, deadline, shown, text}) {
      for (const box of boxes('job')) box.setv({left: release, right: deadline, visible: true});
      for (const box of boxes('late')) {
        box.setv({left: deadline, right: shown, visible: shown > deadline});
      }
      element('mddag-status').textContent = text;
      const end = Math.max(shown, deadline), margin = Math.max(1e-7, end - release) * 0.15;
      range.setv({start: release - margin, end: end + margin});
    }

    function step(forward) {
      let now = (range.start + range.end) / 2;
      if (range.end - range.start > 0.9 * meta.duration) now = forward ? -Infinity : Infinity;
      let best = null;
      for (const miss of missed) {
        const middle = (miss.release + Math.max(miss.shown, miss.deadline)) / 2;
        const ahead = forward ? middle - now : now - middle;
        if (ahead > 1e-6 && (best === null || ahead < best.ahead)) best = {ahead, miss};
      }
      if (best) show(best.miss);
      else element('mddag-status').textContent = 'there is no further missed deadline';
    }

    element('mddag-next').addEventListener('click', () => step(true));
    element('mddag-previous').addEventListener('click', () => step(false));
    element('mddag-whole').addEventListener('click', () =>
      range.setv({start: 0, end: Math.max(1e-7, meta.duration)}));
    document.querySelectorAll('[data-miss]').forEach((line) =>
      line.addEventListener('click', () => {
        show(missed[Number(line.dataset.miss)]);
        element('mddag-timeline').scrollIntoView({behavior: 'smooth'});
      }));
    window.mddag = {meta, missed, range, bars: model('executions'), marks: model('marks'),
                    ready: true};
  }

  const wait = () => {
    const doc = window.Bokeh && Bokeh.documents.find((d) => d.get_model_by_name('timeline_range'));
    if (!doc || !Bokeh.index || !document.querySelector('.mddag-plot *')) {
      return setTimeout(wait, 30);
    }
    return start(doc);
  };
  sinks();
  wait();
})();
