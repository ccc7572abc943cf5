// Alarms: what is wrong, why, what follows, what to do; seen, or out of the way for a while.
import { $, coded, h, replaced, setText } from "./dom.js";
import { confirmed } from "./dialog.js";
import { toldOf } from "./sentences.js";
import { time, word } from "./words.js";

const SHELF_S = 1800, ORDER = ["high", "medium", "low"];
const said = (one, part) => word(`alarm.${one.name}.${part}`);
const shelved = (one) => one.shelved_until_wall_s !== null;

export class Alarms {
  constructor(say, may) {
    Object.assign(this, { say, may });
    this.known = new Set();
    this.told = []; // what the alert says now
  }

  paint({ alarms }) {
    const rank = (one) => (shelved(one) ? 20 : 0) + (one.active ? 0 : 10) + ORDER.indexOf(one.priority);
    const sorted = [...alarms].sort((a, b) => rank(a) - rank(b) || a.since_wall_s - b.since_wall_s);
    const open = sorted.filter((one) => one.active && !shelved(one));
    const keys = open.map((one) => `${one.name} ${one.since_wall_s}`);
    if (!keys.some((key) => this.told.includes(key))) setText($("alert"), ""); // what is over is not read out to who looks around
    const fresh = open.filter((_, i) => !this.known.has(keys[i]));
    if (fresh.length) { // in one piece, the highest first: a later text cuts off an earlier one
      setText($("alert"), fresh.map((one) => `${word(`priority.${one.priority}`)}: ${said(one, "means")}.`).join(" "));
      this.told = keys.filter((key) => !this.known.has(key));
    }
    keys.forEach((key) => this.known.add(key));
    replaced($("now-alarms"), `${document.documentElement.lang} ${open.length} ${open[0]?.name}`, () =>
      open.length ? h("span", { class: `alarm-count ${open[0].priority}` }, `▲ ${open.length}`) : word("alarms.none-short"));
    replaced($("alarm-list"), JSON.stringify([sorted, document.documentElement.lang]), () =>
      sorted.length ? h("ul", { class: "plain" }, sorted.map((one) => this.item(one))) : h("p", {}, word("alarms.none")));
  }

  item(one) {
    const bad = one.active && !shelved(one);
    const state = shelved(one) ? word("alarms.shelved", { until: time(one.shelved_until_wall_s) }) : word(one.active ? "alarms.active" : "alarms.ended");
    const seen = one.acknowledged ? word("alarms.seen-by", { name: one.acknowledged_by }) : word("alarms.unseen");
    return h("li", { class: `alarm ${bad ? one.priority : "over"}` },
      h("p", {}, h("b", { class: bad ? "tag" : "tag over" }, `${bad ? "▲ " : ""}${word(`priority.${one.priority}`)}`), " ", h("b", {}, said(one, "means"))),
      toldOf("p", one),
      h("p", { class: "muted" }, `${time(one.since_wall_s, true)}, ${state}, ${seen}`, one.first_out && `, ${word("alarms.first")}`),
      h("p", {}, h("b", {}, word("alarms.action")), " ", coded("span", said(one, "action"))),
      h("details", {}, h("summary", { "data-focus": `why-${one.name}` }, word("alarms.why")),
        h("p", {}, h("b", {}, word("alarms.cause")), " ", coded("span", said(one, "cause"))),
        h("p", {}, h("b", {}, word("alarms.consequence")), " ", coded("span", said(one, "consequence")))),
      this.may("acknowledge") && h("div", { class: "buttons" },
        !one.acknowledged && h("button", { type: "button", "data-focus": `ack-${one.name}`, onclick: () => this.say({ command: "acknowledge", alarm: one.name, since_wall_s: one.since_wall_s }) }, word("alarms.acknowledge")),
        h("button", { type: "button", "data-focus": `shelve-${one.name}`, onclick: () => this.shelve(one) }, word(shelved(one) ? "alarms.unshelve" : "alarms.shelve"))));
  }

  async shelve(one) {
    if (shelved(one)) return this.say({ command: "shelve", alarm: one.name, for_s: 0, because: word("alarms.unshelve") });
    const because = await confirmed({ title: word("alarms.sure-shelve"), lines: [said(one, "means"), word("alarms.then-shelve")], yes: word("alarms.shelve"), comment: true, needed: true });
    if (because) await this.say({ command: "shelve", alarm: one.name, for_s: SHELF_S, because });
  }
}
