// What a proposal says it rests on: what agents were asked before it was made, and the notes that were looked up.
import { english, h } from "./dom.js";
import { answered } from "./net.js";
import { word } from "./words.js";

// Fills `place`, or with the reason why it cannot be told. False: it is to be begun again.
export async function tellAsked(place, hash) {
  const told = await answered(place, `api/asked/${hash}`);
  if (!told) return false;
  const { asked, notes, missing } = told;
  place.replaceChildren(...[
    asked.length > 0 && h("ul", {}, asked.map(question)),
    notes.length > 0 && [h("h3", {}, word("change.notes")), h("p", { class: "muted" }, word("change.notes-how")), h("ul", { class: "notes" }, notes.map(note))],
    missing.map((text) => english("p", text)),
  ].flat(2).filter(Boolean));
  return true;
}

function question(one) {
  const by = one.by_rules ? word("change.by-rules") : word("change.by-agent", { agent: one.agent });
  return h("li", {}, english("span", one.task), " ", english("b", one.chosen), ` (${by}) `, h("code", {}, one.interaction),
    one.instead && [h("br"), english("span", one.instead)]);
}

function note(one) {
  return h("li", {}, h("details", {},
    h("summary", { "data-focus": `note-${one.key}` }, h("span", {}, english("span", one.title), ` (${word(`tier.${one.tier}`)})`)),
    one.overruled_by.length > 0 && h("p", {}, word("change.note-overruled", { by: one.overruled_by.join(", ") })),
    one.speaks_to_a_model && h("p", {}, word("change.note-orders")),
    english("blockquote", one.passage)));
}
