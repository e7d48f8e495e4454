// Columns of numbers as html_data.py packs them, and searching in them.
'use strict';
window.mddagColumns = (() => {
  async function unpack(described, base64) {
    const text = atob(base64);
    const packed = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream('deflate'));
    const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
    const columns = {};
    let at = 0;
    for (const column of described) {
      const values = new Float64Array(column.n);
      for (let plane = 0, weight = 1; plane < column.width; plane++, weight *= 256) {
        for (let i = 0; i < column.n; i++) values[i] += bytes[at++] * weight;
      }
      let before = 0;
      for (let i = 0; i < column.n; i++) {
        const u = values[i], v = u % 2 ? -(u + 1) / 2 : u / 2;
        values[i] = before = column.delta ? before + v : v;
      }
      columns[column.name] = values;
    }
    return columns;
  }

  function lower(values, wanted, from = 0, to = values.length) {
    while (from < to) {
      const middle = (from + to) >> 1;
      if (values[middle] < wanted) from = middle + 1; else to = middle;
    }
    return from;
  }

  function spans(values, count) {       // of equal numbers in ascending order: [from, to]
    const found = [];
    for (let n = 0; n < count; n++) found.push([lower(values, n), lower(values, n + 1)]);
    return found;
  }

  return {lower, spans, unpack};
})();
