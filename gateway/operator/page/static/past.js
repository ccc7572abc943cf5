// What has been proposed and what became of it, and what the audit tells.
import { $, coded, h, replaced } from "./dom.js";
import { toldOf, translatedWhy } from "./sentences.js";
import { instant, time, word } from "./words.js";

// Each part by itself: a new record leaves what has the focus among the proposals alone.
export function paintHistory(list, records) {
  const { lang } = document.documentElement;
  replaced($("history-proposals"), JSON.stringify([list, lang]), () => proposals(list));
  replaced($("history-records"), JSON.stringify([records, lang]), () => told(records));
}

function proposals(list) {
  const names = ["when", "kind", "author", "stage", "why", "epoch", "open"];
  return [h("h2", {}, word("history.title")),
    list && h("p", {}, word("history.service", { epoch: list.epoch, hash: list.in_service?.slice(0, 12) ?? "–", good: list.last_known_good?.slice(0, 12) ?? "–" })),
    !list?.proposals.length ? h("p", {}, word("history.none")) : h("div", { class: "scroll", tabindex: 0, role: "group", "aria-label": word("history.title"), "data-focus": "proposals" }, h("table", {},
      h("thead", {}, h("tr", {}, names.map((name) => h("th", { scope: "col" }, word(`history.${name}`))))),
      h("tbody", {}, list.proposals.map((one) => h("tr", {},
        h("td", {}, instant(one.created)), h("td", {}, word(`kind.${one.kind}`)), h("td", {}, one.author), h("td", {}, word(`stage.${one.stage}`)),
        translatedWhy("td", one), h("td", {}, one.epoch ?? "–"),
        h("td", {}, h("a", { class: "button", href: `#change/${one.proposal}`, "data-focus": `open-${one.proposal}`, "aria-label": `${word("history.open")} ${one.proposal.slice(0, 12)}` }, word("history.open"))))))))];
}

const toldPlain = (tag, { text }) => coded(tag, text);

function told(records) {
  return [h("h2", {}, word("history.records")),
    !records.length ? h("p", {}, word("history.no-records")) : h("ol", { class: "plain records" }, [...records].reverse().slice(0, 60).map((record) =>
      h("li", {}, h("span", { class: "muted" }, `${time(record.wall_s, true)} · ${record.who}`), (record.said?.[document.documentElement.lang] ? toldOf : toldPlain)("p", record))))];
}
