// The second step of whatever takes two: what will happen, in words, and a comment. Escape is no.
import { $, english, h } from "./dom.js";
import { word } from "./words.js";

// The comment, or null: no.
export function confirmed({ title, lines = [], yes, comment = false, needed = false }) {
  const dialog = $("ask");
  const text = h("textarea", { rows: 3, maxlength: 1000, id: "ask-comment", required: needed });
  const no = h("button", { type: "button", autofocus: true, onclick: () => dialog.close("") }, word("ask.no"));
  dialog.replaceChildren(
    h("form", { method: "dialog" },
      h("h2", { id: "ask-title" }, title),
      ...lines.map((line) => (line.english ? english("p", line.english) : h("p", {}, line))),
      comment && h("label", {}, h("span", {}, word(needed ? "ask.comment-needed" : "ask.comment")), text),
      h("div", { class: "buttons" }, no, h("button", { class: "main", value: "yes" }, yes)),
    ),
  );
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes" ? text.value.trim() : null), { once: true });
    dialog.returnValue = "";
    dialog.showModal();
  });
}
