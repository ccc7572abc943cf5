// What all charts of a page have in common. Everything they show lies in the page; nothing is asked of any other place.
"use strict";
const page = (() => {
  const data = JSON.parse(document.getElementById("report-data").textContent);
  const style = getComputedStyle(document.documentElement); // live: follows light, dark and paper
  const colour = (name) => style.getPropertyValue("--" + name).trim();
  const trace = (i) => () => colour("trace-" + (i % 6));
  const charts = [];

  // An array as the page carries it, to its rows of plain numbers. NaN (not measured) becomes null: a gap.
  function rows(packed) {
    const bytes = Uint8Array.from(atob(packed.base64), (c) => c.charCodeAt(0)).buffer;
    const flat = packed.type === "f8" ? new Float64Array(bytes) : new Float32Array(bytes);
    const values = Array.from(flat, (v) => (Number.isNaN(v) ? null : v));
    const k = packed.shape[packed.shape.length - 1];
    return Array.from({ length: values.length / k }, (_, i) => values.slice(i * k, (i + 1) * k));
  }

  const ends = (list) => [list[0], list[list.length - 1]];
  const text = (value, digits) => (value == null ? "–" : value.toFixed(digits).replace("-", "−"));
  const where = (index) => (index == null ? "At the end" : "At the cursor");

  // --- groups: charts that share the cursor, the zoom and the values at the cursor ----------------------------

  // show(index) writes the values at that sample, or those at the end when index is null.
  function makeGroup(section, name, full, show) {
    const members = [];
    let shown;
    const group = { name, members };
    group.cursor = (index) => {
      if (index !== shown) show((shown = index));
    };
    group.zoom = (min, max) => {
      const least = (full[1] - full[0]) / 500;
      if (max - min < least) [min, max] = [(min + max - least) / 2, (min + max + least) / 2];
      [min, max] = [Math.max(min, full[0]), Math.min(max, full[1])];
      for (const u of members) if (u.scales.x.min !== min || u.scales.x.max !== max) u.setScale("x", { min, max });
    };
    group.zoomBy = (factor) => {
      const u = members[0];
      const { min, max } = u.scales.x;
      const centre = u.cursor.left >= 0 ? u.posToVal(u.cursor.left, "x") : (min + max) / 2;
      group.zoom(centre - (centre - min) * factor, centre + (max - centre) * factor);
    };
    group.reset = () => group.zoom(...full);
    const actions = { in: () => group.zoomBy(0.5), out: () => group.zoomBy(2), reset: group.reset };
    for (const button of section.querySelectorAll("[data-zoom]")) { // a section may hold several groups
      button.addEventListener("click", actions[button.dataset.zoom]);
    }
    group.cursor(null);
    return group;
  }

  function onKey(event, u, group) {
    const step = (event.shiftKey ? 10 : 1) * { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (step) {
      const from = u.cursor.idx ?? u.valToIdx(u.scales.x[step > 0 ? "min" : "max"]);
      const to = u.data[0][Math.min(u.data[0].length - 1, Math.max(0, from + step))];
      u.setCursor({ left: Math.min(u.over.clientWidth, Math.max(0, u.valToPos(to, "x"))), top: 0 }, true, true);
    } else if (event.key === "+" || event.key === "=") group.zoomBy(0.5);
    else if (event.key === "-") group.zoomBy(2);
    else if (event.key === "0" || event.key === "Escape") group.reset();
    else return;
    event.preventDefault();
  }

  // --- one chart ----------------------------------------------------------------------------------------------

  const steps = []; // 1, 2, 5 and their decades: ticks that read well
  for (let decade = -9; decade < 13; decade++) for (const digit of [1, 2, 5]) steps.push(Number(`${digit}e${decade}`));
  const digitsFor = (step) => Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const ticks = (unit) => (u, splits, i, space, step) => splits.map((v) => text(v, digitsFor(step)) + unit);
  const decades = (unit) => ({
    splits: (u, i, min, max) => steps.filter((v) => v >= min && v <= max && Number.isInteger(Math.log10(v))),
    filter: (u, splits) => splits,
    values: (u, splits) => splits.map((v) => (v < 1 ? "" : v + unit)),
  });
  const axis = (extra) => ({
    stroke: () => colour("muted"), font: "12px system-ui, sans-serif", incrs: steps, values: ticks(""),
    grid: { stroke: () => colour("grid"), width: 1 }, ticks: { stroke: () => colour("rule"), width: 1, size: 5 }, ...extra,
  });

  // Limits: dashed lines in the alarm colour, each with its name, where they lie in view.
  function drawLimits(u, limits) {
    const { ctx, bbox } = u;
    const px = devicePixelRatio;
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = colour("alarm");
    ctx.lineWidth = 1.5 * px;
    ctx.font = `${12 * px}px system-ui, sans-serif`;
    ctx.textAlign = "right";
    ctx.setLineDash([10 * px, 4 * px]);
    for (const { value, label } of limits) {
      if (value < u.scales.y.min || value > u.scales.y.max) continue;
      const y = Math.round(u.valToPos(value, "y", true));
      const right = bbox.left + bbox.width;
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(right, y);
      ctx.stroke();
      const above = y - bbox.top > 20 * px;
      ctx.textBaseline = above ? "bottom" : "top";
      ctx.fillText(label, right - 4 * px, y + (above ? -3 : 4) * px);
    }
    ctx.restore();
  }

  // columns: x, then one row per series. yRange(min, max) of the values in view gives the ends of the scale.
  function makeChart(host, group, columns, series, options) {
    const { height, yRange, limits = [], points = true, x = {}, y = {}, xAxis = {}, yAxis = {}, bands } = options;
    const u = new uPlot({
      width: host.clientWidth, height, bands, legend: { show: false }, padding: [8, 22, 0, 0],
      cursor: {
        y: false, drag: { x: true, y: false }, points: { show: points, size: 7 },
        // Others follow the pointer only; the zoom is passed on by value, because charts differ in width.
        sync: {
          key: group.name, setSeries: false, scales: ["x", null],
          filters: { pub: (type) => type === "mousemove" || type === "mouseleave", sub: () => true },
        },
      },
      scales: { x: { time: false, ...x }, y: { range: (_, min, max) => yRange(min ?? 0, max ?? 1), ...y } },
      axes: [axis({ size: 34, values: ticks(" s"), ...xAxis }), axis({ size: 58, ...yAxis })],
      series: [{}, ...series.map((s) => ({ width: 1.5, points: { show: false }, ...s }))],
      hooks: {
        setCursor: [(u) => group.cursor(u.cursor.idx ?? null)],
        setScale: [(u, key) => key === "x" && group.zoom(u.scales.x.min, u.scales.x.max)],
        draw: [(u) => drawLimits(u, limits)],
      },
    }, columns, host);
    host.addEventListener("keydown", (event) => onKey(event, u, group));
    new ResizeObserver(() => host.clientWidth && u.setSize({ width: host.clientWidth, height })).observe(host);
    group.members.push(u);
    charts.push(u);
    return u;
  }

  // Room around the data; a range below `least` is widened to it, so that noise does not fill a chart.
  const padded = (least) => (min, max) => {
    const pad = Math.max((max - min) * 0.06, (least - (max - min)) / 2);
    return [min - pad, max + pad];
  };

  const redraw = () => charts.forEach((u) => u.redraw());
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  const onPaper = (on) => { // paper is white, whatever the screen was
    document.documentElement.classList.toggle("paper", on);
    redraw();
  };
  addEventListener("beforeprint", () => onPaper(true));
  addEventListener("afterprint", () => onPaper(false));

  return { data, rows, ends, text, where, colour, trace, ticks, decades, makeGroup, makeChart, padded };
})();
