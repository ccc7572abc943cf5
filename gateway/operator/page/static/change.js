// A proposal, and the way to a decision on it. What is decided on is exactly what is shown, by its hash.
import { $, english, h, replaced, setText } from "./dom.js";
import { tellAsked } from "./asked.js";
import { drawCourses } from "./courses.js";
import { confirmed } from "./dialog.js";
import { beforeAfter, margins } from "./figures.js";
import { Refused, ask } from "./net.js";
import { translated, translatedWhy } from "./sentences.js";
import { duration, figure, instant, named, word } from "./words.js";

export class Change {
  constructor(say, may) {
    this.say = say;
    this.may = may;
    this.asked = 0;
    this.others = [];
  }

  // `hash`: empty for the one that waits; from then on it is that one, whatever else comes.
  async open(hash, waiting) {
    const wanted = hash || (waiting.includes(this.wanted) ? this.wanted : waiting[0]);
    if (wanted && !hash) history.replaceState(null, "", `#change/${wanted}`);
    const other = wanted !== this.wanted;
    this.wanted = wanted;
    this.others = waiting.filter((one) => wanted && !one.startsWith(wanted));
    const number = ++this.asked;
    if (!wanted) return this.empty();
    if (other) [this.shown, this.newer] = [null, null];
    this.notes();
    try {
      const shown = await ask(`api/proposals/${wanted}`);
      if (number === this.asked) this.take(shown);
    } catch (error) {
      if (!(error instanceof Refused)) throw error;
      if (number === this.asked && !this.shown) this.put(error.message, () => h("section", { class: "panel" }, h("h2", {}, word("change.title")), english("p", error.message)));
    }
  }

  // What somebody may be about to decide on never changes while they read.
  take(shown) {
    if (!this.shown?.shown || !shown.shown || shown.shown === this.shown.shown) return this.fill(shown);
    this.newer = shown;
    for (const button of $("change-body").querySelectorAll(".decide button")) button.disabled = true;
    this.notes();
  }

  notes() {
    const { newer, others } = this;
    replaced($("change-notes"), JSON.stringify([newer?.shown, others, document.documentElement.lang]), () => [
      newer && h("section", { class: "panel prompt" }, h("p", {}, word("change.newer")),
        h("button", { type: "button", class: "main", onclick: () => this.fill(newer) }, word("change.show-newer"))),
      others.map((one) => h("section", { class: "panel" }, h("p", {}, word("change.another"), " ",
        h("a", { class: "button", href: `#change/${one}`, "data-focus": `other-${one}` }, word("prompt.open"), " ", h("code", {}, one.slice(0, 12))))))]);
  }

  put(key, make) {
    this.newer = null;
    this.notes();
    replaced($("change-body"), `${document.documentElement.lang} ${key}`, make);
    for (const button of $("change-body").querySelectorAll(".decide button")) button.disabled = false;
  }

  empty() {
    this.shown = null;
    this.put("none", () => h("section", { class: "panel" }, h("h2", {}, word("change.title")), h("p", {}, word("change.none")),
      h("p", {}, h("a", { class: "button", href: "#history" }, word("view.history")))));
  }

  fill(shown) {
    // Once it is on the line it differs in nothing from what is: what it would have changed stays as it was shown.
    if (shown.stage === "waiting" || shown.stage === "received") this.differs = shown;
    else shown.difference = this.differs?.proposal_hash === shown.proposal_hash ? this.differs.difference : [];
    this.shown = shown;
    this.put(JSON.stringify(shown), () => [h("div", { class: shown.verdict?.figures.length ? "stack" : "stack wide" }, this.what(shown), this.courses(shown)), this.figures(shown), this.rules(shown), this.bar(shown)]);
    this.draw(shown);
  }

  draw(shown) {
    begun($("courses"), (place) => drawCourses(place, shown.proposal_hash, shown.verdict.figures));
    begun($("asked"), (place) => tellAsked(place, shown.proposal_hash));
  }

  what(shown) {
    const plain = shown.evidence.filter((one) => !wasAsked(one));
    const quoted = h("figure", { class: "quote" }, english("blockquote", shown.reason), h("figcaption", {}, word("change.said-by", { author: shown.author, when: instant(shown.created) })));
    return h("section", { class: "panel" },
      h("h2", {}, word(`kind.${shown.kind}`), " ", h("code", {}, shown.proposal_hash.slice(0, 12))),
      h("p", {}, word(`stage.${shown.stage}`), shown.why && [": ", translatedWhy("span", shown)]),
      shown.shown && twoPeople(shown) && h("p", {}, h("b", {}, twoPeople(shown))),
      shown.difference.length > 0 && [h("h3", {}, word("change.difference")), h("ul", {}, shown.difference.map((line) => translated("li", line)))],
      h("h3", {}, word("change.reason")), quoted,
      shown.evidence.length > 0 && [h("h3", {}, word("change.evidence")),
        plain.length > 0 && h("ul", {}, plain.map(evidence)), plain.length < shown.evidence.length && this.before(shown)],
      shown.predicted.length > 0 && [h("h3", {}, word("change.promised")), h("ul", {}, shown.predicted.map(promise))]);
  }

  figures(shown) {
    if (!shown.verdict?.figures.length) return null;
    return h("section", { class: "panel" }, h("h2", {}, word("change.figures")), h("p", { class: "muted" }, word("change.figures-how")), beforeAfter(shown.verdict.figures));
  }

  courses(shown) {
    if (shown.kind !== "gains" || !shown.verdict?.accepted) return null;
    const of = JSON.stringify([document.documentElement.lang, shown.proposal_hash, shown.verdict]);
    if (this.drawn?.of !== of) // while it is the same, it is neither drawn again nor loses the span that was chosen
      this.drawn = { of, section: h("section", { class: "panel" }, h("h2", {}, word("change.courses")), h("div", { id: "courses" }, h("p", {}, word("change.courses-drawing")))) };
    return this.drawn.section;
  }

  // While it is the same, nothing that was opened closes.
  before(shown) {
    const of = `${document.documentElement.lang} ${shown.proposal_hash}`;
    if (this.told?.of !== of) this.told = { of, place: h("div", { id: "asked" }, h("p", { class: "muted" }, word("change.asked-wait"))) };
    return this.told.place;
  }

  rules(shown) {
    if (!shown.verdict) return null;
    const { findings, reported, accepted } = shown.verdict;
    return h("section", { class: "panel wide" }, h("h2", {}, word("change.rules")),
      h("p", {}, word(accepted ? "change.accepted" : "change.refused", { rules: findings.length }), " ", word("change.rules-how")),
      margins(findings),
      reported.length > 0 && h("details", {}, h("summary", {}, word("change.reported")), margins(reported)));
  }

  bar(shown) {
    const until = h("span", { id: "expiry" });
    const decides = shown.shown && this.may("decide");
    return h("div", { class: "decide" }, shown.stage === "waiting" && until,
      shown.shown && !this.may("decide") && h("span", {}, word("change.may-not")),
      decides && h("button", { type: "button", "data-focus": "reject", onclick: () => this.decide(shown, false) }, word("change.reject")),
      decides && h("button", { type: "button", class: "main", "data-focus": "approve", onclick: () => this.decide(shown, true) }, word("change.approve")));
  }

  async decide(shown, approve) {
    const then = approve ? [twoPeople(shown), word(`change.then-${shown.kind}`, { lasts: duration(shown.lasts_s ?? 0) })] : [word("change.then-reject")];
    const answer = await confirmed({
      title: word(approve ? "change.sure-approve" : "change.sure-reject"),
      lines: [...then.filter(Boolean), ...judged(shown.verdict?.region), ...shown.difference.map((line) => ({ said: line })),
        shown.why && { said: shown.why }, word("change.hash", { hash: shown.shown.slice(0, 12) })].filter(Boolean),
      yes: word(approve ? "change.yes-approve" : "change.yes-reject"), comment: true, wide: true,
    });
    if (answer === null) return;
    location.hash = `#change/${shown.proposal_hash}`; // what becomes of it stays in sight
    await this.say({ command: "decide", proposal: shown.proposal_hash, shown: shown.shown, approve, comment: answer });
  }

  paint(now_s) {
    const element = $("expiry");
    if (!element || !this.shown) return;
    const left_s = Date.parse(this.shown.expires) / 1000 - now_s;
    setText(element, left_s > 0 ? word("change.expires", { left: duration(left_s) }) : word("change.expired"));
  }
}

// Once; again where it came to nothing.
async function begun(place, fill) {
  if (!place || place.dataset.begun) return;
  place.dataset.begun = "yes";
  if (!(await fill(place))) delete place.dataset.begun;
}

// Told apart, with what was chosen and why.
const wasAsked = (one) => /^interaction [0-9a-f]{16}$/.test(one.what) && one.value == null && !one.digest;

// Empty: one is enough.
function twoPeople(shown) {
  if (shown.approvals < 2) return "";
  return shown.approved_by ? word("change.second", { name: shown.approved_by }) : word("change.two-people");
}

// How far the gate has judged it; beyond that the line does not go with it.
function judged(region) {
  if (!region) return [];
  const upTo = (value, unit) => (value == null ? word("change.own-limit") : `${figure(value)} ${unit}`);
  const [speed, tension, step] = [upTo(region.speed_max_m_per_s, "m/s"), upTo(region.tension_step_max_n, "N"), upTo(region.speed_step_max_m_per_s, "m/s")];
  return [word("change.region", { speed, tension, step })];
}

function evidence(one) {
  const value = one.value == null ? "" : `: ${figure(one.value)} ${one.unit}`;
  return h("li", {}, english("span", one.what), value, one.digest && [" ", h("code", {}, one.digest.slice(0, 12))]);
}

function promise(one) {
  const parts = [["rmse_n", "N"], ["overshoot_pct", "%"], ["settling_s", "s"]].filter(([name]) => one[name] != null);
  return h("li", {}, h("span", {}, named(one.scenario)), ": ", parts.map(([name, unit]) => `${word(`measure.${name}`)} ${figure(one[name])} ${unit}`).join(", "));
}
