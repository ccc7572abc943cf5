// How the gateway itself fares: timing, buses, history, agents; and what is doubted of the line.
import { $, coded, english, h, replaced, svg } from "./dom.js";
import { translated } from "./sentences.js";
import { number, time, word } from "./words.js";

let painted_ms = 0;

export function paintHealth(tick, line) {
  const now_ms = performance.now(); // the line's clock may be set back
  if (now_ms - painted_ms < 900 && $("view-health").dataset.key) return;
  painted_ms = now_ms;
  const key = JSON.stringify([tick.timing, tick.loop.doubts, tick.before_more, tick.wiring_not_read, tick.proved_wall_s, tick.buses, tick.agents, tick.historian, tick.link, tick.events, document.documentElement.lang]);
  replaced($("view-health"), key, () => [h("div", { class: "stack" }, diagnoses(tick), parts(tick)), h("div", { class: "stack" }, timing(tick, line), events(tick))]);
}

function diagnoses({ loop, change, before_more, wiring_not_read, proved_wall_s }) {
  const told = (one) => h("li", { class: "attention-text" }, coded("span", one.said[document.documentElement.lang] ?? one.text));
  return h("section", { class: "panel" }, h("h2", {}, word("health.diagnoses")),
    loop.doubts.length ? h("ul", {}, loop.doubts.map((doubt) => translated("li", doubt, { class: "attention-text" }))) : h("p", {}, word("health.no-diagnoses")),
    before_more.length ? [h("h3", {}, word("health.before-more")), h("ul", {}, before_more.map(told))] : [],
    wiring_not_read && h("p", {}, word("health.wiring-not-read")),
    proved_wall_s !== null && h("p", {}, word("health.proved", { since: time(proved_wall_s, true) })),
    change && [h("h3", {}, word("health.change")), h("p", {}, word(`kind.${change.kind}`), ". ", word(`stage.${change.stage}`), change.text && [": ", translated("span", change.text)])]);
}

function timing({ timing, link }, line) {
  const spread = (name, found) => found && h("div", { class: "spread" }, h("b", {}, word(`health.${name}`)),
    svg("svg", { viewBox: "0 0 100 10", preserveAspectRatio: "none", "aria-hidden": "true" },
      svg("rect", { x: 0, y: 0, width: 100, height: 10, class: "frame" }),
      svg("rect", { x: 0, y: 0, width: Math.min(100, (100 * found.max_s) / line.period_s), height: 10, class: "before" }),
      svg("rect", { x: 0, y: 0, width: Math.min(100, (100 * found.p99_s) / line.period_s), height: 10, class: "after" })),
    h("span", {}, word("health.spread", { p50: number(1e3 * found.p50_s, 2), p99: number(1e3 * found.p99_s, 2), max: number(1e3 * found.max_s, 2) })));
  const missed = h("p", { class: timing.missed ? "attention-text" : "" }, word("health.missed", { now: timing.missed, total: timing.missed_total }));
  return h("section", { class: "panel" }, h("h2", {}, word("health.timing")), h("p", { class: "muted" }, word("health.timing-how", { period: number(1e3 * line.period_s, 0) })),
    spread("cycle", timing.cycle), spread("lateness", timing.lateness), missed,
    h("p", { class: link.dropped_frames ? "attention-text" : "" }, word("health.link", { dropped: link.dropped_frames, malformed: link.malformed })));
}

function parts({ buses, agents, historian }) {
  const bus = (one) => h("li", { class: one.absent.length ? "attention-text" : "" }, english("b", one.name), ": ",
    one.absent.length ? word("health.absent", { who: one.absent.join(", ") }) : word("health.all-there"), ". ",
    word("health.counts", { timeouts: one.timeouts, malformed: one.malformed, reconnects: one.reconnects }));
  return h("section", { class: "panel" }, h("h2", {}, word("health.buses")),
    buses.length ? h("ul", {}, buses.map(bus)) : h("p", {}, word("health.no-buses")),
    h("h3", {}, word("health.historian")), h("p", { class: historian.storing ? "" : "attention-text" }, historian.storing ? word("health.storing") : english("span", historian.text)),
    h("h3", {}, word("health.agents")), h("p", {}, agents.agents.length ? word("health.agents-there", { who: agents.agents.join(", ") }) : word("health.no-agents")));
}

function events({ events }) {
  return h("section", { class: "panel" }, h("h2", {}, word("health.events")),
    events.length ? h("ol", { class: "plain records" }, [...events].reverse().map((event) => h("li", {}, h("span", { class: "muted" }, time(event.wall_s)), " ", coded("span", event.said?.[document.documentElement.lang] ?? event.text)))) : h("p", {}, word("health.no-events")));
}
