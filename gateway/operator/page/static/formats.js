// A catalogue's words, and numbers and times as its language writes them. Reports embed this file: it asks nothing of anybody.
let words = {};
let made = {};
export let language = "en";

export function useWords(chosen, catalogue) {
  language = chosen;
  words = catalogue;
  made = {};
}

// Sentences with names in braces: those whose keys begin so, taken apart; what says most by itself comes first.
export function templates(family) {
  made[family] ??= Object.keys(words).filter((key) => key.startsWith(family)).map((key) => {
    const literals = key.slice(family.length).split(/\{\w+\}/);
    return { literals, names: [...key.matchAll(/\{(\w+)\}/g)].map((one) => one[1]), said: words[key], size: literals.join("").length };
  }).sort((a, b) => b.size - a.size);
  return made[family];
}

export function word(key, values = {}) {
  const text = words[key] ?? key;
  return text.replace(/\{(\w+)\}/g, (_, name) => values[name] ?? "");
}

// What the gate calls a rule or a course, part by part; of what the catalogue does not know the gate's own word stays.
export const named = (text) => text.split(/(: |, )/).map((part) => words[`gate.${part}`] ?? part).join("");

export function number(value, digits = 1) {
  if (value == null) return "–";
  return value.toLocaleString(language, { minimumFractionDigits: digits, maximumFractionDigits: digits, signDisplay: "negative" }).replace("-", "−");
}

// With as many digits as it needs to be told from its neighbours.
export function figure(value) {
  if (value == null) return "–";
  return value.toLocaleString(language, { maximumSignificantDigits: 3, signDisplay: "negative", useGrouping: Math.abs(value) >= 1e5 }).replace("-", "−");
}

export function time(wall_s, withDate = false) {
  const options = { hour: "2-digit", minute: "2-digit", second: "2-digit", ...(withDate ? { day: "2-digit", month: "2-digit", year: "numeric" } : {}) };
  return new Date(1000 * wall_s).toLocaleString(language === "en" ? "en-GB" : language, options);
}

export const instant = (text) => time(Date.parse(text) / 1000, true);

export function duration(seconds) {
  const whole = Math.max(0, Math.round(seconds));
  const [hours, minutes] = [Math.floor(whole / 3600), Math.floor((whole % 3600) / 60)];
  if (hours) return `${hours} h ${String(minutes).padStart(2, "0")} min`;
  return minutes ? `${minutes} min ${String(whole % 60).padStart(2, "0")} s` : `${whole} s`;
}
