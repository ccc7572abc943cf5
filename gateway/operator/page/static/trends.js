// Ten minutes of tensions and of the line's speed, with marks where the controller became another one.
import { $, english, h, replaced } from "./dom.js";
import { Refused, ask } from "./net.js";
import { number, time, word } from "./words.js";

const LONG_S = 600, EVERY_MS = 500, MARKS = { deployed: "D", "rolled-back": "R" };

export class Trends {
  constructor(line) {
    this.line = line;
    this.times = [];
    this.tension = line.spans.map(() => []);
    this.setpoint = line.spans.map(() => []);
    this.speed = [];
    this.marks = [];
    const names = [["all", word("trend.all")], ...line.spans.map((span, i) => [String(i), `${i + 1} ${span.name}`]), ["speed", word("trend.speed")]];
    const chosen = $("trend-of").value || (line.n <= 12 ? "all" : "0");
    $("trend-of").replaceChildren(...names.map(([value, text]) => h("option", { value }, text)));
    $("trend-of").value = chosen;
    $("trend-of").onchange = () => this.draw(true);
    new ResizeObserver(() => this.draw(true)).observe($("trend"));
  }

  async load(now_s) {
    const asked = new URLSearchParams({ from_wall_s: now_s - LONG_S, to_wall_s: now_s, points: 600 });
    try {
      const past = await ask(`api/tensions?${asked}`);
      const first = this.times[0] ?? Infinity, kept = past.wall_s.filter((t) => t < first).length;
      this.times.unshift(...past.wall_s.slice(0, kept));
      this.speed.unshift(...past.speed_m_per_s.slice(0, kept));
      this.tension.forEach((list, i) => list.unshift(...past.tension_n[i].slice(0, kept)));
      this.setpoint.forEach((list, i) => list.unshift(...past.setpoint_n[i].slice(0, kept)));
      this.draw();
    } catch (error) {
      if (!(error instanceof Refused)) throw error; // without a past the trend begins now
    }
  }

  told(records) {
    this.marks = records.filter((record) => MARKS[record.kind]).slice(-20);
    replaced($("markers"), JSON.stringify([this.marks, document.documentElement.lang]), () =>
      this.marks.slice(-3).reverse().map((mark) => h("li", {}, h("b", {}, MARKS[mark.kind]), ` ${time(mark.wall_s, true)} `, english("span", mark.text))));
    this.draw();
  }

  paint(tick) {
    const now_ms = performance.now();
    if (now_ms - (this.painted_ms ?? -Infinity) < EVERY_MS) return;
    this.painted_ms = now_ms;
    if (tick.wall_s < (this.times.at(-1) ?? 0)) { // the clock was set back: what was stored before has other times now
      for (const list of this.lists()) list.length = 0;
      this.load(tick.wall_s);
    }
    const last = this.times.at(-1) ?? 0;
    if (tick.wall_s === last) return;
    if (this.times.length && tick.wall_s - last > 5) this.push(last + 1, null); // a gap, not a line across it
    this.push(tick.wall_s, tick);
    this.draw();
  }

  lists() {
    return [this.times, this.speed, ...this.tension, ...this.setpoint];
  }

  push(wall_s, tick) {
    this.times.push(wall_s);
    this.speed.push(tick?.speed ?? null);
    this.line.spans.forEach((_, i) => {
      this.tension[i].push(tick?.spans[i][0] ?? null);
      this.setpoint[i].push(tick?.spans[i][1] ?? null);
    });
    const old = this.times.findIndex((t) => t >= wall_s - LONG_S);
    if (old > 50) for (const list of this.lists()) list.splice(0, old);
  }

  draw(anew = false) {
    const element = $("trend"), width = Math.floor(element.clientWidth), chosen = $("trend-of").value;
    if (!width || !this.times.length) return;
    const data = this.data(chosen);
    if (anew || !this.plot) {
      this.plot?.destroy();
      this.plot = new uPlot(this.options(chosen, width, data.length), data, element);
    } else this.plot.setData(data);
    element.setAttribute("aria-label", this.inWords(chosen));
  }

  data(chosen) {
    if (chosen === "all") return [this.times, ...this.tension];
    if (chosen === "speed") return [this.times, this.speed];
    return [this.times, this.tension[chosen], this.setpoint[chosen]];
  }

  inWords(chosen) {
    const list = this.data(chosen)[1].filter((value) => value != null);
    const digits = chosen === "speed" ? 3 : 1;
    const from = list.length ? number(Math.min(...list), digits) : "–", to = list.length ? number(Math.max(...list), digits) : "–";
    return word("trend.label", { of: $("trend-of").selectedOptions[0]?.textContent ?? "", from, to });
  }

  options(chosen, width, count) {
    const style = getComputedStyle(document.documentElement), colour = (name) => style.getPropertyValue(`--${name}`).trim();
    const axis = { stroke: colour("ink"), font: "16px system-ui, sans-serif", grid: { stroke: colour("grid"), width: 1 }, ticks: { show: false } };
    const series = Array.from({ length: count - 1 }, (_, i) =>
      chosen !== "all" && i === 1
        ? { stroke: colour("muted"), width: 2, dash: [8, 6], points: { show: false } }
        : { stroke: colour("trace"), width: chosen === "all" ? 1.5 : 2, points: { show: false } });
    return {
      width, height: 300, legend: { show: false }, cursor: { show: false }, padding: [12, chosen === "all" ? 34 : 12, 0, 0],
      scales: { x: { time: true, range: (_, min, max) => [Math.max(min, max - LONG_S), Math.max(max, min + 60)] },
        y: { range: (_, min, max) => around(min, max, chosen === "speed" ? 0.01 : 2) } },
      axes: [{ ...axis, space: 90, values: (_, list) => list.map((t) => time(t).slice(0, 8)) },
        { ...axis, size: 64, values: (_, list) => list.map((v) => number(v, chosen === "speed" ? 2 : 0)), label: chosen === "speed" ? "m/s" : "N", labelFont: axis.font, labelSize: 24 }],
      series: [{}, ...series],
      hooks: { draw: [(u) => this.over(u, chosen, colour)] },
    };
  }

  // [span, where its line ends], the lowest first.
  ends(u) {
    const values = this.tension.map((list, i) => [i, list.at(-1)]).filter(([, value]) => value != null);
    return values.map(([i, value]) => [i, u.valToPos(value, "y", true)]).sort((a, b) => b[1] - a[1]);
  }

  // Marks of changes, and each line's number at its end.
  over(u, chosen, colour) {
    const c = u.ctx, { left, top, width, height } = u.bbox, ratio = devicePixelRatio;
    c.save();
    [c.textAlign, c.textBaseline] = ["left", "alphabetic"]; // uPlot leaves its axes' behind
    c.font = `bold ${16 * ratio}px system-ui, sans-serif`;
    c.fillStyle = c.strokeStyle = colour("ink");
    for (const mark of this.marks) {
      const x = u.valToPos(mark.wall_s, "x", true);
      if (x < left || x > left + width) continue;
      c.setLineDash([3 * ratio, 4 * ratio]);
      c.beginPath();
      c.moveTo(x, top);
      c.lineTo(x, top + height);
      c.stroke();
      c.fillText(MARKS[mark.kind], x + 4 * ratio, top + 16 * ratio);
    }
    if (chosen === "all") {
      const x = u.valToPos(this.times.at(-1), "x", true) + 6 * ratio;
      let last = Infinity;
      for (const [i, at] of this.ends(u)) {
        last = Math.min(at, last - 15 * ratio); // one below the other, where lines meet
        c.fillText(String(i + 1), x, last + 6 * ratio);
      }
    }
    c.restore();
  }
}

function around(min, max, least) {
  if (min == null || max == null) return [0, 1];
  const more = Math.max(least, 0.1 * (max - min));
  return [min - more, max + more];
}
