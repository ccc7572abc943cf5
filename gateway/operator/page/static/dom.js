// Elements made by hand: texts are always text, never markup.
export const $ = (id) => document.getElementById(id);

export function h(tag, attributes = {}, ...children) {
  return filled(document.createElement(tag), attributes, children);
}

export function svg(tag, attributes = {}, ...children) {
  return filled(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
}

function filled(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value != null) element.setAttribute(name, value);
  }
  element.append(...children.flat(2).filter((child) => child != null && child !== false));
  return element;
}

// What the gateway says, in its language.
export const english = (tag, text, attributes = {}) => h(tag, { lang: "en", ...attributes }, text);

// The same, with the commands in it set apart: `r2rgate status`.
export const coded = (tag, text) => h(tag, {}, text.split("`").map((part, i) => (i % 2 ? h("code", {}, part) : part)));

export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function show(element, visible) {
  if (element.hidden === visible) element.hidden = !visible;
}

// Puts other children in only where they differ: what has the focus keeps it, and a screen reader is not told twice.
export function replaced(element, key, make) {
  if (element.dataset.key === key) return;
  element.dataset.key = key;
  const focused = element.contains(document.activeElement) ? document.activeElement.dataset.focus : null;
  element.replaceChildren(...[make()].flat(2).filter((child) => child != null && child !== false));
  if (focused) element.querySelector(`[data-focus="${CSS.escape(focused)}"]`)?.focus();
}
