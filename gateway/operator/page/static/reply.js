// What came of what was said, in the gateway's words; it stays until the next, or until it is closed.
import { $, coded, h, replaced, show } from "./dom.js";
import { Refused } from "./net.js";
import { word } from "./words.js";

// At once: a finger on Stop has to see that it was felt.
export const stopSent = () => put("status", [h("p", {}, h("b", {}, word("reply.stop-sent")))]);

// Of a session that had ended nothing was handed on; it is said where the page begins anew.
export const notDone = (what) => put("alert", [h("p", {}, h("b", {}, word(`reply.not-${what}`)))]);

// Only what was looked at and turned down is refused. Where no answer came, it may have been done all the same.
export function reply(answer, stop = false) {
  const refused = answer instanceof Refused;
  const text = refused ? answer.message : answer.text;
  const there = answer.said?.[document.documentElement.lang] ?? {}, mine = (sentence) => there[sentence] ?? sentence;
  const said = answer.status === 0 ? h("span", {}, text) : coded("span", mine(text));
  const reasons = (answer.reasons ?? []).filter((reason) => reason !== text).map(mine);
  if (refused && answer.unknown) {
    const then = stop ? word("reply.emergency") : word("reply.look-first");
    return put("alert", [h("p", {}, h("b", {}, word("reply.unknown"), " ", then), " ", said)]);
  }
  put(refused ? "alert" : "status", [
    h("p", {}, h("b", {}, word(refused ? "reply.refused" : "reply.done")), " ", said),
    reasons.length > 0 && h("ul", {}, reasons.map((reason) => coded("li", reason)))]);
}

function put(role, parts) {
  $("reply").setAttribute("role", role);
  $("reply").classList.toggle("refused", role === "alert");
  show($("reply"), true); // before its text: what is hidden is not read out
  replaced($("reply"), `${performance.now()}`, () => [...parts, h("button", { type: "button", onclick: () => show($("reply"), false) }, word("reply.close"))]);
}
