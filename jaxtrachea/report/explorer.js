// The explorer of report.html: the curves of a fit, and where the estimates go without some of them.
// Data: what `explorer.py` writes beside it. Names reach the page as text alone.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("explorer-data").textContent);
  const root = document.getElementById("explorer");
  const SVG = "http://www.w3.org/2000/svg";
  const WIDTH = 460, HIGH = 230, LEFT = 62, BOTTOM = 38, TOP = 8, RIGHT = 8;
  const out = new Set(); // places of the curves that are left out
  const marked = data.curves.map(() => []); // elements of each curve

  function make(tag, attributes = {}, text = "", parent = null) {
    const svg = ["svg", "g", "path", "circle", "line", "rect", "text"].includes(tag);
    const element = svg ? document.createElementNS(SVG, tag) : document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    if (text) element.textContent = text;
    if (parent) parent.append(element);
    return element;
  }

  // An element of curve k: pointing at it lights the curve up everywhere, a click leaves it out.
  function belongs(element, k) {
    element.classList.add("curve");
    marked[k].push(element);
    element.addEventListener("pointerenter", () => light(k, true));
    element.addEventListener("pointerleave", () => light(k, false));
    return element;
  }

  function light(k, on) {
    for (const element of marked[k]) element.classList.toggle("lit", on);
    document.getElementById("explorer-name").textContent = on ? data.curves[k].label : "";
  }

  function toggle(k) {
    if (!out.delete(k)) out.add(k);
    for (const element of marked[k]) element.classList.toggle("out", out.has(k));
    tell();
  }

  const round = (v, digits) => Number(v.toPrecision(digits)).toString();

  function ticks(low, high) {
    const step = 10 ** Math.floor(Math.log10((high - low) / 3));
    const by = step * [1, 2, 5, 10].find((m) => (high - low) / (step * m) <= 5);
    const found = [];
    for (let v = Math.ceil(low / by) * by; v <= high + 1e-9 * by; v += by) found.push(v);
    return found;
  }

  function picture(places, words, series, limits) {
    const svg = make("svg", { viewBox: `0 0 ${WIDTH} ${HIGH}`, role: "img", "aria-label": words[1] });
    const [x0, x1, y0, y1] = limits;
    const X = (v) => LEFT + ((v - x0) / (x1 - x0)) * (WIDTH - LEFT - RIGHT);
    const Y = (v) => HIGH - BOTTOM - ((v - y0) / (y1 - y0)) * (HIGH - BOTTOM - TOP);
    const clip = (v) => Math.min(Math.max(v, y0), y1);
    for (const v of ticks(x0, x1)) {
      make("text", { x: X(v), y: HIGH - BOTTOM + 14, "text-anchor": "middle" }, round(v, 6), svg);
    }
    for (const v of ticks(y0, y1)) {
      make("line", { x1: LEFT, x2: WIDTH - RIGHT, y1: Y(v), y2: Y(v), class: "grid" }, "", svg);
      make("text", { x: LEFT - 5, y: Y(v) + 4, "text-anchor": "end" }, round(v, 6), svg);
    }
    make("text", { x: (LEFT + WIDTH) / 2, y: HIGH - 6, "text-anchor": "middle" }, words[0], svg);
    const at = `translate(13 ${(HIGH - BOTTOM) / 2}) rotate(-90)`;
    make("text", { transform: at, "text-anchor": "middle" }, words[1], svg);
    for (const k of places) {
      const group = belongs(make("g", { stroke: data.curves[k].colour }, "", svg), k);
      group.addEventListener("click", () => toggle(k));
      for (const [name, line] of series) {
        const { x } = data.curves[k], y = data.curves[k][name];
        let path = "";
        x.forEach((v, i) => {
          if (y[i] === null) return;
          const point = `${X(v).toFixed(1)} ${Y(clip(y[i])).toFixed(1)}`;
          if (line) path += (path ? "L" : "M") + point;
          else path += `M${point}h.01`;
        });
        make("path", { d: path, class: line ? "line" : "dots" }, "", group);
      }
    }
    return svg;
  }

  function range(places, names) {
    const all = places.flatMap((k) => names.flatMap((n) => data.curves[k][n])).filter((v) => v !== null);
    const low = Math.min(...all), high = Math.max(...all), margin = 0.04 * (high - low || 1);
    return [low - margin, high + margin];
  }

  function show(lane) {
    marked.forEach((elements) => elements.splice(0));
    const box = document.getElementById("explorer-lane");
    box.replaceChildren();
    const places = data.curves.flatMap((c, k) => (c.lane === lane ? [k] : []));
    const x = range(places, ["x"]), size = data.scale;
    const pictures = make("div", { class: "pictures" }, "", box);
    pictures.append(
      picture(places, [data.along, "force [N]"], [["measured", false], ["fitted", true]],
        [...x, ...range(places, ["measured", "fitted"])]),
      picture(places, [data.along, "residual [std. dev.]"], [["residual", false]], [...x, -size, size]),
    );
    const table = make("table", {}, "", make("div", { class: "wide" }, "", box));
    const names = data.unknowns[lane].map((u) => u.label);
    const head = make("tr", {}, "", make("thead", {}, "", table));
    for (const word of ["left out", "curve", ...names, "Cook"]) make("th", {}, word, head);
    const body = make("tbody", {}, "", table);
    for (const k of places) {
      const curve = data.curves[k], row = belongs(make("tr", {}, "", body), k);
      const tick = make("input", { type: "checkbox", "aria-label": `leave out ${curve.label}` },
        "", make("td", {}, "", row));
      tick.checked = out.has(k);
      make("td", {}, curve.label, row);
      data.unknowns[lane].forEach((u, i) => {
        const move = curve.moves[i];
        make("td", {}, move === null ? curve.reasons[i] : round(move, 2), row);
      });
      make("td", {}, curve.cook === null ? "–" : round(curve.cook, 2), row);
      row.addEventListener("click", () => toggle(k));
      for (const element of marked[k]) element.classList.toggle("out", out.has(k));
    }
    for (const row of document.querySelectorAll("main table tr")) { // the tables of the report
      if (root.contains(row)) continue;
      const cells = [...row.cells].slice(0, 2).map((cell) => cell.textContent);
      const k = places.find((p) => data.curves[p].cells.every((text, i) => text === cells[i]));
      if (k !== undefined) belongs(row, k);
    }
    tell();
  }

  // Estimates without the curves that are left out, to first order.
  function tell() {
    const lane = Number(document.getElementById("explorer-choice").value);
    const gone = [...out].filter((k) => data.curves[k].lane === lane);
    const box = document.getElementById("explorer-estimates");
    box.replaceChildren();
    const head = make("tr", {}, "", make("thead", {}, "", box));
    for (const word of ["parameter", "all curves", "without", "change [std. errors]"]) make("th", {}, word, head);
    const body = make("tbody", {}, "", box);
    data.unknowns[lane].forEach((u, i) => {
      const moves = gone.map((k) => data.curves[k].moves[i]);
      const lost = moves.includes(null), move = lost ? null : moves.reduce((a, b) => a + b, 0);
      const value = lost ? null : u.log ? u.value * Math.exp(move * u.se) : u.value + move * u.se;
      const row = make("tr", { "data-unknown": u.label }, "", body);
      const reason = lost ? data.curves[gone[moves.indexOf(null)]].reasons[i] : "";
      for (const text of [`${u.label} [${u.unit}]`, round(u.value, 4),
        lost ? reason : round(value, 4), lost ? "–" : (move > 0 ? "+" : "") + round(move, 2)]) {
        make("td", {}, text, row);
      }
      if (move !== null && Math.abs(move) >= 1) row.classList.add("moved");
    });
    for (const [k, elements] of marked.entries()) {
      for (const element of elements) {
        const tick = element.querySelector && element.querySelector("input");
        if (tick) tick.checked = out.has(k);
      }
    }
    const line = [...data.excluded, ...[...out].sort((a, b) => a - b).map((k) => data.curves[k].name)];
    document.getElementById("explorer-toml").textContent = out.size
      ? `# fit.toml, below [data]\nexclude = [${line.map((name) => JSON.stringify(name)).join(", ")}]\n\n${data.command}`
      : "Click a curve to leave it out.";
  }

  const choice = document.getElementById("explorer-choice");
  data.lanes.forEach((name, lane) => {
    if (data.curves.some((c) => c.lane === lane)) make("option", { value: lane }, name, choice);
  });
  choice.hidden = choice.options.length < 2;
  choice.addEventListener("change", () => show(Number(choice.value)));
  show(Number(choice.value));
})();
