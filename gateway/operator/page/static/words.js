// The page's words in the language chosen, and numbers and times as that language writes them.
import { $ } from "./dom.js";

let words = {};
export let language = "en";

export async function speak(chosen) {
  language = chosen;
  words = await (await fetch(`words/${chosen}.json`)).json();
  document.documentElement.lang = chosen;
  for (const element of document.querySelectorAll("[data-word]")) element.textContent = word(element.dataset.word);
  for (const element of document.querySelectorAll("[data-label]")) element.setAttribute("aria-label", word(element.dataset.label));
  $("language").value = chosen;
}

export function preferred() {
  const kept = localStorage.getItem("language");
  return kept ?? (navigator.language.startsWith("de") ? "de" : "en");
}

export function word(key, values = {}) {
  const text = words[key] ?? key;
  return text.replace(/\{(\w+)\}/g, (_, name) => values[name] ?? "");
}

export function number(value, digits = 1) {
  if (value == null) return "–";
  return value.toLocaleString(language, { minimumFractionDigits: digits, maximumFractionDigits: digits }).replace("-", "−");
}

// With as many digits as it needs to be told from its neighbours.
export function figure(value) {
  if (value == null) return "–";
  return value.toLocaleString(language, { maximumSignificantDigits: 3, useGrouping: Math.abs(value) >= 1e5 }).replace("-", "−");
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
