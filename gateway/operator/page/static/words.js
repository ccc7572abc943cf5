// The page's words in the language chosen.
import { $ } from "./dom.js";
import { useWords, word } from "./formats.js";

export * from "./formats.js";

export async function speak(chosen) {
  useWords(chosen, await (await fetch(`words/${chosen}.json`)).json());
  document.documentElement.lang = chosen;
  for (const element of document.querySelectorAll("[data-word]")) element.textContent = word(element.dataset.word);
  for (const element of document.querySelectorAll("[data-label]")) element.setAttribute("aria-label", word(element.dataset.label));
  $("language").value = chosen;
}

export function preferred() {
  const kept = localStorage.getItem("language");
  return kept ?? (navigator.language.startsWith("de") ? "de" : "en");
}
