// The charts of a page of sections: those of one section with the same x share the cursor and the zoom.
(() => {
  const { data, rows, ends, text, where, colour, trace, ticks, makeGroup, makeChart, padded } = page;

  // Five significant digits, as wide for every sample of a chart as they can be.
  function significant(value) {
    if (value == null) return "–";
    const size = Math.abs(value);
    if (size >= 1e7 || (size > 0 && size < 1e-4)) return value.toExponential(3).replaceAll("-", "−");
    return text(value, size >= 1e4 ? 0 : 4 - Math.max(0, Math.floor(Math.log10(size || 1))));
  }

  // Powers of ten; where the scale has less than two of them, 2 and 5 between them too.
  const logAxis = {
    splits: (u, i, min, max) => {
      const splits = [];
      for (let k = Math.floor(Math.log10(min)); k <= Math.log10(max); k++) {
        for (const digit of max / min < 100 ? [1, 2, 5] : [1]) splits.push(Number(`${digit}e${k}`));
      }
      return splits.filter((v) => v >= min && v <= max);
    },
    filter: (u, splits) => splits,
    values: (u, splits) => splits.map((v) => String(v).replace("-", "−")),
  };

  const relative = (min, max) => padded(1e-3 * Math.max(Math.abs(min), Math.abs(max)) || 1)(min, max);
  const logRange = (min, max) => (min > 0 ? [min / 1.3, max * 1.3] : [0.1, 10]);

  function drawSection(section, entry, index) {
    const now = section.querySelector("[data-at]");
    const charts = [...section.querySelectorAll("[data-chart]")].map((host, i) => ({
      ...entry.charts[i], host, values: rows(entry.charts[i].values),
      buttons: [...host.closest("figure").querySelectorAll("[data-toggle]")],
    }));
    entry.groups.forEach((packed, g) => {
      const [x] = rows(packed);
      const mine = charts.filter((chart) => chart.group === g);
      const cells = mine.flatMap((chart) => chart.values.map((row, i) => [chart.buttons[i].lastElementChild, row]));
      const [quantity, unit = ""] = mine[0].host.dataset.x.split(", ");
      const group = makeGroup(section, `section-${index}-${g}`, ends(x), (i) => {
        const k = i ?? x.length - 1;
        now.textContent = `${where(i)}: ${quantity} ${significant(x[k])} ${unit}`;
        for (const [cell, row] of cells) cell.textContent = significant(row[k]);
      });
      for (const chart of mine) drawChart(chart, group, x);
    });
  }

  function drawChart(chart, group, x) {
    const series = chart.colours.map((c, i) => ({
      stroke: trace(c), dash: chart.dashed[i] ? [5, 4] : undefined, width: chart.dashed[i] ? 1.25 : 1.5,
      points: chart.points ? { show: true, size: 7, fill: trace(c) } : { show: false },
    }));
    const u = makeChart(chart.host, group, [x, ...chart.values], series, {
      height: 280, yRange: chart.log ? logRange : relative, y: chart.log ? { distr: 3 } : {},
      yAxis: chart.log ? logAxis : {},
      xAxis: { values: ticks(""), size: 30, label: chart.host.dataset.x, labelSize: 20, labelFont: "12px system-ui, sans-serif" },
    });
    chart.buttons.forEach((button, i) => (button.onclick = () => {
      const show = button.getAttribute("aria-pressed") !== "true";
      button.setAttribute("aria-pressed", show);
      u.setSeries(i + 1, { show });
    }));
  }

  document.querySelectorAll("[data-section]").forEach((section, i) => drawSection(section, data.sections[i], i));
})();
