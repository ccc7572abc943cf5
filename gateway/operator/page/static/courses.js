// What the gate has simulated of a proposal, over time: now and proposed, one over the other.
import { english, h } from "./dom.js";
import { Refused, ask } from "./net.js";
import { figure, number, word } from "./words.js";

const AGAIN_MS = 1000, TALL = 200;

// Fills `place` once they are there, or with the reason why there are none. False: it is to be begun again, once `place`
// is shown again or the reason may have gone.
export async function drawCourses(place, hash) {
  while (place.isConnected) {
    try {
      const told = await ask(`api/courses/${hash}`);
      if (!told.drawing) {
        told.courses.length ? new Drawing(place, told) : place.replaceChildren(h("p", {}, word("change.courses-none")));
        return true;
      }
    } catch (error) {
      if (!(error instanceof Refused)) throw error;
      if (!error.unknown) { // an answer; no way to the gateway is none
        place.replaceChildren(english("p", error.message));
        return false;
      }
    }
    await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
  }
  return false;
}

class Drawing {
  constructor(place, { courses, model }) {
    this.courses = courses;
    const spans = courses[0].setpoint_n.map((_, i) => h("option", { value: i }, String(i + 1)));
    this.span = h("select", { "data-focus": "course-span", onchange: () => this.draw() }, spans);
    this.span.value = this.mostMoved();
    this.places = courses.map(() => h("div", { class: "course", role: "img" }));
    place.replaceChildren(
      h("div", { class: "row" }, h("p", { class: "muted" }, word("change.courses-how"), " ", word(model ? "change.courses-model" : "change.courses-file")), h("label", { class: "of-span" }, h("span", {}, word("table.span")), " ", this.span)),
      h("div", { class: "scenarios" }, courses.map((course, k) => h("figure", {}, h("figcaption", {}, english("b", course.scenario), ", N"), this.places[k]))));
    this.plots = [];
    new ResizeObserver(() => this.draw()).observe(place);
  }

  // The span on which most can be seen.
  mostMoved() {
    const errors = this.courses[0].setpoint_n.map((_, i) => Math.max(...this.courses.map((course) => rms(course, "in service", i) ?? Infinity)));
    return errors.indexOf(Math.max(...errors));
  }

  draw() {
    const i = Number(this.span.value), style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(`--${name}`).trim();
    for (const plot of this.plots) plot.destroy();
    this.plots = this.courses.map((course, k) => {
      const place = this.places[k], of = (whose) => rms(course, whose, i);
      const told = (value) => (value == null ? word("measure.away") : `${figure(value)} N`);
      place.setAttribute("aria-label", word("change.courses-label", { scenario: course.scenario, span: i + 1, now: told(of("in service")), proposed: told(of("proposed")) }));
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

// Root mean square of the error of a span, N; null: it ran away.
function rms(course, whose, i) {
  const values = course.tension_n[whose][i];
  if (values.includes(null)) return null;
  return Math.sqrt(values.reduce((sum, value, k) => sum + (value - course.setpoint_n[i][k]) ** 2, 0) / values.length);
}
