// Moves the timelines of a report to missed deadlines; times are in seconds.
'use strict';
(() => {
  const NARROW = 700;                   // pixels, as in html.css
  const element = (id) => document.getElementById(id);
  const meta = JSON.parse(element('mddag-meta').textContent);
  const missed = meta.missed.map(
    ([release, deadline, shown, text]) => ({release, deadline, shown, text}));

  function brief(labels) {
    return new Map([...(labels.entries ? labels.entries() : Object.entries(labels))].map(
      ([y, text]) => {
        const name = text.split(', every ')[0];
        return [Number(y), name.length > 18 ? '…' + name.slice(-17) : name];
      }));
  }

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
  wait();
})();
