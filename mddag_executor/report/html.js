// Draws the pictures of a report on canvases and makes its tables sortable and searchable.
// All times are nanoseconds since the start of the recording. Names are only ever set as text.
'use strict';
(async () => {
  const element = (id) => document.getElementById(`mddag-${id}`);
  if (!window.DecompressionStream) {
    element('status').textContent = 'This browser is too old for the pictures of this page: it ' +
      'has no DecompressionStream.';
    return;
  }
  const packed = Uint8Array.from(atob(element('data').textContent), (char) => char.charCodeAt(0));
  const data = await new Response(
    new Blob([packed]).stream().pipeThrough(new DecompressionStream('deflate'))).json();
  const bars = data.executions, verdicts = data.verdicts, count = bars.name.length;
  const LEFT = 290, RIGHT = 30, LINE = 17, AXIS = 34, MOST_LINES = 100;
  const COLOURS = ['missed', 'least', 'less', 'more', 'most', 'unknown'];

  function added(steps, unit) {       // times and numbers are stored as steps
    let sum = 0;
    return steps.map((step) => (sum += step) * unit);
  }

  bars.start = added(bars.start, 1e3);
  verdicts.release = added(verdicts.release, 1e3);
  const jobs = added(data.jobs.job, 1), releases = new Map();
  added(data.jobs.release, 1e3).forEach((release, i) => {
    releases.set(`${data.jobs.dag[i]} ${jobs[i]}`, release);
  });
  const verdictOf = new Map(verdicts.job.map((job, i) => [`${verdicts.sink[i]} ${job}`, i]));

  // --- texts -------------------------------------------------------------------------------------

  function time(ns) {
    let found = '';
    for (const [scale, unit] of [[1, 'ns'], [1e3, 'us'], [1e6, 'ms'], [1e9, 's']]) {
      found = `${Number((ns / scale).toPrecision(4))} ${unit}`;
      if (Math.abs(ns / scale) < 999.95) break;
    }
    return found;
  }

  const at = (ns) => `${(ns / 1e9).toFixed(6)} s`;

  function jobText(verdict) {
    const dag = data.dags[data.dagOf[verdicts.sink[verdict]]];
    return `job ${verdicts.job[verdict]} of ${dag}, released at ${at(verdicts.release[verdict])}`;
  }

  function verdictText(verdict) {
    const sink = verdicts.sink[verdict], name = data.short[sink], deadline = data.deadlines[sink];
    const due = `(deadline ${time(deadline)})`, response = verdicts.response[verdict];
    if (response === null) return `MISSED at ${name}: ${data.kinds[verdicts.kind[verdict]]} ${due}`;
    const slack = deadline - response;
    return `${slack < 0 ? 'MISSED' : 'in time'} at ${name}: response ${time(response)}, ` +
      (slack < 0 ? `${time(-slack)} late ${due}` : `${time(slack)} of slack ${due}`);
  }

  function barText(i) {
    const name = bars.name[i], verdict = verdictOf.get(`${bars.sink[i]} ${bars.job[i]}`);
    const declared = name < data.declared;
    const release = releases.get(`${data.dagOf[name]} ${bars.job[i]}`);
    const lines = [data.names[name]];
    lines.push(!declared ? 'declared by no DAG' : `job ${bars.job[i]} of ` +
      data.dags[data.dagOf[name]] +
      (release === undefined ? '' : `, released at ${at(release)}`));
    lines.push(`started ${at(bars.start[i])} on ${data.workers[bars.worker[i]]}, waited ` +
      `${time(bars.waited[i])}, ran ${time(bars.ran[i])}`);
    if (declared) {
      lines.push(verdict === undefined ? 'no verdict known' : verdictText(verdict));
    }
    return lines.join('\n');
  }

  // A missed deadline: when it was due, and when the result came (or should have come).
  const missed = data.misses.map((verdict) => {
    const sink = verdicts.sink[verdict], release = verdicts.release[verdict];
    const deadline = release + data.deadlines[sink], response = verdicts.response[verdict];
    return {verdict, sink, release, deadline, text: `${jobText(verdict)}: ${verdictText(verdict)}`,
            shown: response === null ? deadline : release + response};
  });

  // --- tables ------------------------------------------------------------------------------------

  const UNITS = {ns: 1, us: 1e3, ms: 1e6, s: 1e9, '%': 1};

  function sortKey(cell) {
    const text = cell.textContent;
    if (text === '-') return -Infinity;
    const found = /^([-+\d.]+)(?: ?(ns|us|ms|s|%))?$/.exec(text);
    return found ? Number(found[1]) * (UNITS[found[2]] || 1) : text.toLowerCase();
  }

  function enliven(part) {
    const body = part.querySelector('tbody'), titles = [...part.querySelectorAll('th')];
    const search = part.querySelector('input'), button = part.querySelector('button.all');
    const chooseFirst = rove(body);
    const showAll = () => {       // that fit the search
      const words = (search ? search.value : '').toLowerCase().split(/\s+/);
      for (const row of body.rows) {
        const text = [...row.cells].map((cell) => cell.textContent).join(' ').toLowerCase();
        row.hidden = !words.every((word) => text.includes(word));
      }
      if (button) button.remove();
      chooseFirst();
    };
    if (button) button.addEventListener('click', showAll);
    if (search) search.addEventListener('input', showAll);
    function sort(title, column) {
      const names = title.classList.contains('text');       // names from a, figures from the largest
      const first = names ? 'ascending' : 'descending', other = names ? 'descending' : 'ascending';
      const order = title.getAttribute('aria-sort') === first ? other : first;
      for (const each of titles) each.removeAttribute('aria-sort');
      title.setAttribute('aria-sort', order);
      const sign = order === 'ascending' ? 1 : -1;
      const rows = [...body.rows].map((row) => [sortKey(row.cells[column]), row]);
      rows.sort(([a], [b]) => sign * (typeof a !== typeof b ? (typeof a < typeof b ? -1 : 1)
        : a < b ? -1 : a > b ? 1 : 0));
      body.append(...rows.map(([, row]) => row));
      showAll();
    }
    part.classList.add('sortable');
    titles.forEach((title, column) => {
      title.tabIndex = 0;
      activate(title, () => sort(title, column));
    });
  }

  // Of the rows that show something, Tab reaches one, and the arrows reach the others.
  function rove(body) {
    const steps = {ArrowDown: 1, ArrowUp: -1, PageDown: 10, PageUp: -10, Home: -1e9, End: 1e9};
    const rows = () => [...body.rows].filter((row) => row.dataset.miss || row.dataset.dag);
    const shown = () => rows().filter((row) => !row.hidden);
    let chosen;
    const choose = (row) => {
      if (chosen) chosen.tabIndex = -1;
      chosen = row;
      if (chosen) chosen.tabIndex = 0;
    };
    const first = () => choose(shown()[0]);
    for (const row of rows()) row.tabIndex = -1;
    if (rows().length) body.closest('.scroll').removeAttribute('tabindex');
    body.addEventListener('focusin', (event) => choose(event.target.closest('tr')));
    body.addEventListener('keydown', (event) => {
      const by = steps[event.key], places = by ? shown() : [], place = places.indexOf(event.target);
      if (place < 0) return;
      event.preventDefault();
      places[Math.max(0, Math.min(place + by, places.length - 1))].focus();
    });
    first();
    return first;
  }

  function activate(target, action) {       // by mouse and by keyboard
    target.addEventListener('click', action);
    target.addEventListener('keydown', (event) => {
      if (event.key === 'Enter' && event.target === target) action();
    });
  }

  // --- drawing -----------------------------------------------------------------------------------

  let colours = {};

  function readColours() {
    const style = getComputedStyle(document.documentElement);
    colours = {};
    for (const name of [...COLOURS, 'page', 'text', 'faint', 'line', 'heading', 'job', 'late', 'gap',
                        'grid']) {
      colours[name] = style.getPropertyValue(`--${name}`).trim();
    }
  }

  function begin(canvas, height) {
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth;
    canvas.style.height = `${height}px`;
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const draw = canvas.getContext('2d');
    draw.scale(ratio, ratio);
    draw.font = '12px system-ui, sans-serif';
    draw.textBaseline = 'middle';
    return {draw, width};
  }

  function text(draw, words, x, y, align, colour, most) {
    draw.textAlign = align;
    draw.fillStyle = colour || colours.text;
    draw.fillText(words, x, y, most);
  }

  function ticks(from, to, most) {
    let step = 10 ** Math.floor(Math.log10(Math.max(1e-9, (to - from) / most)));
    for (const factor of [2, 2.5, 2]) if ((to - from) / step > most) step *= factor;
    const found = [];
    for (let tick = Math.ceil(from / step) * step; tick <= to; tick += step) found.push(tick);
    return {step, found};
  }

  function timeAxis(draw, width, from, to, x, y, title) {
    const {step, found} = ticks(from, to, Math.max(2, (width - LEFT) / 110));
    const [scale, unit] = step >= 1e8 ? [1e9, 's'] : step >= 1e5 ? [1e6, 'ms'] : [1e3, 'us'];
    const digits = Math.max(0, Math.min(6, Math.ceil(-Math.log10(step / scale) - 1e-9)));
    for (const tick of found) {
      draw.fillStyle = colours.grid;
      draw.fillRect(x(tick), 0, 1, y);
      text(draw, `${(tick / scale).toFixed(digits)} ${unit}`, x(tick), y + 10, 'center', colours.faint);
    }
    if (title) text(draw, title, (x(from) + x(to)) / 2, y + 25, 'center', colours.faint);
  }

  function hatch(draw, left, right, height) {
    draw.save();
    draw.beginPath();
    draw.rect(left, 0, right - left, height);
    draw.clip();
    draw.strokeStyle = colours.gap;
    draw.beginPath();
    for (let x = left - height; x < right; x += 7) {
      draw.moveTo(x, height);
      draw.lineTo(x + height, 0);
    }
    draw.stroke();
    draw.restore();
  }

  function triangle(draw, x, y) {
    draw.fillStyle = colours.missed;
    draw.beginPath();
    draw.moveTo(x - 5, y - 5);
    draw.lineTo(x + 5, y - 5);
    draw.lineTo(x, y + 5);
    draw.closePath();
    draw.fill();
    draw.strokeStyle = colours.page;        // bars under it are red as well
    draw.stroke();
  }

  // --- timelines ---------------------------------------------------------------------------------

  const view = {from: 0, to: data.duration, miss: null};
  const least = 100;        // shortest view, ns
  let filter = '';

  const workerLines = data.workers.map((label) => ({label, heading: false}));
  if (missed.length) workerLines.push({label: 'missed deadlines', heading: false});
  const pictures = {
    workers: {canvas: element('workers'), lines: workerLines, row: (i) => bars.worker[i],
              missRow: () => workerLines.length - 1},
    callbacks: {canvas: element('callbacks'), lines: [], rows: [],
                row: (i) => pictures.callbacks.rows[data.lineOf[bars.name[i]]],
                missRow: (miss) => pictures.callbacks.rows[data.lineOf[miss.sink]]}};

  function chooseLines() {      // those of the filter: whole DAGs, or single callbacks
    const all = data.lines.map(([label, heading, dag]) => ({label, heading, dag}));
    const wanted = filter.toLowerCase(), exact = all.some((line) => line.dag === filter);
    const fits = (line) => exact ? line.dag === filter
      : line.dag.toLowerCase().includes(wanted) || line.label.toLowerCase().includes(wanted);
    const withFit = new Set(all.filter((line) => !line.heading && fits(line)).map((line) => line.dag));
    const chosen = [];
    all.forEach((line, i) => {
      if (line.heading ? withFit.has(line.dag) : fits(line)) chosen.push(i);
    });
    const shown = chosen.slice(0, MOST_LINES);
    const picture = pictures.callbacks;
    picture.lines = shown.map((i) => all[i]);
    picture.rows = new Array(all.length).fill(-1);
    shown.forEach((i, row) => { picture.rows[i] = row; });
    const callbacks = (places) => places.filter((i) => !all[i].heading).length;
    const left = callbacks(chosen) - callbacks(shown);
    element('shown').textContent =
      `${callbacks(shown)} of ${callbacks([...all.keys()])} callbacks` + (left
        ? ` (write a part of a name for the other ${left})` : '') +
      (data.dags.length ? '; DAGs that missed the largest share of their deadlines come first' : '');
  }

  const xOf = (width) => (ns) =>
    LEFT + (ns - view.from) / (view.to - view.from) * (width - LEFT - RIGHT);
  const nsAt = (canvas, x) => view.from +
    (x - LEFT) / (canvas.clientWidth - LEFT - RIGHT) * (view.to - view.from);

  function drawTimeline({canvas, lines, row, missRow}) {
    const height = lines.length * LINE, {draw, width} = begin(canvas, height + AXIS);
    const x = xOf(width), right = width - RIGHT;
    lines.forEach((line, i) => {
      if (line.heading) {
        draw.fillStyle = colours.heading;
        draw.fillRect(0, i * LINE, width, LINE);
      }
      text(draw, line.label, line.heading ? 4 : LEFT - 8, (i + 0.5) * LINE,
           line.heading ? 'left' : 'right', colours.text, LEFT - 12);
    });
    timeAxis(draw, width, view.from, view.to, x, height, '');
    draw.save();
    draw.beginPath();
    draw.rect(LEFT, 0, right - LEFT, height);
    draw.clip();
    for (const [from, to] of data.gaps) {
      if (to > view.from && from < view.to) hatch(draw, x(from), x(to), height);
    }
    if (view.miss) {
      draw.globalAlpha = 0.5;
      const {release, deadline, shown} = view.miss;
      draw.fillStyle = colours.job;
      draw.fillRect(x(release), 0, x(deadline) - x(release), height);
      draw.fillStyle = colours.late;
      draw.fillRect(x(deadline), 0, Math.max(0, x(shown) - x(deadline)), height);
      draw.globalAlpha = 1;
    }
    for (let colour = COLOURS.length - 1; colour >= 0; colour--) {      // missed ones on top
      draw.fillStyle = colours[COLOURS[colour]];
      for (let i = 0; i < count; i++) {
        const start = bars.start[i], end = start + bars.ran[i];
        if (bars.colour[i] !== colour || end < view.from || start > view.to) continue;
        const line = row(i);
        if (line >= 0) {
          draw.fillRect(x(start), line * LINE + 2, Math.max(1, x(end) - x(start)), LINE - 4);
        }
      }
    }
    for (const miss of missed) {
      const line = missRow(miss);
      if (line >= 0 && miss.shown >= view.from && miss.shown <= view.to) {
        triangle(draw, x(miss.shown), (line + 0.5) * LINE);
      }
    }
    draw.restore();
    draw.strokeStyle = colours.line;
    draw.strokeRect(LEFT - 0.5, 0.5, right - LEFT, height - 0.5);
  }

  const overview = element('overview');

  function drawOverview() {
    const height = 92, {draw, width} = begin(overview, height + AXIS), right = width - RIGHT;
    const x = (ns) => LEFT + ns / data.duration * (right - LEFT);
    const workers = data.workers.filter((name) => name !== 'spare threads').length || 1;
    timeAxis(draw, width, 0, data.duration, x, height, 'time of the run');
    text(draw, 'busy workers', 8, height / 2, 'left', colours.faint);
    for (const number of new Set([0, workers])) {
      text(draw, `${number}`, LEFT - 8, height - 6 - number / workers * (height - 24), 'right',
           colours.faint);
    }
    const steps = ({start, step, sums}, act) => sums.forEach((part, i) => {
      if (part) act(x(start + i * step), x(start + (i + 1) * step), part / step);
    });
    draw.save();
    draw.beginPath();
    draw.rect(LEFT, 0, right - LEFT, height);
    draw.clip();
    draw.fillStyle = colours.most;
    steps(data.busy, (from, to, busy) => {
      const top = busy / workers * (height - 18);
      draw.fillRect(Math.floor(from), height - top, Math.ceil(to) - Math.floor(from), top);
    });
    draw.fillStyle = colours.missed;
    steps(data.late, (from, to) => draw.fillRect(from, 2, Math.max(3, to - from), 8));
    draw.restore();
    draw.fillStyle = colours.faint;
    draw.globalAlpha = 0.15;
    draw.fillRect(LEFT, 0, Math.max(0, x(view.from) - LEFT), height);     // what is not in view
    draw.fillRect(x(view.to), 0, Math.max(0, right - x(view.to)), height);
    draw.globalAlpha = 1;
    for (const edge of [view.from, view.to]) draw.fillRect(x(edge) - 1, 0, 2, height);
    draw.strokeStyle = colours.line;
    draw.strokeRect(LEFT - 0.5, 0.5, right - LEFT, height - 0.5);
  }

  let asked = false;

  function redraw() {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      drawOverview();
      drawTimeline(pictures.workers);
      drawTimeline(pictures.callbacks);
    });
  }

  function look(from, to) {     // within one run's length before and after the run
    const length = Math.min(Math.max(to - from, least), 1.4 * data.duration);
    const begins = Math.min(Math.max(from, -0.2 * data.duration), 1.2 * data.duration - length);
    [view.from, view.to] = [begins, begins + length];
    redraw();
  }

  function zoom(factor, around = (view.from + view.to) / 2) {
    look(around + (view.from - around) * factor, around + (view.to - around) * factor);
  }

  const move = (share) => look(view.from + share * (view.to - view.from),
                               view.to + share * (view.to - view.from));

  function show(miss) {
    view.miss = miss;
    element('status').textContent = miss.text;
    const end = Math.max(miss.shown, miss.deadline), margin = Math.max(least, end - miss.release) * 0.15;
    if (pictures.callbacks.rows[data.lineOf[miss.sink]] === -1) setFilter('');
    if (pictures.callbacks.rows[data.lineOf[miss.sink]] === -1) {
      setFilter(data.dags[data.dagOf[miss.sink]]);
    }
    for (const row of document.querySelectorAll('[data-miss]')) {
      row.classList.toggle('chosen', missed[Number(row.dataset.miss)] === miss);
    }
    look(miss.release - margin, end + margin);
  }

  function step(forward) {
    const place = missed.indexOf(view.miss);
    const next = place < 0 ? (forward ? 0 : missed.length - 1) : place + (forward ? 1 : -1);
    if (missed[next]) show(missed[next]);
    else element('status').textContent = 'there is no further missed deadline in the list';
  }

  function setFilter(words) {
    filter = words;
    element('lines').value = words;
    chooseLines();
    redraw();
  }

  // --- mouse and keyboard ------------------------------------------------------------------------

  const tip = element('tip');

  function point({canvas, row, missRow}, event) {       // the bar or miss under the pointer
    const box = canvas.getBoundingClientRect(), x = xOf(canvas.clientWidth);
    const left = event.clientX - box.left, line = Math.floor((event.clientY - box.top) / LINE);
    let found = '', nearest = 4;
    for (const miss of missed) {
      if (missRow(miss) === line && Math.abs(x(miss.shown) - left) < 6) found = miss.text;
    }
    for (let i = 0; !found && i < count; i++) {
      if (row(i) !== line) continue;
      const from = x(bars.start[i]), to = x(bars.start[i] + bars.ran[i]);
      const away = left < from ? from - left : left > to ? left - to : 0;
      if (away < nearest) [nearest, tip.textContent] = [away, barText(i)];
    }
    if (found) tip.textContent = found;
    tip.hidden = left < LEFT || !(found || nearest < 4);
    if (tip.hidden) return;
    tip.style.left = `${Math.max(4, Math.min(event.clientX + 14, innerWidth - tip.offsetWidth - 8))}px`;
    const below = event.clientY + 16;
    tip.style.top = `${below + tip.offsetHeight < innerHeight ? below
      : event.clientY - tip.offsetHeight - 10}px`;
  }

  for (const picture of Object.values(pictures)) {
    const {canvas} = picture;
    let grabbed = null;
    canvas.addEventListener('pointerdown', (event) => {
      grabbed = {x: event.clientX, from: view.from, to: view.to};
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener('pointermove', (event) => {
      if (!grabbed) return point(picture, event);
      tip.hidden = true;
      const by = (grabbed.x - event.clientX) / (canvas.clientWidth - LEFT - RIGHT) *
        (grabbed.to - grabbed.from);
      return look(grabbed.from + by, grabbed.to + by);
    });
    for (const name of ['pointerup', 'pointercancel']) {
      canvas.addEventListener(name, () => { grabbed = null; });
    }
    canvas.addEventListener('pointerleave', () => { tip.hidden = true; });
    canvas.addEventListener('wheel', (event) => {       // without Ctrl the page scrolls
      if (!event.ctrlKey) return;
      event.preventDefault();
      zoom(event.deltaY > 0 ? 1.25 : 0.8, nsAt(canvas, event.offsetX));
    }, {passive: false});
  }

  {
    let grabbed = null;
    const at = (event) => (event.offsetX - LEFT) / (overview.clientWidth - LEFT - RIGHT) * data.duration;
    overview.addEventListener('pointerdown', (event) => {
      const here = at(event), near = 8 / (overview.clientWidth - LEFT - RIGHT) * data.duration;
      const length = view.to - view.from;
      overview.setPointerCapture(event.pointerId);
      if (Math.abs(here - view.from) < near) grabbed = {edge: 'from'};
      else if (Math.abs(here - view.to) < near) grabbed = {edge: 'to'};
      else {
        if (here < view.from || here > view.to) look(here - length / 2, here + length / 2);
        grabbed = {by: here - view.from};
      }
    });
    overview.addEventListener('pointermove', (event) => {
      if (!grabbed) return;
      const here = at(event);
      if (grabbed.edge === 'from') look(Math.min(here, view.to - least), view.to);
      else if (grabbed.edge === 'to') look(view.from, Math.max(here, view.from + least));
      else look(here - grabbed.by, here - grabbed.by + view.to - view.from);
    });
    for (const name of ['pointerup', 'pointercancel']) {
      overview.addEventListener(name, () => { grabbed = null; });
    }
  }

  const whole = () => look(0, data.duration);
  const ACTIONS = {n: () => step(true), p: () => step(false), '+': () => zoom(0.5),
                   '=': () => zoom(0.5), '-': () => zoom(2), 0: whole,
                   ArrowLeft: () => move(-0.25), ArrowRight: () => move(0.25)};
  document.addEventListener('keydown', (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || event.target.matches('input')) return;
    // in a table the arrows scroll
    if (event.key.startsWith('Arrow') && event.target.closest('.scroll')) return;
    if (!ACTIONS[event.key] || ('np'.includes(event.key) && !missed.length)) return;
    event.preventDefault();
    ACTIONS[event.key]();
  });

  // --- histograms --------------------------------------------------------------------------------

  const histograms = data.histograms.map((found) => {
    const canvas = document.createElement('canvas');
    canvas.setAttribute('role', 'img');
    canvas.setAttribute('aria-label', found.title);
    element('histograms').append(canvas);
    canvas.addEventListener('pointermove', (event) => {
      const hit = (found.areas || []).find(({from, to}) => event.offsetX >= from && event.offsetX <= to);
      canvas.title = hit ? hit.text : '';
    });
    return {canvas, ...found};
  });

  function drawHistogram(found) {
    const {canvas, title, deadline, width: step, bars: pairs, later} = found;
    const {draw, width} = begin(canvas, 200), left = 44, bottom = 158, top = 26;
    const right = width - 12, room = later ? 70 : 0;
    const end = Math.max(deadline * 1.06, pairs.length ? (pairs[pairs.length - 1][0] + 1) * step : 0);
    const x = (ns) => left + ns / end * (right - room - left);
    const most = Math.max(later ? later[0] : 0, ...pairs.map(([, n]) => n));
    const y = (n) => bottom - n / most * (bottom - top);
    draw.font = 'bold 12px system-ui, sans-serif';
    text(draw, title, left, 10, 'left');
    draw.font = '12px system-ui, sans-serif';
    text(draw, `${most}`, left - 6, top, 'right', colours.faint);
    text(draw, '0', left - 6, bottom, 'right', colours.faint);
    text(draw, 'jobs', left - 6, (top + bottom) / 2, 'right', colours.faint);
    const {step: between, found: at} = ticks(0, end, Math.max(2, (right - room - left) / 80));
    const [scale, unit] = end >= 2e9 ? [1e9, 's'] : end >= 2e6 ? [1e6, 'ms'] : [1e3, 'us'];
    const digits = Math.max(0, Math.ceil(-Math.log10(between / scale) - 1e-9));
    for (const tick of at) {
      text(draw, (tick / scale).toFixed(digits), x(tick), bottom + 12, 'center', colours.faint);
    }
    text(draw, `response time (${unit})`, (left + right - room) / 2, bottom + 30, 'center', colours.faint);
    found.areas = pairs.map(([place, n]) => {
      const [from, to] = [x(place * step), x((place + 1) * step)];
      draw.fillStyle = place * step >= deadline * (1 - 1e-9) ? colours.missed : colours.most;
      draw.fillRect(from, y(n), Math.max(1, to - from - 1), bottom - y(n));
      return {from, to, text: `${time(place * step)} to ${time((place + 1) * step)}: ${n} jobs`};
    });
    if (later) {        // all that is far beyond the deadline, apart from the scale
      const from = right - 46, ends = [...new Set([time(later[1]), time(later[2])])];
      const words = ends.join(' to ');
      draw.fillStyle = colours.missed;
      draw.fillRect(from, y(later[0]), 34, bottom - y(later[0]));
      text(draw, '…', right - room + 10, bottom - 4, 'center');
      text(draw, words, right, bottom + 30, 'right', colours.missed);
      found.areas.push({from, to: from + 34, text: `${words}: ${later[0]} jobs`});
    }
    draw.strokeStyle = colours.missed;
    draw.lineWidth = 2;
    draw.setLineDash([5, 4]);
    draw.beginPath();
    draw.moveTo(x(deadline), top);
    draw.lineTo(x(deadline), bottom);
    draw.stroke();
    draw.setLineDash([]);
    draw.fillStyle = colours.line;
    draw.fillRect(left, bottom, right - left, 1);
  }

  // --- start -------------------------------------------------------------------------------------

  function drawAll() {
    readColours();
    redraw();
    histograms.forEach(drawHistogram);
  }

  document.querySelectorAll('.data').forEach(enliven);
  for (const [id, action] of Object.entries({
    next: () => step(true), previous: () => step(false), whole, in: () => zoom(0.5),
    out: () => zoom(2)})) {
    if (element(id)) element(id).addEventListener('click', action);
  }
  const toTimeline = () => element('timeline').scrollIntoView({behavior: 'smooth'});
  for (const row of document.querySelectorAll('[data-miss]')) {
    activate(row, () => { show(missed[Number(row.dataset.miss)]); toTimeline(); });
  }
  for (const row of document.querySelectorAll('#mddag-sinks [data-dag]')) {
    activate(row, () => { setFilter(row.dataset.dag); toTimeline(); });
  }
  element('lines').addEventListener('input', () => setFilter(element('lines').value));
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', drawAll);
  addEventListener('resize', drawAll);
  chooseLines();
  drawAll();
  window.mddag = {data, missed, view, pictures, barText, xOf, colours: () => colours, ready: true};
})();
