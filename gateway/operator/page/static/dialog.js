// The second step of whatever takes two: what will happen, in words, and a comment. Escape is no.
import { $, h } from "./dom.js";
import { translated } from "./sentences.js";
import { word } from "./words.js";

const WITH_IT = ["stop", "stale", "reply"]; // nothing outside an open window can be touched

// Puts them into the window; what comes back puts them where they were.
function taken(place) {
  const elements = WITH_IT.map($), marks = elements.map((element) => document.createComment(element.id));
  elements.forEach((element, i) => element.replaceWith(marks[i]));
  place.append(...elements);
  return () => marks.forEach((mark, i) => mark.replaceWith(elements[i]));
}

// The comment, or null: no. Stop is no, too. `wide`: more than a few lines, each of them to be read.
export function confirmed({ title, lines = [], yes, comment = false, needed = false, wide = false }) {
  const dialog = $("ask");
  const text = h("textarea", { rows: 3, maxlength: 1000, id: "ask-comment", required: needed });
  const no = h("button", { type: "button", autofocus: true, onclick: () => dialog.close("") }, word("ask.no"));
  const always = h("div", { class: "always" });
  dialog.replaceChildren(
    always,
    h("form", { method: "dialog" },
      h("h2", { id: "ask-title" }, title),
      h("div", { class: wide ? "lines" : "", tabindex: wide && 0, role: wide && "group", "aria-labelledby": wide && "ask-title" },
        ...lines.map((line) => (line.said ? translated("p", line.said) : h("p", {}, line)))),
      comment && h("label", {}, h("span", {}, word(needed ? "ask.comment-needed" : "ask.comment")), text),
      h("div", { class: "buttons" }, no, h("button", { class: "main", value: "yes" }, yes)),
    ),
  );
  const back = taken(always), stopped = () => dialog.close("");
  $("stop").addEventListener("click", stopped);
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      $("stop").removeEventListener("click", stopped);
      back();
      resolve(dialog.returnValue === "yes" ? text.value.trim() : null);
    }, { once: true });
    dialog.returnValue = "";
    dialog.showModal();
  });
}
