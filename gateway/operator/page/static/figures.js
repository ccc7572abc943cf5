// Numbers of a verdict as bars: how much of each limit is used, and what was simulated before and after. Of page and reports.
import { h, svg } from "./dom.js";
import { figure, named, number, word } from "./formats.js";
import { translated } from "./sentences.js";

export function margins(findings) {
  const order = (one) => (one.passed ? 0 : 10) + (one.used ?? -1);
  const sorted = [...findings].sort((a, b) => order(b) - order(a));
  return h("ul", { class: "plain margins" }, sorted.map(margin));
}

function margin(finding) {
  const unit = finding.unit ? ` ${finding.unit}` : "";
  const limits = finding.used == null ? null : h("span", { class: "numbers" },
    word("margin.numbers", { value: figure(finding.value) + unit, limit: figure(finding.limit) + unit, margin: figure(finding.margin) + unit }));
  return h("li", { class: finding.passed ? "" : "failed" },
    h("div", { class: "row" }, h("b", {}, named(finding.rule)), h("span", { class: finding.passed ? "" : "alarm-text" }, word(finding.passed ? "margin.passed" : "margin.failed"))),
    finding.used != null && bar(finding),
    limits,
    translated("p", finding.text, { class: "muted" }));
}

function bar({ used, passed }) {
  const wide = 400;
  return svg("svg", { class: "margin-bar", viewBox: `0 0 ${wide} 16`, preserveAspectRatio: "none", role: "img", "aria-label": word("margin.used", { percent: number(100 * used, 0) }) },
    svg("rect", { x: 0, y: 0, width: wide, height: 16, class: "frame" }),
    svg("rect", { x: 0, y: 0, width: wide * used, height: 16, class: "fill", "data-bad": passed ? "" : "alarm" }),
    svg("rect", { x: wide - 4, y: 0, width: 4, height: 16, class: "end" }));
}

const MEASURES = [["rmse_n", "N"], ["overshoot_pct", "%"], ["settling_s", "s"], ["effort_n2m2s", "N²m²s"]];

export function beforeAfter(figures) {
  const scenarios = [...new Set(figures.map((one) => one.scenario))];
  return h("div", { class: "scenarios" }, scenarios.map((scenario) => {
    const of = Object.fromEntries(figures.filter((one) => one.scenario === scenario).map((one) => [one.configuration, one]));
    return h("figure", {}, h("figcaption", {}, h("b", {}, named(scenario))), MEASURES.map(([name, unit]) => compared(name, unit, of)));
  }));
}

function compared(name, unit, of) {
  const rows = Object.entries(of).map(([configuration, one]) => [configuration, one[name]]);
  const most = Math.max(1e-12, ...rows.map(([, value]) => value ?? 0));
  if (rows.every(([, value]) => value === 0)) return null;
  return h("div", { class: "compared" }, h("div", { class: "measure" }, word(`measure.${name}`)),
    rows.map(([configuration, value]) => h("div", { class: "pair" },
      h("span", {}, word(`configuration.${configuration}`)),
      value == null ? h("div", { class: "no-end", "aria-hidden": "true" }) : svg("svg", { viewBox: "0 0 100 10", preserveAspectRatio: "none", "aria-hidden": "true" },
        svg("rect", { x: 0, y: 0, width: (100 * value) / most, height: 10, class: configuration === "proposed" ? "after" : "before" })),
      value == null ? h("b", { class: "alarm-text" }, "▲ ", word(name === "settling_s" ? "measure.unsettled" : "measure.away")) : h("b", {}, `${figure(value)} ${unit}`))));
}
