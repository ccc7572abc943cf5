// The line as a picture: the web over its rollers, and under each span its tension as a bar between the limits.
import { $, h, setText, svg } from "./dom.js";
import { number, word } from "./words.js";

const LEAST = 104, MOST = 190, LEAD = 64, TALL = 334, R = 21, BAR = { top: 158, bottom: 268, wide: 42 };

export class Picture {
  constructor(line) {
    this.line = line;
    this.cells = [];
    new ResizeObserver(() => this.build()).observe($("picture"));
    this.build();
    this.table();
  }

  build() {
    const { n } = this.line, width = Math.floor($("picture").clientWidth);
    if (!width || width === this.width) return;
    this.width = width;
    const columns = Math.max(1, Math.min(n, Math.floor((width - LEAD) / LEAST)));
    const cell = Math.min(MOST, Math.floor((width - LEAD) / columns));
    this.cells = [];
    const rows = [];
    for (let first = 0; first < n; first += columns) rows.push(this.row(first, Math.min(n, first + columns), cell));
    $("picture").replaceChildren(...rows);
    if (this.last) this.paint(this.last);
  }

  row(first, end, cell) {
    const wide = LEAD + (end - first) * cell;
    const root = svg("svg", { width: wide, height: TALL, viewBox: `0 0 ${wide} ${TALL}`, role: "img",
      "aria-label": word("picture.label", { first: first + 1, last: end }) });
    const exit = (i) => (i % 2 === 0 ? 50 - R : 74 + R); // over the odd rollers, under the even ones
    const points = [first === 0 ? [34, 32] : [0, exit(first - 1)]];
    const rollers = [];
    if (first === 0) rollers.push(svg("circle", { cx: 34, cy: 62, r: 30, class: "unwinder" }), svg("circle", { cx: 34, cy: 62, r: 5, class: "hub" }));
    for (let i = first; i < end; i++) {
      const x = LEAD + (i - first) * cell, cx = x + cell - R - 4, cy = i % 2 === 0 ? 50 : 74;
      points.push([cx - 6, exit(i)], [cx + 6, exit(i)]);
      rollers.push(svg("circle", { cx, cy, r: R, class: "roller" }), svg("text", { x: cx, y: cy + 6, class: "roller-name" }, String(i + 1)));
      root.append(this.cell(i, x, cell));
    }
    if (end < this.line.n) points.push([wide, exit(end - 1)]);
    root.prepend(...rollers, svg("polyline", { points: points.map((p) => p.join()).join(" "), class: "web" }));
    const [least, most] = this.line.tension_n;
    root.append(
      svg("text", { x: LEAD - 4, y: BAR.top + 14, class: "limit" }, number(most, 0)),
      svg("text", { x: LEAD - 4, y: BAR.bottom, class: "limit" }, number(least, 0)),
      svg("text", { x: LEAD - 4, y: (BAR.top + BAR.bottom) / 2 + 5, class: "limit" }, "N"),
    );
    return root;
  }

  cell(i, x, wide) {
    const left = x + (wide - BAR.wide - 58) / 2, middle = left + BAR.wide / 2; // the set-point's number stands beside it
    const parts = {
      value: svg("text", { x: middle, y: 140, class: "tension" }),
      fill: svg("rect", { x: left, width: BAR.wide, y: BAR.bottom, height: 0, class: "fill" }),
      mark: svg("path", { class: "mark" }),
      setpoint: svg("text", { x: left + BAR.wide + 13, class: "setpoint" }),
      note: svg("text", { class: "note" }, svg("tspan", { x: middle, y: BAR.bottom + 40 }), svg("tspan", { x: middle, y: BAR.bottom + 59 })),
      frame: svg("rect", { x: left, width: BAR.wide, y: BAR.top, height: BAR.bottom - BAR.top, class: "frame" }),
      left,
    };
    this.cells[i] = parts;
    const name = svg("text", { x: middle, y: BAR.bottom + 20, class: "span-name" }, fitting(this.line.spans[i].name, wide));
    return svg("g", {}, parts.frame, parts.fill, parts.mark, parts.value, parts.setpoint, parts.note, name);
  }

  paint(tick) {
    this.last = tick;
    const [least, most] = this.line.tension_n;
    const y = (value) => BAR.bottom - (BAR.bottom - BAR.top) * Math.min(1, Math.max(0, (value - least) / (most - least)));
    tick.spans.forEach(([tension, setpoint, , , bad, why], i) => {
      const parts = this.cells[i];
      if (!parts) return;
      setText(parts.value, number(tension));
      const [, first, rest] = why ? /^(\S+) ?(.*)$/.exec(word(why)) : ["", "", ""];
      setText(parts.note.firstChild, bad ? `▲ ${first}` : first);
      setText(parts.note.lastChild, rest);
      for (const name of ["value", "fill", "note", "frame"]) parts[name].setAttribute("data-bad", bad);
      const top = tension == null ? BAR.bottom : y(tension);
      parts.fill.setAttribute("y", top);
      parts.fill.setAttribute("height", BAR.bottom - top);
      const at = setpoint == null ? null : y(setpoint), right = parts.left + BAR.wide;
      parts.mark.setAttribute("d", at == null ? "" : `M${parts.left - 4} ${at}H${right + 4}M${right + 4} ${at}l7 -5v10z`);
      parts.setpoint.setAttribute("y", (at ?? 0) + 5);
      setText(parts.setpoint, setpoint == null ? "" : number(setpoint));
    });
    if ($("span-table").offsetParent) this.fill(tick);
  }

  table() {
    const names = ["span", "tension", "setpoint", "speed", "torque", "condition"];
    this.values = this.line.spans.map(() => names.slice(1).map(() => h("td")));
    $("span-table").replaceChildren(
      h("thead", {}, h("tr", {}, names.map((name) => h("th", { scope: "col" }, word(`table.${name}`))))),
      h("tbody", {}, this.line.spans.map((span, i) => h("tr", {}, h("th", { scope: "row" }, `${i + 1} ${span.name}`), this.values[i]))),
    );
  }

  fill(tick) {
    const now_ms = performance.now(); // the line's clock may be set back
    if (now_ms - (this.filled_ms ?? -Infinity) < 900) return;
    this.filled_ms = now_ms;
    tick.spans.forEach(([tension, setpoint, speed, torque, bad, why], i) => {
      const texts = [number(tension), number(setpoint), number(speed, 3), number(torque), why ? `${bad && "▲ "}${word(why)}` : word("span.well")];
      texts.forEach((text, k) => setText(this.values[i][k], text));
    });
  }
}

function fitting(name, wide) {
  const most = Math.floor(wide / 9);
  return name.length > most ? `${name.slice(0, most - 1)}…` : name;
}
