// What the gate and the loop say, in the page's language as far as the catalogue has it. A sentence of the catalogue has
// names in braces where sentences differ. Numbers there are written as the language writes them; what the gate itself has
// put there is said in the language, too; names of the plant, and the words of people and agents, stay as they are.
import { english, h } from "./dom.js";
import { language, named, templates } from "./formats.js";

const MOST_PIECES = 20;
const OF_THE_GATE = new Set(["before", "channel", "chatter", "course", "courses", "distance", "high", "left_out", "limit", "low",
  "made_by", "metric", "output", "promised", "said", "swing", "value", "wanted", "way", "what", "where", "whose"]);
const SENTENCES = new Set(["doubts", "why"]); // of the gate, or somebody's words
const NUMBER = /^[+-]?\d+(\.\d+)?(e[+-]?\d+)?(?: \S{1,5}|%)?$/;

// What has become of a change: a person's words are no sentence of the gate.
export const translatedWhy = (tag, { stage, why }) => (stage === "rejected" ? english : translated)(tag, why);

// Marked as English where the catalogue does not have it; where it has it, the gate's own words are the tooltip.
export function translated(tag, text, attributes = {}) {
  const said = sentence(text);
  return said == null ? english(tag, text, attributes) : h(tag, { title: text, ...attributes }, said);
}

// An event or an alarm: what was found in it is said in the page's language by whoever serves the page.
export function toldOf(tag, { text, said }, attributes = {}) {
  const mine = said?.[document.documentElement.lang];
  return mine ? h(tag, { title: text, ...attributes }, mine) : translated(tag, text, attributes);
}

// One sentence, or several with semicolons between them; a sentence may have semicolons, too. Null: not in the catalogue.
export function sentence(text) {
  const pieces = text.split("; "), said = Array(pieces.length + 1).fill(null); // what is said of the pieces from each on
  if (pieces.length > MOST_PIECES) return found(text, templates("sentence."));
  said[pieces.length] = [];
  for (let from = pieces.length - 1; from >= 0; from--) {
    for (let to = from + 1; to <= pieces.length && !said[from]; to++) {
      const first = said[to] && found(pieces.slice(from, to).join("; "), templates("sentence."));
      if (first != null) said[from] = [first, ...said[to]];
    }
  }
  return said[0] && said[0].join("; ");
}

function found(text, some) {
  for (const { literals, names, said } of some) {
    const between = standing(literals, names, text);
    if (between) return said.replace(/\{(\w+)\}/g, (_, name) => within(name, between[names.indexOf(name)]));
  }
  return null;
}

// What stands between the literals, each of which is taken where it comes first; null where they are not the text's.
function standing(literals, names, text) {
  if (!text.startsWith(literals[0])) return null;
  const between = [];
  let at = literals[0].length;
  for (const [i, literal] of literals.entries()) {
    if (i === 0) continue;
    const next = i === literals.length - 1 ? text.length - literal.length : text.indexOf(literal, at + 1);
    if (next <= at || !text.startsWith(literal, next)) return null;
    const one = text.slice(at, next);
    if (one.includes("; ") && !SENTENCES.has(names[i - 1])) return null; // it may be another sentence, of which nothing is known
    between.push(one);
    at = next + literal.length;
  }
  return at === text.length ? between : null;
}

function within(name, text) {
  const pieces = text.split(", ");
  if (pieces.every((one) => NUMBER.test(one))) return pieces.map(inNumbers).join(", ");
  if (SENTENCES.has(name)) return sentence(text) ?? text;
  if (!OF_THE_GATE.has(name)) return text;
  const part = (one) => found(one, templates("part.")), known = pieces.map(part);
  if (known.every((one) => one != null)) return known.join(", ");
  return part(text) ?? sentence(text) ?? pieces.map((one, i) => known[i] ?? named(one)).join(", ");
}

const inNumbers = (text) => text.replace(".", (1.5).toLocaleString(language).charAt(1)).replace("-", "−");
