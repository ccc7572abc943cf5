// What the gate has simulated of a proposal, over time: now and proposed, one over the other.
import { english, h } from "./dom.js";
import { answered } from "./net.js";
import { figure, named, number, word } from "./words.js";

const TALL = 200;

// Fills `place` once they are there, or with the reason why there are none. `figures`: those of the verdict. False: it
// is to be begun again, once `place` is shown again or the reason may have gone.
export async function drawCourses(place, hash, figures) {
  const told = await answered(place, `api/courses/${hash}`, ({ drawing }) => !drawing);
  if (!told) return false;
  told.courses.length ? new Drawing(place, told, figures) : place.replaceChildren(h("p", {}, word("change.courses-none")));
  return true;
}

class Drawing {
  constructor(place, { courses, model }, figures) {
    this.courses = courses;
    this.figures = figures;
    const spans = courses[0].setpoint_n.map((_, i) => h("option", { value: i }, String(i + 1)));
    this.span = h("select", { "data-focus": "course-span", onchange: () => this.draw() }, spans);
    this.span.value = this.mostMoved();
    this.places = courses.map(() => h("div", { class: "course", role: "img" }));
    place.replaceChildren(
      h("div", { class: "row" }, h("p", { class: "muted" }, word("change.courses-how"), " ", word(model ? "change.courses-model" : "change.courses-file")), h("label", { class: "of-span" }, h("span", {}, word("table.span")), " ", this.span)),
      h("div", { class: "scenarios" }, courses.map((course, k) => h("figure", {}, h("figcaption", {}, h("b", {}, named(course.scenario)), ", N"), this.places[k]))));
    this.plots = [];
    new ResizeObserver(() => this.draw()).observe(place);
  }

  // The span on which most can be seen.
  mostMoved() {
    const off = this.courses[0].setpoint_n.map((_, i) => Math.max(...this.courses.map((course) => furthest(course, i))));
    return off.indexOf(Math.max(...off));
  }

  // What is to be seen, for whoever does not see it: the verdict's own figures, of all spans.
  label({ scenario }, i) {
    const name = named(scenario);
    const of = (whose) => this.figures.find((one) => one.scenario === scenario && one.configuration === whose);
    const told = ({ rmse_n }) => (rmse_n == null ? word("measure.away") : `${figure(rmse_n)} N`);
    const [now, proposed] = [of("in service"), of("proposed")];
    if (!now || !proposed) return `${name}, ${word("table.span")} ${i + 1}`;
    return word("change.courses-label", { scenario: name, span: i + 1, now: told(now), proposed: told(proposed) });
  }

  draw() {
    const i = Number(this.span.value), style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(`--${name}`).trim();
    for (const plot of this.plots) plot.destroy();
    this.plots = this.courses.map((course, k) => {
      const place = this.places[k];
      place.setAttribute("aria-label", this.label(course, i));
      const data = [course.time_s, course.setpoint_n[i], course.tension_n["in service"][i], course.tension_n.proposed[i]];
      return new uPlot(options(Math.floor(place.clientWidth), colour), data, place);
    });
  }
}

function options(width, colour) {
  const axis = { stroke: colour("ink"), font: "16px system-ui, sans-serif", grid: { stroke: colour("grid"), width: 1 }, ticks: { show: false } };
  const line = (stroke, wide, dash) => ({ stroke, width: wide, dash, points: { show: false } });
  return {
    width, height: TALL, legend: { show: false }, cursor: { show: false }, padding: [10, 14, 0, 0],
    scales: { x: { time: false }, y: { range: (_, min, max) => [min - 1, max + 1] } },
    axes: [{ ...axis, size: 34, space: 70, incrs: [0.5, 1, 2, 5], values: (_, list) => list.map((t) => `${number(t, 1)} s`) },
      { ...axis, size: 56, incrs: [0.5, 1, 2, 5, 10, 20], values: (_, list) => list.map((value) => number(value, list.every(Number.isInteger) ? 0 : 1)) }],
    series: [{}, line(colour("muted"), 1.5, [6, 5]), line(colour("before"), 5), line(colour("ink"), 2)],
  };
}

// How far a span comes from its set-point with what is in service, N.
function furthest(course, i) {
  return Math.max(...course.tension_n["in service"][i].map((value, k) => (value == null ? Infinity : Math.abs(value - course.setpoint_n[i][k]))));
}
