// The charts of a run: its cases, and the timing of the cycles.
(() => {
  const { data, rows, ends, text, where, colour, trace, decades, makeGroup, makeChart, padded } = page;

  // --- a case ---------------------------------------------------------------------------------------------------

  const digits = { tension_n: 2, setpoint_n: 2, torque_nm: 2, speed_m_per_s: 4 };

  function drawCase(section, entry, index) {
    const [time] = rows(entry.time_s);
    const [unwind] = rows(entry.unwind_speed_m_per_s);
    const values = Object.fromEntries(Object.keys(digits).map((key) => [key, rows(entry[key])]));
    const spans = values.tension_n.map((_, i) => i);
    const cells = [...section.querySelectorAll("[data-value]")];
    const now = section.querySelector("[data-at]");
    const group = makeGroup(section, "case-" + index, ends(time), (i) => {
      const k = i ?? time.length - 1;
      now.textContent = `${where(i)}: t = ${text(time[k], 3)} s, v0 = ${text(unwind[k], 4)} m/s`;
      for (const cell of cells) {
        const { value, span } = cell.dataset;
        cell.textContent = text(values[value][span][k], digits[value]);
      }
    });
    const chart = (name, columns, series, options) =>
      makeChart(section.querySelector(`[data-chart="${name}"]`), group, [time, ...columns], series, options);
    const solid = (i) => ({ stroke: trace(i), span: i });
    const dashed = (i) => ({ stroke: trace(i), span: i, width: 1.25, dash: [5, 4] });

    const [low, high] = entry.tension_band_n;
    const band = [{ value: low, label: `lower limit ${low} N` }, { value: high, label: `upper limit ${high} N` }];
    const limit = entry.torque_limit_nm;
    const bounds = [{ value: limit, label: `limit ${limit} Nm` }, { value: -limit, label: `limit −${limit} Nm` }];
    // A limit far from the data would flatten it; nearer than that, it is in view.
    const withBounds = (min, max) =>
      padded(1)(min < -0.4 * limit ? Math.min(min, -limit) : min, max > 0.4 * limit ? Math.max(max, limit) : max);

    const { tension_n: tension, setpoint_n: setpoint, torque_nm: torque, speed_m_per_s: speed } = values;
    const together = [
      chart("tension", [...tension, ...setpoint], [...spans.map(solid), ...spans.map(dashed)],
        { height: 320, yRange: padded(2), limits: band }),
      chart("torque", torque, spans.map(solid), { height: 260, yRange: withBounds, limits: bounds }),
      chart("speed", [...speed, unwind], [...spans.map(solid), { stroke: () => colour("ink"), dash: [2, 3] }],
        { height: 220, yRange: padded(0.001) }),
    ];
    for (const i of spans) {
      const options = { height: 160, yRange: padded(1), limits: band };
      chart("span-" + i, [tension[i], setpoint[i]], [solid(i), dashed(i)], options);
    }

    const buttons = [...section.querySelectorAll("[data-toggle]")];
    const toggle = (button, show) => {
      button.setAttribute("aria-pressed", show);
      const span = Number(button.dataset.toggle);
      for (const u of together) u.series.forEach((s, j) => s.span === span && u.setSeries(j, { show }));
    };
    for (const button of buttons) button.onclick = () => toggle(button, button.getAttribute("aria-pressed") !== "true");
    section.querySelector("[data-all]").onclick = () => buttons.forEach((button) => toggle(button, true));
  }

  // --- cycle timing ---------------------------------------------------------------------------------------------

  function drawTiming(section, timing) {
    const [time] = rows(timing.time_s);
    const envelopes = { lateness: rows(timing.lateness_us), cycle: rows(timing.cycle_us) };
    const host = (name) => section.querySelector(`[data-chart="${name}"]`);
    const cells = [...section.querySelectorAll("[data-value]")];
    const now = section.querySelector("[data-at]");
    const group = makeGroup(section, "timing", ends(time), (i) => {
      const k = i ?? time.length - 1;
      now.textContent = `${where(i)}: t = ${text(time[k], 2)} s`;
      for (const cell of cells) cell.textContent = text(envelopes[cell.dataset.value][cell.dataset.row][k], 0);
    });
    const floor = (values) => values.map((v) => (v == null ? null : Math.max(v, 1))); // a log scale has no zero
    const limits = [{ value: timing.period_us, label: `period ${timing.period_us} µs` }];
    const yRange = (min, max) => [10 ** Math.floor(Math.log10(min || 1)), Math.max(max, timing.period_us) * 1.8];
    Object.keys(envelopes).forEach((name, i) => {
      const [min, median, max] = envelopes[name].map(floor);
      const edge = { stroke: trace(i), width: 0.5 };
      makeChart(host(name), group, [time, max, min, median], [edge, edge, { stroke: trace(i) }], {
        height: 200, yRange, limits, points: false, y: { distr: 3 }, yAxis: decades(""),
        bands: [{ series: [1, 2], fill: () => trace(i)() + "40" }],
      });
    });

    const edges = timing.edges_us;
    const middles = edges.slice(1).map((edge, i) => Math.sqrt(edge * edges[i]));
    const counts = [timing.lateness_count, timing.cycle_count];
    const words = section.querySelector("[data-bin]");
    const hint = words.textContent;
    const bins = makeGroup(document.createElement("div"), "histogram", ends(edges), (i) => {
      words.textContent = i == null ? hint : `${text(edges[i], 0)} to ${text(edges[i + 1], 0)} µs: `
        + `${counts[0][i]} cycles by lateness, ${counts[1][i]} by cycle time.`;
    });
    const bars = (i) => ({
      stroke: trace(i), fill: () => trace(i)() + "66", width: 1, fillTo: () => 0.5, paths: uPlot.paths.bars({ size: [1, 100] }),
    });
    makeChart(host("histogram"), bins, [middles, ...counts.map((row) => row.map((c) => c || null))], [bars(0), bars(1)], {
      height: 240, yRange: (_, max) => [0.5, max * 1.8], points: false, y: { distr: 3 }, yAxis: decades(""),
      x: { distr: 3, range: (_, min, max) => (min === middles[0] ? ends(edges) : [min, max]) }, xAxis: decades(" µs"),
    });
  }

  document.querySelectorAll("[data-case]").forEach((section, i) => drawCase(section, data.cases[i], i));
  const timing = document.querySelector("[data-timing]");
  if (timing) drawTiming(timing, data.timing);
})();
